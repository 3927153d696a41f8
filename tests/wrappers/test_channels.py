"""The wrappers equal a brute-force account of every message, for every law, rule and channel."""

import contextlib
import functools
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import Autoreset, DelayObservation, RecordEpisodeStatistics, TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st

import delayrl
from delayrl.delays import Delay, PerEpisode, as_delay
from delayrl.wrappers import AugmentedObservation, AugmentedVectorObservation, Delayed, DelayedVector
from delayrl.wrappers.transit import Fill
from strategies import DELAYS


class Journal(gym.Env):
    """Observation [t, the action that acted]; the reward of step t is 2**t, so that each sum shows its parts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))
    spec = None

    def __init__(self, length: int, truncates: bool = False):
        self.length, self.truncates, self.acted = length, truncates, []

    def reset(self, *, seed: int | None = None, options: Any = None):
        super().reset(seed=seed)
        self.acted = []
        return np.zeros(2), {}

    def step(self, action):
        self.acted.append(float(action[0]))
        t = len(self.acted)
        assert t <= self.length, "stepped after its end"
        end = t == self.length
        return np.array([t, action[0]]), 2.0 ** (t - 1), end and not self.truncates, end and self.truncates, {}


def account(delay: Delay, fill: str, length: int, truncates: bool, issued: list[float], seed: int) -> list[dict]:
    """Keep every message with its time of arrival, and work out what counts at each step."""
    random = np.random.default_rng([seed, 1])
    states = {"action": 0, "observation": 0, "reward": 0}  # of the laws
    lag = delay.action.maximum
    if isinstance(delay.action.law, PerEpisode) and delay.action.rule != "wait":
        lag, states["action"] = delay.action.law.draw(0, random)
    sent: dict[str, list[tuple[int, int]]] = {"action": [], "observation": [], "reward": []}  # (made, arrives)

    def send(name: str, made: int) -> int:
        channel = getattr(delay, name)
        if channel.rule == "wait":
            travel = channel.maximum
        else:
            travel, states[name] = channel.law.draw(states[name], random)
        arrives = made + travel
        if channel.rule == "fifo":
            arrives = max([arrives, *(a for _, a in sent[name])])
        sent[name].append((made, arrives))
        return travel

    def counts(name: str, now: int, travel: int) -> int:
        if getattr(delay, name).rule == "raw":
            return max(now - travel, -1)
        return max([made for made, arrives in sent[name] if arrives <= now], default=-1)

    truth = [np.zeros(2)]
    if fill == "first":
        sent["observation"].append((0, 0))
        shown = 0
    else:
        shown = counts("observation", 0, send("observation", 0))
    rows = [{"shown": shown, "truth": truth[0], "reward": None, "end": (False, False)}]
    applied: list[int] = [0]  # the age of the action that led to each state
    paid: set[int] = set()
    end = None
    for t, _ in enumerate(issued):
        number = t
        if delay.action.maximum:
            number = counts("action", t, send("action", t))
        age = min(t - number, delay.action.maximum)
        applied.append(age)
        if end is None:
            truth.append(np.array([t + 1.0, issued[t - age] if t >= age else 0.0]))
        else:
            truth.append(truth[-1])
        now = t + 1
        looked = counts("observation", now, send("observation", now))
        shown = looked if looked >= 0 or fill == "zeros" else 0
        over = end is None and now == length
        if not delay.reward.maximum:
            reward, finish = 2.0**t, (over and not truncates, over and truncates)
        else:
            if end is None:
                send("reward", now)
                if over and not truncates:
                    end = sent["reward"][-1][1]
            cut = over and truncates
            finish = (end == now, cut)
            due = {made for made, arrives in sent["reward"] if arrives <= now or any(finish)} - paid
            paid |= due
            reward = sum(2.0 ** (made - 1) for made in due)
        rows.append({"shown": shown, "truth": truth[-1], "reward": reward, "end": finish})
        if any(finish):
            break
    for t, row in enumerate(rows):
        row["obs"] = truth[row["shown"]] if row["shown"] >= 0 else np.zeros(2)
        row["age"] = t - max(row["shown"], 0) + lag
        row["observation_age"] = t - max(row["shown"], 0)
        first = t - row["age"]
        row["actions"] = [issued[i] if i >= 0 else 0.0 for i in range(first, t)]
        row["applied"] = applied[row["shown"]] if row["shown"] >= 0 else 0
    return rows


@settings(max_examples=400, deadline=None)
@given(DELAYS, st.sampled_from(["first", "zeros"]), st.integers(1, 25), st.booleans(), st.integers(0, 99))
def test_equals_the_account(delay: Delay, fill: str, length: int, truncates: bool, seed: int) -> None:
    """Observations, ages, histories, actions in force, rewards and the end, in two episodes."""
    env = Delayed(Journal(length, truncates), delay, fill=fill)
    issued = np.random.default_rng(seed).uniform(-1, 1, length + 20).astype(np.float32).astype(float).tolist()
    for _ in range(2):
        obs, info = env.reset(seed=seed)
        shown, rewards, ends = [(obs, info)], [None], [(False, False)]
        for action in issued:
            obs, reward, terminated, truncated, info = env.step(np.float32([action]))
            shown.append((obs, info))
            rewards.append(reward)
            ends.append((terminated, truncated))
            if terminated or truncated:
                break
        rows = account(delay, fill, length, truncates, issued, seed)
        assert len(rows) == len(shown)
        for t, (row, (obs, info)) in enumerate(zip(rows, shown, strict=True)):
            np.testing.assert_array_equal(obs, row["obs"])
            np.testing.assert_array_equal(info["truth"], row["truth"])
            assert info["age"] == row["age"]
            assert info["actions"].shape == (delay.maximum, 1)
            assert info["actions"][: row["age"], 0].tolist() == row["actions"]
            assert not info["actions"][row["age"] :].any()
            assert info["mask"].tolist() == [i < row["age"] for i in range(delay.maximum)]
            if delay.action.maximum:
                assert info["observation_age"] == row["observation_age"]
                assert info["applied"] == row["applied"]
            assert rewards[t] == row["reward"]
            assert ends[t] == row["end"]
        assert sum(r for r in rewards if r) == 2.0**length - 1  # each reward once, whatever its delay


@settings(max_examples=150, deadline=None)
@given(DELAYS, st.integers(0, 99))
def test_no_peek_and_no_travel_in_time(delay: Delay, seed: int) -> None:
    """Nothing is shown before it arrives; newest and fifo never go back in time; the history covers the age."""
    env = Delayed(Journal(60), Delay(delay.observation, delay.action))
    obs, info = env.reset(seed=seed)
    before = 0.0
    for t in range(1, 60):
        obs, _, _, _, info = env.step(np.float32([0.5]))
        assert obs[0] == t - info.get("observation_age", info["age"])
        assert 0 <= info["age"] <= delay.maximum
        if delay.observation.rule != "raw":
            assert obs[0] >= before
        before = obs[0]


@pytest.mark.parametrize("delay", [1, 4])
def test_zeros_are_gymnasiums_own_wrapper(delay: int) -> None:
    for task in ("Pendulum-v1", "Hopper-v5"):
        ours, theirs = Delayed(gym.make(task), delay, fill="zeros"), DelayObservation(gym.make(task), delay)
        ours.action_space.seed(0)
        for seed in range(3):
            np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
            done = False
            while not done:
                action = ours.action_space.sample()
                (obs, reward, terminated, truncated, _), other = ours.step(action), theirs.step(action)
                np.testing.assert_array_equal(obs, other[0])
                assert (reward, terminated, truncated) == other[1:4]
                done = terminated or truncated


def test_holding_the_first_is_the_released_code() -> None:
    """VDPO's wrapper repeats s_0 until it is Δ old, and counts min(t, Δ)."""
    env, bare = Delayed(gym.make("Hopper-v5"), 3), gym.make("Hopper-v5")
    truth = [bare.reset(seed=1)[0]]
    shown = [env.reset(seed=1)[0]]
    env.action_space.seed(0)
    for _ in range(8):
        action = env.action_space.sample()
        truth.append(bare.step(action)[0])
        obs, *_, info = env.step(action)
        shown.append(obs)
        assert info["age"] == min(len(shown) - 1, 3)
    np.testing.assert_array_equal(shown, [truth[max(t - 3, 0)] for t in range(9)])


