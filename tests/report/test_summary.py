"""Results, anchors and aggregates, worked out by hand."""

import math
from typing import Any

import numpy as np
import pytest
from synthetic import anchored, curve, row, small, standing

from delayrl.errors import DelayRLError
from delayrl.report.markdown import markdown
from delayrl.report.page import page, payload
from delayrl.report.results import Place, Result, Setting
from delayrl.report.summary import Summary, summarise
from delayrl.run.cell import Progress

PAPER = Setting("corrected", "paper")


def of(
    summary: Summary, label: str, delay: int | str = 5, env: str = "delayrl/Ant-v4", setting: Setting = PAPER
) -> Result:
    return summary.results[Place(setting, env, delay, label)]


def test_a_table_of_the_paper_by_hand() -> None:
    cells = small()
    summary = summarise(anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]]), [*cells.values()])
    result = of(summary, "vdpo")
    assert result.curves.steps.tolist() == [100, 200, 300]
    assert result.random_anchor.value == 10
    assert result.reference_anchor.value == 110
    assert (result.reference_anchor.returns.tolist(), result.reference_anchor.source) == ([100, 120], "sac, no delay")
    np.testing.assert_allclose(result.final, [0.5, 1.5])
    np.testing.assert_allclose(result.area, [(60 - 10) / 100, (280 / 3 - 10) / 100])
    assert result.threshold == pytest.approx((150 / 3 + 170 / 3) / 2)  # delay-free SAC, smoothed as the curve is
    assert result.steps_to_threshold == 200  # smoothed means 5, 60 and 77
    assert result.seeds_at_threshold == 2

    normalised, steps = summary.tables
    entry = normalised.entries["delayrl/Ant-v4", 5, "vdpo"]
    assert (entry.value, entry.std) == (1.0, pytest.approx(math.sqrt(0.5)))
    assert (entry.raw, entry.raw_std) == (110, pytest.approx(math.sqrt(5000)))
    assert entry.area == pytest.approx((0.5 + 5 / 6) / 2)
    assert entry.published is None  # it trains for 300 steps, the paper for a million
    assert steps.entries["delayrl/Ant-v4", 5, "vdpo"].value == 200
    (aggregate,) = summary.aggregates
    assert (aggregate.iqm, aggregate.tasks, aggregate.runs) == (1.0, 1, 2)


def test_without_anchors_there_are_raw_returns_and_nothing_else() -> None:
    cells = small()
    for missing in ("sac", "random"):
        left = {name: c for name, c in cells.items() if name != missing}
        every = anchored(cells, vdpo=[[0.0, 1, 2], [0.0, 1, 4]])
        summary = summarise([r for r in every if r["agent"] != missing], [*left.values()])
        entry = summary.tables[0].entries["delayrl/Ant-v4", 5, "vdpo"]
        assert math.isnan(entry.value)
        assert entry.raw == 3
        lacks = {"sac": "SAC without a delay has not ended", "random": "the random policy has no rows"}[missing]
        assert f"Returns on delayrl/Ant-v4 are not normalised: {lacks}" in markdown(summary, "t", {})
        assert math.isnan(entry.area)
        assert np.isnan(entry.interval).all()
        assert not summary.aggregates
        result = of(summary, "vdpo")
        assert np.isnan([result.threshold, result.steps_to_threshold, *result.steps_interval]).all()


def test_a_reference_inside_another_agent_is_no_anchor() -> None:
    """It may be frozen, coupled to the delayed policy, or have learned from its data: the cell is raw only."""
    cells = small()
    del cells["sac"]
    inner = [r for seed in range(2) for r in curve(cells["vdpo"], seed, [0.0, 10, 210], "reference")]
    every = anchored(cells | small(), vdpo=[[0.0, 0, 110], [0.0, 0, 110]])
    summary = summarise([r for r in every if r["agent"] != "sac"] + inner, [*cells.values()])
    result = of(summary, "vdpo")
    assert result.reference_anchor.returns.size == 0
    assert np.isnan([*result.final, result.threshold, result.steps_to_threshold, *result.steps_interval]).all()
    for table in summary.tables:
        entry = table.entries["delayrl/Ant-v4", 5, "vdpo"]
        assert (math.isnan(entry.value), entry.missed, entry.raw) == (True, False, 110)


