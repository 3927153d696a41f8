"""The tables of VDPO's own questions, from results whose answer is known."""

from dataclasses import replace

import questions
from finished import result

from delayrl.report.results import Result

PUSHER, CHEETAH = ("delayrl/Pusher-v4", 25), ("HalfCheetah-v5", 5)
STEPS = {PUSHER: 40_000, CHEETAH: 100_000}


def of(returns: list[list[float]], case: tuple[str, int] = PUSHER, agent: str = "vdpo", **overrides: str) -> Result:
    env, delay = case
    plain = result(agent, delay, returns, **overrides)
    condition = replace(plain.condition, env=env, steps=STEPS[case])
    privileged = agent == "vdpo" and overrides.get("behaviour") != "delayed"
    return replace(plain, place=plain.place._replace(env=env), condition=condition, privileged=privileged)


def test_a_change_stands_beside_the_unchanged_agent() -> None:
    """Highest over training first; another agent, what has not ended and what has no change are left out."""
    higher = of([[-60.0, -40.5], [-60.0, -40.0], [-60.0, -39.5]], behaviour="delayed")
    results = [
        of([[-80.0, -40.2], [-80.0, -39.8]]),
        replace(higher, cost=replace(higher.cost, flops=2 * higher.cost.flops)),
        of([[0.0, 0.0], [0.0, 1.0]], agent="bpql"),
        replace(of([[0.0, 0.0], [0.0, 1.0]], n_steps="1"), seeds=3),
        of([[0.0, 4000.0], [0.0, 4002.0]], CHEETAH),
        of([[0.0, 2000.0], [0.0, 2002.0]], CHEETAH, direction="forward"),
    ]
    tables = [table.splitlines() for table in questions.tables(results)]
    assert [table[0] for table in tables] == ["**Pusher, 25 steps late**", "**HalfCheetah, 5 steps late**"]
    pusher, cheetah = ([row.strip("| ").split(" | ") for row in table[4:]] for table in tables)
    assert pusher == [
        [
            "`behaviour=delayed` (3 seeds)",
            "-40.0 ± 0.5",
            "+0.0 (-1.1 to +1.1)",
            "-50.0 ± 0.2",
            "**+10.0 (+9.4 to +10.6)**",
            "2.00",
        ],
        ["none † (2 seeds)", "-40.0 ± 0.3", "", "-60.0 ± 0.1", "", "1.00"],
    ]
    assert cheetah[1][:3] == ["`direction=forward` † (2 seeds)", "2,001 ± 1", "**-2,000 (-2,006 to -1,994)**"]


def test_a_task_without_a_change_has_no_table() -> None:
    assert questions.tables([of([[-60.0, -40.0], [-60.0, -39.0]])]) == []
    assert questions.tables([of([[-60.0, -40.0], [-60.0, -39.0]], direction="forward")]) == []