def test_a_longer_history() -> None:
    short, long = Delayed(Journal(20), "uniform:1:3"), Delayed(Journal(20), "uniform:1:3", history=6)
    for env in (short, long):
        env.reset(seed=3)
    for _ in range(10):
        action = short.action_space.sample()
        a, b = short.step(action)[4], long.step(action)[4]
        assert a["age"] == b["age"]
        np.testing.assert_array_equal(np.pad(a["actions"], ((0, 3), (0, 0))), b["actions"])
    with pytest.raises(delayrl.DelayRLError, match="too short"):
        Delayed(Journal(20), 5, history=4)
    with pytest.raises(delayrl.DelayRLError, match="first or zeros"):
        Delayed(Journal(20), 5, fill="ones")  # type: ignore[arg-type]


def vector(mode: str | None, task: str, count: int = 3, **options: Any) -> Any:
    from gymnasium.vector import SyncVectorEnv

    keywords = {} if mode is None else {"autoreset_mode": mode}
    return SyncVectorEnv([lambda: gym.make(task, **options) for _ in range(count)], **keywords)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize(
    "delay",
    ["3", "uniform:1:4", "uniform:0:3@fifo+action=uniform:0:2", "paper-stochastic-5", "episode:0:3+action=episode:0:2"],
)
def test_vector_is_many_singles(mode: str, delay: str) -> None:
    """Number for number, through the ends of episodes, in each of Gymnasium's autoreset modes."""
    from gymnasium.vector import AutoresetMode

    env = AugmentedVectorObservation(DelayedVector(vector(AutoresetMode(mode), "Hopper-v5"), delay))
    singles = [AugmentedObservation(Delayed(gym.make("Hopper-v5"), delay)) for _ in range(3)]
    obs, infos = env.reset(seed=5)
    env.action_space.seed(2)
    now = [single.reset(seed=5 + i) for i, single in enumerate(singles)]
    ended = np.zeros(3, bool)
    ends = 0
    for _ in range(120):
        for i, (x, info) in enumerate(now):
            np.testing.assert_array_equal(obs[i], x)
            for name in ("age", "actions", "mask", "truth", *(["observation_age", "applied"] if "=" in delay else [])):
                np.testing.assert_array_equal(infos[name][i], info[name])
        assert env.observation_space.contains(obs.astype(env.observation_space.dtype))
        if mode == "Disabled" and ended.any():
            obs, infos = env.reset(options={"reset_mask": ended})
            now = [
                single.reset() if end else now[i] for i, (single, end) in enumerate(zip(singles, ended, strict=True))
            ]
            ended = np.zeros(3, bool)
            continue
        actions = env.action_space.sample()
        obs, rewards, terminated, truncated, infos = env.step(actions)
        for i, single in enumerate(singles):
            if ended[i] and mode == "NextStep":
                now[i] = single.reset()
                assert (rewards[i], terminated[i]) == (0, False)
                continue
            x, reward, end, _, info = single.step(actions[i])
            assert (reward, end) == (rewards[i], terminated[i])
            if end and mode == "SameStep":
                np.testing.assert_array_equal(infos["final_obs"][i], x)
                for name in ("age", "actions", "truth"):
                    np.testing.assert_array_equal(infos["final_info"][name][i], info[name])
                x, info = single.reset()
            now[i] = x, info
        ended = terminated | truncated
        ends += ended.sum()
    assert ends > 5


