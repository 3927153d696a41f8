"""Known delays are measured: of environments to the step, of logs to the row."""

import csv
import json
import subprocess
import sys
import warnings
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.wrappers import DelayObservation, StickyAction

from delayrl import DelayRLError, DelayWarning
from delayrl.cli.console import seconds
from delayrl.cli.main import main
from delayrl.cli.measure import _show_environment
from delayrl.delays import as_delay
from delayrl.envs.task import quiet
from delayrl.measure import correlate, from_log, probe
from delayrl.measure.ages import rounded_up_steps
from delayrl.measure.reading import Table, read_signals
from delayrl.wrappers import AugmentedObservation, Delayed
from short_runs import refused

ROOT = Path(__file__).parents[2]


def make(name: str) -> gym.Env:
    with quiet():
        return gym.make(name, disable_env_checker=True)


class ActionDelay(gym.Wrapper):
    def __init__(self, env: gym.Env, steps: int) -> None:
        super().__init__(env)
        self.steps = steps

    def reset(self, **words):
        self.queue = deque([np.zeros(self.action_space.shape, np.float32)] * self.steps)
        return self.env.reset(**words)

    def step(self, action):
        self.queue.append(action)
        return self.env.step(self.queue.popleft())


class RandomDelay(gym.Wrapper):
    """Observations travel for a random time; raw: step t shows s_{t-d}; else the newest that has arrived."""

    def __init__(self, env: gym.Env, low: int, high: int, raw: bool) -> None:
        super().__init__(env)
        self.low, self.high, self.raw = low, high, raw

    def reset(self, *, seed=None, options=None):
        obs, info = self.env.reset(seed=seed, options=options)
        self.draws = np.random.default_rng([seed, 7])
        self.history, self.arrivals = [obs], [0]
        return obs, info

    def step(self, action):
        obs, *rest = self.env.step(action)
        t, travel = len(self.history), int(self.draws.integers(self.low, self.high + 1))
        self.history.append(obs)
        self.arrivals.append(t + travel)
        shown = max(0, t - travel) if self.raw else max(i for i, a in enumerate(self.arrivals) if a <= t)
        self.shown = shown
        return self.history[shown], *rest


class RandomActionDelay(gym.Wrapper):
    """Each action travels 0 or 2 steps; of those that have arrived the newest acts on."""

    def reset(self, *, seed=None, options=None):
        self.draws, self.t, self.sent = np.random.default_rng([seed, 7]), 0, []
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        self.sent.append((self.t + 2 * int(self.draws.integers(2)), action))
        arrived = [a for arrival, a in self.sent if arrival <= self.t]
        self.t += 1
        return self.env.step(arrived[-1] if arrived else np.zeros_like(action))


class DoublePush(gym.Wrapper):
    """A buffer for a delay of `steps` into which a bug puts every observation twice."""

    def __init__(self, env: gym.Env, steps: int) -> None:
        super().__init__(env)
        self.steps = steps

    def reset(self, **words):
        obs, info = self.env.reset(**words)
        self.buffer = deque([obs] * (self.steps + 1), maxlen=self.steps + 1)
        return obs, info

    def step(self, action):
        obs, *rest = self.env.step(action)
        self.buffer.extend([obs, obs])
        return self.buffer[0], *rest


class Hold(gym.Wrapper):
    """A sensor that is read every third step."""

    def reset(self, **words):
        self.t = 0
        self.obs, info = self.env.reset(**words)
        return self.obs, info

    def step(self, action):
        obs, *rest = self.env.step(action)
        self.t += 1
        self.obs = obs if self.t % 3 == 0 else self.obs
        return self.obs, *rest


class Repeat(gym.Wrapper):
    def step(self, action):
        for _ in range(3):
            result = self.env.step(action)
        return result


