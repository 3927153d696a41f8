"""The controller's history matches the plant, whatever the network does."""

import dataclasses
import math
import threading
import time
from collections import Counter

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Counting, Setting, draw_events, draw_setting, play

from delayrl.deploy import ClockError, Controller, OverrunError, Statistics
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.wrappers import Delayed


def fuzz(sequences: int, seed: int) -> Counter:
    happened: Counter = Counter()
    for number in range(sequences):
        rng = np.random.default_rng([seed, number])
        setting = draw_setting(rng)
        events = draw_events(rng, setting, int(rng.integers(3, 25)))
        try:
            happened.update(play(setting, events))
        except AssertionError as error:
            raise AssertionError(f"sequence {number} of seed {seed}: {error}\n{setting}\n{events}") from error
    return happened


EVERYTHING = [
    *("new", "late", "duplicate", "invalid", "future", "reset", "held", "ClockError", "OverrunError", "DelayRLError"),
    *(f"age {age}" for age in range(10)),
]


def test_random_event_sequences_against_the_oracle() -> None:
    happened = fuzz(2_500, seed=1)
    assert all(happened[name] > 100 for name in EVERYTHING), happened


@pytest.mark.slow
def test_100_000_random_event_sequences_against_the_oracle() -> None:
    happened = fuzz(100_000, seed=0)
    assert all(happened[name] > 5_000 for name in EVERYTHING), happened