def test_the_anchors_uncertainty_is_in_the_intervals() -> None:
    """Two seeds of an agent that agree: what is left is the reference's spread, and random's."""
    cells, agent = small(), [[0.0, 0, 60], [0.0, 0, 60]]
    exact = {"sac": [[0.0, 0, 110]] * 2, "random": [[10.0] * 3] * 2}
    result = of(summarise(anchored(cells, vdpo=agent, **exact), [*cells.values()]), "vdpo")
    assert result.final_interval == (0.5, 0.5)
    spread = summarise(anchored(cells, vdpo=agent, **exact | {"sac": [[0.0, 0, 60], [0.0, 0, 160]]}), [*cells.values()])
    assert of(spread, "vdpo").final_interval == pytest.approx((50 / 150, 1))
    (aggregate,) = spread.aggregates
    assert (aggregate.iqm, aggregate.low, aggregate.high) == pytest.approx((0.5, 50 / 150, 1))
    random = summarise(anchored(cells, vdpo=agent, **exact | {"random": [[0.0] * 3, [20.0] * 3]}), [*cells.values()])
    assert of(random, "vdpo").final_interval == pytest.approx((40 / 90, 60 / 110))


def test_a_variant_of_sac_has_an_interval_and_the_anchors_have_none() -> None:
    cells, agent = small(), [[0.0, 0, 60], [0.0, 0, 60]]
    steps = cells["sac"][0].condition.steps
    layer = standing("sac", "delayrl/Ant-v4", 0, 2, overrides={"critic_norm": "layer"}, id="layer", steps=steps)
    extra = [row for seed in range(2) for row in curve(layer, seed, [0.0, 0, 50 + 20 * seed])]
    rows = anchored(cells, vdpo=agent, sac=[[0.0, 0, 110]] * 2, random=[[10.0] * 3] * 2) + extra
    results = summarise(rows, [*cells.values(), layer]).results.values()
    intervals = {r.place.label: r.final_interval for r in results if r.is_anchor}
    assert intervals.pop("sac critic_norm=layer") == pytest.approx((0.4, 0.6))
    assert np.isnan([*intervals["sac"], *intervals["random"]]).all()


def test_steps_to_the_threshold_have_an_interval() -> None:
    """One seed of two reaches it at the second evaluation; the mean and the other never do."""
    cells = small()
    curves = {"sac": [[0.0, 0, 90]] * 2, "vdpo": [[0.0, 70, 0], [0.0, 0, 0]]}
    summary = summarise(anchored(cells, **curves), [*cells.values()])
    result = of(summary, "vdpo")
    assert result.threshold == 30
    assert result.missed
    assert result.steps_interval == (200, math.inf)
    assert result.seeds_at_threshold == 1
    text = markdown(summary, "t", {})
    assert "**×**<br>200 to ×<br>raw 0.00 ± 0.00<br>1/2 seeds" in text
    assert "| ×<br>200 to × | 2/2 | 300 |  | done |" in text


@pytest.mark.parametrize("change", [{"protocol": "official"}, {"steps": 200}, {"preset": "small"}])
def test_delay_free_sac_of_another_protocol_preset_or_budget_is_no_anchor(change: dict[str, Any]) -> None:
    cells = small() | {"sac": standing("sac", "delayrl/Ant-v4", 0, 2, **{"steps": 300} | change)}
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 2], [0.0, 1, 4]]), [*cells.values()])
    assert math.isnan(of(summary, "vdpo").reference_anchor.value)


def test_the_plainest_sac_is_the_anchor_whatever_its_budget() -> None:
    """Not the one with the fewest overrides: how often it was evaluated leaves it what it is."""
    cells, steps = small(), 300
    plain = {"precision": "bfloat16", "evaluate_every": 100, "replay_capacity": 300}
    cells["sac"] = standing("sac", "delayrl/Ant-v4", 0, 2, steps=steps, overrides=plain)
    cells["layer"] = standing("sac", "delayrl/Ant-v4", 0, 5, id="0", steps=steps, overrides={"critic_norm": "layer"})
    rows = anchored(cells, vdpo=[[0.0, 0, 60]] * 2, sac=[[0.0, 0, 110]] * 2, layer=[[0.0, 0, 999]] * 5)
    result = of(summarise(rows, [*cells.values()]), "vdpo")
    assert result.reference_anchor.value == 110
    assert result.final.tolist() == [0.5, 0.5]


