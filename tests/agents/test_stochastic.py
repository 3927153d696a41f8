"""Every agent under random delays: it learns from what its actor saw, and from nothing that had not arrived."""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learners import program_of

import delayrl
from conftest import TINY, learned, quick, record, replay_of
from delayrl.cli import main as cli
from delayrl.core import replay as ring
from delayrl.core.protocol import OFFICIAL
from delayrl.core.types import Seen, Spec
from delayrl.core.views import view
from delayrl.delays import Channel, Constant, Delay, DelayLaw, as_delay
from delayrl.play.evaluation import evaluate
from delayrl.training.actor import Actor
from delayrl.training.loop import hidden_steps
from short_runs import SHRINK, assert_same_replay, killed_and_resumed, train
from strategies import CHANNELS, EPISODES

DELAYED = [name for name in TINY if name != "sac"]
UNLIKE = ("bpql", "any-age", "ad-sac", "dcac", "dida", "vdpo")  # the others sample as BPQL does
STOCHASTIC, OF_EPISODES = "uniform:1:3@raw", "1+action=episode:choice:0=0.5,2=0.5"


@functools.partial(jax.jit, static_argnames="longest")
def seen_in(replay: ring.Replay, key: jax.Array, longest: int) -> tuple[Seen, Seen, jax.Array]:
    """What `view` makes of sampled steps and of the next ones, and the steps' actions."""
    windows = ring.sample(replay, key, 256, longest, 2, jnp.int32(0))
    now, later = (jax.vmap(lambda window, k=k: view(window, k))(windows) for k in (0, 1))
    return now, later, windows.action[:, longest, 0]


@settings(max_examples=15, deadline=None)
@given(CHANNELS, st.one_of(st.integers(0, 2).map(Constant), EPISODES), st.integers(0, 99))
def test_round_trip(channel: Channel, lag: DelayLaw, seed: int) -> None:
    """What the wrapper showed is what `view` makes of the replay, now and k steps later, for every law and rule."""
    delay = Delay(channel, Channel(lag)).observed()
    longest = delay.maximum
    transitions, shown = record("delayrl/Counter-v0", delay, 90, seed)
    replay = replay_of(transitions, Spec(2, 1, longest), 200)
    now, later, actions = jax.device_get(seen_in(replay, jax.random.key(seed), longest))
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    for i, action in enumerate(actions.tolist()):
        step = by_action[action]
        known = [(now, step)]
        if step + 1 < len(shown) and not transitions[step].done:
            known.append((later, step + 1))
        for seen, number in known:
            assert int(seen.age[i]) == shown[number].age
            np.testing.assert_array_equal(seen.obs[i], shown[number].obs)
            np.testing.assert_array_equal(seen.actions[i], shown[number].actions)


@pytest.mark.parametrize(
    ("name", "delay"),
    [
        *(pytest.param(*each.values, STOCHASTIC, marks=each.marks) for each in quick(DELAYED, *UNLIKE)),
        pytest.param("bpql", OF_EPISODES, marks=pytest.mark.thorough),
    ],
)
def test_every_agent_learns_under_random_delays(name: str, delay: str) -> None:
    """Some updates on raw, unordered ages, or on another age in each episode: all finite, and the parameters move."""
    agent, observed = TINY[name], as_delay(delay).observed()
    longest = observed.maximum
    transitions, shown = record("Reacher-v5", observed, 170)
    assert {int(s.age) for s in shown} == {0, 1, 2, 3}
    program = program_of(agent, longest)
    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    before = jax.device_get(program.init(keys, 200).agent)
    *_, (learner, metrics) = learned(program, keys, [transitions], 106)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(metrics))
    after = jax.device_get(learner.agent)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after) if np.issubdtype(x.dtype, np.floating))
    assert not all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True))


@pytest.mark.parametrize(
    ("delay", "longest"),
    [("3", 3), ("uniform:0:3", 3), ("uniform:1:2+action=1", 3), ("1+reward=4", 4), ("1+action=3+reward=4", 7)],
)
def test_what_may_be_missing_is_hidden(delay: str, longest: int) -> None:
    """An overtaken observation may arrive late, and an action acts before its reward sets out."""
    parsed = as_delay(delay)
    for privileged in (False, True):
        actor = Actor(delayrl.make("Reacher-v5", parsed.observed(), rescale=True), 0, privileged)
        for t in range(60):
            assert hidden_steps(actor, parsed) == (0 if privileged else min(t % 50, longest))
            actor.step(np.zeros(2, np.float32))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "delay", ["uniform:0:2@fifo+action=1+reward=2", "episode:0:2+action=episode:0:2+reward=episode:0:3"]
)
def test_killed_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, delay: str) -> None:
    """Travel times come back with the episode: the same rows and replay as uninterrupted."""
    whole = train("random", tmp_path / "whole", delay=delay)
    assert whole.config["delay"] == delay
    assert {row["delay"] for row in whole.rows()} == {delay}

    cut = killed_and_resumed("random", tmp_path / "cut", monkeypatch, delay=delay)
    assert cut.rows() == whole.rows()
    assert_same_replay(cut, whole)