def test_vector_has_the_options_of_a_single() -> None:
    """A longer history, zeros before anything arrives, another idle action, and steps of another length."""
    options: dict[str, Any] = {"history": 6, "fill": "zeros", "idle": np.float32([0.5]), "step_seconds": 0.1}
    delay = "0.2s+action=0.1s"
    env = DelayedVector(vector(None, "Pendulum-v1"), delay, **options)
    singles = [Delayed(gym.make("Pendulum-v1"), delay, **options) for _ in range(3)]
    (obs, infos), now = env.reset(seed=5), [single.reset(seed=5 + i) for i, single in enumerate(singles)]
    assert not obs.any()
    assert env.delay == as_delay("2+action=1")
    for step in range(8):
        for i, (x, info) in enumerate(now):
            np.testing.assert_array_equal(obs[i], x)
            for name in ("age", "actions", "mask", "truth", "observation_age", "applied"):
                np.testing.assert_array_equal(infos[name][i], info[name])
        actions = np.full((3, 1), 0.1 * step, np.float32)
        obs, *_, infos = env.step(actions)
        now = [(x, info) for x, *_, info in (single.step(a) for single, a in zip(singles, actions, strict=True))]
    assert infos["actions"].shape == (3, 6, 1)


def test_vector_streams_and_refusals() -> None:
    env = DelayedVector(vector(None, "Pendulum-v1", 4), "uniform:0:5")
    env.reset(seed=1)
    ages = np.array([env.step(env.action_space.sample())[4]["age"] for _ in range(40)])
    assert len({tuple(column) for column in ages.T}) == 4
    with pytest.raises(delayrl.DelayRLError, match="all environments step together: give the whole delay inside"):
        DelayedVector(vector(None, "Pendulum-v1"), "2+reward=3")
    with pytest.raises(delayrl.DelayRLError, match="continuous"):
        DelayedVector(vector(None, "CartPole-v1"), 2)
    with pytest.raises(delayrl.DelayRLError, match="goes around"):
        AugmentedVectorObservation(vector(None, "Pendulum-v1"))  # type: ignore[arg-type]


