"""What a controller must show, by brute force: all events are kept, and every answer is computed from all of them.

Events are (kind, x, y) with small whole numbers, which a fuzzer and `hypothesis` can make. Times are multiples
of a quarter of a period of 1/16 s, so that floating point is exact and halfway cases happen all the time.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from delayrl.deploy import ClockError, Controller, OverrunError
from delayrl.deploy.runtime.controller import EXTRA_STEPS
from delayrl.errors import DelayRLError

DT = 1 / 16
Event = tuple[str, int, int]


def nearest(x: float) -> int:
    """The nearest whole number; halfway, the larger."""
    return min(range(int(x) - 1, int(x) + 2), key=lambda m: (abs(x - m), -m))


@dataclass(frozen=True)
class Setting:
    """The settings of a controller, as numbers."""

    seconds: bool
    max_age: int
    action_delay: int
    on_overrun: str
    idle: float | None
    min_age: int = 0
    obs_size: int = 1

    @property
    def period(self) -> float:
        return DT if self.seconds else 1


class Counting:
    """A policy whose n-th action is n, and which records its inputs."""

    action_size = 1
    dt: float | None = None
    low, high = np.float32([-1e6]), np.float32([1e6])

    def __init__(self, obs_size: int, max_age: int) -> None:
        self.obs_size, self.max_age = obs_size, max_age
        self.calls: list[tuple[float, list[float], int]] = []

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        assert actions.shape == (self.max_age, 1)
        assert obs.shape == (self.obs_size,)
        self.calls.append((float(obs[0]), actions[:, 0].tolist(), age))
        return np.float32([len(self.calls)])


@dataclass
class Oracle:
    """Keeps the events of the present episode and the counts of all episodes."""

    setting: Setting
    episode: int = 0
    start: float | None = 0.0  # None until the first observation or command sets it
    # ("obs", stamp, content) | ("command", now, action) | ("fix", step, action), as far as they were accepted
    log: list[tuple[str, float, float]] = field(default_factory=list)
    shown: float = -math.inf  # the stamp of the observation that was shown last in this episode
    latest: float = -math.inf  # the latest time that an observation came at
    tally: dict[str, int] = field(default_factory=dict)
    ages: list[int] = field(default_factory=list)
    delays: list[float] = field(default_factory=list)
    periods: list[float] = field(default_factory=list)
    missed: int = 0
    replaced: int = 0
    held: int = 0

    def __post_init__(self) -> None:
        self.start = None if self.setting.seconds else 0.0

    def before(self, when: float) -> int:
        """Whole steps from the start of the episode to a time."""
        return 0 if self.start is None else max(0, nearest((when - self.start) / self.setting.period))

    def count(self, name: str) -> None:
        self.tally[name] = self.tally.get(name, 0) + 1

    def steps(self, until: float | None = None) -> tuple[list[float], list[float], int, int]:
        """Beginnings and actions of all steps, and how many were missed and replaced.

        With `until`, there is one more beginning: that of the step of a command at that time.
        """
        s, begins, actions, missed, replaced = self.setting, [], [], 0, 0
        goes_on: set[int] = set()  # steps without a command that repeat the one before
        commands = [e for e in self.log if e[0] != "obs"] + ([("command", until, None)] if until is not None else [])
        for kind, when, action in commands:
            if kind == "fix":  # what the plant went on with, it went on with as corrected
                actions[int(when)] = action
                for i in range(int(when) + 1, len(actions)):
                    if i not in goes_on:
                        break
                    actions[i] = action
                continue
            begin = when + s.action_delay * s.period
            if not begins:
                missed += self.before(when)
                quiet = s.action_delay + self.before(when)
                for i in range(quiet):
                    begins.append(begin - (quiet - i) * s.period)
                    actions.append(0.0 if s.idle is None else s.idle)
            else:
                gap = nearest((begin - begins[-1]) / s.period)
                if gap == 0:
                    replaced += 1
                    if action is None:
                        return begins, actions[:-1], missed, replaced
                    actions[-1] = action
                    continue
                missed += gap - 1
                for _ in range(gap - 1):
                    if s.idle is None:
                        goes_on.add(len(actions))
                    begins.append(begins[-1] + s.period)
                    actions.append(actions[-1] if s.idle is None else s.idle)
            begins.append(begin)
            if action is not None:
                actions.append(action)
        return begins, actions, missed, replaced

    def commands(self) -> list[float]:
        return [when for kind, when, _ in self.log if kind == "command"]

    def observations(self) -> list[tuple[float, float]]:
        return [(stamp, content) for kind, stamp, content in self.log if kind == "obs"]

    def elapsed(self) -> float:
        return max(0, len(self.steps()[1]) - self.setting.action_delay)

    def observe(self, content: float, stamp: float, now: float, episode: int | None) -> str:
        seen = self.observations()
        in_episode = episode in (None, self.episode) and (self.start is None or stamp >= self.start)
        if not abs(content) <= 3.4e38 or not abs(stamp) <= 1e15 or (stamp < 0 and not self.setting.seconds):
            verdict = "invalid"
        elif not in_episode:
            verdict = "late"
        elif stamp - now > self.setting.period / 2:
            verdict = "future"
        elif any(stamp == other for other, _ in seen if other >= self.held_from()):
            verdict = "duplicate"
        elif stamp < self.held_from() or (self.holds() and now < self.latest - self.setting.period / 2):
            verdict = "late"
        else:
            verdict = "new"
            self.log.append(("obs", stamp, content))
            self.start = stamp if self.start is None else self.start
        if verdict != "invalid" and not (verdict == "late" and not in_episode):
            self.latest = max(self.latest, now)
        self.count(verdict)
        return verdict

    def held_from(self) -> float:
        """The stamp that an observation must not be older than."""
        newest = max((stamp for stamp, _ in self.observations()), default=-math.inf)
        return self.shown if self.holds() else newest

    def holds(self) -> bool:
        return self.setting.min_age > 0 and self.commands() != []

    def forward(self, now: float) -> None:
        if not abs(now) <= 1e15 or (now < 0 and not self.setting.seconds) or any(c >= now for c in self.commands()):
            raise ClockError

    def act(self, now: float) -> tuple[int, float, list[float], list[float]]:
        """Age, content, the actions since, all of them; and all actions up to now, those of missed steps included."""
        self.forward(now)
        if not self.observations():
            raise DelayRLError
        newest_stamp, _ = newest = max(self.observations())
        if newest_stamp - now > self.setting.period / 2:
            raise ClockError
        begins, actions, *_ = self.steps(now)
        past = self.steps()[1]

        def step_of(stamp: float) -> int:
            nearest = min(range(len(begins)), key=lambda j: (abs(begins[j] - stamp), -j))
            return min(nearest, len(begins) - 1 - self.setting.action_delay)

        newest_age = len(begins) - 1 - step_of(newest_stamp)
        waiting = [newest]
        if self.holds():
            waiting = sorted(seen for seen in self.observations() if seen[0] >= self.shown)
        old = [seen for seen in waiting if len(begins) - 1 - step_of(seen[0]) >= self.setting.min_age]
        young = waiting[max(1, len(old)) :]
        stamp, content = max(old) if old else min(waiting)
        if young and len(begins) - 1 - step_of(stamp) > self.setting.max_age:
            stamp, content = min(young)
        self.shown, step = stamp, step_of(stamp)
        age = len(begins) - 1 - step
        warm = bool(self.commands()) and step_of(newest_stamp) > self.before(self.commands()[0])
        refused = age > self.setting.max_age and self.setting.on_overrun == "raise"
        if warm:
            self.ages.append(newest_age)
            self.delays.append(now - newest_stamp)
            self.periods += [] if refused else [now - max(self.commands())]
        if age > self.setting.max_age:
            self.count("overruns")
        if refused:
            raise OverrunError
        self.held += age > newest_age
        return age, content, actions[step:], [*past, *actions[len(past) :]]

    def command(self, now: float, action: float) -> None:
        if not self.commands():
            self.shown = max((stamp for stamp, _ in self.observations()), default=-math.inf)
        self.log.append(("command", now, action))
        self.start = now if self.start is None else self.start

    def applied(self, step: int, action: float) -> None:
        if not 0 <= step < len(self.steps()[1]):
            raise DelayRLError
        self.log.append(("fix", step, action))

    def reset(self, now: float) -> None:
        *_, missed, replaced = self.steps()
        self.missed, self.replaced = self.missed + missed, self.replaced + replaced
        self.episode, self.start, self.log = self.episode + 1, now if self.setting.seconds else 0.0, []
        self.shown = self.latest = -math.inf


def play(setting: Setting, events: list[Event]) -> dict[str, int]:
    """Give the same events to a controller and to the oracle, which must agree; return counts of what happened."""
    world = 0.0  # the clock
    policy = Counting(setting.obs_size, setting.max_age)
    policy.dt = setting.period
    controller = Controller(
        policy,
        stamps="seconds" if setting.seconds else "steps",
        action_delay=setting.action_delay,
        min_age=setting.min_age,
        on_overrun=setting.on_overrun,
        idle=None if setting.idle is None else [setting.idle],
        clock=lambda: world,
    )
    oracle = Oracle(setting)
    unit = DT / 4 if setting.seconds else 1
    sent: list[tuple[float, float]] = []
    chosen = 0
    happened: dict[str, int] = {}
    exact = True

    def both(real: Any, expected: Any) -> tuple[Any, Any]:
        try:
            wanted: Any = expected()
        except DelayRLError as error:
            wanted = type(error)
        try:
            given: Any = real()
        except DelayRLError as error:
            given = type(error)
        name = wanted.__name__ if isinstance(wanted, type) else "fine"
        happened[name] = happened.get(name, 0) + 1
        return given, wanted

    for number, (kind, x, y) in enumerate(events):
        explicit = y % 2 == 0
        default = world if setting.seconds else oracle.elapsed()
        now = world if explicit else default
        argument = world if explicit else None
        if kind in ("act", "override") and y == 2:
            now = argument = [1e16, -1e308, 10**400, math.nan][number % 4]
        value = 1000.0 + number
        if kind == "wait":
            world += x * unit
        elif kind == "observe":
            stamp, content, episode = world - x * unit, float(number), None
            match y // 2:
                case 1 if sent:  # again, or for the first time: one that was made before
                    stamp, content = sent[x % len(sent)]
                case 2:
                    content = [math.nan, math.inf, -math.inf, 1e39, -1e300][x % 5]
                case 3:
                    stamp = [math.nan, math.inf, -math.inf, 1e16, -1e308, 10**400][x % 6]
                case 4:
                    episode = oracle.episode - x % 2
                case _:
                    pass
            sent.append((stamp, content))
            obs = [content] * setting.obs_size
            given, wanted = both(
                lambda: controller.observe(obs, stamp, argument, episode=episode),  # noqa: B023
                lambda: oracle.observe(content, stamp, now, episode),  # noqa: B023
            )
            assert given == wanted, (number, given, wanted)
            happened[wanted] = happened.get(wanted, 0) + 1
        elif kind == "act":
            asked = len(policy.calls)
            given, wanted = both(lambda: controller.act(argument), lambda: oracle.act(now))  # noqa: B023
            if isinstance(wanted, type) or isinstance(given, type):
                assert given == wanted, (number, given, wanted)
                assert len(policy.calls) == asked, "the policy was asked for nothing"
                continue
            age, content, since, past = wanted
            remembered = age <= setting.max_age + setting.action_delay + EXTRA_STEPS
            exact = exact and remembered
            happened[f"age {min(age, 9)}"] = happened.get(f"age {min(age, 9)}", 0) + 1
            if len(policy.calls) > asked:
                shown = min(age, setting.max_age)
                assert age <= setting.max_age or setting.on_overrun == "clip"
                assert len(since) == age
                expected = (content, since[:shown] + [0.0] * (setting.max_age - shown), shown)
                assert policy.calls[-1] == expected, (number, policy.calls[-1], expected)
                action = float(len(policy.calls))
            else:  # an overrun, with nothing to be shown
                assert age > setting.max_age
                assert setting.on_overrun == "hold" or not remembered
                action = past[-1] if past else (0.0 if setting.idle is None else setting.idle)
            assert given.tolist() == [action], (number, given, action)
            given[0] = math.nan  # the caller's array is the caller's
            oracle.command(now, action)
            oracle.count("decisions")
            chosen += 1
        elif kind == "override":
            given, wanted = both(lambda: controller.override([value], argument), lambda: oracle.forward(now))  # noqa: B023
            assert given == wanted, (number, given, wanted)
            if wanted is None:
                oracle.command(now, value)
                oracle.count("overridden")
        elif kind == "applied":
            step = controller.step - x
            given, wanted = both(
                lambda: controller.applied([value], step),  # noqa: B023
                lambda: oracle.applied(step, value),  # noqa: B023
            )
            assert given == wanted if isinstance(wanted, type) else given in (True, False)
            exact = exact and given is not False
        elif kind == "reset":
            controller.reset(argument if setting.seconds else None)
            oracle.reset(now)
            world = world if setting.seconds else 0.0
            happened["reset"] = happened.get("reset", 0) + 1
        assert controller.episode == oracle.episode
        assert controller.ready == bool(oracle.observations())
        assert controller.step == len(oracle.steps()[1]) - 1

    got = controller.statistics
    for name in ("new", "late", "duplicate", "invalid", "future", "decisions", "overruns", "overridden"):
        assert getattr(got, name) == oracle.tally.get(name, 0), name
    *_, missed, replaced = oracle.steps()
    assert (got.missed, got.replaced) == (oracle.missed + missed, oracle.replaced + replaced)
    assert (got.counted, got.held) == (len(oracle.ages), oracle.held)
    happened["held"] = oracle.held
    if exact and oracle.ages:
        assert (got.age_min, got.age_max) == (min(oracle.ages), max(oracle.ages))
        moments = [("age", oracle.ages)]
        if setting.seconds:
            moments += [("delay", oracle.delays), ("period", oracle.periods)]
        for name, values in moments:
            expected = (np.mean(values), np.std(values)) if values else (np.nan, np.nan)
            np.testing.assert_allclose((getattr(got, f"{name}_mean"), getattr(got, f"{name}_std")), expected, atol=1e-9)
    return happened


def draw_setting(rng: np.random.Generator) -> Setting:
    max_age = int(rng.integers(0, 7))
    return Setting(
        seconds=bool(rng.integers(2)),
        max_age=max_age,
        action_delay=int(rng.integers(0, min(2, max_age) + 1)) if rng.random() < 0.4 else 0,
        on_overrun=["hold", "clip", "raise"][rng.integers(3)],
        idle=None if rng.random() < 0.6 else 7.0,
        min_age=int(rng.integers(1, max_age + 1)) if max_age and rng.random() < 0.4 else 0,
        obs_size=int(rng.integers(1, 3)),
    )


def draw_events(rng: np.random.Generator, setting: Setting, length: int) -> list[Event]:
    """A control loop on a bad network: mostly regular, with everything that can go wrong in between."""
    ticks = 4 if setting.seconds else 1
    chaos = rng.choice([0.05, 0.3])
    calm = rng.random(length) > chaos
    kinds = rng.integers(0, 20, length)
    numbers = rng.integers(0, 1000, (length, 3))
    events: list[Event] = [("observe", 0, 0)]
    travel = int(rng.integers(0, setting.max_age + 2)) * ticks
    for i in range(length):
        a, b, c = (int(n) for n in numbers[i])
        if calm[i]:  # one period: maybe an observation arrives, then the command
            events.append(("wait", ticks if not setting.seconds or b % 3 else 3 + a % 3, 0))
            if a % 8:
                events.append(("observe", travel + (b % 3) * ticks - (c % 3 if setting.seconds else 0), c % 2))
            events.append(("act", 0, c % 2))
            continue
        match int(kinds[i]):
            case 0 | 1 | 2:
                events.append(("wait", a % (6 * ticks), 0))
            case 3:
                events.append(("wait", -(a % (3 * ticks) + 1), 0))
            case 4 if a % 20 == 0:
                events.append(("wait", (b % 300) * ticks, 0))
            case 5 | 6:
                events.append(("act", 0, b % 3))
            case 7 | 8:
                events.append(("override", 0, b % 3))
            case 9 | 10:
                events.append(("applied", a % 6 - 1, 0))
            case 11:
                events.append(("reset", 0, b % 2))
            case _:
                events.append(("observe", a % (8 * ticks) - 2 * ticks, b % 10))
    return events
