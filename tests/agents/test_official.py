"""Protocol `official`: the table in docs/protocols.md, and that each habit has its effect."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import ACT, OBS, random_windows, sampled, seen

import delayrl
from conftest import TINY, TINY_SAC, record, replay_of, sample
from delayrl.agents.registry import AGENTS
from delayrl.core import networks
from delayrl.core.protocol import CORRECTED
from delayrl.core.types import Spec
from delayrl.envs.making import make
from delayrl.play.policy import spec_of
from delayrl.run.condition import resolve
from delayrl.training.actor import Actor
from short_runs import train

PAGE = Path(__file__).parents[2] / "docs" / "protocols.md"
DELAY = 3


def official(agent: str):
    return resolve(agent, "Reacher-v5", 0 if agent == "sac" else DELAY, "paper", "official", {})


def test_the_page_says_what_is_done() -> None:
    """Its line for each agent, and the one for `corrected`, are made of the registry's values."""
    text = PAGE.read_text()
    ours = [resolve(agent, "Reacher-v5", 0 if agent == "sac" else DELAY, "paper", "corrected", {}) for agent in AGENTS]
    assert all(setup.protocol == CORRECTED for setup in ours)
    setups = [("all, `corrected`", ours[0]), *((f"`{agent}`", official(agent)) for agent in AGENTS)]
    for name, setup in setups:
        agent, rules, given = name.strip("`"), setup.protocol, setup.schedule
        first = "the preset's" if rules == CORRECTED else f"{given.first_update:,}"
        unit = setup.config["hyperparameters"].get("entropy_unit", "–")
        habits = [
            rules.start_states,
            rules.time_limit,
            {"vdpo": "contest"}.get(agent, rules.opening),
            rules.evaluation_opening,
            "opening" if rules.opening_steps == "dropped" else "last" if rules.last_starts == "dropped" else "none",
            rules.capacity,
            unit if rules != CORRECTED else "the preset's",
            getattr(setup.agent, "evaluation", "mode") if agent not in ("random",) else "random",
            first if agent != "random" else "never",
        ]
        line = re.search(rf"^\| {re.escape(name)} \|(.*)\|$", text, re.M)
        assert line, agent
        assert [cell.strip(" `") for cell in line[1].split("|")] == habits, agent


def test_entropies_are_in_the_tasks_units() -> None:
    units = {agent: official(agent).config["hyperparameters"].get("entropy_unit") for agent in AGENTS}
    assert {agent for agent, unit in units.items() if unit != "task"} == {"dcac", "random"}  # which have no option
    for agent in ("sac", "vdpo", "bpql"):
        small = resolve(agent, "Pusher-v5", 3, "small", "official", {}).config["hyperparameters"]
        assert small["entropy_unit"] == "task"
        assert resolve(agent, "Pusher-v5", 3, "small", "corrected", {}).config["hyperparameters"]["entropy_unit"] == (
            "scaled"
        )


@pytest.mark.parametrize(("env", "target"), [("Pusher-v5", -11.852), ("HalfCheetah-v5", -6), ("Humanoid-v5", -1.423)])
def test_target_entropy_of_a_task(env: str, target: float) -> None:
    """-A in the task's units is -A - Σ log half range in scaled ones."""
    spec = spec_of(make(env, 0, rescale=True))
    assert spec == spec_of(make(env, 0))
    windows = random_windows(spec)
    assert replace(TINY_SAC, entropy_unit="task").target_entropy(windows) == pytest.approx(target, abs=1e-3)
    assert replace(TINY_SAC, entropy_unit="scaled").target_entropy(windows) == -spec.action_size


def windows_of(log_scale: float):
    transitions = [t._replace(reward=np.float32(0)) for t in record("Reacher-v5", 0, 60)[0]]
    return replace(sampled(transitions, Spec(OBS, ACT, 0), 32, 1), log_scale=log_scale)


