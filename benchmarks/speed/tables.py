"""Tables and pictures of docs/performance.md, from the rows of run.py alone; figures.py puts them there."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot
from speed.works import SIZES

from delayrl.bench.results import read_table

RESULTS = Path(__file__).parent.parent / "results"
Row = dict[str, Any]


def rows(name: str = "speed") -> list[Row]:
    """What was measured; none where nothing was."""
    path = RESULTS / f"{name}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def compared(found: list[Row]) -> str:
    """Markdown: ours beside each peer."""
    lines = [
        *head("work; peer|device|threads|ours, steps/s|peer, steps/s|ratio (quartiles)|of processor time|slices|load"),
    ]
    for row in (r for r in found if not r["work"].startswith("size-")):
        cells = [row["title"], row["device"], row["threads"], f"{row['ours']['steps_per_second']:.1f}"]
        if "peer" in row:
            asleep = " (asleep)" if row["peer"].get("waiting") == "passive" else ""
            cells += [f"{row['peer']['steps_per_second']:.1f}{asleep}"]
            cells += [spread(row["ratio"]), spread(row["processor_ratio"])]
        else:
            cells += ["", "", ""]
        cells += [len(row["ours"]["slices"]), f"{row['load']['median']:.1f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def behind(found: list[Row]) -> str:
    """A sentence for each work in which the peer is faster: our distance from the floor, and our longest part."""
    lines = []
    for row in (r for r in found if "peer" in r and r["ratio"]["median"] < 1):
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


def head(columns: str) -> list[str]:
    names = columns.split("|")
    return ["| " + " | ".join(names) + " |", "| " + " | ".join("---" for _ in names) + " |"]


def spread(value: dict[str, float]) -> str:
    return f"{value['median']:.2f} ({value['low']:.2f}–{value['high']:.2f})"


def once(found: list[Row]) -> dict[str, Row]:
    """One row for each work: the first, that of the most threads (`run.write` sorts them)."""
    return {row["work"]: row for row in reversed(found)}


def where(row: Row, found: list[Row]) -> str:
    """Device and threads of a row, in a table whose rows differ in them."""
    several = len({(r["device"], r["threads"]) for r in found}) > 1
    return f" ({row['device']}, {row['threads']} threads)" if several else ""


def resources(found: list[Row]) -> str:
    """Markdown: processor time and memory of both sides."""
    lines = [
        *head("work; peer|ours, processor ms/step|peer, processor ms/step|ours, peak MB|peer, peak MB"),
    ]
    for row in (r for r in found if "peer" in r):
        sides = row["ours"], row["peer"]
        cells = [f"{1e3 * s['processor']['median']:.1f}" for s in sides] + [
            f"{s['peak_bytes'] / 1e6:.0f}" for s in sides
        ]
        lines.append(f"| {row['title']}{where(row, found)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def parts(found: list[Row]) -> str:
    """Markdown: where our step goes, and what the peer times of its own."""
    lines = [
        *head("work|act|environment|SAC and belief|cloning|their sum|whole step|peer's parts"),
    ]
    for row in (r for r in found if r.get("floor") and not r["work"].startswith("size-")):
        seconds, seeds = row["floor"]["parts"], row["ours"]["seeds"]
        names = ("act", "environment", "phase 0", "phase 1")
        cells = [f"{1e3 * seconds[n] / seeds:.2f}" if n in seconds else "" for n in names]
        cells += [f"{1e3 * sum(seconds.values()) / seeds:.2f}", f"{1e3 * row['ours']['seconds']['median']:.2f}"]
        theirs = row.get("peer", {}).get("parts", {})
        words = {"train_sac": "SAC", "train_belief": "belief", "train_kl": "cloning"}
        cells.append(", ".join(f"{words[n]} {1e3 * theirs[n]['median']:.1f}" for n in words if n in theirs))
        lines.append(f"| {row['title'].split(';')[0]}{where(row, found)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def floor_seconds(row: Row) -> float:
    """Of one environment step of one seed: its matrix products at the best rate that this machine ever showed."""
    return row["floor"]["flops"] / best_rate(row)


def spent(row: Row) -> float:
    """Seconds of a step that stand beside its floor: of the processor's cores; on a GPU, of the whole step."""
    ours = row["ours"]
    return ours["processor"]["median"] / row["threads"] if row["device"] == "cpu" else ours["seconds"]["median"]