def test_rows_name_the_physics(tmp_path: Path) -> None:
    run = train("random", tmp_path / "pusher", env="delayrl/Pusher-v4", delay="paper-stochastic-5")
    row = run.rows()[0]
    assert row["delay"] == run.config["delay"] == "paper-stochastic-5"
    assert row["mujoco"] == run.config["versions"]["mujoco"]
    assert row["gymnasium"] == run.config["versions"]["gymnasium"]
    assert len(row["physics"]) == 16
    other = train("random", tmp_path / "probe", env="delayrl/Counter-v0", delay=1).rows()[0]
    assert other["physics"] is other["mujoco"] is None


def test_a_recorded_delay_needs_its_file_only_once(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("delay\n" + "\n".join(["2", "0", "3"] * 20))
    run = train(SHRINK, tmp_path / "run", delay=f"recorded:{trace}")
    trace.unlink()
    assert delayrl.load(run.path).spec.delay == 3
    assert np.isfinite(evaluate(run.path, 2)["mean_return"])
    assert len(run.rows()[0]["delay"]) < 40


@pytest.mark.parametrize("agent", quick(["bpql", "vdpo", "dida"], "bpql"))
def test_train_and_evaluate_a_delay_of_each_episode(agent: str, tmp_path: Path) -> None:
    """Each start state under the delay of its seed: the return is that under this delay alone."""
    run = train(agent, tmp_path / "run", delay="action=episode:1:3")
    assert run.config["delay"] == "0+action=episode:1:3"
    assert all(np.isfinite(row["return"]) for row in run.rows())
    returns = evaluate(run.path, 8)["returns"]
    alone = [evaluate(run.path, 8, f"action={lag}")["returns"] for lag in (1, 2, 3)]
    lags = {column.index(own) for own, *column in zip(returns, *alone, strict=True)}
    assert len(lags) > 1


def test_evaluate_any_other_delay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = train("any-age", tmp_path / "run", delay="uniform:1:3")
    returns = {d: evaluate(run.path, 2, d)["mean_return"] for d in (None, 0, "2@fifo", "2+action=1", "uniform:0:3@raw")}
    assert len(set(returns.values())) == 5
    with pytest.raises(delayrl.DelayRLError, match="up to 3"):
        evaluate(run.path, 2, "3+action=1")
    cli.main(["evaluate", str(run.path), "--sweep", "--episodes", "2", "--json"])
    results = json.loads(capsys.readouterr().out)
    assert [r["delay"] for r in results] == [0, 1, 2, 3]
    assert results[0]["mean_return"] == returns[0]
    assert (run.path / "delays.png").stat().st_size > 5000
    cli.main(["evaluate", str(run.path), "--sweep", "--episodes", "2"])
    titles, *_, last = capsys.readouterr().out.split("\n")[:-1]
    assert titles.split() == ["delay", "learned", "mean", "return", "std", "lowest", "episodes"]
    assert [last.split()[1], last.split()[4]] == ["yes", f"{min(results[-1]['returns']):.1f}"]
    with pytest.raises(SystemExit):
        cli.main(["evaluate", str(run.path), "--sweep", "--delay", "2"])


def test_official_episodes_have_their_own_travel_times() -> None:
    """One start state, as in the released code; but not one sequence of delays."""
    actor = Actor(delayrl.make("delayrl/Counter-v0", "uniform:0:4", rescale=True), 0, False, OFFICIAL)
    ages: list[list[int]] = [[]]
    for _ in range(300):
        done = actor.step(np.zeros(1, np.float32)).done
        ages[-1].append(int(actor.seen.age))
        if done:
            ages.append([])
    whole = {tuple(a) for a in ages[:-1]}
    assert len(whole) > len(ages) // 2


def test_random_action_delays_are_refused_in_training(tmp_path: Path) -> None:
    with pytest.raises(delayrl.DelayRLError, match="constant delay") as error:
        train("a-sac", tmp_path / "run", delay="1+action=uniform:0:2")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_an_action_delay_is_a_longer_observation_delay() -> None:
    """From its first action on, a plant whose actions are late is the plant whose observations are later by as much."""
    late, seen = delayrl.make("Hopper-v5", "2+action=3"), delayrl.make("Hopper-v5", 5)
    (obs, info), (other, other_info) = late.reset(seed=0), seen.reset(seed=0)
    for _ in range(3):  # zero acts until the first action arrives
        other, *_, other_info = seen.step(np.zeros(3, np.float32))
    rng = np.random.default_rng(0)
    for _ in range(12):
        np.testing.assert_array_equal(obs, other)
        np.testing.assert_array_equal(info["actions"], other_info["actions"])
        assert info["age"] == other_info["age"]
        action = rng.uniform(-1, 1, 3).astype(np.float32)
        obs, *_, info = late.step(action)
        other, *_, other_info = seen.step(action)