class Tensor:
    """Stands for an array of PyTorch, which NumPy could read."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.values, dtype)


class Tensors(gym.vector.VectorWrapper):
    def reset(self, **options: Any) -> tuple:
        obs, info = self.env.reset(**options)
        return Tensor(obs), info


def test_a_vector_takes_numpy_arrays() -> None:
    env = DelayedVector(Tensors(vector(None, "Pendulum-v1")), 2)
    with pytest.raises(
        delayrl.DelayRLError, match=r"NumPy arrays, but the environments give \w+\.Tensor: convert them"
    ):
        env.reset(seed=1)
    assert "torch" not in sys.modules


def test_a_vector_asks_for_the_length_of_a_step() -> None:
    assert DelayedVector(vector(None, "Pendulum-v1"), "0.1s").delay == as_delay(2)


def test_augmented_state_of_random_actions() -> None:
    """It shows which action led to the observation; without that the delayed task would not be Markov."""
    env = AugmentedObservation(Delayed(Journal(30), "1+action=uniform:0:2"))
    env.reset(seed=0)
    ages = set()
    for _ in range(29):
        x, *_, info = env.step(env.action_space.sample())
        assert x.shape == (2 + 3 + 2,)
        assert env.observation_space.contains(x.astype(env.observation_space.dtype))
        assert x[-1] == pytest.approx(info["applied"] / 2)
        ages.add(info["applied"])
    assert ages == {0, 1, 2}


class Integers(Journal):
    observation_space = gym.spaces.Box(-100, 100, (2,), np.int64)


def test_integer_observations_do_not_truncate_actions() -> None:
    env = AugmentedObservation(Delayed(Integers(20), 2))
    env.reset(seed=0)
    for _ in range(3):
        x, *_ = env.step(np.float32([0.75]))
    assert x[2:].tolist() == [0.75, 0.75, 1.0]


def test_the_time_limit_is_not_late() -> None:
    """The episode ends at 9 and the agent would learn it at 15. The time limit of 10 ends the waiting and pays all."""
    gym.register("Journal-v0", lambda: Journal(9), max_episode_steps=10)
    env = Delayed(gym.make("Journal-v0", disable_env_checker=True), "1+reward=6")
    gym.registry.pop("Journal-v0")
    env.reset(seed=0)
    rewards, ends = [], []
    for _ in range(10):
        _, reward, terminated, truncated, _ = env.step(np.float32([0]))
        rewards.append(reward)
        ends.append((terminated, truncated))
    assert ends[-2:] == [(False, False), (True, True)]
    assert sum(rewards) == 2.0**9 - 1


def test_a_time_limit_goes_inside() -> None:
    """Around delayed rewards it would lose those on their way; inside, the same return comes as without a delay."""
    for layers in (TimeLimit, lambda env, steps: RecordEpisodeStatistics(TimeLimit(env, steps))):
        with pytest.raises(delayrl.DelayRLError, match="put TimeLimit inside Delayed"):
            AugmentedObservation(layers(Delayed(Journal(20), "2+reward=3"), 10))
    AugmentedObservation(TimeLimit(Delayed(Journal(20), "2+action=1"), 10))
    env = AugmentedObservation(Delayed(TimeLimit(Journal(20), 10), "2+reward=3"))
    env.reset(seed=0)
    outcomes = [env.step(np.float32([0]))[1:4] for _ in range(10)]
    assert outcomes[-1][1:] == (False, True)
    assert sum(reward for reward, *_ in outcomes) == 2.0**10 - 1


def test_an_environment_that_resets_itself_is_refused() -> None:
    """Its new episode would show what was still on its way in the old one."""
    for env in (Autoreset(Journal(5)), RecordEpisodeStatistics(Autoreset(Journal(5)))):
        with pytest.raises(delayrl.DelayRLError, match=r"carry .* the next episode: .* Autoreset\(Delayed\("):
            Delayed(env, 3)
    env = Autoreset(Delayed(Journal(5), 3))
    env.reset(seed=0)
    seen = [(obs[0], info["age"]) for obs, *_, info in (env.step(np.float32([0])) for _ in range(8))]
    assert seen == [(0, 1), (0, 2), (0, 3), (1, 3), (2, 3), (0, 0), (0, 1), (0, 2)]


@pytest.mark.parametrize(
    ("method", "given", "line"),
    [
        ("reset", np.zeros(2), "reset of Journal must give the observation and its info .* it gave one ndarray$"),
        ("step", (np.zeros(1), 0.0, False, {}), "step of Journal must give observation, reward, .* it gave 4 things$"),
    ],
)
def test_the_api_before_gymnasium_is_named(method: str, given: object, line: str) -> None:
    """An observation of two numbers would pass for an observation and an info."""
    task = Journal(5)
    env = Delayed(task, 1)
    env.reset(seed=0)
    setattr(task, method, lambda *_, **__: given)
    with pytest.raises(delayrl.DelayRLError, match=line):
        env.reset(seed=0) if method == "reset" else env.step(np.float32([0]))


def test_a_task_that_is_delayed_already_is_not_delayed_in_silence() -> None:
    with pytest.warns(delayrl.DelayWarning, match="DelayObservation inside Journal shows old observations already"):
        Delayed(DelayObservation(Journal(5), 1), 1)


def test_the_info_of_the_last_step_is_not_repeated() -> None:
    """The task's own `info` of the last step comes once, although the termination is still on its way."""
    env = Delayed(gym.wrappers.RecordEpisodeStatistics(Journal(5)), "1+reward=4")
    env.reset(seed=0)
    assert sum("episode" in env.step(np.float32([0]))[4] for _ in range(9)) == 1


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_belong_to_whoever_holds_them(dtype: type, delay: int) -> None:
    """Neither an environment that reuses its arrays nor an agent that writes into its own changes what is shown."""

    class Reusing(Journal):
        array = np.zeros(2, dtype)

        def reset(self, **options: Any):
            self.array[:] = super().reset(**options)[0]
            return self.array, {}

        def step(self, action):
            obs, *rest = super().step(action)
            self.array[:] = obs
            return self.array, *rest

    env = Delayed(Reusing(20), delay)
    obs, info = env.reset(seed=0)
    truths = [info["truth"]]
    for t in range(1, 9):
        obs[:] = 99
        obs, *_, info = env.step(np.float32([0.5]))
        assert obs[0] == max(t - delay, 0)
        info["actions"][:] = 99
        truths.append(info["truth"])
    assert [truth[0] for truth in truths] == [*range(9)]