def best_rate(row: Row) -> float:
    """The highest rate in any row of the same device and threads: of squares, or of the shapes of an update."""
    same = [r for r in rows() if r.get("floor") and (r["device"], r["threads"]) == (row["device"], row["threads"])]
    return max(rate for r in same for rate in r["floor"]["rates"].values())


def floors(found: list[Row]) -> str:
    """Markdown: each work beside its floor, and the rates at which its own shapes multiply."""
    lines = [
        *head("work|GFLOP/step|floor, ms|processor, ms|times the floor|squares|forward|weights'|inputs'"),
    ]
    for row in (r for r in found if r.get("floor") and not r["work"].startswith("size-")):
        least, rates = floor_seconds(row), row["floor"]["rates"]
        ours, words = spent(row), "" if row["device"] == "cpu" else " (whole step)"
        cells = [f"{row['floor']['flops'] / 1e9:.3f}", f"{1e3 * least:.2f}", f"{1e3 * ours:.2f}{words}"]
        cells += [f"{ours / least:.1f}"]
        cells += [f"{rates[name] / 1e9:.0f}" for name in ("square", "forward", "weights", "inputs")]
        lines.append(f"| {row['title'].split(';')[0]}{where(row, found)} | " + " | ".join(cells) + " |")
    best: dict[str, float] = {}
    for row in (r for r in found if r.get("floor")):
        best[row["device"]] = max(best_rate(row), best.get(row["device"], 0))
    words = " and ".join(f"{v / 1e9:.0f} GFLOP/s{f' ({d})' if len(best) > 1 else ''}" for d, v in best.items())
    return "\n".join([*lines, "", f"The best rate seen: {words}."])


def operations() -> str:
    """Markdown: one update on one core, by kind of operation."""
    found = rows("operations")
    names = {0: "SAC and belief", 1: "cloning"}
    kinds = sorted(
        {k for row in found for k in row["kinds"]}, key=lambda k: -max(r["kinds"].get(k, [0])[0] for r in found)
    )
    lines = [*head("|".join(["work", "update", "whole, ms", "GFLOP", *(f"{kind}, ms (calls)" for kind in kinds)]))]
    for row in found:
        phase = names[row["phase"]] if row["title"].startswith("VDPO") else "SAC"
        cells = [row["title"], phase, f"{row['milliseconds']:.1f}", f"{row['gflop']:.2f}"]
        cells += [f"{row['kinds'][k][0]:.2f} ({row['kinds'][k][1]:.0f})" if k in row["kinds"] else "" for k in kinds]
        lines.append("| " + " | ".join(cells) + " |")
    loads = [row["load"] for row in found]
    lines += ["", f"Commit {commits(found)}; load before each: {min(loads):.1f} to {max(loads):.1f}."] if found else []
    return "\n".join(lines)