SETTINGS = st.builds(
    lambda seconds, age, κ, overrun, idle, held: Setting(seconds, age, min(κ, age), overrun, idle, min(held, age)),
    st.booleans(),
    st.integers(0, 4),
    st.integers(0, 2),
    st.sampled_from(["hold", "clip", "raise"]),
    st.sampled_from([None, 7.0]),
    st.sampled_from([0, 0, 1, 3, 4]),
)
EVENTS = st.one_of(
    st.tuples(st.just("wait"), st.integers(-4, 24), st.just(0)),
    st.tuples(st.just("observe"), st.integers(-8, 24), st.integers(0, 9)),
    st.tuples(st.just("act"), st.just(0), st.integers(0, 2)),
    st.tuples(st.just("override"), st.just(0), st.integers(0, 2)),
    st.tuples(st.just("applied"), st.integers(-1, 5), st.just(0)),
    st.tuples(st.just("reset"), st.just(0), st.integers(0, 1)),
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(SETTINGS, st.lists(EVENTS, max_size=40))
def test_any_event_sequence_against_the_oracle(setting: Setting, events: list) -> None:
    play(setting, events)


class Recorder:
    """A policy that records its inputs; the sequence of its actions is random and repeatable."""

    def __init__(self, env: gym.Env, max_age: int, dt: float | None = None) -> None:
        self.obs_size, self.action_size = env.observation_space.shape[0], env.action_space.shape[0]
        self.low, self.high, self.max_age, self.dt = env.action_space.low, env.action_space.high, max_age, dt
        self.rng = np.random.default_rng(5)
        self.shown: list = []

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        self.shown.append((obs, actions, age))
        return self.rng.uniform(self.low, self.high).astype(np.float32)


def assert_shown(policy: Recorder, obs: np.ndarray, info: dict) -> None:
    """The policy was shown what the wrapper shows."""
    got_obs, got_actions, got_age = policy.shown[-1]
    np.testing.assert_array_equal(got_obs, obs)
    np.testing.assert_array_equal(got_actions, info["actions"])
    assert got_age == info["age"]


@pytest.mark.parametrize("stamps", ["steps", "seconds"])
@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("delay", ["0", "1", "5", "uniform:0:4", "gilbert:1:5:0.2:0.4@fifo", "uniform:0:3+action=2"])
def test_shows_what_the_wrapper_shows(stamps: str, delay: str, first: int) -> None:
    """A network that brings observations in random order shows the policy what the wrapper shows.

    The first observation arrives `first` steps late. Until then nobody can act, and the plant is idle.
    """
    env = Delayed(gym.make("Pendulum-v1"), delay)
    policy = Recorder(env, env.history, dt=0.05)
    lag = env.delay.action.maximum
    # the control period; actions in flight and steps without a command take so many nominal ones
    uneven = 0.04 if lag or first else 0.2
    controller = Controller(policy, stamps=stamps, action_delay=lag, on_overrun="raise")
    rng = np.random.default_rng(0)
    clock = 100.0
    for episode in range(3):
        clock += 10
        controller.reset(clock if stamps == "seconds" else None)
        obs, info = env.reset(seed=episode)
        times, mailbox = [], {}
        for step in range(60):
            clock += 0.05 * rng.uniform(1 - uneven, 1 + uneven)
            times.append(clock)
            mailbox[step] = info["truth"]
            if step < first:
                obs, _, _, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
                continue
            now = clock if stamps == "seconds" else step
            shown = step - info["age"] + lag
            for k in rng.permutation([k for k in mailbox if k <= shown][-3:]):  # in any order, and again and again
                stamp = times[k] - 0.015 * rng.random() if stamps == "seconds" else int(k)
                if stamps == "steps" or k == shown:
                    controller.observe(mailbox[k], stamp, now)
            action = controller.act(now)
            assert_shown(policy, obs, info)
            obs, _, _, _, info = env.step(action)


@pytest.mark.parametrize("delay", ["uniform:1:4@wait", "uniform:0:3@wait+action=2"])
def test_holds_back_as_the_wrapper_waits(delay: str) -> None:
    """Messages overtake each other on the way; the policy is shown each once it has the longest delay."""
    env = Delayed(gym.make("Pendulum-v1"), delay)
    policy = Recorder(env, env.history)
    lag = env.delay.action.maximum
    controller = Controller(policy, action_delay=lag, min_age=env.delay.minimum, on_overrun="raise")
    assert env.delay.minimum == env.delay.maximum
    rng = np.random.default_rng(0)
    for episode in range(3):
        controller.reset()
        obs, info = env.reset(seed=episode)
        due: list[tuple[int, int, np.ndarray]] = []
        for step in range(40):
            travel = rng.integers(0, env.delay.observation.maximum + 1) if step else 0
            due.append((step + travel, step, info["truth"]))
            for arrival, k, values in due:
                if arrival == step:
                    assert controller.observe(values, k, step) == "new"
            action = controller.act(step)
            assert_shown(policy, obs, info)
            obs, _, _, _, info = env.step(action)
    assert controller.statistics.held > 100
    assert controller.statistics.late == 0


def test_what_is_held_back() -> None:
    """The policy's own `min_age` counts. Of a slow sensor a younger one is shown, rather than one that is too old."""
    policy = counting(4)
    policy.min_age = 4
    controller = Controller(policy)
    assert controller.serves.endswith("; held back until 4 steps late")
    for step in range(9):
        if step % 2 == 0:
            controller.observe([10.0 + step], step, step)
        controller.act(step)
    shown = [(obs - 10, age) for obs, _, age in policy.calls[1:]]  # the first call is of the constructor
    assert shown == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (2, 3), (2, 4), (4, 3), (4, 4)]
    assert controller.observe([0.0], 3) == "late"
    assert controller.observe([0.0], 5) == "new"  # which has been overtaken, and is not too old yet
    assert [controller.observe([0.0], k) for k in (5, 6)] == ["duplicate", "duplicate"]
    assert controller.statistics.overruns == 0


def test_the_statistics_are_of_the_link() -> None:
    """Whether an observation was held back or not, so that a link that is faster than trained is seen."""
    policy = counting(4)
    controller = Controller(policy, min_age=4)
    for step in range(40):
        controller.observe([float(max(0, step - 3))], max(0, step - 3), step)
        controller.act(step)
    assert [(obs, age) for obs, _, age in policy.calls[-3:]] == [(33, 4), (34, 4), (35, 4)]
    got = controller.statistics
    assert (got.age_min, got.age_max, got.age_mean, got.held, got.overruns) == (3, 3, 3, 36, 0)


def test_an_episode_begins_with_the_newest() -> None:
    """As training does: what came before the first command is not held back, and a fresh observation has no past."""
    policy = counting(4)
    controller = Controller(policy, min_age=4)
    for step in range(20):
        controller.observe([float(step)], step, step)
    for step in range(19, 26):
        controller.observe([float(step)], step, step)
        controller.act(step)
    assert [(obs, age) for obs, _, age in policy.calls[1:]] == [(19, age) for age in range(5)] + [(20, 4), (21, 4)]
    assert policy.calls[1][1] == [0, 0, 0, 0]