def test_the_threshold_alone_may_be_of_a_longer_reference() -> None:
    """Where none has as many steps: the longest of the plain ones. Returns are not normalised by it."""
    cells = small()
    cells["sac"] = standing("sac", "delayrl/Ant-v4", 0, 2, id="4", steps=400, overrides={"steps": 400})
    more = {
        "5": standing("sac", "delayrl/Ant-v4", 0, 2, id="5", steps=500, overrides={"steps": 500}),
        "6": standing("sac", "delayrl/Ant-v4", 0, 2, id="6", steps=600, overrides={"steps": 600, "discount": 0.9}),
        "7": standing("sac", "delayrl/Ant-v4", 0, 2, id="7", state="running", step=500, steps=700),
        "official": standing("sac", "delayrl/Ant-v4", 0, 2, id="8", steps=800, protocol="official"),
    }
    given = {
        "vdpo": [[0.0, 0, 99], [0.0, 0, 120]],
        "sac": [[60.0] * 4] * 2,
        "5": [[25.0] * 5, [35.0] * 5],
        "6": [[70.0] * 6] * 2,
        "7": [[80.0] * 5] * 2,
        "official": [[90.0] * 8] * 2,
    }
    summary = summarise(anchored(cells | more, **given), [*cells.values(), *more.values()])
    result = of(summary, "vdpo")
    assert (result.threshold, result.steps_to_threshold, result.missed) == (30, 300, False)
    assert result.steps_interval == (300, math.inf)
    assert math.isnan(result.reference_anchor.value)
    assert np.isnan([*result.final, *result.area, *result.final_interval]).all()
    (steps,) = [table for table in summary.tables if table.kind == "steps"]
    assert steps.entries["delayrl/Ant-v4", 5, "vdpo"].note == "300 steps · 2/2 seeds · reference of 500 steps"
    (shown,) = [a["threshold"] for a in payload(summary, "t")["anchors"] if (a["setting"], a["total"]) == (0, 300)]
    assert shown == "30.0 ± 7.1 (sac steps=500, no delay, 500 steps)"
    equal = small()["sac"]
    both = summarise(
        anchored(cells | more | {"equal": equal}, **given, equal=[[0.0, 0, 90]] * 2),
        [*cells.values(), *more.values(), equal],
    )
    assert of(both, "vdpo").threshold == 30  # (0 + 0 + 90) / 3, of that with the same steps
    assert of(both, "vdpo").reference_anchor.value == 90
    assert of(both, "vdpo").threshold_anchor == of(both, "vdpo").reference_anchor


def test_a_reference_that_is_worse_than_random_normalises_nothing() -> None:
    cells = small()
    curves = anchored(cells, sac=[[0.0, 0, 5], [0.0, 0, 5]], vdpo=[[0.0, 0, 50], [0.0, 0, 50]])
    summary = summarise(curves, [*cells.values()])
    line = (
        "Returns on delayrl/Ant-v4 are not normalised: SAC without a delay (5.00) is not better than the random policy"
    )
    assert f"{line} (10.0)." in markdown(summary, "t", {})
    result = of(summary, "vdpo")
    assert np.isnan(result.normalise(result.curves.final)).all()
    assert np.isnan([result.threshold, result.steps_to_threshold, *result.steps_interval]).all()


def test_the_random_policy_with_the_most_seeds_is_the_anchor() -> None:
    """It does not learn, so one of any preset will do; one seed of it has no interval."""
    cells = small() | {"lone": standing("random", "delayrl/Ant-v4", 0, 1, id="a", steps=300, preset="matched")}
    every = anchored(cells, vdpo=[[0.0, 0, 60], [0.0, 0, 60]], lone=[[50.0] * 3])
    result = of(summarise(every, [*cells.values()]), "vdpo")
    assert result.random_anchor.value == 10
    assert np.isfinite(result.final_interval).all()


def test_runs_of_other_lengths_are_not_beside_each_other_over_all_tasks() -> None:
    """Each is normalised by delay-free SAC of its own length. The table says how long each was."""
    given: dict[str, Any] = {"seeds": 2, "steps": 200}
    shorter = {
        "bpql": standing("bpql", "delayrl/Ant-v4", 5, **given),
        "sac2": standing("sac", "delayrl/Ant-v4", 0, id="shorter", **given),
    }
    cells = small() | shorter
    curves = {"vdpo": [[0.0, 0, 60]] * 2, "bpql": [[0.0, 60]] * 2, "sac2": [[0.0, 60], [0.0, 70]]}
    summary = summarise(anchored(cells, **curves), [*cells.values()])
    assert not summary.aggregates
    entries = summary.tables[0].entries
    notes = {label: entry.note for (_, _, label), entry in entries.items() if entry.note}
    assert notes == {"vdpo": "300 steps", "bpql": "200 steps"}


