"""Delay laws, channels and their text form; bad ones are refused in one line."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from delayrl.delays import (
    PAPER_STOCHASTIC_5,
    Channel,
    Choice,
    Constant,
    Delay,
    DelayLaw,
    DelayLike,
    Markov,
    PerEpisode,
    Recorded,
    any_phase,
    as_delay,
    gamma,
    gilbert_elliott,
    in_other_unit,
    poisson,
    random_walk,
    recorded,
    short_label,
    uniform,
)
from delayrl.errors import DelayRLError
from strategies import DELAYS, LAWS


def drawn(law: object, count: int, seed: int = 0) -> list[int]:
    """Draw the delays of one long episode."""
    random, state, values = np.random.default_rng(seed), 0, []
    for _ in range(count):
        value, state = law.draw(state, random)  # type: ignore[attr-defined]
        values.append(value)
    return values


@given(DELAYS)
def test_text_round_trip(delay: Delay) -> None:
    assert short_label(delay.plain()) == short_label(delay.label()) == delay.label()
    assert as_delay(delay.plain()) == delay
    assert as_delay(str(delay)) == delay
    assert len(str(delay.label())) <= max(len(str(delay.plain())), 12)


@given(LAWS, st.integers(0, 5), st.integers(0, 100))
def test_laws_stay_in_their_range_and_are_observed_later(law: DelayLaw, more: int, seed: int) -> None:
    values = drawn(law, 50, seed)
    assert all(0 <= value <= law.maximum for value in values)
    observed = Delay(Channel(law), Channel(Constant(more))).observed()
    assert "Sum(" in str(observed) or as_delay(str(observed)) == observed  # a user's law has no text that is longer
    assert observed.maximum == law.maximum + more
    assert drawn(observed.observation.law, 50, seed) == [value + more for value in values]


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (uniform(2, 4), {2: 1 / 3, 3: 1 / 3, 4: 1 / 3}),
        (Choice((1, 5), (0.1, 0.9)), {1: 0.1, 5: 0.9}),
        (PAPER_STOCHASTIC_5.law, {1: 0.02, 2: 0.02, 3: 0.02, 4: 0.02, 5: 0.92}),
        (gilbert_elliott(1, 6, 0.05, 0.3), {1: 6 / 7, 6: 1 / 7}),  # stationary: recover / (worsen + recover)
        (random_walk(3), {k: 1 / 4 for k in range(4)}),
    ],
)
def test_frequencies(law: Choice | Markov, expected: dict[int, float]) -> None:
    """The share of every delay, in the long run and in the first draw of an episode."""
    counts = np.bincount(drawn(law, 40_000), minlength=7) / 40_000
    first = np.bincount([law.draw(0, np.random.default_rng(seed))[0] for seed in range(4000)], minlength=7) / 4000
    for k in range(7):
        assert counts[k] == pytest.approx(expected.get(k, 0), abs=0.02)
        assert first[k] == pytest.approx(expected.get(k, 0), abs=0.03)


def test_truncated_distributions_against_scipy() -> None:
    law = poisson(3, 8)
    pmf = stats.poisson.pmf(np.arange(9), 3)
    np.testing.assert_allclose(law.probabilities, pmf / pmf.sum(), rtol=1e-12)
    for mean, deviation, maximum in ((3.0, 1.5, 8), (0.7, 2.0, 6), (20.0, 2.0, 30), (2.5, 0.1, 5)):
        shape, scale = (mean / deviation) ** 2, deviation**2 / mean
        mass = np.diff(stats.gamma.cdf(np.arange(maximum + 1), shape, scale=scale), prepend=0)
        np.testing.assert_allclose(gamma(mean, deviation, maximum).probabilities, mass / mass.sum(), atol=1e-12)


def test_bursts() -> None:
    """Bad delays of a Gilbert-Elliott network come in runs of mean length 1 / recover."""
    values = np.array(drawn(gilbert_elliott(0, 1, 0.05, 0.2), 50_000))
    starts = ((values[1:] == 1) & (values[:-1] == 0)).sum()
    assert values.sum() / starts == pytest.approx(5, rel=0.1)
    np.testing.assert_allclose(random_walk(3).transitions[1], [1 / 3, 1 / 3, 1 / 3, 0])
    steps = np.abs(np.diff(drawn(random_walk(9, 0.5), 20_000)))
    assert set(steps) == {0, 1}
    assert steps.mean() == pytest.approx(0.5 * 0.9, abs=0.02)  # at 2 of 10 states half of the moves are not taken


def test_of_each_episode() -> None:
    """The first message draws, by the law inside; the others repeat it."""
    inner = gilbert_elliott(1, 6, 0.05, 0.3)
    first = []
    for seed in range(4000):
        values = drawn(PerEpisode(inner), 20, seed)
        assert len(set(values)) == 1
        assert values[0] == inner.draw(0, np.random.default_rng(seed))[0]
        first.append(values[0])
    assert np.mean(np.array(first) == 6) == pytest.approx(1 / 7, abs=0.02)
    assert drawn(PerEpisode(PerEpisode(uniform(2, 4))), 9) == drawn(PerEpisode(uniform(2, 4)), 9)


@pytest.mark.parametrize(
    ("text", "law", "written"),
    [
        ("episode:2:4", uniform(2, 4), "episode:2:4"),
        ("episode:uniform:2:4", uniform(2, 4), "episode:2:4"),
        ("episode:0.05s:120ms", uniform(2, 3), "episode:2:3"),
        ("episode:choice:40ms=0.5,80ms=0.5", Choice((1, 2), (0.5, 0.5)), "episode:choice:1=0.5,2=0.5"),
        ("episode:walk:3", random_walk(3), "episode:walk:3"),
        ("episode:recorded:3,1,", Recorded((3, 1)), "episode:recorded:3,1,"),
        ("episode:3", Constant(3), "episode:3"),
        ("episode:1e1:20", uniform(10, 20), "episode:10:20"),
    ],
)
def test_texts_of_episodes(text: str, law: DelayLaw, written: str) -> None:
    delay = as_delay(f"{text}@fifo+action={text}", 0.04)
    assert delay.observation == Channel(PerEpisode(law), "fifo")
    assert str(delay) == f"{written}@fifo+action={written}"
    assert as_delay(str(delay)) == delay


@pytest.mark.parametrize(
    ("text", "step", "plain"),
    [
        ("80ms~", 0.04, "episode:2:3"),
        ("2~", None, "episode:2:3"),
        ("92ms~", 0.04, "episode:2:3"),  # 2.3 steps
        ("104ms~", 0.04, "episode:3:4"),  # 2.6 steps
        ("100ms~", 0.04, "episode:2:3"),
        ("0~", None, "episode:0:1"),
        ("80ms~12ms", 0.04, "uniform:2:3"),  # up to 2.3 steps
        ("80ms~24ms", 0.04, "uniform:2:4"),
        ("0.08s~0.08s@fifo+action=1~", 0.04, "uniform:2:5@fifo+action=episode:1:2"),
    ],
)
def test_a_sensor_at_any_phase(text: str, step: float | None, plain: str) -> None:
    assert as_delay(text, step).plain() == plain


@pytest.mark.parametrize("jitter", [0, 1, 24, 32, 40])
def test_ages_at_any_phase_by_counting(jitter: int) -> None:
    """Delays in 64ths of a step: rounded ages of all observations that may be the newest at a decision."""
    for delay in range(0, 200, 4):
        # a decision at 0 uses what was made at least delay, and less than delay + jitter + period, ago
        for period in (8, 64, 80):
            ages = {-math.floor(-ago / 128 + 0.5) for ago in range(2 * delay, 2 * (delay + jitter + period))}
            assert any_phase(delay / 64, (delay + jitter) / 64, period / 64) == (min(ages), max(ages))


def test_recorded_goes_on_in_order_from_a_random_place() -> None:
    trace = tuple(range(7))
    starts = set()
    for seed in range(60):
        values = drawn(Recorded(trace), 10, seed)
        assert values == [(values[0] + i) % 7 for i in range(10)]
        starts.add(values[0])
    assert starts == set(trace)


def test_recorded_files(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([3, 1, 4]))
    (tmp_path / "b.csv").write_text("sent,delay\n0.00,0.010\n0.02,0.041\n0.04,0.040\n")
    (tmp_path / "c.txt").write_text("3\n1\n4\n")
    assert recorded(tmp_path / "a.npy") == recorded(tmp_path / "c.txt") == Recorded((3, 1, 4))
    with pytest.raises(DelayRLError, match=r"no unit.*got 'us'"):
        recorded(tmp_path / "b.csv", 0.02, "us")
    assert recorded(tmp_path / "b.csv", 0.02, "s") == Recorded((1, 3, 2))  # 41 ms are seen at the third step
    assert as_delay(f"recorded:{tmp_path / 'b.csv'}:s", 0.02).observation.law == Recorded((1, 3, 2))
    long = Delay(Channel(Recorded(tuple(range(30)) * 3)))
    assert as_delay(long.plain()) == long
    assert len(str(long.label())) < 30


@pytest.mark.parametrize(
    ("text", "step", "maximum"),
    [
        ("80ms", 0.04, 2),
        (" 80 ms ", 0.04, 2),
        ("0.08s", 0.05, 2),
        ("81ms", 0.04, 3),
        ("0.1s", 0.1, 1),
        ("70ms", 0.01, 7),
        ("uniform:20ms:90ms", 0.02, 5),
        ("900ms", float(np.float32(0.02)), 45),  # 45.000001 steps
        ("899ms", float(np.float32(0.02)), 45),
        ("901ms", float(np.float32(0.02)), 46),
        ("20s", float(np.float32(0.02)), 1000),
        ("910ms~", float(np.float32(0.02)), 46),  # 45.5 steps
    ],
)
def test_times_are_rounded_up(text: str, step: float, maximum: int) -> None:
    """A step's length of single precision costs no step, however long the delay."""
    assert as_delay(text, step).maximum == maximum


