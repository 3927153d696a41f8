"""The code of docs/simulators.md runs as it stands; the training with a small budget."""

import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from delayrl.batched import as_batched

PAGE = (Path(__file__).parents[2] / "docs" / "simulators.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def run(words: str, names: dict[str, Any], more: str = "", **smaller: str) -> None:
    """Run the only block of the page that contains some words, with more delay or some of its numbers replaced."""
    (code,) = [block for block in BLOCKS if words in block]
    code = code.replace('+action=1"', f'+action=1{more}"')
    for old, new in smaller.items():
        assert f"{old}=" in code
        code = re.sub(rf"\b{old}=[\d_]+", f"{old}={new}", code)
    exec(code, names)


def test_a_loop_of_your_own(capsys) -> None:
    names: dict[str, Any] = {}
    run("one_robot(key)", names)
    shown = jax.device_get(names["shown"])
    assert shown.obs.shape == (1024, 100, 2)
    assert set(np.unique(shown.age)) == {1, 2, 3, 4}, "1 to 3 steps of the observation, 1 of the action"
    assert shown.truncated[:, [49, 99]].all()
    assert not shown.terminated.any()
    late: dict[str, Any] = {}
    run("one_robot(key)", late, "+reward=2")
    delayed = jax.device_get(late["shown"])
    np.testing.assert_array_equal(delayed.obs, shown.obs)
    np.testing.assert_array_equal(delayed.reward[:, 3:49], shown.reward[:, 1:47])
    np.testing.assert_allclose(delayed.reward[:, :50].sum(1), shown.reward[:, :50].sum(1), rtol=1e-5)
    assert "longest age 4" in capsys.readouterr().out


def test_the_page_trains_as_the_example_does() -> None:
    """With the settings that learn."""
    (page,) = [block for block in BLOCKS if "train.train(" in block]
    example = (Path(__file__).parents[2] / "examples" / "ppo_brax.py").read_text()
    pendulum = example.split('"inverted_pendulum": {')[1].split("}")[0] + example.split("PPO = {")[1].split("}")[0]
    for name, value in re.findall(r'"(\w+)": ([^,\n]+)', pendulum):
        assert name == "hidden" or f"{name}={value}," in page.replace("),", ","), name


def test_ranges_of_two_kinds_of_robots() -> None:
    names: dict[str, Any] = {}
    run("kinds = ", names)
    delay = names["delay"]
    assert (delay.observation, delay.maximum) == (as_batched("2").observation, 4)
    assert (delay.action.law.law.high - delay.action.law.law.low == 1).all()


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_from_training_to_a_bundle(tmp_path: Path, monkeypatch) -> None:
    """The bundle's actions are those of the policy in the controller, for every age."""
    pytest.importorskip("brax")
    monkeypatch.setattr(jax, "device_put_replicated", None, raising=False)
    monkeypatch.delattr(jax, "device_put_replicated")  # put back at the end, whatever the page does
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    run("device_put_replicated", names)
    small = {"num_timesteps": "320", "episode_length": "10", "num_envs": "8", "batch_size": "8", "num_minibatches": "8"}
    run("train.train(", names, **small)
    run("class Robot", names)
    controller = names["controller"]
    rng = np.random.default_rng(0)
    for step in range(8):
        controller.observe(rng.normal(size=4), step)
        assert controller.act().shape == (1,)
    run("def layers_of", names)
    from delayrl.deploy import load_bundle

    policy = load_bundle("robot")
    assert policy.max_age == 5
    obs, actions = rng.normal(size=4).astype(np.float32), rng.uniform(-1, 1, (5, 1)).astype(np.float32)
    actions[3:] = 0
    vector = np.concatenate([obs, actions.ravel(), [3 / 5]]).astype(np.float32)
    np.testing.assert_allclose(policy(obs, actions, 3), names["act"](vector), atol=1e-4)