def test_stamps_that_repeat_after_the_clock_stepped_back_are_late() -> None:
    policy = counting(4)
    policy.dt = 1 / 16
    controller = Controller(policy, stamps="seconds", min_age=4)
    tenths = policy.dt / 10  # so that no stamp is that of one before
    for step in range(30):
        controller.observe([0.0], step * policy.dt, step * policy.dt)
        controller.act(step * policy.dt)
    again = [(step + 0.2) * policy.dt for step in range(20, 40)]
    assert [controller.observe([0.0], time, time + tenths) for time in again] == ["late"] * 9 + ["new"] * 11
    assert controller.statistics.late == 9


def counting(max_age: int = 3) -> Counting:
    return Counting(1, max_age)


def test_another_period_than_that_of_training_is_told() -> None:
    """As where milliseconds stand for seconds: all commands would fall into one step."""
    policy = counting()
    policy.dt = 0.04
    with pytest.warns(DelayWarning, match=r"learned with steps of 0.04 s; got dt = 40 s: ages are counted in these"):
        Controller(policy, stamps="seconds", dt=40)
    Controller(policy, stamps="seconds")
    Controller(policy, stamps="seconds", dt=0.041)


def test_actions_are_counted_not_the_clock() -> None:
    """A loop that runs at 0.7 of its nominal period: after five actions the age is 5, not round(5 · 0.7) = 4."""
    policy = counting(8)
    controller = Controller(policy, stamps="seconds", dt=0.1)
    controller.observe([0.0], 0.0, 0.0)
    for i in range(6):
        controller.act(0.07 * i)
    assert policy.calls[-1] == (0.0, [2, 3, 4, 5, 6, 0, 0, 0], 5)  # 1 was the first call, to warm up


def test_missed_periods_are_in_the_history() -> None:
    for idle, filled in ((None, 2.0), (0.0, 0.0)):
        policy = counting(8)
        controller = Controller(policy, stamps="seconds", dt=0.1, idle=None if idle is None else [idle])
        controller.observe([0.0], 0.0, 0.0)
        controller.act(0.0)
        controller.act(0.41)  # the loop stalled for three periods
        controller.act(0.5)
        assert policy.calls[-1] == (0.0, [2, filled, filled, filled, 3, 0, 0, 0], 5)
        assert controller.statistics.missed == 3


def test_a_slow_first_call_costs_no_action() -> None:
    """The policy compiles at its first call, which is over when the controller is made and is in no statistic."""
    clock = [0.0]

    class Slow(Counting):
        def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
            clock[0] += 0.0 if self.calls else 5.0
            return super().__call__(obs, actions, age)

    policy = Slow(1, 3)
    controller = Controller(policy, stamps="seconds", dt=0.1, clock=lambda: clock[0])
    for i in range(6):
        controller.observe([i], clock[0])
        controller.act()
        clock[0] += 0.1
    assert [age for *_, age in policy.calls] == [0] * 7
    assert controller.statistics.delay_mean == 0
    assert controller.statistics.period_mean == pytest.approx(0.1)
    assert controller.statistics.missed == 0


def test_the_cold_start_is_not_in_the_effective_delay() -> None:
    controller = Controller(counting(5))
    for t in range(30):
        if t >= 5 or t == 0:
            controller.observe([t], max(0, t - 5))
        controller.act()
    got = controller.statistics
    assert (got.age_mean, got.age_std, got.age_max, got.counted) == (5, 0, 5, 24)


@pytest.mark.parametrize(("stamps", "dt"), [("steps", 1.0), ("seconds", 0.25)])
@pytest.mark.parametrize("announced", [True, False])
def test_a_first_observation_that_comes_late_is_as_old_as_it_is(stamps: str, dt: float, announced: bool) -> None:
    """By the wrapper's count, s_0 has the age 5 at step 5, and the plant was idle before. Both modes agree."""
    policy = counting(8)
    controller = Controller(policy, stamps=stamps, idle=[7.0], **({} if stamps == "steps" else {"dt": dt}))
    if announced:
        controller.reset(0.0)
    assert controller.observe([1.0], 0.0, now=5 * dt) == "new"
    controller.act(5 * dt)
    controller.act(6 * dt)
    assert policy.calls[1:] == [(1.0, [7] * 5 + [0] * 3, 5), (1.0, [7] * 5 + [2, 0, 0], 6)]
    controller.observe([2.0], 5 * dt, now=7 * dt)
    controller.act(7 * dt)
    assert controller.statistics.counted == 0  # made before anybody had acted
    controller.observe([3.0], 6 * dt, now=8 * dt)
    controller.act(8 * dt)
    assert (controller.statistics.counted, controller.statistics.age_mean) == (1, 2)
    assert controller.statistics.missed == 5