@pytest.mark.parametrize(
    ("value", "step", "words"),
    [
        (80, 0.04, "80 steps = 3.2 s"),
        ("80", 0.04, "80 steps = 3.2 s"),
        (1, 0.008, "1 step = 8 ms"),
        ("80ms", 0.04, "2 steps of 40 ms"),
        ("81ms", 0.04, "3 steps of 40 ms"),
        ("3s", 1.5, "2 steps of 1.5 s"),
        ("2+action=1", 0.02, "3 steps = 60 ms"),
        ("40ms+action=1", 0.02, "2+action=1, 3 steps of 20 ms"),
        ("80ms~", 0.04, "episode:2:3, up to 3 steps of 40 ms"),
        ("uniform:1:5", 0.05, "up to 5 steps = 250 ms"),
        ("uniform:1:5@wait", 0.05, "5 steps = 250 ms"),
        (uniform(1, 2), 0.05, "up to 2 steps = 100 ms"),
    ],
)
def test_a_delay_in_the_other_unit(value: DelayLike, step: float, words: str) -> None:
    assert in_other_unit(value, as_delay(value, step), step) == words


@pytest.mark.parametrize(
    ("text", "shortest"),
    [
        *(("0", 0), ("4", 4), ("uniform:2:4", 2), ("uniform:2:4@wait", 4), ("uniform:2:4@raw", 2), ("poisson:2:5", 0)),
        *(("gilbert:3:1:0.2:0.4", 1), ("walk:8", 0), ("recorded:4,2,6,", 2), ("paper-stochastic-5", 1)),
        ("recorded:" + "5," * 1999 + "1,", 5),  # 1 is one in two thousand
        *(
            ("gamma:1e-200:1e-200:3", 1),
            ("gamma:1e200:1e200:3", 1),
            ("gamma:20:2:30", 15),
            ("choice:0=0,5=1", 5),
            ("walk:3:0.5+action=2", 2),
        ),
        *(("uniform:0:1999", 1), ("1+action=uniform:1:3@wait", 4)),
        *(("episode:2:4", 2), ("80~15", 80), ("2+action=3+reward=1", 5), ("uniform:1:3+action=episode:2:4", 3)),
    ],
)
def test_the_shortest_age(text: str, shortest: int) -> None:
    delay = as_delay(text)
    assert delay.minimum == shortest
    assert delay.observed().minimum == shortest
    law, random = delay.observed().observation.law, np.random.default_rng(0)
    assert all(law.draw(0, random)[0] >= shortest for _ in range(50)) or "@wait" in text