def blocks() -> str:
    """Markdown: learning with several steps a call, from the rows of benchmarks/updates-per-call.toml."""
    if not (table := RESULTS / "updates-per-call.sqlite").exists():
        return ""
    found, cells, used = read_table(table)
    lines = head("task|`--updates-per-call`|mean of all evaluations|last evaluation|last, each seed|seed-steps/s")
    for cell, progress in cells:
        returns: dict[int, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in (row for row in found if row["cell"] == cell.id and row["policy"] == "agent"):
            returns[row["step"]][row["seed"]].append(row["return"])
        means = {step: [float(np.mean(x)) for x in seeds.values()] for step, seeds in sorted(returns.items())}
        last, speed = means[max(means)], progress.speed
        cells_of = [f"{cell.env}, Δ = {cell.delay}", str(cell.overrides.get("updates_per_call", 1))]
        cells_of += [f"{np.mean(list(means.values())):.1f}", f"{np.mean(last):.1f}"]
        cells_of += [" · ".join(f"{x:.1f}" for x in last)]
        cells_of += [f"{speed * len(cell.seeds):.0f}" if speed else ""]
        lines.append("| " + " | ".join(cells_of) + " |")
    commit = commits([{"versions": versions} for versions in used])
    about = f"VDPO, preset `{cells[0][0].preset}`, {len(cells[0][0].seeds)} seeds in lockstep. Commit {commit}."
    return "\n".join([*lines, "", f"{about} Rows: `benchmarks/results/updates-per-call.sqlite`."])


def precision() -> str:
    """Markdown: the error of coarser products, from the rows of benchmarks/precision.py."""
    found = rows("precision")
    lines = head("`--precision`|actions|gradient of the belief's loss")
    lines += [f"| `{row['precision']}` | {row['action']:.1e} | {row['gradient']:.1e} |" for row in found]
    return "\n".join([*lines, "", f"Commit {commits(found)}. Rows: `benchmarks/results/precision.jsonl`."])


def sizes(found: list[Row]) -> str:
    """Markdown: cost against Δ, seeds and task; what was not run stays empty."""
    lines = [
        *head("preset|task|Δ|seeds|ms/step of a seed|seed-steps/s|processor ms/step|floor, ms|replay|peak MB"),
    ]
    measured = once(found)
    for name, work in SIZES.items():
        side, row = work.sides["ours"], measured.get(name)
        cells = [f"`{side['preset']}`", side["env"], side["delay"], side["seeds"]]
        if row:
            ours, floor = row["ours"], row.get("floor")
            cells += [f"{1e3 * ours['seconds']['median']:.1f}", f"{ours['steps_per_second']:.1f}"]
            cells += [f"{1e3 * ours['processor']['median']:.1f}"]
            cells += [f"{1e3 * floor_seconds(row):.2f}", f"{floor['replay_bytes'] / 1e9:.2f} GB"] if floor else ["", ""]
            cells += [f"{ours['peak_bytes'] / 1e6:.0f}"]
        lines.append("| " + " | ".join(map(str, cells + [""] * (10 - len(cells)))) + " |")
    return "\n".join(lines)


def draw_sizes(found: list[Row], out: Path) -> None:
    """Processor time of a seed's step against Δ, seeds and observation size, and the floor beneath."""
    chosen = [r for r in once(found).values() if r["work"].startswith("size-") and r.get("floor")]
    panels = {
        "delay Δ (steps)": lambda r: r["task"].startswith("HalfCheetah") and r["ours"]["seeds"] == 1 and r["delay"],
        "seeds in lockstep": lambda r: r["task"].startswith("HalfCheetah") and r["delay"] == 5 and r["ours"]["seeds"],
        "observation size": lambda r: r["delay"] == 5 and r["ours"]["seeds"] == 1 and r["floor"]["obs_size"],
    }
    figure, every = pyplot.subplots(1, 3, figsize=(11, 3.6), layout="constrained", sharey=True)
    for axes, (words, pick) in zip(every, panels.items(), strict=True):
        for preset, colour in (("small", "#1f6feb"), ("paper", "#1a7f37")):
            points = sorted((pick(r), r) for r in chosen if r["preset"] == preset and pick(r)) if chosen else []
            if not points:
                continue
            x = [p for p, _ in points]
            cost = [1e3 * r["ours"]["processor"]["median"] / r["threads"] for _, r in points]
            axes.plot(x, cost, color=colour, marker="o", label=f"preset {preset}")
            axes.plot(x, [1e3 * floor_seconds(r) for _, r in points], color=colour, linestyle=":", label="its floor")
        axes.set(xlabel=words, xscale="log", yscale="log")
        axes.set_xticks(sorted({pick(r) for r in chosen if pick(r)}), minor=False)
        axes.get_xaxis().set_major_formatter(matplotlib.ticker.ScalarFormatter())
        axes.minorticks_off()
        axes.grid(alpha=0.25)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    every[0].yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
    every[0].yaxis.set_major_formatter(matplotlib.ticker.ScalarFormatter())
    every[0].set_ylabel("ms of all cores, a step of a seed")
    if every[1].lines:
        every[1].legend(frameon=False)
    figure.savefig(out, dpi=140)
    pyplot.close(figure)


def replay(obs_size: int, action_size: int, delay: int, rows: int) -> tuple[int, int]:
    """Bytes of the replay: ours, and the released code's, whose rows hold x_t, its targets and its masks.

    Its columns: two states, action, reward, end and discount as floats; of what is cloned from, one state, Δ actions
    and Δ states as floats, Δ positions as 8 bytes, Δ masks as 1.
    """
    ours = 4 * (obs_size + action_size) + 17
    theirs = 4 * (2 * obs_size + action_size + 3) + 4 * (obs_size + delay * (action_size + obs_size)) + 9 * delay
    return rows * ours, rows * theirs


def memory() -> str:
    """Markdown: replay of a million steps."""
    lines = ["| task | Δ | ours | released code | ratio |", "| --- | --- | --- | --- | --- |"]
    tasks = (("HalfCheetah-v5", 17, 6), ("Humanoid-v5", 348, 17))
    for (task, obs_size, action_size), delay in ((t, d) for t in tasks for d in (5, 25, 50)):
        ours, theirs = replay(obs_size, action_size, delay, 1_000_000)
        lines.append(f"| {task} | {delay} | {ours / 1e9:.2f} GB | {theirs / 1e9:.1f} GB | {theirs / ours:.0f} |")
    return "\n".join(lines)


def provenance(found: list[Row]) -> str:
    """One line for each device: on what the rows were made."""
    devices = sorted({row["device"] for row in found})
    return "\n\n".join(machine([row for row in found if row["device"] == device]) for device in devices)


def commits(found: list[Row]) -> str:
    return ", ".join(sorted({row["versions"]["commit"] or "?" for row in found}))


def machine(found: list[Row]) -> str:
    def words(name: str) -> str:
        return ", ".join(sorted({str(row["versions"][name]) for row in found}))

    peers = sorted({f"{n} {v}" for r in found for n, v in r.get("peer", {}).get("packages", {}).items() if n in PEERS})
    dates = sorted({row["date"] for row in found})
    return (
        f"{words('cores')} x86 cores ({words('device')}), shared with other work: the load is the mean number "
        f"of processes that wanted a core. Python {words('python')}, jax {words('jax')}, "
        f"MuJoCo {words('mujoco')}, Gymnasium {words('gymnasium')}; peers: {', '.join(peers)}. "
        f"Commit {commits(found)}; {' to '.join(dates)}. "
        "Rows: `benchmarks/results/speed.jsonl`."
    )


PEERS = ("torch", "jax", "stable_baselines3", "sbx_rl")


def pages(root: Path) -> dict[str, str]:
    """Text by key for docs/performance.md; the picture is drawn beside it."""
    found = rows()
    if not found:
        return {}
    draw_sizes(found, root / "docs" / "img" / "performance-sizes.png")
    return {
        "speed-compared": "\n\n".join(x for x in (compared(found), behind(found), provenance(found)) if x),
        "speed-resources": resources(found),
        "speed-parts": parts(found),
        "speed-floors": floors(found),
        "speed-operations": operations(),
        "speed-blocks": blocks(),
        "speed-precision": precision(),
        "speed-sizes": sizes(found),
        "speed-memory": memory(),
    }