def test_a_run_that_goes_on_is_not_compared_as_if_it_had_ended() -> None:
    cells = small()
    cells["vdpo"] = standing("vdpo", "delayrl/Ant-v4", 5, 2, steps=300, step=200, state="running")
    summary = summarise(anchored(cells, vdpo=[[0.0, 100], [0.0, 100, 500]]), [*cells.values()])
    assert of(summary, "vdpo").runs == 1  # the seed that has ended; the other is not mixed in
    summary = summarise(anchored(cells, vdpo=[[0.0, 100], [0.0, 100]]), [*cells.values()])
    result = of(summary, "vdpo")
    assert result.partial
    assert not summary.aggregates
    entry = summary.tables[1].entries["delayrl/Ant-v4", 5, "vdpo"]
    assert not entry.missed  # it may yet get there
    assert np.isnan(entry.interval).all()
    assert "at 200 of 300 steps" in entry.note
    early = summarise(anchored(cells, vdpo=[[0.0, 100], [0.0, 900]], sac=[[0.0, 0, 240]] * 2), [*cells.values()])
    assert (of(early, "vdpo").threshold, of(early, "vdpo").steps_to_threshold) == (80, 200)
    assert np.isnan(of(early, "vdpo").steps_interval).all()  # one of its seeds alone has not reached it: no × yet
    assert "to ×" not in markdown(early, "t", {})
    assert "at 200 of 300 steps" in markdown(summary, "t", {})
    ended = small()
    summary = summarise(anchored(ended, vdpo=[[0.0, 1, 2], [0.0, 1, 2]]), [*ended.values()])
    assert summary.tables[1].entries["delayrl/Ant-v4", 5, "vdpo"].missed


def test_seeds_that_are_missing_are_told() -> None:
    cells = small(seeds=3)
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 60]]), [*cells.values()])
    entry = summary.tables[0].entries["delayrl/Ant-v4", 5, "vdpo"]
    assert entry.value == 0.5
    assert math.isnan(entry.std)  # one seed
    assert "1 of 3 seeds" in entry.note
    assert math.isnan(summary.aggregates[0].low)


def test_a_failed_seed_beside_one_that_has_ended() -> None:
    """A cell of its own, as with lockstep = 1: it did not fail at the last step of the other."""
    cells = small() | {"vdpo": standing("vdpo", "delayrl/Ant-v4", 5, seeds=(0,), steps=300)}
    failed = standing("vdpo", "delayrl/Ant-v4", 5, seeds=(1,), id="1", steps=300, step=100, state="failed")
    todo = standing("vdpo", "delayrl/Ant-v4", 5, seeds=(2,), id="2", steps=300, step=0, state="todo")
    summary = summarise(anchored(cells, vdpo=[[0.0, 1, 60]]), [*cells.values(), failed, todo])
    entry = summary.tables[0].entries["delayrl/Ant-v4", 5, "vdpo"]
    assert entry.note == "1 of 3 seeds · failed at 100 of 300 steps"
    assert of(summarise(anchored(cells, vdpo=[[0.0, 1, 60]]), [*cells.values(), todo]), "vdpo").unfinished == "begun"


def test_an_agent_with_a_failed_seed_is_not_compared_by_the_others() -> None:
    """Those that did not fail are the better ones. The agent's numbers on the task remain, with what happened."""
    cells = small() | {"bpql": standing("bpql", "delayrl/Ant-v4", 5, 2, steps=300)}
    failed = standing("vdpo", "delayrl/Ant-v4", 5, (2,), id="1", steps=300, step=100, state="failed")
    rows = anchored(cells, vdpo=[[0.0, 1, 60], [0.0, 1, 80]], bpql=[[0.0, 1, 20], [0.0, 1, 40]])
    summary = summarise(rows, [*cells.values(), failed])
    assert [aggregate.label for aggregate in summary.aggregates] == ["bpql"]
    assert not summary.comparisons
    assert summary.tables[0].entries["delayrl/Ant-v4", 5, "vdpo"].note == "2 of 3 seeds · failed at 100 of 300 steps"
    assert summarise(rows, [*cells.values()]).comparisons