class Hidden(gym.Env):
    """x' = x/2 + a, shown in the same array each time; no attribute says what the state is."""

    observation_space, action_space = Box(-9, 9, (1,), np.float32), Box(-1, 1, (1,), np.float32)

    def __init__(self, rewarded: bool = True, noise: bool = False) -> None:
        self.rewarded, self.noise = rewarded, noise
        self.array = np.zeros(1, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.array[:] = self.np_random.uniform(-1, 1)
        return self.array, {}

    def step(self, action):
        self.array[:] = self.array / 2 + action + (np.random.default_rng().normal() if self.noise else 0)
        return self.array, float(self.array[0]) if self.rewarded else 0.0, False, False, {}


def delays(env: gym.Env | str, **words) -> tuple:
    p = probe(env, episodes=3, **words)
    assert sum(p.total.values()) >= 10
    assert set(p.reaction) <= set(range(max(p.total) + 1))
    return tuple(None if c is None else sorted(c) for c in (p.action, p.observation, p.total))


@pytest.mark.parametrize(
    ("name", "observation", "action"),
    [
        *(("delayrl/Walk-v0", *delays) for delays in [(0, 0), (5, 0), (0, 3), (4, 2)]),
        ("Pendulum-v1", 4, 2),
        ("InvertedPendulum-v5", 4, 2),
    ],
)
def test_constant_delays(name: str, observation: int, action: int) -> None:
    """0: the observation that step(a) returns reacts to a. Delays add up, in either order of the wrappers."""
    want = ([action], [observation], [observation + action])
    assert delays(Delayed(ActionDelay(make(name), action), observation)) == want
    assert delays(ActionDelay(Delayed(make(name), observation), action)) == want
    assert delays(DelayObservation(ActionDelay(make(name), action), observation))[2] == want[2]


@pytest.mark.parametrize(
    ("text", "want"), [("2+action=3", ([3], [2], [5])), ("1@fifo+action=1+reward=2", ([1], [1], [2]))]
)
def test_channels_of_the_wrapper(text: str, want: tuple) -> None:
    assert delays(Delayed(make("Pendulum-v1"), text)) == want


@pytest.mark.parametrize("text", ["uniform:1:3", "uniform:1:4@raw", "gilbert:0:4:0.2:0.4@fifo", "paper-stochastic-5"])
def test_laws_and_rules_of_the_wrapper(text: str) -> None:
    """The measured ages are those that the wrapper shows."""
    env = Delayed(make("Pendulum-v1"), text)
    probed = probe(env, episodes=4)
    assert set(probed.action) == {0}
    assert 1 < len(probed.observation) <= env.history + 1
    assert max(probed.observation) == env.history


def test_bare_tasks_by_name() -> None:
    assert delays(Delayed(ActionDelay(make("HalfCheetah-v5"), 2), 1)) == ([2], [1], [3])
    for name in ("Reacher-v5", "delayrl/Pusher-v4", "MountainCarContinuous-v0"):
        assert delays(name) == ([0], [0], [0])


def test_double_push_halves_the_delay() -> None:
    assert delays(DoublePush(make("Pendulum-v1"), 6)) == ([0], [3], [3])


def test_long_delay_and_short_episodes() -> None:
    """Of the pushes of full size many end Hopper's episode before they are seen; Reacher ends at 50 steps."""
    assert sorted(probe(Delayed(make("Hopper-v5"), 20), episodes=1).total) == [20]
    p = probe(Delayed(make("InvertedPendulum-v5"), 9), episodes=2)
    assert (sorted(p.total), p.scale < 1) == ([9], True)
    assert sorted(probe(Delayed(make("Reacher-v5"), 40), episodes=1).total) == [40]


@pytest.mark.parametrize("raw", [True, False])
def test_random_delays_step_by_step(raw: bool) -> None:
    """The distribution is that of the ages that the wrapper showed, count by count, in the same steps."""
    env = RandomDelay(make("Pendulum-v1"), 1, 5, raw)
    p = probe(env, episodes=4, seed=3)
    ages: Counter[int] = Counter()
    for seed in range(3, 7):
        env.reset(seed=seed)
        for t in range(1, p.length + 1):
            env.step(np.zeros(1, np.float32))
            ages[t - env.shown] += t > max(p.total)
    assert p.total == p.observation == {age: count for age, count in sorted(ages.items()) if count}
    assert p.action == {0: sum(p.action.values())}
    assert len(p.total) == 5
    assert set(p.reaction) <= set(p.total)


def test_random_action_delay_and_lost_actions() -> None:
    p = probe(RandomActionDelay(make("Pendulum-v1")), episodes=4)
    assert sorted(p.action) == [0, 2]
    assert sorted(p.observation) == [0]
    assert p.lost > 0.1  # overtaken by a later action
    p = probe(StickyAction(make("Pendulum-v1"), 0.5), episodes=8)
    assert sorted(p.action) == [0]
    assert 0.3 < p.lost < 0.7
    assert 0.3 < p.total[0] / sum(p.total.values()) < 0.7  # the rest shows an older action's effect


def test_held_observations_and_repeated_actions() -> None:
    p = probe(Hold(make("Pendulum-v1")), episodes=3)
    assert sorted(p.total) == [0, 1, 2]
    assert max(p.total.values()) - min(p.total.values()) <= 6
    assert delays(Delayed(Repeat(make("Pendulum-v1")), 2)) == ([0], [2], [2])
    assert delays(Repeat(Delayed(make("Pendulum-v1"), 5))) == (
        [0],
        [1],
        [1],
    )  # 5 of 3 inner steps: 6 show it


def test_actions_in_the_observation_are_no_observation_of_them() -> None:
    p = probe(AugmentedObservation(Delayed(make("Pendulum-v1"), 4)), episodes=2)
    assert sorted(p.total) == [4]
    assert p.echoes == (3, 4, 5, 6)
    assert p.components == (4, 4, 4, None, None, None, None, None)


@pytest.mark.parametrize("how", ["error", "other units"])
def test_what_is_made_from_the_action(how: str) -> None:
    """An error, of which some pushes show the action alone, is left out; a command in other units is told."""

    class More(gym.ObservationWrapper):
        def step(self, action):
            self.action = action
            return super().step(action)

        def reset(self, **words):
            self.action = np.zeros(1)
            return super().reset(**words)

        def observation(self, observation):
            return np.append(observation, self.action - observation[0] if how == "error" else self.action / 2)

    p = probe(lambda: More(DelayObservation(make("Pendulum-v1"), 3)), episodes=2)
    assert (sorted(p.total), p.echoes) == (([3], (3,)) if how == "error" else ([0], ()))
    assert ("hide the delay of the others" in _show_environment(p)) == (how == "other units")


def test_without_a_visible_state_rewards_tell() -> None:
    class Plain(gym.Wrapper):  # truth would be in Delayed's info
        def step(self, action):
            *result, _ = self.env.step(action)
            return *result, {}

        def reset(self, **words):
            return self.env.reset(**words)[0], {}

    p = probe(Plain(Delayed(ActionDelay(Hidden(), 2), 3)), episodes=2)
    assert (sorted(p.action), sorted(p.observation), sorted(p.total)) == ([2], [3], [5])
    assert "reward" in p.action_from
    p = probe(Plain(Delayed(ActionDelay(Hidden(rewarded=False), 2), 3)), episodes=2)
    assert (p.action, p.observation, sorted(p.total)) == (None, None, [5])
    assert delays(Delayed(Hidden(), 3))[1] == [3]  # from info["truth"]


@pytest.mark.parametrize(("low", "high"), [(0, np.inf), (5, np.inf), (-np.inf, -3)])
def test_pushes_stay_within_a_space_of_one_bound(low: float, high: float) -> None:
    class Careful(Hidden):
        action_space = Box(low, high, (1,), np.float32)

        def step(self, action):
            assert self.action_space.contains(action)
            return super().step(action)

    assert delays(Careful())[2] == [0]


@pytest.mark.parametrize(("low", "high"), [(-100, np.inf), (-np.inf, 1000), (-np.inf, np.inf)])
def test_a_far_bound_moves_no_push(low: float, high: float) -> None:
    class Watched(Hidden):
        action_space, most = Box(low, high, (1,), np.float32), 0.0

        def step(self, action):
            self.most = max(self.most, float(np.abs(action).max()))
            return super().step(action)

    env = Watched()
    probe(env, episodes=1)
    assert 0 < env.most <= 1


def test_environments_that_cannot_be_probed() -> None:
    with pytest.raises(DelayRLError, match=r"does not repeat itself.*np_random"):
        probe(Hidden(noise=True))
    with pytest.raises(DelayRLError, match="no observation reacted"):
        probe("delayrl/Coin-v0")
    with pytest.raises(DelayRLError, match=r"no observation reacted.*within 6 steps"):
        probe(Delayed(make("Pendulum-v1"), 20), longest=6)
    with pytest.raises(DelayRLError, match="Box actions"):
        probe(make("CartPole-v1"))
    with pytest.raises(DelayRLError, match="must return a Gymnasium environment; got int"):
        probe(lambda: 3)
    with pytest.raises(DelayRLError, match="cannot be made here: ZeroDivisionError"):
        probe(lambda: 1 / 0)


# ------------------------------------------------------------------------------------------------ logs

ROW = 0.02
STEPS: dict[str, Callable[[float, float, float], tuple[float, float]]] = {
    "gain": lambda x, v, u: (u, 0.0),
    "integrator": lambda x, v, u: (x + 0.1 * u, 0.0),
    "servo": lambda x, v, u: (x + (w := v + 0.09 * (u - x) - 0.42 * v), w),
    "second": lambda x, v, u: (x + (w := v + 0.02 * u - 0.05 * v - 0.01 * x), w),
}


def signals(plant: str, delay, rows: int = 1500, noise: float = 0.0, policy: bool = True, wander: float = 0.8) -> tuple:
    """Commands and late observations; `delay` in rows, or a function of the row."""
    rng = np.random.default_rng(0)
    states, u, y, x, v, walk = [0.0], np.zeros(rows), np.zeros(rows), 0.0, 0.0, 0.0
    for t in range(rows):
        rows_late = delay(t) if callable(delay) else delay
        y[t] = states[max(0, t - rows_late)] + noise * rng.normal()
        walk = wander * walk + 0.3 * rng.normal()
        u[t] = np.tanh(walk - 0.5 * y[t]) if policy else walk
        x, v = STEPS[plant](x, v, u[t])
        states.append(x)
    return u, y


def write(path: Path, columns: dict, rows: list[int] | None = None) -> Path:
    with path.open("w", newline="") as file:
        table = list(zip(*columns.values(), strict=True))
        csv.writer(file).writerows([list(columns), *(table if rows is None else [table[i] for i in rows])])
    return path


def log(path: Path, u: np.ndarray, y: np.ndarray, time: np.ndarray | None = None) -> Path:
    return write(path, {"time": ROW * np.arange(len(u)) if time is None else time, "command": u, "obs": y})


@pytest.mark.parametrize(
    ("commands", "observations", "wanted"),
    [
        (["q1_cmd"], ["q1_cmd_seen"], (["q1_cmd"], ["q1_cmd_seen"])),
        (["q1_cmd"], ["q1"], (["q1_cmd"], ["q1"])),
        (["Q1_CMD"], ["Q1"], (["q1_cmd"], ["q1"])),
        (["q1_cmd", "q2_c"], ["q1", "q2_v"], (["q1_cmd", "q2_cmd"], ["q1", "q2_velocity"])),
        (["q2_cmd"], ["q2"], (["q2_cmd"], ["q2_velocity"])),
        (["q1_c"], ["q1"], (["q1_cmd", "q1_cmd_seen"], ["q1"])),
        ("q1_c", "q1", (["q1_cmd", "q1_cmd_seen"], ["q1"])),
        (None, ["q1"], (["action", "action_raw"], ["q1"])),
    ],
)
def test_whole_names_come_before_prefixes(
    commands: list | str | None, observations: list | str, wanted: tuple, tmp_path: Path
) -> None:
    """A word that is the name of a column means this column alone, and no prefix takes it from there."""
    names = ["time", "q1", "q1_cmd", "q1_cmd_seen", "q2_cmd", "q2_velocity", "action", "action_raw"]
    path = write(tmp_path / "log.csv", {name: np.arange(5.0) for name in names})
    log = read_signals(Table(path), commands=commands, observations=observations)
    assert (list(log.command_names), list(log.observation_names)) == wanted


@pytest.mark.parametrize("policy", [True, False])
def test_commands_that_come_back_are_no_answer(
    policy: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A set-point, the last command or an error beside the plant's answer changes nothing, and is told."""
    u, y = signals("servo", 3, policy=policy)
    alone = from_log(log(tmp_path / "alone.csv", u, y))
    assert alone.echoes == ()
    last = np.append(0, u[:-1])
    more = {"obs_goal": u, "obs_last": last, "obs_error": last - 0.2 * y, "obs_scaled": -3 * u}
    for name, values in more.items():
        path = write(tmp_path / "log.csv", {"time": ROW * np.arange(len(u)), "command": u, "obs": y, name: values})
        e = from_log(path)
        assert e.echoes == (name,)
        assert (e.delay, e.low, e.high, e.peak) == (alone.delay, alone.low, alone.high, alone.peak)
    main(["measure", str(path)])
    assert "obs_scaled repeats a command" in (shown := capsys.readouterr().out)
    assert "left out; if it is a sensor, name it alone" in shown
    alike = write(tmp_path / "only.csv", {"time": ROW * np.arange(len(u)), "command": u, "obs_last": last})
    main(["measure", str(alike)])
    assert "the answer may not be the plant's; name others" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "doubtful"),
    [
        ({"period": 1.0}, False),
        ({"period": 25.0}, True),
        ({"period": 25.0, "unit": "s"}, True),
        ({"period": 0.001}, True),
        ({"period": 0.001, "unit": "s"}, True),
        ({"unit": "us"}, False),
    ],
)
def test_units_that_do_not_fit_each_other(words: dict, doubtful: bool, tmp_path: Path) -> None:
    """Far more or fewer rows in a period than a loop has: one of the two units is wrong."""
    u, y = signals("servo", 3, 600)
    with warnings.catch_warnings(record=True, action="always") as caught:
        from_log(log(tmp_path / "log.csv", u, y), **words)
    assert [str(w.message).endswith("check --unit, and that of --period") for w in caught] == [True] * doubtful


