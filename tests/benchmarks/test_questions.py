"""The tables of VDPO's own questions, from results whose answer is known."""

from dataclasses import replace

import questions
from finished import result

from delayrl.report.results import Result

ENV, STEPS = "delayrl/Pusher-v4", 40_000


def of(returns: list[list[float]], agent: str = "vdpo", **overrides: str) -> Result:
    plain = result(agent, 25, returns, **overrides)
    condition = replace(plain.condition, env=ENV, steps=STEPS)
    privileged = agent == "vdpo" and overrides.get("behaviour") != "delayed"
    return replace(plain, place=plain.place._replace(env=ENV), condition=condition, privileged=privileged)


def test_a_change_stands_beside_the_unchanged_agent() -> None:
    """Highest over training first; another agent and what has not ended are left out."""
    lower = of([[-80.0, -40.5], [-80.0, -40.0], [-80.0, -39.5]], behaviour="delayed")
    results = [
        of([[-60.0, -40.2], [-60.0, -39.8]]),
        replace(lower, cost=replace(lower.cost, flops=2 * lower.cost.flops)),
        of([[0.0, 0.0], [0.0, 1.0]], agent="bpql"),
        replace(of([[0.0, 0.0], [0.0, 1.0]], n_steps="1"), seeds=3),
    ]
    (table,) = questions.tables(results)
    title, _, _, _, *body = table.splitlines()
    assert title == "**Pusher, 25 steps late**"
    assert [row.strip("| ").split(" | ") for row in body] == [
        ["none † (2 seeds)", "0.01", "-40.0 ± 0.3", "", "-50.0 ± 0.1", "", "1.00"],
        [
            "`behaviour=delayed` (3 seeds)",
            "0.01",
            "-40.0 ± 0.5",
            "+0.0 (-1.1 to +1.1)",
            "-60.0 ± 0.2",
            "**-10.0 (-10.6 to -9.4)**",
            "2.00",
        ],
    ]


def test_a_task_without_a_change_has_no_table() -> None:
    assert questions.tables([of([[-60.0, -40.0], [-60.0, -39.0]])]) == []
    assert questions.tables([of([[-60.0, -40.0], [-60.0, -39.0]], direction="forward")]) == []