def test_tasks_count_alike_whatever_their_seeds() -> None:
    """Of ten seeds on one task and five on another, five of each: the others would draw the mean to their task."""
    curves = {"random": [[0.0] * 3] * 2, "sac": [[0.0, 0, 100]] * 2}
    cells, rows = {}, []
    for env, seeds, score in (("delayrl/Ant-v4", 10, 20.0), ("delayrl/Hopper-v4", 5, 80.0)):
        for agent, own in (curves | {"vdpo": [[0.0, 0, score]] * seeds}).items():
            cell = standing(agent, env, 5 if agent == "vdpo" else 0, len(own), id=f"{agent} {env}", steps=300)
            cells[cell[0].id] = cell
            rows += [row for seed, values in enumerate(own) for row in curve(cell, seed, values)]
    (aggregate,) = summarise(rows, [*cells.values()]).aggregates
    assert (aggregate.iqm, aggregate.runs, aggregate.tasks) == (pytest.approx(0.5), 10, 2)


def test_over_all_delays_conditions_are_counted() -> None:
    """And an agent that was spared the long delays is not shown beside those that had them; nor is one left alone."""
    late = [standing(agent, "delayrl/Ant-v4", 25, 2, steps=300) for agent in ("vdpo", "a-sac")]
    early = {agent: standing(agent, "delayrl/Ant-v4", 5, 2, steps=300) for agent in ("bpql", "a-sac")}
    cells = small() | early
    every = anchored(cells, **{agent: [[0.0, 0, 60], [0.0, 0, 60]] for agent in ("vdpo", *early)})
    longer = [curve(cell, seed, [0, 0, 30]) for cell in late for seed in range(2)]

    def counts(rows: list[Any], more: list[Any]) -> dict[Any, tuple[int, int]]:
        summary = summarise(every + [row for run in rows for row in run], [*cells.values(), *more])
        assert ("2 conditions, 4 runs" in markdown(summary, "t", {})) == (len(more) == 2)
        return {(a.label, a.delay): (a.tasks, a.runs) for a in summary.aggregates}

    at_5 = {(agent, 5): (1, 2) for agent in ("bpql", "a-sac", "vdpo")}
    at_25 = {(agent, 25): (1, 2) for agent in ("a-sac", "vdpo")}
    assert counts(longer, late) == at_5 | at_25 | {("a-sac", None): (2, 4), ("vdpo", None): (2, 4)}
    assert counts(longer[:2], late[:1]) == at_5 | {("vdpo", 25): (1, 2)}


def test_cells_that_share_all_but_their_seeds_are_one_and_others_are_not_mixed() -> None:
    cells = small()
    more = standing("vdpo", "delayrl/Ant-v4", 5, id="more", seeds=(7,), steps=300)
    other = standing("vdpo", "delayrl/Ant-v4", 5, 2, id="wide", overrides={"width": 64}, steps=300)
    every = anchored(cells, vdpo=[[0.0, 0, 10], [0.0, 0, 20]]) + curve(more, 7, [0, 0, 30])
    every += curve(other, 0, [0, 0, 1000]) + curve(other, 1, [0, 0, 1000])
    summary = summarise(every, [*cells.values(), more, other])
    assert of(summary, "vdpo").curves.final.tolist() == [10, 20, 30]
    assert of(summary, "vdpo width=64").curves.final.tolist() == [1000, 1000]
    assert [t.title for t in summary.tables if t.kind == "ablation"] == ["Ablation of vdpo"]
    again = standing("vdpo", "delayrl/Ant-v4", 5, 2, id="~twice", steps=300)
    summary = summarise(every + curve(again, 0, [0, 0, 5]), [*cells.values(), more, again, other])
    assert of(summary, "vdpo").curves.final.tolist() == [10, 20, 30]
    assert of(summary, "vdpo #~twice").curves.final.tolist() == [5]


def test_order_of_rows_does_not_matter() -> None:
    cells = small()
    every = anchored(cells, vdpo=[[0.0, 120, 60], [10.0, 110, 160]])
    mixed = [every[i] for i in np.random.default_rng(0).permutation(len(every))]
    pages = [page(summarise(some, [*cells.values()]), "t") for some in (every, mixed)]
    assert pages[0] == pages[1]