def test_an_old_first_observation_is_an_overrun() -> None:
    controller = Controller(counting(), stamps="seconds", dt=0.25, on_overrun="raise")
    controller.observe([1.0], 0.0, now=100.0)
    with pytest.raises(OverrunError, match="400 steps old"):
        controller.act(100.0)
    controller.override([0.0], 100.0)
    assert controller.statistics.overruns == 1
    other = Controller(counting(), stamps="seconds", dt=0.25)
    other.override([0.0], 100.0)  # the episode begins with this command: what is older is not of it
    assert other.observe([1.0], 0.0, now=100.1) == "late"


def test_in_steps_a_lost_first_observation_needs_now() -> None:
    controller = Controller(counting())
    assert controller.observe([1.0], 1) == "future"
    assert controller.observe([1.0], 1, now=2) == "new"
    controller.act(2)
    assert controller.policy.calls[-1] == (1.0, [0, 0, 0], 1)


def test_what_single_precision_does_not_hold_is_not_used() -> None:
    controller = Controller(counting())
    controller.observe([1.0], 0)
    assert controller.observe([1e39], 1, now=1) == "invalid"
    controller.act(1)
    assert controller.policy.calls[-1][0] == 1.0


@pytest.mark.parametrize("huge", [1e16, 1e308, -1e308, 10**400, -(10**400)])
def test_times_beyond_reach(huge: float) -> None:
    controller = Controller(counting(), stamps="seconds", dt=0.25)
    assert controller.observe([1.0], huge, now=0.0) == "invalid"
    controller.observe([1.0], 0.0, now=0.0)
    for call in (controller.act, controller.reset, lambda now: controller.observe([1.0], 0.0, now)):
        with pytest.raises(ClockError):
            call(huge)
    controller.act(1e15)


def test_the_policys_own_action_delay() -> None:
    policy = counting()
    policy.action_delay = 2
    assert Controller(policy).action_delay == 2
    assert Controller(policy, action_delay=0).action_delay == 0


def test_an_observation_pushed_twice_is_one() -> None:
    controller = Controller(counting())
    assert [controller.observe([1.0], 0) for _ in range(3)] == ["new", "duplicate", "duplicate"]
    controller.act()
    assert controller.observe([2.0], 0) == "duplicate"


def test_halfway_between_two_steps_is_the_later() -> None:
    for offset, age in ((0.124, 2), (0.125, 1), (0.126, 1)):
        policy = counting()
        controller = Controller(policy, stamps="seconds", dt=0.25)
        controller.observe([0.0], 0.0, 0.0)
        controller.act(0.0)
        controller.act(0.25)
        controller.observe([1.0], 0.0 + offset, 0.5)
        controller.act(0.5)
        assert policy.calls[-1][2] == age


@pytest.mark.parametrize("on_overrun", ["hold", "clip", "raise"])
def test_overruns(on_overrun: str) -> None:
    policy = counting(2)
    controller = Controller(policy, on_overrun=on_overrun)
    controller.observe([0.0], 0)
    assert [controller.act()[0] for _ in range(3)] == [2, 3, 4]
    if on_overrun == "raise":
        with pytest.raises(OverrunError, match="ages up to 2; the newest is 3 steps old"):
            controller.act()
        assert controller.step == 2  # nothing was recorded
        controller.override([9.0])
        controller.observe([1.0], 3)
        controller.act()
        assert policy.calls[-1] == (1.0, [9, 0], 1)
    elif on_overrun == "hold":
        assert [controller.act()[0] for _ in range(2)] == [4, 4]
        controller.observe([1.0], 4)
        controller.act()
        assert policy.calls[-1] == (1.0, [4, 0], 1)
    else:
        controller.act()
        assert policy.calls[-1] == (0.0, [2, 3], 2)
        controller.act()
        assert policy.calls[-1] == (0.0, [2, 3], 2)
    assert controller.statistics.overruns == (1 if on_overrun == "raise" else 2)