@pytest.mark.parametrize("fill", ["first", "zeros"])
@pytest.mark.parametrize("delay", ["uniform:0:5", "episode:0:9"])
def test_travel_times_of_another_seed(delay: str, fill: Fill) -> None:
    one, other = (Delayed(Journal(40), delay, fill=fill) for _ in range(2))
    one.reset(seed=1)
    assert one.draw_from(7)[1]["age"] == other.reset(seed=7)[1]["age"]
    ages = [[env.step(np.float32([0]))[4]["age"] for _ in range(30)] for env in (one, other)]
    assert ages[0] == ages[1]


def test_travel_times_of_actions_of_another_seed() -> None:
    late = Delayed(Journal(40), "action=episode:0:90", history=90)
    late.reset(seed=1)
    assert late.draw_from(7)[1]["age"] == late.reset(seed=7)[1]["age"] != late.reset(seed=1)[1]["age"]


@pytest.mark.parametrize("rule", ["newest", "fifo", "raw"])
def test_a_delay_of_each_episode(rule: str) -> None:
    """One age for all of an episode once it has been reached, each as often as the law says, in every channel."""
    env = Delayed(Journal(12), f"episode:choice:1=0.25,3=0.75@{rule}+action=episode:0:2+reward=episode:0:1")
    env.reset(seed=0)
    delays = []
    for _ in range(400):
        _, info = env.reset()
        infos, rewards, done = [info], [], False
        while not done:
            _, reward, done, _, info = env.step(np.float32([0.5]))
            infos.append(info)
            rewards.append(reward)
        observed, lag, late = infos[-1]["observation_age"], infos[-1]["age"] - infos[-1]["observation_age"], rewards[0]
        delays.append((observed, lag, int(late == 0)))
        assert [i["observation_age"] for i in infos] == [min(t, observed) for t in range(len(infos))]
        assert {i["age"] - i["observation_age"] for i in infos} == {lag}
        assert env.unwrapped.acted == [0.0] * lag + [0.5] * (12 - lag)  # type: ignore[attr-defined]
        assert rewards == [0.0] * delays[-1][2] + [2.0**t for t in range(12)]
    observed, lags, late = np.array(delays).T
    assert np.mean(observed == 3) == pytest.approx(0.75, abs=0.08)
    assert np.bincount(lags) / 400 == pytest.approx([1 / 3] * 3, abs=0.08)
    assert np.mean(late) == pytest.approx(0.5, abs=0.08)
    assert len(set(delays)) == 12  # independent of each other


