"""Make the tables and pictures of docs/performance.md from the rows of run.py; figures.py inserts them."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot
from speed.works import OWN, SIZES

from delayrl.bench.results import read_table
from delayrl.report.markup import markdown_table
from delayrl.run.folder import versions_in

RESULTS = Path(__file__).parent.parent / "results"
Row = dict[str, Any]


def read_rows(name: str = "speed") -> list[Row]:
    """Read the rows of a results file; none if there is no such file."""
    path = RESULTS / f"{name}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def compared(rows: list[Row], names: tuple[str, str] = ("ours", "peer")) -> str:
    """Return a Markdown table of both sides of each work, by default ours beside each peer."""
    sides = f"work; {names[1]}|device|threads|{names[0]}, steps/s|{names[1]}, steps/s"
    body = []
    for row in (r for r in rows if not r["work"].startswith("size-")):
        cells = [row["title"], row["device"], row["threads"], f"{row['ours']['steps_per_second']:.1f}"]
        if "peer" in row:
            asleep = " (asleep)" if row["peer"].get("waiting") == "passive" else ""
            cells += [f"{row['peer']['steps_per_second']:.1f}{asleep}"]
            cells += [spread(row["ratio"]), spread(row["processor_ratio"])]
        else:
            cells += ["", "", ""]
        body.append([*cells, len(row["ours"]["slices"]), f"{row['load']['median']:.1f}"])
    return markdown_table(f"{sides}|ratio (quartiles)|of processor time|slices|load".split("|"), body)


def behind(rows: list[Row]) -> str:
    """Return a sentence for each work in which the peer is faster: our distance from the floor, our longest part."""
    lines = []
    for row in (r for r in rows if "peer" in r and r["ratio"]["median"] < 1):
        line = f"**The peer is faster** in: {row['title']} (ratio {row['ratio']['median']:.2f})."
        if floor := row.get("floor"):
            names = {"phase 0": "SAC and belief", "phase 1": "cloning"}
            longest = max(floor["parts"], key=floor["parts"].get)
            share = floor["parts"][longest] / sum(floor["parts"].values())
            words = "processor time" if row["device"] == "cpu" else "step"
            line += f" Our {words} is {spent(row) / floor_seconds(row):.1f} times the floor below; "
            line += f"{share:.0%} of the parts' sum is "
            line += f"{names.get(longest, longest)}."
        lines.append(line)
    return "\n\n".join(lines)


def spread(value: dict[str, float]) -> str:
    """Format a median with its quartiles."""
    return f"{value['median']:.2f} ({value['low']:.2f}–{value['high']:.2f})"


def once(rows: list[Row]) -> dict[str, Row]:
    """Return the first row of each work, that with the most threads (`run.write` sorts them)."""
    return {row["work"]: row for row in reversed(rows)}


def where(row: Row, rows: list[Row]) -> str:
    """Return device and threads of a row if the rows of the table differ in them."""
    several = len({(r["device"], r["threads"]) for r in rows}) > 1
    return f" ({row['device']}, {row['threads']} threads)" if several else ""


def resources(rows: list[Row]) -> str:
    """Return a Markdown table of processor time and peak memory of both sides."""
    body = []
    for row in (r for r in rows if "peer" in r):
        sides = row["ours"], row["peer"]
        times = [f"{1e3 * s['processor']['median']:.1f}" for s in sides]
        body.append([row["title"] + where(row, rows), *times, *(f"{s['peak_bytes'] / 1e6:.0f}" for s in sides)])
    head = ["work; peer", "ours, processor ms/step", "peer, processor ms/step", "ours, peak MB", "peer, peak MB"]
    return markdown_table(head, body)


def parts(rows: list[Row]) -> str:
    """Return a Markdown table of the parts of our step, and those that the peer times."""
    body = []
    for row in (r for r in rows if r.get("floor") and not r["work"].startswith("size-")):
        seconds, seeds = row["floor"]["parts"], row["ours"]["seeds"]
        names = ("act", "environment", "phase 0", "phase 1")
        cells = [f"{1e3 * seconds[n] / seeds:.2f}" if n in seconds else "" for n in names]
        cells += [f"{1e3 * sum(seconds.values()) / seeds:.2f}", f"{1e3 * row['ours']['seconds']['median']:.2f}"]
        theirs = row.get("peer", {}).get("parts", {})
        words = {"train_sac": "SAC", "train_belief": "belief", "train_kl": "cloning"}
        cells.append(", ".join(f"{words[n]} {1e3 * theirs[n]['median']:.1f}" for n in words if n in theirs))
        body.append([row["title"] + where(row, rows), *cells])
    head = ["work; peer", "act", "environment", "SAC and belief", "cloning", "their sum", "whole step", "peer's parts"]
    return markdown_table(head, body)


def floor_seconds(row: Row) -> float:
    """Return the seconds of a seed's step if its matrix products ran at this machine's best rate."""
    return row["floor"]["flops"] / best_rate(row)


def spent(row: Row) -> float:
    """Return the seconds to compare with the floor: processor time per thread, or on a GPU the time of the step."""
    ours = row["ours"]
    return ours["processor"]["median"] / row["threads"] if row["device"] == "cpu" else ours["seconds"]["median"]


def best_rate(row: Row) -> float:
    """Return the highest rate, over all shapes, in any row of the same device, threads and day."""
    alike = ("device", "threads", "date")
    same = [r for r in read_rows() if r.get("floor") and all(r[name] == row[name] for name in alike)]
    return max(rate for r in same for rate in r["floor"]["rates"].values())


def floors(rows: list[Row]) -> str:
    """Return a Markdown table of each work beside its floor, with the rates of its own shapes."""
    head = ["work", "GFLOP/step", "floor, ms", "processor, ms", "times the floor"]
    head += ["squares", "forward", "weights'", "inputs'"]
    body: list[list[str]] = []
    shown = [r for r in rows if r.get("floor") and not r["work"].startswith("size-")]
    for row in shown:
        least, rates = floor_seconds(row), row["floor"]["rates"]
        ours, words = spent(row), "" if row["device"] == "cpu" else " (whole step)"
        cells = [f"{row['floor']['flops'] / 1e9:.3f}", f"{1e3 * least:.2f}", f"{1e3 * ours:.2f}{words}"]
        cells += [f"{ours / least:.1f}"]
        cells += [f"{rates[name] / 1e9:.0f}" for name in ("square", "forward", "weights", "inputs")]
        body.append([row["title"].split(";")[0] + where(row, rows), *cells])
    return "\n\n".join(filter(None, (markdown_table(head, body), best_rates(shown))))


def best_rates(rows: list[Row]) -> str:
    """Return a sentence with the rate of these rows' floors; where there are several, with what each is of."""
    rates = {(row["device"], f"{row['threads']} threads", row["date"]): best_rate(row) for row in rows}
    told = [i for i in range(3) if len({of[i] for of in rates}) > 1]
    each = []
    for of, rate in sorted(rates.items()):
        words = ", ".join(of[i] for i in told)
        each.append(f"{rate / 1e9:.0f} GFLOP/s{words and f' ({words})'}")
    return f"The best rate seen: {', '.join(each)}." if each else ""