def test_channels_of_a_text() -> None:
    delay = as_delay("uniform:1:5@fifo+action=2+reward=uniform:0:3")
    assert delay == Delay(Channel(uniform(1, 5), "fifo"), Channel(Constant(2)), Channel(uniform(0, 3)))
    assert delay.maximum == 7
    assert delay.observed() == Delay(Channel(uniform(3, 7), "fifo"))
    assert as_delay("paper-stochastic-5").observation == PAPER_STOCHASTIC_5
    assert Channel(Choice((1, 2, 3, 4, 5), (0.02,) * 4 + (0.92,)), "raw") == PAPER_STOCHASTIC_5
    assert Channel(uniform(1, 5)).rule == "newest"
    assert str(as_delay("paper-stochastic-5")) == "paper-stochastic-5"
    assert as_delay("paper-stochastic-5@fifo").observation.rule == "fifo"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("-1", "negative"),
        ("2.5", "whole"),
        ("soon", "is not a number"),
        ("nan", "is not a number"),
        ("", "is not a number"),
        ("recorded:log.csv:us", "s or ms; got 'us'"),
        ("unifrom:1:5", "unknown delay 'unifrom:1:5'; did you mean uniform?"),
        ("uniform:5:1", "LOW ≤ HIGH"),
        ("uniform:1", "takes 2 values between colons"),
        ("uniform:-1:3", "negative"),
        ("uniform:0:99999999", "at most 100000"),
        ("choice:1=0.5,2=0.6", "sum to 1.1"),
        ("choice:1=0.5", "sum to 0.5"),
        ("choice:1=-1,2=2", "from 0 to 1"),
        ("choice:1", "is not a number"),
        ("markov:1,2:1,0", "square"),
        ("gilbert:1:5:2:0.1", "from 0 to 1"),
        ("walk:3:2", "a walk, as in walk:MAX:MOVE, moves with a probability from 0 to 1; got 2"),
        ("poisson:-1:3", "positive"),
        ("gamma:100:1:3", "never below"),
        ("5@soon", "newest, fifo, raw, wait"),
        ("80ms", "no `dt`"),
        ("1+2", "is not a number"),
        ("1+foo=2", "'1\\+foo=2' delays foo; it may delay observation, action, reward"),
        ("1+observation=2", "two for the observations"),
        ("2+reward=3@raw", "newest, fifo or wait"),
        ("recorded:nowhere.csv", "No such file"),
        ("recorded:a+b@c.csv", "a\\+b@c.csv"),
        ("recorded:a/+b=c/d.csv", "No such file"),
        ("recorded", "takes values after a colon"),
        ("episode", "takes values after a colon"),
        ("-1~", "not negative"),
        ("1~-1", "not negative"),
        ("80ms~", "no `dt`"),
        ("1~soon", "is not a number"),
        ("episode:4:2", "LOW ≤ HIGH"),
        ("episode:-1:3", "negative"),
        ("episode:1:2:3", "takes 2 values"),
        ("episode:soon", "is not a number"),
        ("recorded:" + "9" * 5000 + ",", "No such file|too long"),
        ("1e400", "is not a number|finite|whole"),
        ("gamma:1e-200:1:5", "between"),
        ("gamma:1:1e200:5", "between"),
        ("walk:100000", "1 to 1000 states"),
        ("walk:8:0.5s", "no unit"),
        ("choice:1=0.5s,2=0.5", "no unit"),
    ],
)
def test_bad_texts(text: str, words: str) -> None:
    with pytest.raises(DelayRLError, match=words) as error:
        as_delay(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("uniform:100ms:200", "'uniform:100ms:200' mixes steps and times: '200' has no unit, as in 200ms"),
        ("200ms~15", "'200ms~15' mixes steps and times: '15'"),
        ("3+action=episode:2:80ms", "'episode:2:80ms' mixes steps and times: '2'"),
    ],
)
def test_a_law_is_in_steps_or_in_time(text: str, words: str) -> None:
    """A forgotten unit would be 200 steps, not 200 ms. Each channel may have its own, and 0 needs none."""
    with pytest.raises(DelayRLError, match=words):
        as_delay(text, 0.02)
    assert as_delay("uniform:0:0.2s@fifo+action=2", 0.02) == as_delay("uniform:0:200ms@fifo+action=40ms", 0.02)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "empty"),
        ("delay\n", "empty"),
        ("3\n-1\n", "not negative"),
        ("3\nnan\n", "finite"),
        ("3\ninf\n", "finite"),
        ("3\n2.5\n", "recorded:.*:ms"),
        ("3\nmany\n", "must be numbers"),
        ("54,3\n61,0\n58,9\n", "line 1: several columns and no header, or decimal commas; write one number a line"),
        ("54\n61,5\n", "line 2: several columns and no header, or decimal commas"),
        ("delay\n54,3\n", "line 2: several columns and no header, or decimal commas"),
        ("0,3\n1,1\n", "line 1: several columns and no header"),
        ("time,delay\n0.1,2\n0.2\n", "line 3: 1 of 2 columns; the delay is in the last"),
    ],
)
def test_bad_recordings(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "trace.csv").write_text(content)
    with pytest.raises(DelayRLError, match=words):
        recorded(tmp_path / "trace.csv")