def test_entropy_in_values_and_temperature() -> None:
    """With zero critics, rewards and α = 1 the target is -γ log π in the unit of entropies."""
    agent = replace(TINY_SAC, n_steps=1, actor_every=1, actor_updates=1, entropy_unit="task")
    state = agent.init(Spec(OBS, ACT, 0), jax.random.key(0))
    zero = jax.tree.map(jnp.zeros_like, state.critic)
    state = state._replace(critic=zero, target=zero)
    scales = (0.0, 2.0, -9.0)
    ends = [agent.update(state, windows_of(scale), jax.random.key(1), jnp.int32(0)) for scale in scales]
    (_, plain), (_, scaled), _ = ends
    assert float(scaled["entropy"] - plain["entropy"]) == pytest.approx(2.0, abs=1e-5)
    policy = agent.policy(state.actor, windows_of(0.0).obs[:, 1])
    _, log_prob = networks.sample(policy, jax.random.split(jax.random.key(1))[0])
    target = -0.99 * (np.asarray(log_prob) - 2.0)
    assert float(scaled["critic_loss"]) == pytest.approx(2 * (target**2).mean(), rel=1e-5)
    # Adam's first step goes by the sign of the gradient: down while the entropy is above its target
    for scale, (moved, _) in zip(scales, ends, strict=True):
        entropy = float(plain["entropy"]) + scale
        assert (float(moved.log_temperature) > 0) == (entropy < -ACT), scale


@pytest.mark.parametrize(
    ("agent", "kind", "length"),
    [
        ("bpql", "zero", DELAY),
        ("ad-sac", "agent", 0),
        pytest.param("a-sac", "random", 1, marks=pytest.mark.thorough),
        pytest.param("dida", "random", DELAY, marks=pytest.mark.thorough),
    ],
)
def test_openings(agent: str, kind: str, length: int, tmp_path: Path, monkeypatch) -> None:
    """Which actions of an episode are not the agent's: in training after the random steps, and in evaluation."""
    played: list[tuple[bool, int, np.ndarray]] = []  # in training, number of the action, action

    def act(self, state, seen, key, *, explore):
        return jnp.full(2, 0.25)

    step = delayrl.Delayed.step
    at: dict[int, int] = {}

    def spy(self, action):
        at[id(self)] = number = at.get(id(self), 0)
        if self.history:  # not where a reference is evaluated
            played.append((id(self) in training, number, np.array(action)))
        *rest, over, late, info = step(self, action)
        at[id(self)] = 0 if over or late else number + 1
        return *rest, over, late, info

    training: set[int] = set()
    start = Actor.start_episode

    def note(self, episode):
        training.add(id(self.env))
        start(self, episode)

    monkeypatch.setattr(type(AGENTS[agent].presets["small"].agent), "act", act)
    monkeypatch.setattr(type(AGENTS[agent].presets["small"].agent), "phases", lambda self: ())  # nothing is learned
    monkeypatch.setattr(delayrl.Delayed, "step", spy)
    monkeypatch.setattr(Actor, "start_episode", note)
    monkeypatch.setattr("delayrl.training.train.check_repeats", lambda setup: None)  # it plays a few steps, too
    values = {"random_steps": 50, "steps": 210, "replay_capacity": 1000}
    values |= {"hidden": [7, 7]}  # of an agent that no other test compiles
    train(agent, tmp_path / "run", protocol="official", **values)
    own = np.full(2, 0.25, np.float32)
    late = [x for x in played if x[0]][50:]
    for shown in (late, [x for x in played if not x[0]]):
        assert {number for _, number, _ in shown} >= {0, 1, 2, 3, 4}
        for _, number, action in shown:
            if number >= length:
                np.testing.assert_array_equal(action, own)
            elif kind == "zero":
                np.testing.assert_array_equal(action, 0)
            else:
                assert (action != own).all()
                assert (np.abs(action) <= 1).all()