def test_a_given_unit_is_believed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It warns, and recommends a delay. By stamps nothing is in doubt where a sensor is slow."""
    path = str(log(tmp_path / "log.csv", *signals("servo", 3, 600)))
    for more, recommended in (([], False), (["--unit", "s"], True)):
        with warnings.catch_warnings(action="default"):
            main(["measure", path, "--period", "1ms", *more])
        said = capsys.readouterr()
        assert "check --unit" in said.err
        assert ("train with: --delay" in said.out) == recommended
    slow = from_log(stamps(tmp_path / "stamps.csv", np.arange(60.0), 0.1), 0.02)
    assert slow.step == 5


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_the_last_command_is_an_echo_where_commands_are_held(rows: int, tmp_path: Path) -> None:
    """Rows may be closer than commands; the command before is then as many rows back."""
    u, y = (np.repeat(signal, rows) for signal in signals("servo", 3))
    last = np.append(np.zeros(rows), u[:-rows])
    columns = {"time": ROW / rows * np.arange(len(u)), "command": u, "obs": y}
    alone = from_log(write(tmp_path / "alone.csv", columns))
    e = from_log(write(tmp_path / "log.csv", columns | {"obs_last": last}))
    assert (alone.echoes, e.echoes) == ((), ("obs_last",))
    assert (e.delay, e.low, e.high) == (alone.delay, alone.low, alone.high)


def test_smooth_commands_make_no_echo(tmp_path: Path) -> None:
    """Their increments are alike for some rows, so those of a plant that answers rows later are like theirs at once."""
    rng = np.random.default_rng(0)
    u = np.convolve(rng.normal(size=3100), np.hanning(100), "valid")[:3000] + 0.05 * rng.normal(size=3000)
    y = np.zeros(3000)
    for t in range(5, 3000):
        y[t] = 0.5 * y[t - 1] + 0.5 * u[t - 4]
    e = from_log(write(tmp_path / "log.csv", {"time": ROW * np.arange(3000), "command": u, "obs": y, "obs_goal": u}))
    assert e.echoes == ("obs_goal",)
    assert e.low <= 3 * ROW <= e.high


class Integrator(gym.Env):
    """A position that starts at 0: the first action is all that it shows."""

    observation_space, action_space = Box(-99, 99, (1,)), Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(1, np.float32)
        return self.x.copy(), {}

    def step(self, action):
        self.x = self.x + action
        return self.x.copy(), 0.0, False, False, {}


@pytest.mark.parametrize("delay", [0, 3])
def test_a_position_that_begins_with_the_action_is_no_echo(delay: int) -> None:
    def make_it() -> gym.Env:
        env = gym.wrappers.TimeLimit(Integrator(), 100)
        return DelayObservation(env, delay) if delay else env

    p = probe(make_it, episodes=2, longest=20)
    assert (sorted(p.total), p.echoes) == ([delay], ())


def test_held_commands(tmp_path: Path) -> None:
    """A command that is held for as long as the delay: one step's response falls on the next step's command."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 200), 10)
    for delay in (3, 9, 10, 11):
        x, v, y = 0.0, 0.0, []
        for t in range(len(u)):
            y.append(x)
            x, v = STEPS["servo"](x, v, u[t - delay] if t >= delay else 0.0)
        e = from_log(log(tmp_path / "log.csv", u, np.array(y) + 0.002 * rng.normal(size=len(u))))
        assert e.delay == pytest.approx(delay * ROW), delay