def test_a_late_actuator_is_a_late_sensor() -> None:
    """What training sees of a delay of the actions that differs between episodes, in the actions' own time."""
    text = "uniform:0:2+action=episode:1:3"
    seen = Delayed(Journal(30), as_delay(text).observed())
    real, lags = Delayed(Journal(30), text), set()
    for seed in range(20):
        seen.reset(seed=seed)
        _, info = real.reset(seed=seed)
        lag = info["age"]
        ages = [[env.step(np.float32([0]))[4]["age"] for _ in range(29)] for env in (seen, real)]
        assert ages[0][lag:] == ages[1][:-lag]
        lags.add(lag)
    assert lags == {1, 2, 3}


class Gas(Journal):
    action_space = gym.spaces.Box(1, 10, (1,))
    tau = 0.02


def test_actions_without_a_zero() -> None:
    """The idle action is clipped to the bounds; an empty slot of the augmented state lies in its space."""
    env = AugmentedObservation(Delayed(Gas(20), "1+action=2", idle=np.array([-5.0])))
    x, _ = env.reset(seed=0)
    assert env.observation_space.contains(x.astype(env.observation_space.dtype))
    env.step(np.float32([3]))
    assert env.unwrapped.acted == [1.0]  # type: ignore[attr-defined]
    for wrong in ([np.nan], [0.5, 0.5]):
        with pytest.raises(delayrl.DelayRLError, match=r"idle action must be finite and have the shape \(1,\)"):
            Delayed(Gas(20), "1+action=2", idle=np.array(wrong))


def test_the_length_of_a_step_may_be_called_tau() -> None:
    assert Delayed(Gas(20), "40ms").delay == as_delay(2)


def test_a_wrapper_that_repeats_actions_says_how_long_its_step_is() -> None:
    class Repeating(gym.Wrapper):
        dt = 0.08
        tau = 0.5  # of a filter

    env = Delayed(AugmentedObservation(Delayed(Repeating(Gas(20)), 0)).env.env, "160ms")
    assert (env.delay, env.step_seconds) == (as_delay(2), 0.08)
    assert Delayed(Repeating(Gas(20)), "160ms", step_seconds=0.04).delay == as_delay(4)
    del Repeating.dt
    assert Delayed(Repeating(Gas(20)), "160ms").delay == as_delay(8)


def test_idle_is_zero_in_the_tasks_units() -> None:
    class Gas(Journal):
        action_space = gym.spaces.Box(0, 10, (1,))

    gym.register("Gas-v0", lambda: Gas(20), max_episode_steps=30)
    try:
        for rescale in (False, True):
            env = delayrl.make("Gas-v0", "action=2", rescale=rescale)
            env.reset(seed=0)
            env.step(np.float32([1]))
            assert env.unwrapped.acted == [0.0]  # type: ignore[attr-defined]
    finally:
        gym.registry.pop("Gas-v0")