def test_hold_stays_in_the_policys_range() -> None:
    """The history keeps what the plant did, which may lie beyond it."""
    policy = counting(1)
    policy.low, policy.high = np.float32([-3]), np.float32([3])
    controller = Controller(policy, idle=[-9.0])
    controller.observe([0.0], 0, now=2)
    assert controller.act(2) == -3
    controller.override([50.0])
    assert controller.act() == 3
    controller.applied([-50.0])
    assert controller.act() == -3
    controller.observe([1.0], 5)
    controller.applied([7.0])
    controller.observe([1.0], 5, now=6)
    assert controller.act() == 2


@pytest.mark.parametrize("lag", [0, 2])
def test_after_missed_periods_hold_goes_on_as_the_plant(lag: int) -> None:
    for idle, held in ((None, 2.0), ([0.0], 0.0)):
        controller = Controller(counting(2), stamps="seconds", dt=0.25, idle=idle, action_delay=lag)
        controller.observe([0.0], 0.0, 0.0)
        assert controller.act(0.0) == 2
        assert controller.act(2.0) == held  # the loop stalled; the plant has gone on by itself
        controller.override([9.0], 2.25)
        assert [controller.act(2.5), controller.act(2.5625), controller.act(3.0)] == [9, 9, 9 if idle is None else 0]


def test_what_the_plant_really_did() -> None:
    policy = counting(4)
    controller = Controller(policy)
    controller.observe([0.0], 0)
    for _ in range(3):
        controller.act()
    assert controller.applied([0.5], 1)
    controller.applied([-0.5])
    controller.act()
    assert policy.calls[-1] == (0.0, [2, 0.5, -0.5, 0], 3)
    with pytest.raises(DelayRLError, match="4 steps, from 0 on; got step 4"):
        controller.applied([0.0], 4)


def test_a_report_that_comes_after_missed_steps_corrects_them_too() -> None:
    """The plant went on with what it did; what was commanded since, and what `idle` says, stays."""
    for idle, history in ((None, [0.5, 0.5, 0.5, 0.25]), ([0.0], [0.5, 0.0, 0.0, 0.25])):
        policy = Counting(1, 8)
        controller = Controller(policy, dt=None, idle=idle)
        controller.observe([0.0], 0, now=0)
        controller.act(0)
        controller.act(3)
        controller.applied([0.25])
        assert controller.applied([0.5], 0)
        controller.act(4)
        assert policy.calls[-1][1][:4] == history


def test_actions_in_flight_add_to_the_age() -> None:
    """With κ = 2 the plant does the n-th action in step n + 2; before that it is idle."""
    policy = counting(4)
    controller = Controller(policy, action_delay=2)
    plant = [0.0, 0.0]  # what it does in step 0, 1, ...
    for t in range(10):
        controller.observe([t], t)
        plant.append(float(controller.act()[0]))
        assert policy.calls[-1] == (t, [*plant[t : t + 2], 0, 0], 2)


def test_actions_lie_in_the_policys_range() -> None:
    policy = counting()
    policy.high = np.float32([2.5])
    controller = Controller(policy)
    controller.observe([0.0], 0)
    assert [controller.act()[0] for _ in range(2)] == [2, 2.5]