def test_a_length_in_single_precision() -> None:
    assert as_delay("80ms", np.float32(0.04)).maximum == 2


def test_a_home_that_nobody_has() -> None:
    with pytest.raises(DelayRLError, match=r"^~nobody-of-that-name/delays\.txt cannot be read as recorded delays: "):
        as_delay("recorded:~nobody-of-that-name/delays.txt")


@pytest.mark.parametrize("seconds", ["20ms", 0, -0.05, math.nan, math.inf])
def test_a_step_that_takes_no_time(seconds: float | str) -> None:
    with pytest.raises(DelayRLError, match=r"^step_seconds is the seconds of a step, a number above 0; got "):
        as_delay("80ms", seconds)  # type: ignore[arg-type]


def test_recordings_in_odd_forms(tmp_path: Path) -> None:
    (tmp_path / "bom.csv").write_bytes("\ufeff3\r\n1\r\n4\r\n".encode())
    assert recorded(tmp_path / "bom.csv") == Recorded((3, 1, 4))
    (tmp_path / "quoted.csv").write_text('time,"delay"\n0,"3"\n1,"1"\n\n')
    assert recorded(tmp_path / "quoted.csv") == Recorded((3, 1))
    np.save(tmp_path / "table.npy", np.array([[100.0, 3.0], [101.0, 4.0]]))
    assert recorded(tmp_path / "table.npy") == Recorded((3, 4))
    (tmp_path / "a+b@c=d.csv").write_text("2\n")
    assert as_delay(f"recorded:{tmp_path / 'a+b@c=d.csv'}+action=1").maximum == 3
    assert as_delay(f"episode:recorded:{tmp_path / 'a+b@c=d.csv'}@fifo").observation == Channel(
        PerEpisode(Recorded((2,))), "fifo"
    )
    assert as_delay(f"episode:recorded:{tmp_path / 'a+b@c=d.csv'}").plain() == "episode:recorded:2,"
    np.save(tmp_path / "complex.npy", np.array([1j]))
    np.savez(tmp_path / "zip.npz", a=np.ones(2))
    (tmp_path / "zip.npz").rename(tmp_path / "zip.npy")
    huge = (
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117)
        + b"\n"
    )
    (tmp_path / "huge.npy").write_bytes(huge)
    for name in ("complex.npy", "zip.npy", "huge.npy"):
        with pytest.raises(DelayRLError, match="cannot be read"):
            recorded(tmp_path / name)