def operations() -> str:
    """Return a Markdown table of one update on one core, by kind of operation."""
    rows = read_rows("operations")
    names = {0: "SAC and belief", 1: "cloning"}
    kinds = sorted(
        {k for row in rows for k in row["kinds"]}, key=lambda k: -max(r["kinds"].get(k, [0])[0] for r in rows)
    )
    body = []
    for row in rows:
        phase = names[row["phase"]] if row["title"].startswith("VDPO") else "SAC"
        cells = [row["title"], phase, f"{row['milliseconds']:.1f}", f"{row['gflop']:.2f}"]
        cells += [f"{row['kinds'][k][0]:.2f} ({row['kinds'][k][1]:.0f})" if k in row["kinds"] else "" for k in kinds]
        body.append(cells)
    table = markdown_table(["work", "update", "whole, ms", "GFLOP", *(f"{kind}, ms (calls)" for kind in kinds)], body)
    loads = [row["load"] for row in rows]
    about = f"\n\nCommit {commits(rows)}; load before each: {min(loads):.1f} to {max(loads):.1f}." if rows else ""
    return table + about


def trial(grid: str, option: str, default: int, before: str = "", *, timed: bool) -> str:
    """Return a Markdown table of what VDPO learns with values of an option: the cells of a grid that have ended."""
    if not (table := RESULTS / f"{grid}.sqlite").exists():
        return ""
    rows, standing, configs, _ = read_table(table)
    ended = [(cell, progress) for cell, progress in standing if progress.state == "done"]
    if not ended:
        return ""
    titles = f"task|`--{option.replace('_', '-')}`|mean of all evaluations|last evaluation|last, each seed"
    body = []
    for cell, progress in ended:
        returns: dict[int, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in (row for row in rows if row["cell"] == cell.id and row["policy"] == "agent"):
            returns[row["step"]][row["seed"]].append(row["return"])
        means = {step: [float(np.mean(x)) for x in seeds.values()] for step, seeds in sorted(returns.items())}
        last, speed, condition = means[max(means)], progress.speed, cell.condition
        cells = [f"{condition.env}, Δ = {condition.delay}", str(condition.overrides.get(option, default))]
        cells += [f"{np.mean(list(means.values())):.1f}", f"{np.mean(last):.1f}", " · ".join(f"{x:.1f}" for x in last)]
        body.append(cells + [f"{speed * len(cell.seeds):.0f}" if speed else ""] * timed)
    commit = commits([{"versions": used} for config in configs for used in versions_in(config)])
    about = f"VDPO, preset `{condition.preset}`, {len(cell.seeds)} seeds in lockstep. Commit {commit}."
    about = f"{about} Rows: `benchmarks/results/{table.name}`."
    results = markdown_table((titles + "|seed-steps/s" * timed).split("|"), body)
    return "\n\n".join([*([before] if before else []), results, about])


def precision() -> str:
    """Return a Markdown table of the error of coarser products, from the rows of benchmarks/precision.py."""
    rows = read_rows("precision")
    body = [[f"`{row['precision']}`", f"{row['action']:.1e}", f"{row['gradient']:.1e}"] for row in rows]
    table = markdown_table(["`--precision`", "actions", "gradient of the belief's loss"], body)
    return f"{table}\n\nCommit {commits(rows)}. Rows: `benchmarks/results/precision.jsonl`."


def sizes(rows: list[Row]) -> str:
    """Return a Markdown table of cost against Δ, seeds and task; cells that were not run are empty.

    Each floor has the best rate of its own day, so that the rate stands beside it.
    """
    head = ["preset", "task", "Δ", "seeds", "ms/step of a seed", "seed-steps/s", "processor ms/step"]
    head += ["floor, ms (at GFLOP/s)", "replay", "peak MB"]
    body, measured = [], once(rows)
    for name, work in SIZES.items():
        side, row = work.sides["ours"], measured.get(name)
        cells = [f"`{side['preset']}`", side["env"], side["delay"], side["seeds"]]
        if row:
            ours, floor = row["ours"], row.get("floor")
            cells += [f"{1e3 * ours['seconds']['median']:.1f}", f"{ours['steps_per_second']:.1f}"]
            cells += [f"{1e3 * ours['processor']['median']:.1f}"]
            if floor:
                cells += [f"{1e3 * floor_seconds(row):.2f} ({best_rate(row) / 1e9:.0f})"]
                cells += [f"{floor['replay_bytes'] / 1e9:.2f} GB"]
            else:
                cells += ["", ""]
            cells += [f"{ours['peak_bytes'] / 1e6:.0f}"]
        body.append(cells + [""] * (len(head) - len(cells)))
    return markdown_table(head, body)


def draw_sizes(rows: list[Row], out: Path) -> None:
    """Draw processor time and floor of a seed's step against Δ, seeds and observation size."""
    chosen = [r for r in once(rows).values() if r["work"].startswith("size-") and r.get("floor")]
    cheetah = [r for r in chosen if r["task"].startswith("HalfCheetah")]
    panels = {
        "delay Δ (steps)": [(r["delay"], r) for r in cheetah if r["ours"]["seeds"] == 1],
        "seeds in lockstep": [(r["ours"]["seeds"], r) for r in cheetah if r["delay"] == 5],
        "observation size": [
            (r["floor"]["obs_size"], r) for r in chosen if r["delay"] == 5 and r["ours"]["seeds"] == 1
        ],
    }
    figure, every = pyplot.subplots(1, 3, figsize=(11, 3.6), layout="constrained", sharey=True)
    for axes, (words, placed) in zip(every, panels.items(), strict=True):
        for preset, colour in (("small", "#1f6feb"), ("paper", "#1a7f37")):
            points = sorted(((x, r) for x, r in placed if r["preset"] == preset), key=lambda point: point[0])
            if not points:
                continue
            x = [p for p, _ in points]
            cost = [1e3 * r["ours"]["processor"]["median"] / r["threads"] for _, r in points]
            axes.plot(x, cost, color=colour, marker="o", label=f"preset {preset}")
            axes.plot(x, [1e3 * floor_seconds(r) for _, r in points], color=colour, linestyle=":", label="its floor")
        axes.set(xlabel=words, xscale="log", yscale="log")
        axes.set_xticks(sorted({x for x, _ in placed}), minor=False)
        axes.get_xaxis().set_major_formatter(matplotlib.ticker.ScalarFormatter())
        axes.minorticks_off()
        axes.grid(alpha=0.25)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    every[0].yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
    every[0].yaxis.set_major_formatter(matplotlib.ticker.ScalarFormatter())
    every[0].set_ylabel("processor ms / cores, a step of a seed")
    if every[1].lines:
        every[1].legend(frameon=False)
    figure.savefig(out, dpi=140)
    pyplot.close(figure)


def replay(obs_size: int, action_size: int, delay: int, rows: int) -> tuple[int, int]:
    """Return the bytes of the replay: ours, and the released code's, whose rows hold x_t, its targets and its masks.

    Columns of the released code: two states, action, reward, end and discount as floats; for cloning, one state, Δ
    actions and Δ states as floats, Δ positions of 8 bytes and Δ masks of 1 byte.
    """
    ours = 4 * (obs_size + action_size) + 17
    theirs = 4 * (2 * obs_size + action_size + 3) + 4 * (obs_size + delay * (action_size + obs_size)) + 9 * delay
    return rows * ours, rows * theirs


def memory() -> str:
    """Return a Markdown table of the replay of a million steps."""
    body = []
    tasks = (("HalfCheetah-v5", 17, 6), ("Humanoid-v5", 348, 17))
    for (task, obs_size, action_size), delay in ((t, d) for t in tasks for d in (5, 25, 50)):
        ours, theirs = replay(obs_size, action_size, delay, 1_000_000)
        body.append([task, delay, f"{ours / 1e9:.2f} GB", f"{theirs / 1e9:.1f} GB", f"{theirs / ours:.0f}"])
    return markdown_table(["task", "Δ", "ours", "released code", "ratio"], body)


def provenance(rows: list[Row]) -> str:
    """Return one line for each device on the machine and versions behind the rows."""
    devices = sorted({row["device"] for row in rows})
    return "\n\n".join(machine([row for row in rows if row["device"] == device]) for device in devices)


def commits(rows: list[Row]) -> str:
    return ", ".join(sorted({row["versions"]["commit"] or "?" for row in rows}))


def machine(rows: list[Row]) -> str:
    def words(name: str) -> str:
        return ", ".join(sorted({str(row["versions"][name]) for row in rows}))

    used = [row["peer"].get("packages", {}) for row in rows if "peer" in row and row["work"] not in OWN]
    peers = ", ".join(sorted({f"{n} {v}" for packages in used for n, v in packages.items() if n in PEERS}))
    dates = sorted({row["date"] for row in rows})
    return (
        f"{words('cores')} x86 cores ({words('device')}), shared with other work. "
        f"Python {words('python')}, jax {words('jax')}, "
        f"MuJoCo {words('mujoco')}, Gymnasium {words('gymnasium')}{peers and f'; peers: {peers}'}. "
        f"Commit {commits(rows)}; {' to '.join(sorted({dates[0], dates[-1]}))}. "
        "Rows: `benchmarks/results/speed.jsonl`."
    )


PEERS = ("torch", "jax", "stable_baselines3", "sbx_rl")


def pages(root: Path) -> dict[str, str]:
    """Return the generated sections of docs/performance.md and of README.md here by key, and draw their picture."""
    every = read_rows()
    if not every:
        return {}
    rows, own = ([row for row in every if (row["work"] in OWN) == ours] for ours in (False, True))
    beside = [row for row in rows if not row["work"].startswith("size-")]
    draw_sizes(rows, root / "docs" / "img" / "performance-sizes.png")
    return {
        "speed-compared": "\n\n".join(x for x in (compared(rows), behind(rows), provenance(beside)) if x),
        "speed-own": "\n\n".join((compared(own, ("first", "second")), provenance(own))),
        "speed-resources": resources(rows),
        "speed-parts": parts(rows),
        "speed-floors": floors(rows),
        "speed-operations": operations(),
        "speed-blocks": trial("updates-per-call", "updates_per_call", 1, timed=True),
        "speed-tokens": trial(
            "tokens", "tokens", 640, "What that does to learning (0 takes whole windows):", timed=False
        ),
        "speed-precision": precision(),
        "speed-sizes": "\n\n".join((sizes(rows), provenance([row for row in rows if row not in beside]))),
        "speed-memory": memory(),
    }
