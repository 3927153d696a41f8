"""The paper's row of Pusher: returns at the paper's steps, from results whose answer is known."""

from dataclasses import replace

import numpy as np
import paper_row
from finished import result

from delayrl.report.results import Curves, Result


def of(agent: str, steps: list[int], returns: list[list[float]]) -> Result:
    plain = result(agent, 0 if agent == "sac" else 5, returns)
    condition = replace(plain.condition, steps=steps[-1])
    return replace(plain, condition=condition, curves=Curves(np.array(steps), np.array(returns)))


def test_returns_at_the_papers_step_beside_sacs() -> None:
    """The paper's DC/AC reaches SAC's return after 20,000 steps. What has not ended is left out, except of SAC."""
    late = of("dcac", [10_000, 20_000, 30_000], [[-90.0, -40.0, -36.0], [-91.0, -42.0, -38.0]])
    sac = replace(of("sac", [20_000, 40_000], [[-30.0, -20.0]]), seeds=3)
    unfinished = replace(of("bpql", [270_000], [[-1.0]]), seeds=3)
    going_on = replace(of("sac", [20_000], [[-9.0], [-8.0]]), partial=True)
    assert "sac" not in paper_row.table([late, going_on])
    lines = [line.strip("| ").split(" | ") for line in paper_row.table([late, sac, unfinished]).splitlines()[2:]]
    assert lines[0] == [
        "`dcac`",
        "`corrected`",
        "20,000",
        "-41.0 ± 1.4",
        "-30.0 (1 of 3 seeds)",
        "-37.0 ± 1.4, 30,000 steps",
    ]
    assert lines[1][0] == "`sac`, no delay"
    assert lines[1][-1] == "-20.0 (1 of 3 seeds), 40,000 steps"
    assert len(lines) == 2