def test_shorthands() -> None:
    assert Delay(observation=3, action=2) == as_delay("3+action=2")  # type: ignore[arg-type]
    assert Channel(3) == Channel(Constant(3))  # type: ignore[arg-type]
    assert as_delay(" 2 + action = 1 ") == as_delay("2+action=1")
    with pytest.raises(DelayRLError, match="as_delay"):
        Channel("uniform:1:3")  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match="as_delay"):
        Delay(action="2")  # type: ignore[arg-type]
    assert poisson(1000, 3).probabilities[3] > 0.99
    assert len(str(as_delay("choice:" + ",".join(f"{i}={1 / 50!r}" for i in range(50))).label())) < 60


def test_recordings_run_no_code(tmp_path: Path) -> None:
    """A .npy file with pickled objects is refused, and its code does not run."""
    np.save(tmp_path / "trace.npy", np.array([object()]), allow_pickle=True)
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY")
    for name in ("trace.npy", "cut.npy"):
        with pytest.raises(DelayRLError, match="cannot be read"):
            recorded(tmp_path / name)


def test_values_that_are_no_delay() -> None:
    for given_ in (True, None, [1], 2.5):
        with pytest.raises(DelayRLError, match="whole"):
            as_delay(given_)  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match="constant delay"):
        as_delay("action=uniform:0:3").observed()


def test_actions_of_each_episode_are_observed_late() -> None:
    assert as_delay("2+action=episode:1:3").observed() == as_delay("episode:3:5")
    assert as_delay("uniform:0:2@wait+action=episode:1:3").observed() == as_delay("episode:3:5")
    assert as_delay("2+action=episode:1:3@wait").observed() == as_delay(5)
    both = as_delay("gilbert:0:4:0.3:0.3@fifo+action=episode:1:3").observed().observation
    assert (both.maximum, both.rule) == (7, "fifo")
    offsets = set()
    for seed in range(40):
        values = np.array(drawn(both.law, 60, seed))
        assert set(values - values.min()) == {0, 4}
        offsets.add(int(values.min()))
    assert offsets == {1, 2, 3}


def test_laws_take_arrays() -> None:
    assert Choice(np.array([1, 2]), np.array([0.5, 0.5])) == Choice((1, 2), (0.5, 0.5))
    assert Markov(np.array([1, 2]), np.eye(2)) == Markov((1, 2), ((1, 0), (0, 1)))
    for empty in (lambda: Choice((), ()), lambda: Recorded(())):
        with pytest.raises(DelayRLError, match="at least one"):
            empty()


def test_ages_count_the_longest_delay_of_an_action_that_varies_within_an_episode() -> None:
    assert as_delay("1+action=uniform:1:3").minimum == 4
    assert as_delay("1+action=episode:1:3").minimum == 2
