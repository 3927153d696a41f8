"""A law of a user is drawn from, named, read back and refused as one of ours."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import delayrl
from delayrl.delays import Channel, Delay, as_delay, short_label, stored_delay
from delayrl.delays.episodes import PerEpisode
from delayrl.delays.own import OwnLaw
from delayrl.errors import DelayRLError
from own_laws import Burst, Cycle, Endless, Plain
from own_tasks import make_arm, write_module
from short_runs import declare

BURST = "own_laws:Burst(length=2, rate=0.1, steps=3)"


def drawn(law: Any, count: int) -> list[int]:
    random, state, travels = np.random.default_rng(0), 0, []
    for _ in range(count):
        travel, state = law.draw(state, random)
        travels.append(travel)
    return travels


@pytest.mark.parametrize(
    "delay",
    [Burst(), Channel(Burst()), Delay(Burst()), "own_laws:Burst", "own_laws:Burst()", BURST, " own_laws:Burst ( ) "],
)
def test_all_ways_give_one_text(delay: Any) -> None:
    parsed = as_delay(delay)
    assert str(parsed) == BURST
    assert parsed == as_delay(BURST)
    assert parsed.maximum == 3
    assert drawn(parsed.observation.law, 30) == drawn(Burst(), 30)
    assert {1, 3} == set(drawn(parsed.observation.law, 30))


def test_texts_with_rules_channels_and_lists() -> None:
    delay = as_delay("own_laws:Cycle(times=[1, 2])@fifo+action=own_laws:Burst(rate=1)@wait")
    assert delay.observation == Channel(Cycle((1, 2)), "fifo")
    assert delay.action == Channel(Burst(1), "wait")
    assert as_delay("own_laws:Cycle").observation.law.law == Cycle()  # type: ignore[union-attr]
    assert str(as_delay(Cycle((1, 2)))) == "own_laws:Cycle(maximum=2, times=[1, 2])"
    assert as_delay("own_laws:Cycle(maximum=0)") == as_delay(0)


def test_an_own_law_is_played_as_ours() -> None:
    """Always two steps is the delay 2; with one more of the actions, agents are trained as under 3."""
    late, usual = delayrl.make("Pendulum-v1", Cycle()), delayrl.make("Pendulum-v1", 2)
    assert_alike(late, usual)
    observed = as_delay(Delay(Cycle(), action=1)).observed()
    assert observed.maximum == 3
    assert_alike(delayrl.make("Pendulum-v1", observed), delayrl.make("Pendulum-v1", 3))


def test_its_state_is_its_own() -> None:
    """Whatever it keeps between two messages comes back, also where the actions are late by a constant."""

    class Memory:
        maximum = 3

        def draw(self, state: Any, random: np.random.Generator) -> tuple[int, Any]:
            seen = state or ()
            return len(seen), (*seen, 0.5)

    observed = Delay(Memory(), action=2).observed()  # type: ignore[arg-type]
    assert drawn(observed.observation.law, 4) == [2, 3, 4, 5]


def test_what_an_episode_draws_of_an_own_law_is_checked() -> None:
    law = PerEpisode(Wrong())
    assert str(law) == "episode:<Wrong:1>"
    with pytest.raises(DelayRLError, match="drew 9: a travel time is a whole number of steps from 0 to its maximum, 1"):
        law.draw(0, np.random.default_rng(0))


class Wrong:
    maximum = 1

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        return 9, 0


def assert_alike(one: Any, other: Any) -> None:
    pairs = [(one.reset(seed=0), other.reset(seed=0))]
    actions = np.random.default_rng(0).uniform(-2, 2, (10, 1)).astype(np.float32)
    pairs += [(one.step(action), other.step(action)) for action in actions]
    for got, expected in pairs:
        np.testing.assert_array_equal(got[0], expected[0])
        assert got[-1]["age"] == expected[-1]["age"]
        np.testing.assert_array_equal(got[-1]["actions"], expected[-1]["actions"])


def test_what_has_no_name() -> None:
    """Classes in a function, no dataclasses, arguments that are not JSON or do not make it again."""

    @dataclass(frozen=True)
    class Local(Burst):
        pass

    numbers = Cycle((np.int64(1), 2))
    texts = {"<Local:3>": Local(), "<Plain:2>": Plain(), "<Cycle:2>": numbers}
    for text, law in texts.items():
        parsed = as_delay(law)
        assert str(parsed) == text
        read = as_delay(text)
        assert (str(read), read.maximum) == (text, parsed.maximum)
        with pytest.raises(DelayRLError, match=f"{text} has no name that it could be imported by: give it again, as"):
            drawn(read.observation.law, 1)
        assert as_delay(f"{text}@wait+action=1").observed().maximum == parsed.maximum + 1
    assert short_label("<Local:3>") == "<Local:3>"


def test_entry_points_are_names(tmp_path: Path, monkeypatch) -> None:
    declare(tmp_path, "delayrl.delays", burst="own_laws:Burst", walk="own_laws:Burst")
    monkeypatch.syspath_prepend(tmp_path)
    for delay in (Burst(0.5), "burst(rate=0.5)", "own_laws:Burst(rate=0.5)"):
        assert str(as_delay(delay)) == "burst(length=2, rate=0.5, steps=3)"
    assert as_delay("burst@fifo").observation == Channel(Burst(), "fifo")
    assert not isinstance(as_delay("walk:3").observation.law, OwnLaw)
    with pytest.raises(DelayRLError, match="is not a number"):
        as_delay("brust")


@pytest.mark.parametrize(
    ("delay", "words"),
    [
        (Burst, r"a law is an instance: give Burst\(…\) for the class Burst"),
        (Endless(), "Endless is no law of delays, because it lacks maximum"),
        ("own_laws:Endless", "Endless is no law of delays, because it lacks maximum"),
        (Cycle(maximum=-1), "cannot be negative"),
        ("own_laws:Plain", "own_laws:Plain is no law of delays, because it is no dataclass with draw"),
        ("os:system(command=1)", "os:system is no law of delays"),
        ("own_laws:Brust", "module 'own_laws' has no 'Brust'; did you mean Burst"),
        ("not_there:Law", "cannot import 'not_there': ModuleNotFoundError"),
        ("own_laws:Burst(rat=1)", "the law 'own_laws:Burst.*cannot be made: TypeError: .*'rat'"),
        ("own_laws:Burst(0.1)", r"write e.g. own_laws:Burst\(rate=0.1\), with values as JSON"),
        ("own_laws:Burst(rate=x)", "with values as JSON"),
        ("own_laws:Burst(rate=1", "with values as JSON"),
        ("own_laws:Burst(rate=1)2", "with values as JSON"),
    ],
)
def test_what_is_no_law(delay: Any, words: str) -> None:
    with pytest.raises(DelayRLError, match=words) as error:
        as_delay(delay)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ((time,), f"drew {time}: a travel time is a whole number of steps from 0 to its maximum, 2")
        for time in (3, -1, 0.5)
    ],
)
def test_travel_times_are_checked(times: tuple, words: str) -> None:
    for delay in (as_delay(Cycle(times)), as_delay(Delay(Cycle(times), action=2)).observed()):
        with pytest.raises(DelayRLError, match=words):
            drawn(delay.observation.law, 1)


def test_code_that_came_with_a_run_is_not_imported(tmp_path: Path, monkeypatch) -> None:
    folder, witness = tmp_path / "runs" / "mine", tmp_path / "witness"
    folder.mkdir(parents=True)
    write_module(
        tmp_path / "runs",
        "evil",
        f"from pathlib import Path\nPath({str(witness)!r}).touch()\nfrom own_laws import Burst",
    )
    monkeypatch.chdir(tmp_path)
    assert stored_delay(BURST, folder) == as_delay(BURST)
    assert stored_delay(5, folder) == as_delay(5)
    for text in ("runs.evil:Burst", "1+action=runs.evil:Burst@wait"):
        with pytest.raises(DelayRLError, match=r"came with a law of delays that could run any code, runs.evil:Burst"):
            stored_delay(text, folder)
    for text in (f'os:mkdir(path="{witness}")', f'pathlib:Path.touch(self="{witness}")'):
        with pytest.raises(DelayRLError, match="came with a law of delays that could run any code"):
            stored_delay(text, folder)
    (tmp_path / "secret.txt").write_text("hunter2")
    with pytest.raises(DelayRLError, match=r"unknown delay 'recorded:secret.txt'"):
        stored_delay("recorded:secret.txt", folder)  # a folder from elsewhere names no file
    assert stored_delay("recorded:1,2,", folder) == as_delay("recorded:1,2,")
    assert not witness.exists()
    assert delayrl.make(make_arm, "runs.evil:Burst").delay.maximum == 3  # whoever names it means it
    assert witness.exists()


@dataclass(frozen=True)
class UDP:
    """Its name is in capitals, and it forgets that draw returns a state."""

    maximum: int = 3

    def draw(self, state: int, random: np.random.Generator) -> Any:
        return 3


def test_a_draw_without_a_state() -> None:
    with pytest.raises(DelayRLError, match="drew 3, not a travel time and the next state"):
        drawn(as_delay(UDP()).observation.law, 1)


def test_a_name_in_capitals_may_be_of_an_episode(tmp_path: Path) -> None:
    """A run keeps such texts: they are no two numbers."""
    text = str(as_delay(PerEpisode(UDP())))  # type: ignore[arg-type]
    assert text.startswith("episode:")
    for kept in (text, "episode:<UDP:3>"):
        assert str(stored_delay(kept, tmp_path)) == kept