def test_rows_of_no_cell_are_counted() -> None:
    cells = small()
    stray = standing("bpql", "Ant-v4", 5, id="gone")
    summary = summarise(anchored(cells) + curve(stray, 0, [1]), [*cells.values()])
    assert summary.unplaced == 2
    assert "2 rows belong to no cell" in markdown(summary, "t", {})


def test_a_task_that_changed_is_told() -> None:
    """Another model under the same MuJoCo is another task; under another MuJoCo its fingerprint may differ."""
    cells = small()
    rows = anchored(cells)
    models = [{"mujoco": "3.5.0", "physics": "a"}, {"mujoco": "3.2.7", "physics": "b"}]
    same = [r | models[r["seed"]] for r in rows]
    assert not summarise(same, [*cells.values()]).changed
    summary = summarise([*same[:-1], same[-1] | {"physics": "c"}], [*cells.values()])
    assert summary.changed == [rows[0]["env"]]
    assert f"The simulated model of {rows[0]['env']} is not the same" in markdown(summary, "t", {})


def test_rows_of_two_things_under_one_cell() -> None:
    c = standing("bpql", "Ant-v4", 5)
    rows = [row(c, 0, 100, 1.0), row(c, 0, 200, 1.0) | {"env": "Hopper-v4"}]
    with pytest.raises(DelayRLError, match=r"rows of cell .* are of different things"):
        summarise(rows, [c])


def test_hours_of_all_cells_of_a_result() -> None:
    """300 steps at 10 and at 20 steps a second: 45 s. Unknown where a cell that has begun says no speed."""
    parts = [standing("bpql", "Ant-v4", 5, (seed,), id=str(seed), steps=300) for seed in range(3)]
    every = [r for seed, cell in enumerate(parts) for r in curve(cell, seed, [0, 0, 1])]
    speeds = [Progress("done", 300, 10.0), Progress("done", 300, 20.0), Progress("todo", 0)]
    cells = [(cell, speed) for (cell, _), speed in zip(parts, speeds, strict=True)]
    place = Place(Setting("corrected", "paper"), "Ant-v4", 5, "bpql")
    assert summarise(every, cells).results[place].hours == pytest.approx(45 / 3600)
    assert "| 0.013 |" in markdown(summarise(every, cells), "t", {})
    cells[2] = parts[2]
    assert math.isnan(summarise(every, cells).results[place].hours)


def test_overrides_of_a_task_do_not_part_an_agent() -> None:
    """BPQL with fewer steps on Hopper is BPQL there too; what tells apart its cells on one task is in its labels."""
    short = {"steps": 200, "overrides": {"steps": 200}}
    cells = [
        standing("bpql", "Ant-v4", 5, 2, steps=300),
        standing("bpql", "Ant-v4", 5, 2, steps=300, overrides={"critic_norm": "layer"}),
        standing("bpql", "Hopper-v4", 5, 2, **short),
        standing("vdpo", "Ant-v4", 5, 2, steps=300),
        standing("vdpo", "Hopper-v4", 5, 2, **short),
    ]
    every = [
        r
        for cell in cells
        for seed in range(2)
        for r in curve(cell, seed, [0, 0, 1][-cell[0].condition.steps // 100 :])
    ]
    summary = summarise(every, cells)
    assert summary.labels == ["bpql", "bpql critic_norm=layer", "vdpo"]
    assert summary.shared == {("bpql", "Hopper-v4"): {"steps": 200}, ("vdpo", "Hopper-v4"): {"steps": 200}}
    line = "Overridden in all cells of bpql, vdpo on Hopper-v4: steps=200."
    assert line in markdown(summary, "t", {})
    assert payload(summary, "t")["remarks"][-1] == line
    (met,) = [c for c in summary.comparisons if (c.one, c.other) == ("bpql", "vdpo")]
    assert met.tasks == 2


def test_a_threshold_that_random_reaches_is_none() -> None:
    """Smoothing over a fast ascent brings the reference below `random`, which would reach it at its first step."""
    cells = small()
    rows = [row for row in anchored(cells, vdpo=[[0.0, 1, 2], [0.0, 1, 4]]) if row["agent"] != "sac"]
    rows += [row for seed in range(2) for row in curve(cells["sac"], seed, [-900.0, -900, 100])]
    result = of(summarise(rows, [*cells.values()]), "vdpo")
    assert (result.reference_anchor.value, result.random_anchor.value) == (100, 10)
    assert np.isnan([result.threshold, result.steps_to_threshold, *result.steps_interval]).all()