def test_episodes_do_not_mix() -> None:
    policy = counting()
    controller = Controller(policy)
    controller.observe([0.0], 0)
    controller.act()
    controller.reset()
    assert not controller.ready
    assert controller.observe([8.0], 0, episode=0) == "late"  # still travelling when the episode ended
    with pytest.raises(DelayRLError, match="wait until"):
        controller.act()
    controller.observe([9.0], 0, episode=1)
    controller.act()
    assert policy.calls[-1] == (9.0, [0, 0, 0], 0)
    assert not controller.applied([5.0], 0, episode=0)  # so was this report
    assert controller.applied([6.0], 0, episode=1)
    controller.act()
    assert policy.calls[-1] == (9.0, [6, 0, 0], 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.observe([1.0, 2.0], 0), "observations of size 1; got shape"),
        (lambda c: c.observe(["a"], 0), "array of numbers"),
        (lambda c: c.observe([1.0], 0.5), "whole numbers; got 0.5"),
        (lambda c: c.observe([1.0], True), "a number of steps; got True"),
        (lambda c: c.observe([1.0], "0"), "a number of steps"),
        (lambda c: c.act(math.nan), "must be finite"),
        (lambda c: c.act(-1), "steps count from 0"),
        (lambda c: c.override([math.nan]), "1 finite numbers"),
        (lambda c: c.applied([1.0]), "0 steps"),
        (lambda c: c.applied([1.0], 0.0), "whole number; got 0.0"),
        (lambda c: c.applied([1.0], "a"), "whole number; got 'a'"),
        (lambda c: c.observe([10**400], 0), "array of numbers"),
        (lambda c: c.override([1e39]), "1 finite numbers"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(call, message: str) -> None:
    controller = Controller(counting())
    with pytest.raises(DelayRLError, match=message) as caught:
        call(controller)
    assert "\n" not in str(caught.value)
    assert dataclasses.asdict(controller.statistics) == pytest.approx(
        dataclasses.asdict(Controller(counting()).statistics), nan_ok=True
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stamps": "ticks"}, "in steps or in seconds"),
        ({"on_overrun": "panic"}, "hold, clip or raise"),
        ({"action_delay": -1}, "whole steps"),
        ({"action_delay": 4}, "longest age 3"),
        ({"min_age": 4}, "min_age is 4 steps, and the policy's longest age 3"),
        ({"min_age": 1.0}, "min_age counts whole steps; got 1.0"),
        ({"dt": 0.1}, "steps have no length"),
        *(({"stamps": "seconds", "dt": dt}, "give dt") for dt in (0.0, "0.1", True, 1e-300, 1e7, math.nan)),
        ({"idle": [1.0, 2.0]}, "idle must be 1 finite"),
    ],
)
def test_bad_settings_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(DelayRLError, match=message):
        Controller(counting(), **arguments)


class Direction:
    """A policy without `dt`, whose action has no value at an observation of zeros, as that of the first call is."""

    obs_size, max_age, low, high = 1, 3, np.float32([-1]), np.float32([1])

    def __init__(self, action_size: int) -> None:
        self.action_size = action_size

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return obs / np.linalg.norm(obs)


def test_what_is_no_policy_is_refused_at_once() -> None:
    """Not at the first command, when the plant waits for it."""
    one = Direction(2)
    one.low, one.high = np.full(2, -1.0), np.ones(2)
    with pytest.raises(DelayRLError, match=r"the policy's action must be 2 numbers; got shape \(1,\)"):
        Controller(one)
    with pytest.raises(DelayRLError, match=r"a policy also says its obs_size, action_size, low, high, max_age \(see"):
        Controller(np.sin)
    controller = Controller(Direction(1))
    controller.observe([2.0], 0)
    assert controller.act() == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"max_age": 3.0}, "whole number of steps, 0 or more; got 3.0"),
        ({"max_age": -1}, "got -1"),
        ({"low": np.zeros(2)}, r"are 1 numbers each.*got \[0.0, 0.0\] and \[2.0\]"),
        ({"high": np.float32([-3])}, "none of low above"),
        ({"low": np.float32([np.nan])}, "none of low above"),
    ],
)
def test_what_a_policy_says_of_itself_is_checked(changes: dict, words: str) -> None:
    policy = Recorder(gym.make("Pendulum-v1"), 3)
    vars(policy).update(changes)
    with pytest.raises(DelayRLError, match=words):
        Controller(policy)


def test_a_policy_may_overwrite_its_inputs() -> None:
    class Overwriter(Counting):
        def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
            action = super().__call__(obs, actions, age)
            obs[:], actions[:] = -1, -1
            return action

    policy = Overwriter(1, 3)
    controller = Controller(policy)
    controller.observe([5.0], 0)
    for _ in range(3):
        controller.act()
    assert policy.calls[-1] == (5.0, [2, 3, 0], 2)


