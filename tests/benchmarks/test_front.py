"""The table and the picture of the first page, from results whose answer is known."""

from dataclasses import replace
from pathlib import Path

import front
import pytest
from finished import result

from delayrl.errors import DelayRLError
from delayrl.report.results import Result


def test_the_result_of_the_first_page(tmp_path: Path) -> None:
    """Each arm where it has ended, with most seeds, at the budget of its task; nothing for what has not run."""

    def of(agent: str, case: front.Case, returns: list[float], steps: int = 0, **overrides: float | str) -> Result:
        plain = result(agent, case[1], [[0.0, end] for end in returns], **overrides)
        condition = replace(plain.condition, env=case[0], steps=steps or front.STEPS[case[0]])
        return replace(plain, place=plain.place._replace(env=case[0]), condition=condition)

    late, later = front.CASES[1], front.CASES[3]
    few = replace(of("vdpo", late, [1000.0, 1200.0], tokens=1280), privileged=True)
    unfinished = replace(of("bpql", late, [3900.0] * 9), seeds=10)
    longer = of("bpql", late, [3900.0] * 9, steps=10**7)
    many = of("any-age", later, [10.0, 20.0, 30.0, 40.0, 50.0])
    sac = of("sac", (late[0], 0), [3900.0] * 5)
    elsewhere = of("bpql", late, [1.0], critic_norm="layer"), of("dida", late, [1.0])
    chosen = front.choose([few, many, of("any-age", later, [0.0]), sac, unfinished, longer, *elsewhere])
    lines = [line.split(" | ") for line in front.table(chosen).splitlines()[2:]]
    assert [line[0] for line in lines] == ["| `sac`, no delay", "| `vdpo` †", "| `any-age`"]
    assert lines[0][1:] == ["**1.00**<br>3,900 ± 0"] * 3 + ["", "", " |"]
    assert lines[1][2] == "**0.30**<br>0.28 to 0.33; 2 seeds<br>1,100 ± 141"
    assert lines[2][4] == "**0.03**<br>0.03 to 0.04<br>30.0 ± 15.8"
    lone = front.cell(replace(sac, curves=sac.curves._replace(returns=sac.curves.returns[:3])))
    assert lone == "**1.00**<br>3 seeds<br>3,900 ± 0"
    sparse = replace(many, curves=many.curves._replace(steps=2 * many.curves.steps))
    with pytest.raises(DelayRLError, match="results on delayrl/Hopper-v4 have evaluations at different steps"):
        front.comparable([many, sparse])
    shorter, other = of("bpql", late, [1.0], evaluate_every=2_000), of("bpql", late, [2.0], random_steps=20_000)
    assert [front.name(arm) for arm in (shorter, other)] == ["`bpql`", "`bpql`, `random_steps=20000`"]
    front.draw(chosen, tmp_path / "result.png")
    assert (tmp_path / "result.png").stat().st_size > 5_000