def test_one_delay_is_enough() -> None:
    with pytest.raises(delayrl.DelayRLError, match="delayed already"):
        Delayed(AugmentedObservation(Delayed(Journal(5), 1)), 2)
    with pytest.raises(delayrl.DelayRLError, match="takes a vector"):
        DelayedVector(Journal(5), 2)  # type: ignore[arg-type]
    for inside in ("2", "action=1", "reward=1", "uniform:0:2+reward=uniform:0:3"):
        with pytest.raises(delayrl.DelayRLError, match=r"delayed already: .* the whole delay inside"):
            DelayedVector(vectors(lambda d=inside: Delayed(Journal(5), d)), 2)
    assert DelayedVector(vectors(lambda: Delayed(Journal(5), 0)), 2).delay == as_delay(2)


@pytest.mark.parametrize("delay", [2, "0+reward=1"])
def test_one_delay_is_enough_in_other_processes(delay: int | str) -> None:
    """Their environments show what they are at the first reset."""
    wrappers, spawn = [functools.partial(Delayed, delay=delay)], {"context": "spawn"}  # JAX warns of forks
    inside = gym.make_vec("Pendulum-v1", 2, "async", wrappers=wrappers, vector_kwargs=spawn)
    with contextlib.closing(DelayedVector(inside, 1)) as env, pytest.raises(delayrl.DelayRLError, match="already"):
        env.reset(seed=0)


@pytest.mark.parametrize("delay", ["2", "2+action=1"])
@pytest.mark.parametrize("shape", [(2,), (1, 1), (2, 2), ()])
def test_actions_of_a_vector_have_a_row_for_each_environment(delay: str, shape: tuple[int, ...]) -> None:
    env = DelayedVector(vectors(lambda: gym.make("Pendulum-v1")), delay)
    env.reset(seed=0)
    with pytest.raises(delayrl.DelayRLError, match=r"actions have the shape \(2, 1\); got "):
        env.step(np.zeros(shape, np.float32))


def vectors(make: Any, **options: Any) -> Any:
    """Two environments in a vector."""
    from gymnasium.vector import SyncVectorEnv

    return SyncVectorEnv([make] * 2, **options)


def test_an_inner_wrapper_without_a_delay_is_not_seen() -> None:
    """Through the end of an episode, where both wrappers have an `info` of their own."""
    made = [
        vectors(lambda d=d: Delayed(Journal(4), 0) if d else Journal(4), autoreset_mode="SameStep")
        for d in (True, False)
    ]
    inside, plain = (AugmentedVectorObservation(DelayedVector(env, "uniform:0:3+action=1")) for env in made)
    for env in (inside, plain):
        env.reset(seed=2)
    for step in range(1, 10):
        (ours, *_, infos), (want, *_, wanted) = (env.step(np.full((2, 1), 0.1 * step)) for env in (inside, plain))
        np.testing.assert_array_equal(ours, want)
        assert ("final_info" in infos) == (step % 4 == 0)
        for name in wanted.get("final_info", ()):
            np.testing.assert_array_equal(infos["final_info"][name], wanted["final_info"][name])


class Numeric(gym.vector.VectorWrapper):
    """Gives the last observations as one array of numbers, as vectors on accelerators do."""

    def step(self, actions: Any) -> Any:
        *outcome, infos = self.env.step(actions)
        if "final_obs" in infos:
            infos["final_obs"] = np.array([np.zeros(2) if x is None else x for x in infos["final_obs"]])
            del infos["_final_obs"]
        return *outcome, infos


@pytest.mark.parametrize("numeric", [False, True])
def test_what_else_stands_in_the_info_of_an_end(numeric: bool) -> None:
    """Statistics of the episode, whose entries are dicts; and last observations in an array of numbers."""
    from gymnasium.vector import AutoresetMode

    made = vectors(lambda: RecordEpisodeStatistics(Journal(4)), autoreset_mode=AutoresetMode.SAME_STEP)
    env = AugmentedVectorObservation(DelayedVector(Numeric(made) if numeric else made, 2))
    env.reset(seed=0)
    for step in range(1, 5):
        *_, infos = env.step(np.full((2, 1), 0.1 * step, np.float32))
    assert set(infos["final_info"]) >= {"episode", "age", "actions"}
    for last in infos["final_obs"]:
        np.testing.assert_allclose(last, [2, 0.2, 0.3, 0.4, 1], rtol=1e-6)


@pytest.mark.parametrize("delay", [2, "uniform:1:3@fifo+action=1", as_delay("walk:3")])
def test_made_again_from_its_specification(delay: object) -> None:
    env = Delayed(gym.make("Pendulum-v1"), delay)  # type: ignore[arg-type]
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.get_wrapper_attr("delay") == env.delay