@pytest.mark.parametrize("on_overrun", ["hold", "clip"])
def test_an_observation_older_than_the_history(on_overrun: str) -> None:
    """Still an overrun: `clip` has nothing to show and holds, and the age is a sensible estimate."""
    controller = Controller(counting(2), stamps="seconds", dt=0.25, on_overrun=on_overrun)
    controller.observe([1.0], 90.0, 90.0)  # 40 periods before the first command
    for i in range(300):
        action = controller.act(100 + 0.25 * i)
    assert controller.statistics.overruns == 300
    assert controller.statistics.counted == 0  # nothing newer than step 0 has arrived
    controller.observe([1.0], 101.0, 180.0)
    assert controller.act(100 + 0.25 * 300) == action
    assert controller.statistics.age_max == 296
    controller.act(1e9)  # a stall of many steps does not grow the history
    controller.observe([2.0], 1e9, 1e9)
    controller.act(1e9 + 0.25)
    assert controller.policy.calls[-1][0::2] == (2.0, 1)
    with pytest.raises(DelayRLError, match="steps, from 0 on"):
        controller.applied([0.0], controller.step + 1)
    assert not controller.applied([0.0], 0)


def test_a_policy_without_a_number_is_not_recorded() -> None:
    policy = counting()
    controller = Controller(policy)
    controller.observe([0.0], 0)
    controller.policy = lambda obs, actions, age: np.float32([np.nan])
    controller.policy.action_size, controller.policy.max_age = 1, 3
    with pytest.raises(DelayRLError, match="the policy's action must be"):
        controller.act()
    assert controller.step == -1


def test_time_must_go_forward() -> None:
    controller = Controller(counting(), stamps="seconds", dt=0.1)
    controller.observe([0.0], 5.0, 5.0)
    with pytest.raises(ClockError, match="more than half a step before the newest observation, made at 5"):
        controller.act(4.9)
    controller.act(5.0)
    for now in (5.0, 4.0, -math.inf):
        with pytest.raises(ClockError):
            controller.act(now)
    controller.act(5.1)
    assert controller.step == 1


def test_two_threads() -> None:
    """Threads bring observations, duplicated and shuffled, while another acts: inputs of the policy stay consistent."""
    seen: list[tuple[float, list[float], int]] = []
    given: list[float] = []  # step -> action

    class Slow(Counting):
        def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
            action = super().__call__(obs, actions, age)
            seen.append(self.calls[-1])
            finished.wait(0.0003)
            return action

    finished, broken = threading.Event(), []
    controller = Controller(Slow(1, 6), on_overrun="hold")
    controller.observe([0.0], 0)
    seen.clear()

    def network(seed: int) -> None:
        rng = np.random.default_rng(seed)
        try:
            while not finished.is_set():
                newest = controller.step + 1
                k = max(0, newest - int(rng.integers(0, 6)))
                controller.observe([float(k)], k)  # s_k says k
                assert isinstance(controller.statistics, Statistics)
                finished.wait(1e-4)
        except BaseException as error:
            broken.append(error)

    threads = [threading.Thread(target=network, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    asked: list[tuple[float, list[float], int] | None] = []
    deadline = time.monotonic() + 60
    try:
        while len(seen) < 250 and time.monotonic() < deadline:
            before = len(seen)
            given.append(float(controller.act()[0]))
            asked.append(seen[-1] if len(seen) > before else None)
            if asked[-1] is None:  # all observations are too old: yield to the network
                time.sleep(0.001)
    finally:
        finished.set()
        for thread in threads:
            thread.join(10)
    assert not broken
    assert not any(thread.is_alive() for thread in threads)
    checked = 0
    for n, call in enumerate(asked):
        if call is not None:
            k, actions, age = call
            assert (age, actions) == (n - k, given[int(k) : n] + [0.0] * (6 - age))
            checked += 1
    assert len(seen) >= 250, f"{len(given)} decisions in a minute, and {len(seen)} were not too late"
    assert checked == len(seen)
    got = controller.statistics
    assert got.decisions == len(given)
    assert got.new <= len(given) + 1


def test_refused_decisions_show_why() -> None:
    """A link slower than the policy's longest age: nothing is decided, and the delays that were met are told."""
    controller = Controller(counting(2), stamps="seconds", dt=1.0, on_overrun="raise")
    for step in range(8):
        if step >= 4:
            controller.observe([0.0], step - 4, now=step)
            with pytest.raises(OverrunError):
                controller.act(step)
        controller.override([0.0], step)
    seen = controller.statistics
    assert (seen.decisions, seen.overruns, seen.counted) == (0, 4, 3)
    assert (seen.age_min, seen.age_max, seen.delay_mean) == (4, 4, 4.0)
