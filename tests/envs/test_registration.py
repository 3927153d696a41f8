"""`import delayrl` is all that Gymnasium needs to know our tasks, and it stays cheap."""

import subprocess
import sys

import gymnasium
import pytest
from gymnasium.envs.registration import WrapperSpec

from delayrl.envs import paper, registration
from delayrl.envs.paper import MuJoCo2, RewardBeforeStep
from delayrl.wrappers import NoisyActions


def python(code: str) -> None:
    """Run a program in a process of its own, where nothing is imported yet."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "code",
    [
        "import delayrl; import gymnasium; NAME = 'delayrl/Walk-v0'",
        "import gymnasium; import delayrl; NAME = 'delayrl/Walk-v0'",
        "import gymnasium; NAME = 'delayrl:delayrl/Walk-v0'",
        "import delayrl; import gymnasium; NAME = 'delayrl:delayrl/Walk-v0'",
        "import delayrl; import delayrl.wrappers; import gymnasium; NAME = 'delayrl/Walk-v0'",
    ],
)
def test_gymnasium_makes_our_tasks(code: str) -> None:
    code += "\nimport sys\nassert not {'jax', 'mujoco'} & set(sys.modules)\ngymnasium.make(NAME).reset(seed=0)\n"
    code += "assert 'delayrl/Ant-v4' in gymnasium.registry and not {'jax', 'mujoco'} & set(sys.modules)\n"
    python(code + "assert not [f for f in sys.meta_path if type(f).__module__ == 'delayrl.envs.registration']")


def test_what_another_package_imports_is_found_as_before() -> None:
    """Whoever watches imports must not break those that fail."""
    code = "import sys, delayrl\nsys.modules['gymnasium'] = None\n"
    python(code + "try: import gymnasium\nexcept ImportError: pass\nelse: raise SystemExit(1)\nimport json")


def test_the_ids_name_our_classes() -> None:
    """The registry holds them as texts; a class that is renamed would break them only when a task is made."""
    assert gymnasium.spec("delayrl/NoisyPusher-v4").additional_wrappers == (
        MuJoCo2.wrapper_spec(),
        RewardBeforeStep.wrapper_spec(),
        NoisyActions.wrapper_spec(probability=0.1),
    )
    assert all(isinstance(w, WrapperSpec) for w in gymnasium.spec("delayrl/Ant-v4").additional_wrappers)
    count = len(gymnasium.registry)
    registration.watch_gymnasium()
    paper.register()  # the name that version 0.1 documents
    assert len(gymnasium.registry) == count