def test_contest_of_vdpo(rng: np.random.Generator) -> None:
    """At age 0 a random action stands against the reference's, and the one with the lower Q is taken."""
    assert official("vdpo").agent.at_age_0 == "random"
    agent = replace(TINY["vdpo"], at_age_0="random")
    state = agent.init(Spec(OBS, ACT, DELAY), jax.random.key(0))
    taken, lower = [], []
    now = seen(DELAY, 0, rng)._replace(truth=jnp.asarray(rng.normal(size=OBS), jnp.float32))
    for key in jax.random.split(jax.random.key(3), 40):
        action = agent.act(state, now, key, explore=True)
        _, delayed_key, reference_key, _ = jax.random.split(key, 4)
        uniform = networks.uniform(jax.random.fold_in(delayed_key, 1), (ACT,))
        reference, _ = networks.sample(agent.reference.policy(state.reference.actor, now.truth), reference_key)
        q = [float(networks.twin(state.reference.critic, now.truth, a).min()) for a in (reference, uniform)]
        lower.append(uniform if q[1] <= q[0] else reference)
        taken.append(action)
    np.testing.assert_allclose(taken, lower, rtol=1e-5)
    old = now._replace(age=np.int32(1))
    keys = jax.random.split(jax.random.key(4), 5)
    plain = replace(agent, at_age_0="reference")
    for key in keys:
        np.testing.assert_array_equal(
            agent.act(state, old, key, explore=True), plain.act(state, old, key, explore=True)
        )


def test_what_is_learned_from() -> None:
    """BPQL's opening, and the step that a time limit ends for DC/AC, are in the replay but never drawn."""
    transitions, _ = record("delayrl/Counter-v0", DELAY, 150)
    first_action = {float(t.action[0]): t for t in transitions}
    limit = [t._replace(terminated=np.bool_(False)) for t in transitions]
    for steps, learnable, allowed in (
        (transitions, official("bpql").learnable(Spec(2, 1, DELAY)), lambda t: t.obs[0] >= DELAY),
        (limit, official("dcac").learnable(Spec(2, 1, DELAY)), lambda t: not t.done),
        (transitions, official("dcac").learnable(Spec(2, 1, DELAY)), lambda t: True),
        (transitions, official("vdpo").learnable(Spec(2, 1, DELAY)), lambda t: t.obs[0] <= t.obs[1] - 3),
    ):
        replay = replay_of(steps, Spec(2, 1, DELAY), 500, learnable)
        windows = sample(replay, jax.random.key(0), 5000, DELAY, 3, jnp.int32(0))
        drawn = set(np.asarray(windows.action[:, DELAY, 0]).tolist())
        expected = {action for action, t in first_action.items() if allowed(t)}
        unfinished = {float(t.action[0]) for t in transitions[-3:]}
        assert drawn - unfinished == expected - unfinished


def test_capacity_counts_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """VDPO's code holds 1,000,000 entries, three for each step."""
    spec = Spec(OBS, ACT, DELAY)
    assert [1_000_000 // official(agent).entries(spec) for agent in ("vdpo", "a-sac", "bpql")] == [
        333_333,
        333_333,
        1_000_000,
    ]
    monkeypatch.setattr(type(TINY["a-sac"]), "phases", lambda self: ())  # of what is stored nothing is learned
    values = {"steps": 160, "evaluate_every": 160, "replay_capacity": 90}
    values |= {"hidden": [6, 6]}  # of an agent that no other test compiles
    for protocol, rows in (("official", 30), ("corrected", 90)):
        run = train("a-sac", tmp_path / protocol, protocol=protocol, **values)
        pieces = [path.stem.split("-") for path in (run.path / "replay").iterdir()]
        assert max(int(end) for _, end in pieces) - min(int(first) for first, _ in pieces) == rows - 1, protocol


def test_the_habits_are_part_of_a_run(tmp_path: Path) -> None:
    """A run under other habits of the same name, as of an earlier version, is not gone on with."""
    run = train("random", tmp_path / "run", protocol="official", steps=150)
    assert run.config["habits"]["opening"] == "one-random"
    config = (run.path / "config.json").read_text()
    (run.path / "config.json").write_text(config.replace('"one-random"', '"zeros"'))
    with pytest.raises(delayrl.DelayRLError, match="another opening"):
        train("random", tmp_path / "run", protocol="official", steps=150)