@pytest.mark.parametrize("policy", [True, False])
@pytest.mark.parametrize("plant", list(STEPS))
def test_dead_time_of_plants(plant: str, policy: bool, tmp_path: Path) -> None:
    """To the row, whatever the plant's own lag, with and without feedback, up to noise of a few percent."""
    for delay, noise in ((0, 0.0), (4, 0.0), (9, 0.005)):
        e = from_log(log(tmp_path / "log.csv", *signals(plant, delay, noise=noise, policy=policy)))
        assert e.delay == pytest.approx(delay * ROW)
        assert e.low <= delay * ROW <= e.high
        assert (e.in_step, e.step) == (str(delay), delay)
        assert e.train_with == f"episode:{delay}:{delay + 2}"  # the dead time is known to a row
        assert e.strength > 1


def test_the_peak_is_no_delay(tmp_path: Path) -> None:
    """The peak is not reported, because it includes the plant's own lag: here more than twice the delay."""
    e = from_log(log(tmp_path / "log.csv", *signals("second", 4, policy=False, wander=0.99)))
    assert e.delay == pytest.approx(4 * ROW)
    assert e.peak.lag > 10 * ROW
    e = from_log(log(tmp_path / "log.csv", *signals("gain", 4, policy=False)))
    assert e.peak.lag == pytest.approx(5 * ROW, abs=0.2 * ROW)  # no lag of its own: the delay, and the row of the step


def test_unrelated_signals_show_nothing(tmp_path: Path) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u, y = np.cumsum(rng.normal(size=(2, 600)), 1) if seed % 2 else rng.normal(size=(2, 600))
        with pytest.raises(DelayRLError, match="no delay found"):
            from_log(log(tmp_path / "log.csv", u, y))


def test_feedback_alone_is_no_delay(tmp_path: Path) -> None:
    """A policy that only reads the observation, of a process that it cannot move."""
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.normal(size=1000))
    with pytest.raises(DelayRLError, match="no delay found"):
        from_log(log(tmp_path / "log.csv", -0.5 * y + rng.normal(size=1000), y))


def test_irregular_rows(tmp_path: Path) -> None:
    """Jitter of the stamps, lost rows, a long gap; the delay is in seconds, so half the rows give half the rows."""
    rng = np.random.default_rng(0)
    u, y = signals("servo", 6, 3000, policy=False)
    time = ROW * np.arange(3000) + rng.uniform(-0.3, 0.3, 3000) * ROW
    assert from_log(log(tmp_path / "log.csv", u, y, time)).delay == pytest.approx(6 * ROW, abs=1.01 * ROW)
    time[2000:] += 3600
    assert from_log(log(tmp_path / "log.csv", u, y, time)).delay == pytest.approx(6 * ROW, abs=1.01 * ROW)
    kept = sorted(rng.choice(3000, 2850, replace=False))
    e = from_log(write(tmp_path / "log.csv", {"time": time, "command": u, "obs": y}, kept))
    assert e.delay == pytest.approx(6 * ROW, abs=1.01 * ROW)
    assert e.rows < 3000


def test_parts_that_differ_by_a_row_do_not_vary(tmp_path: Path) -> None:
    """A dead time is known to a row, so such parts are those of a constant delay."""
    e = from_log(log(tmp_path / "log.csv", *signals("servo", 3, 4000)), 2 * ROW)
    parts = tuple((float(n), delay * ROW) for n, delay in enumerate((3, 4, 4, 4, 3)))
    alike = replace(e, windows=parts, span=(3 * ROW, 5 * ROW), step_span=(1, 2), steps=(1, 2, 2, 2, 1))
    assert (alike.train_with, alike.in_step) == ("episode:1:3", "episode:1:2")
    apart = replace(alike, span=(3 * ROW, 6 * ROW), step_span=(2, 3))
    assert (apart.train_with, apart.in_step) == ("uniform:1:4", "uniform:2:3")


def test_columns_units_and_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    u, y = signals("servo", 3, 1200)
    clock = np.tile(1000 * ROW * np.arange(400), 3)  # three recordings, in ms
    path = write(
        tmp_path / "log.csv", {"clock": clock, "part": np.repeat(range(3), 400), "wish": u, "angle": y, "x": y}
    )
    words = {"time": "clock", "commands": ["wish"], "observations": ["angle"]}
    e = from_log(path, episode="part", unit="ms", **words)
    line = r"lie 20 s apart: if its time stamps are not in seconds, say so \(--unit ms\)"
    with pytest.warns(DelayWarning, match=line):
        from_log(path, episode="part", **words)
    given = ["--time", "clock", "--commands", "wish", "--observations", "angle", "--episode", "part"]
    with warnings.catch_warnings(action="ignore"):
        main(["measure", str(path), *given])
    assert "give --unit" in (shown := capsys.readouterr().out)
    assert "train with: --delay" not in shown
    with pytest.raises(DelayRLError, match="--period is a time in seconds; got 40ms"):
        from_log(path, period="40ms")  # type: ignore[arg-type]
    assert (e.row, e.delay) == (pytest.approx(ROW), pytest.approx(3 * ROW))
    assert (e.peak.command, e.peak.observation) == ("wish", "angle")
    with pytest.raises(DelayRLError, match="row 401: clock goes back"):
        from_log(path, unit="ms", **words)


