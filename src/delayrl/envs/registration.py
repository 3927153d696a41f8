"""The ids `delayrl/…` in Gymnasium's registry.

    import delayrl
    env = gymnasium.make("delayrl/Ant-v4")

`import delayrl` calls `watch_gymnasium`, which imports nothing itself: it registers the ids as soon as Gymnasium is
imported, whichever of the two comes first. The ids name their classes as texts, so MuJoCo is loaded by the first task.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

TASKS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "Pusher", "Reacher", "Swimmer", "Walker2d")
NOISE = 0.1  # probability of a random action in the noisy tasks (AD-SAC, ICML 2024)
PROBES = {"Coin": 50, "Walk": 50, "Counter": 1000}  # with their time limits
REGISTRY = "gymnasium.envs"
"""The module that, when it is imported, registers Gymnasium's own tasks."""


def watch_gymnasium() -> None:
    """Register our ids now if Gymnasium is imported, and else when it is. May be called again."""
    if REGISTRY in sys.modules:
        register()
    elif not any(isinstance(finder, GymnasiumWatch) for finder in sys.meta_path):
        sys.meta_path.insert(0, GymnasiumWatch())


class GymnasiumWatch:
    """A finder of modules that finds one, the way all others do, and calls `register` once it is imported."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return what the other finders say of Gymnasium's tasks, and None for every other module."""
        if name != REGISTRY:
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)  # type: ignore[arg-type]
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                register()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def register() -> None:
    """Add the papers' tasks, their noisy variants and the probes to Gymnasium's registry. May be called again.

    The ids are `delayrl/Ant-v4` … `delayrl/Walker2d-v4`, `delayrl/NoisyAnt-v4` … for the tasks of AD-SAC's paper in
    which a tenth of the actions is random, and `delayrl/Coin-v0`, `delayrl/Walk-v0`, `delayrl/Counter-v0`.

    Entry point, time limit and reward threshold of the papers' tasks are Gymnasium's own. Its `Pusher-v4` refuses
    MuJoCo 3, so our Pusher is `Pusher-v5` with v4's model file and v4's reward timing.
    """
    from gymnasium.envs import registration as gym  # `gymnasium` itself may be half imported

    def add(name: str, **options: Any) -> None:
        if name not in gym.registry:
            gym.register(name, **options)

    def wrapper(module: str, name: str, **options: Any) -> gym.WrapperSpec:
        return gym.WrapperSpec(name, f"delayrl.{module}:{name}", options)

    for name, limit in PROBES.items():
        add(f"delayrl/{name}-v0", entry_point=f"delayrl.envs.probe:{name}", max_episode_steps=limit)
    for task in TASKS:
        pusher = task == "Pusher"
        origin = gym.registry["Pusher-v5" if pusher else f"{task}-v4"]
        names = ["MuJoCo2", "RewardBeforeStep"] if pusher else ["MuJoCo2"]
        physics = [wrapper("envs.paper", name) for name in names]
        noise = wrapper("wrappers.noise", "NoisyActions", probability=NOISE)
        for name, additional in ((task, physics), (f"Noisy{task}", [*physics, noise])):
            add(
                f"delayrl/{name}-v4",
                entry_point=origin.entry_point,
                max_episode_steps=origin.max_episode_steps,
                reward_threshold=origin.reward_threshold,
                kwargs={"xml_file": "pusher.xml"} if pusher else {},
                additional_wrappers=tuple(additional),
            )