def test_a_delay_that_drifts_and_a_cold_start(tmp_path: Path) -> None:
    e = from_log(log(tmp_path / "log.csv", *signals("servo", lambda t: 3 + 3 * (t > 2100), 4000)))
    assert [round(d / ROW) for _, d in e.windows] == [3, 3, 3, 3, 6, 6, 6, 6]
    assert (e.train_with, e.in_step) == ("uniform:3:8", "uniform:3:6")
    with pytest.raises(DelayRLError, match=r"only stamps give a delay of each step .* --delay uniform:3:8"):
        e.save(tmp_path / "steps.txt")
    cold = signals("servo", lambda t: 20 - min(t, 100) // 6, 3000)
    e = from_log(log(tmp_path / "log.csv", *cold))
    assert (e.delay, e.in_step) == (pytest.approx(4 * ROW), "4")


def test_two_parts_that_differ(tmp_path: Path) -> None:
    """They count like the three and more of a longer log."""
    u, y = signals("gain", lambda t: 3 + 4 * (t > 570), 1100, noise=0.05)
    e = from_log(log(tmp_path / "log.csv", u, y))
    assert [round(d / ROW) for _, d in e.windows] == [3, 7]
    assert (e.train_with, e.in_step) == ("uniform:3:9", "uniform:3:7")


def test_period_and_rounding(tmp_path: Path) -> None:
    """Rounded up, because an action on its way must be remembered; but not for rounding errors of floats."""
    path = log(tmp_path / "log.csv", *signals("servo", 7))
    assert [from_log(path, period).step for period in (0.02, 0.04, 0.07, 0.14, 1.0)] == [7, 4, 2, 1, 1]
    for steps in range(200):
        for period in (0.02, 0.001, 1 / 30, 7.3):
            assert rounded_up_steps(steps * period, period) == steps
            assert rounded_up_steps((steps + 0.01) * period, period) == steps + 1
    times = {"20ms": 0.02, "0.02s": 0.02, "50Hz": 0.02, "2e-2s": 0.02, "15 s": 15.0, "500us": 5e-4}
    assert {text: seconds(text) for text in times} == pytest.approx(times)


def test_stamps_are_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = 1.7e9 + ROW * np.arange(1000)
    steps = np.where(np.arange(1000) < 40, 30, rng.choice([3, 4, 5], 1000))  # a cold start of 40 rows
    columns = {"stamp": made, "received": made + ROW * steps, "command": 1.0}
    columns["command"] = np.ones(1000)  # not looked at
    e = from_log(write(tmp_path / "log.csv", columns))
    left_out = 1000 - e.rows
    assert 40 <= left_out <= 60
    assert e.counts == dict(sorted(Counter(steps[left_out:].tolist()).items()))
    assert (e.method, e.in_step, e.slowest_warm_up) == ("stamps", "uniform:3:5", pytest.approx(0.6, abs=1e-5))
    assert from_log(write(tmp_path / "log.csv", columns), warm_up=0).longest == pytest.approx(0.6, abs=1e-5)
    assert from_log(tmp_path / "log.csv", 0.1).in_step == "1"
    recommended = [from_log(tmp_path / "log.csv", period).train_with for period in (ROW, 0.05, 0.1)]
    assert recommended == ["uniform:3:6", "uniform:1:2", "1"]  # made up to 100 + 20 ms ago, rounded
    columns["received"] = made + 0.05 + 1e-3 * (made - made[0])  # a clock that gains 1 ms a second
    assert from_log(write(tmp_path / "log.csv", columns)).drift == pytest.approx(1000, rel=0.01)


@pytest.mark.parametrize("every", [2, 3])
def test_a_sensor_slower_than_the_loop(every: int, tmp_path: Path) -> None:
    """Each row of the loop shows the newest observation: one that stands in several rows counts once."""
    made = ROW * every * np.arange(300)
    columns = {"stamp": made, "received": made + 0.05}
    rows = [row for row in range(300) for _ in range(every)]
    once = from_log(write(tmp_path / "once.csv", columns))
    often = from_log(write(tmp_path / "often.csv", columns, rows))
    assert (often.row, often.rows, often.steps) == (once.row, once.rows, once.steps)
    loop = from_log(tmp_path / "often.csv", ROW)
    assert loop.train_with == f"uniform:2:{2 + every}"  # 50 ms, and up to a period of the sensor more
    assert loop.in_step == f"uniform:3:{2 + every}"
    loop.save(str(tmp_path / "steps.txt"))
    ages = [str(2 + age) for age in range(every, 0, -1)]  # what is missing in a step comes with the next observation
    assert (tmp_path / "steps.txt").read_text().split() == ["3", *ages * (loop.rows - 1)]


def stamps(path: Path, made: np.ndarray, delay: np.ndarray | float) -> Path:
    return write(path, {"stamp": made, "received": made + delay})


def test_messages_that_overtake_others_need_not_be_sorted(tmp_path: Path) -> None:
    """A log of messages as they arrive tells what the log in the order of the stamps tells."""
    random = np.random.default_rng(0)
    made = 0.02 * np.arange(400)
    delay = random.uniform(0.03, 0.09, 400)
    arrival = np.argsort(made + delay)
    assert (np.diff(made[arrival]) < 0).sum() > 50
    as_they_arrive = from_log(stamps(tmp_path / "arrival.csv", made[arrival], delay[arrival]))
    assert replace(as_they_arrive, path="") == replace(from_log(stamps(tmp_path / "sorted.csv", made, delay)), path="")


def test_overtaken_messages_stay_in_their_recording(tmp_path: Path) -> None:
    """Whatever the recordings are called. A clock that restarts without a name is refused, however short they are."""
    made = np.append(0.02 * np.arange(300), 0.02 * np.arange(200))
    delay, found = np.repeat([0.05, 0.07], [300, 200]), []
    for parts in ([0, 1], [1, 0]):
        columns = {"stamp": made, "received": made + delay, "episode": np.repeat(parts, [300, 200])}
        found.append(replace(from_log(write(tmp_path / "log.csv", columns)), path=""))
    assert found[0] == found[1]
    assert found[0].train_with == "uniform:2:4"
    short = np.tile(0.02 * np.arange(18), 30)
    with pytest.raises(DelayRLError, match="row 19: the stamp goes back"):
        from_log(stamps(tmp_path / "short.csv", short, 0.05))


def test_stamps_of_two_clocks_or_units(tmp_path: Path) -> None:
    made = 0.02 * np.arange(400)
    with pytest.raises(
        DelayRLError, match=r"1\.7e\+09 s after it was made, or later: --stamp and --received are of two"
    ):
        from_log(stamps(tmp_path / "clocks.csv", made, 1.7e9))
    late = write(tmp_path / "units.csv", {"stamp": 1e3 * (made + 9), "received": made + 9.05})
    with pytest.raises(DelayRLError, match="swapped or in different units, or the clocks differ"):
        from_log(late)


def test_stamps_of_several_recordings(tmp_path: Path) -> None:
    """The clock starts again in the second; together they show what each shows alone."""
    made, delay = np.tile(ROW * np.arange(300), 2), np.tile([2.5, 3.5], 300) * ROW
    columns = {"stamp": made, "received": made + delay, "flight": np.repeat([1, 2], 300)}
    path = write(tmp_path / "log.csv", columns)
    with pytest.raises(DelayRLError, match=r"row 301: the stamp goes back; sort .* or name a column with --episode"):
        from_log(path)
    both = from_log(path, episode="flight", warm_up=0)
    once = from_log(stamps(tmp_path / "once.csv", made[:300], delay[:300]), warm_up=0)
    assert (both.rows, once.rows) == (600, 300)
    for name in ("row", "in_step", "train_with", "longest"):
        assert getattr(both, name) == pytest.approx(getattr(once, name)), name
    assert max(both.replay) == max(once.replay)
    columns["flight"] = np.arange(600)
    with pytest.raises(DelayRLError, match="column flight changes in every row"):
        from_log(write(tmp_path / "every.csv", columns), episode="flight")


@pytest.mark.parametrize("every", [1, 2, 3])
def test_ages_of_a_saved_recording(every: int, tmp_path: Path) -> None:
    """A sensor in step with the loop, a fifth lost, some overtaken: the recording shows the ages of the log."""
    rng = np.random.default_rng(1)
    made = ROW * every * np.arange(400)[rng.random(400) > 0.2 * (np.arange(400) > 0)]
    delay = rng.choice([0.9, 1.5, 2.2, 4.8], len(made)) * ROW
    e = from_log(stamps(tmp_path / "log.csv", made, delay), ROW, warm_up=0)
    e.save(tmp_path / "steps.txt")
    lines = np.array((tmp_path / "steps.txt").read_text().split(), int)
    assert len(lines) > 300 * every
    step, arrives = np.arange(len(lines)), np.arange(len(lines)) + lines  # as `Delayed` sends them, one each step
    now = step[10 : -10 * every]
    shown = [n - step[arrives <= n].max() for n in now]
    logged = [n - round(made[made + delay < n * ROW + 1e-9].max() / ROW) for n in now]
    assert shown == logged
    low, high = min(logged), max(logged)
    assert as_delay(e.in_step).observation.law.steps[0] == low
    assert low + every < as_delay(e.in_step).maximum <= high
    assert np.mean(np.array(logged) > as_delay(e.in_step).maximum) < 0.02


def test_lost_observations_count(tmp_path: Path) -> None:
    """20 ms, 41 to 45 ms late, a fifth lost: 99 % of the ages of a loop at any phase are in the range."""
    rng = np.random.default_rng(0)
    made = 0.02 * np.arange(3000)
    delay = 0.041 + rng.uniform(0, 0.004, 3000)
    whole = from_log(stamps(tmp_path / "whole.csv", made, delay), 0.02)
    assert (whole.train_with, whole.in_step) == ("uniform:2:3", "3")
    kept = rng.random(3000) > 0.2
    made, arrived = made[kept], (made + delay)[kept]
    e = from_log(stamps(tmp_path / "lost.csv", made, arrived - made), 0.02)
    assert (e.train_with, e.in_step) == ("uniform:2:5", "uniform:3:5")
    for phase in np.arange(0, 0.02, 0.004):
        now = np.arange(100, 2900) * 0.02 + phase
        ages = np.rint((now - made[np.searchsorted(arrived, now, "right") - 1]) / 0.02)
        assert ages.min() >= 2
        assert np.mean(ages > 5) < 0.01


def test_constant_delays_of_which_some_are_lost_vary(tmp_path: Path) -> None:
    made = ROW * np.delete(np.arange(600), np.arange(0, 600, 9))
    e = from_log(stamps(tmp_path / "log.csv", made, 2.2 * ROW), ROW)
    assert (e.train_with, e.in_step) == ("uniform:2:4", "uniform:3:4")


def test_overtaken_observations_leave_the_older_in_use(tmp_path: Path) -> None:
    """Every tenth takes 9 steps, longer than the next: it is never the newest, so the one before it ages by a step."""
    delay = np.where(np.arange(600) % 10 == 0, 9.2, 2.2) * ROW
    e = from_log(stamps(tmp_path / "log.csv", ROW * np.arange(600), delay), ROW)
    assert (e.train_with, e.in_step) == ("uniform:2:4", "uniform:3:4")


def test_a_pause_is_not_a_delay(tmp_path: Path) -> None:
    """Two recordings in a file: nobody waited for an observation between them, and the robot warmed up once."""
    made = ROW * np.arange(60) + 3600.0 * (np.arange(60) >= 30)
    e = from_log(stamps(tmp_path / "log.csv", made, 2.2 * ROW), ROW)
    assert e.rows == 57  # without the first twentieth of the log, in which the pause does not count
    assert e.train_with == "episode:2:3"
    e.save(tmp_path / "steps.txt")
    assert (tmp_path / "steps.txt").read_text().split() == ["3"] * e.rows


@pytest.mark.parametrize("sensor", [0.01, 0.02, 0.05])
def test_a_saved_recording_keeps_the_time(sensor: float, tmp_path: Path) -> None:
    """Half a second of slow messages in every two are 25 lines of 20 ms, whatever the sensor's period."""
    made = sensor * np.arange(round(40 / sensor))
    delay = np.where(made % 2 < 0.5 - 1e-9, 0.16, 0.01)
    e = from_log(stamps(tmp_path / "log.csv", made, delay), 0.02, warm_up=0)
    e.save(tmp_path / "steps.txt")
    steps = np.array((tmp_path / "steps.txt").read_text().split(), int)
    assert abs(len(steps) - 2000) < 3
    slow = (steps[80:1880] > 3).reshape(-1, 100)
    assert np.abs(slow.sum(1) - 25).max() <= 8  # the last of them are overtaken


@pytest.mark.parametrize(("period", "law"), [(0.01, "episode:2:3"), (0.02, "episode:2:3"), (0.06, "uniform:2:5")])
def test_a_longer_period_of_the_sensor_is_jitter(period: float, law: str, tmp_path: Path) -> None:
    """A loop of 20 ms with a sensor of 60 ms meets three ages in turn, at any phase."""
    path = stamps(tmp_path / "log.csv", period * np.arange(400), 0.042)
    assert from_log(path, 0.02).train_with == law


def test_half_of_the_stamps(tmp_path: Path) -> None:
    """Who names a column of stamps is not given a correlation instead."""
    path = write(tmp_path / "log.csv", {"time": TIME, "made": TIME, "command": COMMAND, "obs": OBS})
    with pytest.raises(DelayRLError, match="no column for --received, when observations arrived"):
        from_log(path, stamp="made")
    with pytest.raises(DelayRLError, match="no column for --stamp, when observations were made"):
        from_log(path, received="made")


def test_simulated_robot(tmp_path: Path) -> None:
    """HalfCheetah, observations four steps late, a random feedback policy: the estimate is right."""
    env = Delayed(make("HalfCheetah-v5"), 4)
    rng = np.random.default_rng(0)
    gains, walk, rows = 0.1 * rng.normal(size=(6, 17)), np.zeros(6), []
    obs, _ = env.reset(seed=0)
    for t in range(1000):
        walk = 0.8 * walk + 0.3 * rng.normal(size=6)
        action = np.tanh(gains @ obs + walk).astype(np.float32)
        rows.append([t * env.unwrapped.dt, *action, *obs])
        obs, *_ = env.step(action)
    names = ["time", *(f"action_{i}" for i in range(6)), *(f"observation_{i}" for i in range(17))]
    e = from_log(write(tmp_path / "log.csv", dict(zip(names, np.array(rows).T, strict=True))))
    assert (e.in_step, e.delay) == ("4", pytest.approx(4 * 0.05))
    assert sorted(probe(env, episodes=1).total) == [4]


def test_parquet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Columns of numbers and of vectors; and one line where pyarrow is missing."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    u, y = signals("servo", 5)
    path = tmp_path / "log.parquet"
    vectors = {"action": [[a, 0.0] for a in u], "observation.state": [[b, 1.0] for b in y]}
    parquet.write_table(pyarrow.table({"timestamp": ROW * np.arange(len(u)), **vectors}), path)
    e = from_log(path)
    assert (e.in_step, e.peak.command, e.peak.observation) == ("5", "action[0]", "observation.state[0]")
    uneven = {"timestamp": [0.0, 0.1, 0.2], "action": [[1.0, 0.0], [1.0], [1.0, 0.0]], "observation": [0.0, 1.0, 2.0]}
    parquet.write_table(pyarrow.table(uneven), tmp_path / "uneven.parquet")
    with pytest.raises(DelayRLError, match="row 2: column action has 1 numbers, in the row before 2; drop such rows"):
        from_log(tmp_path / "uneven.parquet")
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(DelayRLError, match="damaged"):
        from_log(path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(DelayRLError, match=r"delayrl\[parquet\]"):
        from_log(path)


# ---------------------------------------------------------------------------------------- command line


def test_command_for_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, saved = log(tmp_path / "log.csv", *signals("servo", 4)), tmp_path / "steps.txt"
    main(["measure", str(path), "--period", "20ms", "--plot", str(tmp_path / "a.png")])
    out = capsys.readouterr().out
    recommended = ("train with: --delay episode:4:6", "or: --delay 4 ")
    for words in ("dead time                 80 ms", *recommended):
        assert words in out
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert "only stamps give a delay of each step" in refused(capsys, "measure", path, "--save", saved)
    assert not saved.exists()
    main(["measure", str(path), "--period", "40ms", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert (result["kind"], result["in_step"], result["step"]) == ("log", "2", 2)
    assert result["train_with"] == "episode:2:3"
    assert result["low"] <= result["delay"] <= result["high"]
    path = stamps(tmp_path / "stamps.csv", TIME, 3.5 * ROW)
    main(["measure", str(path), "--save", str(saved)])
    out = capsys.readouterr().out
    assert f"or: --delay recorded:{saved}" in out
    assert "age when the next arrives 90 ms or less for 99 % of those in use" in out
    assert set(saved.read_text().split()) == {"4"}
    main(["measure", str(path), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert (result["train_with"], result["in_step"], result["steps"]) == ("episode:3:4", "4", {"4": 380})
    assert "replay" not in result
    assert "No such file" in refused(capsys, "measure", path, "--save", tmp_path / "no" / "x.txt")


def test_unrelated_signals_rarely_show_a_delay() -> None:
    """Few of a thousand short logs: 27 when far lags, at which fewer rows have a product, counted as the others."""
    random, episode, shown = np.random.default_rng(5), np.zeros(200), 0
    for _ in range(1000):
        u, y = correlate.innovations(random.normal(size=(200, 1)), random.normal(size=(200, 1)), episode)
        shown += correlate.onset(correlate.correlation(*correlate.blocks(u, y, 20, 8), 20)) is not None
    assert shown <= 10


def test_chance_is_alike_at_all_lags_and_in_all_parts() -> None:
    """N r² of white signals is 1 in the mean, in the first part of a log too, where few rows have a far product."""
    random, found = np.random.default_rng(0), []
    for _ in range(40):
        sums, products = correlate.blocks(random.normal(size=(1200, 1)), random.normal(size=(1200, 1)), 100, 8)
        parts = [correlate.correlation(sums[part], products[part], 100) for part in (slice(8), slice(3), slice(3, 8))]
        found.append([part.rows * (r**2).mean() for part in parts for r in (part.near, part.far)])
    np.testing.assert_allclose(np.mean(found, 0), 1, atol=0.15)


@pytest.mark.parametrize("latency", [0, 2])
@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_sensor_read_once_a_period_waits(latency: int, rows: int, tmp_path: Path) -> None:
    """However many rows lie in a period, the policy of `Delayed(task, 2)` is for a log of that task.

    Between two readings the rows repeat the newest, so that an effect shows a period after its command and not a row.
    """
    env, random = Delayed(make("Pendulum-v1").unwrapped, latency), np.random.default_rng(0)
    obs, _ = env.reset(seed=0)
    commands, seen = random.uniform(-2, 2, (600, 1)), []
    for command in commands:
        seen.append(obs[2])
        obs, *_ = env.step(command)
    table = {"command": np.repeat(commands[:, 0], rows), "obs": np.repeat(seen, rows)}
    table["time"] = 0.04 / rows * np.arange(600 * rows)
    found = from_log(write(tmp_path / "log.csv", table), period=0.04)
    assert found.in_step == str(latency)
    assert found.delay == pytest.approx(0.04 * latency + found.wait)
    assert found.wait == pytest.approx(0.04 - 0.04 / rows)
    low, high = (int(n) for n in found.train_with.removeprefix("episode:").split(":"))
    assert low <= latency < high


def test_a_coarse_encoder_is_no_sensor_that_waits(tmp_path: Path) -> None:
    """It repeats rows while it moves slowly, and not at others."""
    u, y = signals("servo", 4)
    steps = np.round(y / y.std() * 5)
    found = from_log(log(tmp_path / "log.csv", u, steps), period=4 * ROW)
    assert (found.wait, found.step) == (0, 1)


def test_a_slow_camera_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its rows repeat the newest image: 60 ms apart, in rows and steps of 20 ms."""
    u, y = signals("servo", 4)
    held = y[np.arange(len(y)) // 3 * 3]
    assert from_log(log(tmp_path / "log.csv", u, y)).renewed == pytest.approx(ROW)
    main(["measure", str(log(tmp_path / "camera.csv", u, held))])
    assert "The observation changes every 60 ms, more rarely than the loop decides" in capsys.readouterr().out
    main(["measure", str(log(tmp_path / "camera.csv", u, held)), "--period", "60ms"])
    assert "changes every" not in capsys.readouterr().out


def test_command_for_environments(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    module = "import gymnasium\nfrom delayrl.wrappers import Delayed\n\n\ndef make_env():\n"
    module += "    return Delayed(gymnasium.make('Pendulum-v1'), 2)\n"
    (tmp_path / "my_own_task.py").write_text(module)
    monkeypatch.chdir(tmp_path)
    main(["measure", "my_own_task:make_env", "--episodes", "2"])
    out = capsys.readouterr().out
    for words in (
        "observation delay  2 steps",
        "action delay       0 steps",
        "remember 2 actions",
        "env.unwrapped.state",
    ):
        assert words in out
    main(["measure", "my_own_task:make_env", "--json", "--episodes", "2"])
    result = json.loads(capsys.readouterr().out)
    assert (result["kind"], result["total"], result["maximum"]) == ("environment", {"2": 64}, 2)
    (tmp_path / "my_broken_task.py").write_text("def make_env(:\n")
    for target, words in (
        ("my_own_task:nothing", "has no class or function 'nothing'"),
        ("nowhere_at_all:make", "cannot import"),
        ("my_broken_task:make_env", "cannot import"),
        ("Pendulm-v1", "did you mean Pendulum-v1"),
    ):
        assert words in refused(capsys, "measure", target)
    assert "--period is an option of a log" in refused(capsys, "measure", "Pendulum-v1", "--period", "20ms")
    assert "--warm-up is an option of a log" in refused(capsys, "measure", "Pendulum-v1", "--warm-up", "0s")
    assert "count from 1" in refused(capsys, "measure", "Pendulum-v1", "--episodes", "0")
    assert "counts steps" in refused(capsys, "measure", "Pendulum-v1", "--longest", "1s")


TIME, COMMAND, OBS = ROW * np.arange(400), *signals("servo", 4, 400)


def replaced(values: np.ndarray, row: int, by: object) -> list:
    return [*values[: row - 1], by, *values[row:]]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"time": TIME[::-1], "command": COMMAND, "obs": OBS}, "row 2: time goes back"),
        ({"time": replaced(TIME, 7, TIME[5]), "command": COMMAND, "obs": OBS}, "row 7: time repeats"),
        ({"time": TIME, "command": replaced(COMMAND, 9, "nan"), "obs": OBS}, "row 9: column command has nan"),
        ({"time": TIME, "command": replaced(COMMAND, 9, "inf"), "obs": OBS}, "row 9: column command has inf"),
        ({"time": TIME, "command": COMMAND, "obs": replaced(OBS, 3, "left")}, "row 3: column obs has 'left'"),
        ({"time": TIME, "command": COMMAND, "obs": replaced(OBS, 3, "")}, "row 3: column obs has an empty cell"),
        ({"time": TIME[:90], "command": COMMAND[:90], "obs": OBS[:90]}, "too short"),
        ({"time": TIME[:9], "command": COMMAND[:9], "obs": OBS[:9]}, "too short"),
        ({"time": TIME[:2], "command": COMMAND[:2], "obs": OBS[:2]}, "too short"),
        ({"time": TIME[:1], "command": COMMAND[:1], "obs": OBS[:1]}, "too short"),
        ({"time": TIME[:0], "command": COMMAND[:0], "obs": OBS[:0]}, "has no rows"),
        ({"time": TIME, "command": TIME * 0, "obs": OBS}, "every command is constant"),
        ({"time": TIME, "command": COMMAND, "obs": TIME * 0 + 3}, "every observation is constant"),
        ({"when": TIME, "command": COMMAND, "obs": OBS}, "no column time"),
        (
            {"time": ["2026-03-01T00:00:00"] * len(TIME), "command": COMMAND, "obs": OBS},
            "write times as numbers, such as",
        ),
        ({"time": [f"0,{i:03}" for i in range(400)], "command": COMMAND, "obs": OBS}, "with decimal points"),
        ({"time": TIME, "torque": COMMAND, "obs": OBS}, "--commands"),
        ({"time": TIME, "command": COMMAND, "angle": OBS}, "--observations"),
        (
            {"stamp": TIME, "received": TIME - 0.1},
            "--stamp and --received are swapped or in different units, or the clocks differ",
        ),
        ({"stamp": TIME[::-1], "received": TIME[::-1] + 0.1}, "the stamp goes back"),
        ({"stamp": TIME[:5], "received": TIME[:5]}, "too short"),
    ],
)
def test_bad_logs(columns: dict, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert words in refused(capsys, "measure", write(tmp_path / "log.csv", columns))


def test_bad_files_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content, words in (
        ("empty.csv", b"", "is empty"),
        ("binary.csv", bytes(range(256)), "neither CSV text nor a Parquet file"),
        ("numbers.csv", b"1,2,3\n4,5,6\n", "no header"),
        ("text.txt", b"hello\nworld\n", "no header"),
        ("comment.csv", b"# my robot\ntime,command,obs\n", "('# my robot'): a CSV file begins with the names of its"),
        ("ragged.csv", b"time,command,obs\n0,1,2\n1,2\n", "row 2: 2 cells under 3"),
        ("twice.csv", b"time,obs,obs\n0,1,2\n", "two columns of the same name"),
    ):
        (tmp_path / name).write_bytes(content)
        assert words in refused(capsys, "measure", tmp_path / name)
    assert "no such file" in refused(capsys, "measure", tmp_path / "missing.csv")
    path = log(tmp_path / "log.csv", *signals("servo", 4, 400))
    for option, words in (
        ("--period 20kg", "a time such as 20ms"),
        ("--period 0.02", "a time such as 20ms"),
        ("--period 0Hz", "a time such as 20ms"),
        ("--period 0s", "a time in seconds"),
        ("--longest 20", "a time such as 200ms in a log; got 20"),
        ("--longest 1min", "a time such as"),
        ("--longest 10s", "too few to look for a delay"),
        ("--warm-up 7s", "too short"),
        ("--seed -1", "a whole number from 0; got -1"),
        ("--time clock", "no column clock"),
        ("--stamp sent", "no column sent"),
        ("--episodes 3", "an option of an environment"),
        (f"--plot {tmp_path / 'x.tape'}", ".png"),
    ):
        assert words in refused(capsys, "measure", path, *option.split())


def test_example_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A servo with a lag of its own, 65 ms late after a cold start; and stamped delays of 50 ms and more."""
    for name, options in (("arm.csv", []), ("stamps.csv", ["--stamps"])):
        script = [sys.executable, str(ROOT / "examples" / "make_log.py"), str(tmp_path / name), *options]
        subprocess.run(script, check=True)
    e = from_log(tmp_path / "arm.csv", 0.02)
    assert e.low <= 0.065 <= e.high
    assert (e.train_with, e.in_step) == ("episode:3:5", "4")
    assert from_log(tmp_path / "stamps.csv", 0.02).low > 0.05
