"""Pictures and tables of the docs, from committed rows alone: `python benchmarks/figures.py`."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot

HERE = Path(__file__).parent
COLOURS = {
    "vdpo": "#1f6feb",
    "reference": "#8c8c8c",
    "sac-memoryless": "#d1242f",
    "bpql": "#1a7f37",
    "a-sac": "#9a6700",
}

Curves = dict[str, dict[int, list[float]]]  # label -> step -> one mean return a seed


def read(name: str) -> tuple[dict[int, dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    """Configurations by run, rows, and evaluations of a results file."""
    lines = [json.loads(line) for line in (HERE / "results" / f"{name}.jsonl").read_text().splitlines()]
    configs = {line["run"]: line["config"] for line in lines if "config" in line}
    return configs, [line for line in lines if "step" in line], [line for line in lines if "evaluation" in line]


def curves(name: str) -> Curves:
    """Mean return of each seed's evaluations, by agent; the reference of vdpo beside it."""
    configs, rows, _ = read(name)
    episodes: dict[tuple[str, int, int], list[float]] = defaultdict(list)
    for row in rows:
        agent = configs[row["run"]]["agent"]
        label = agent if row["policy"] == "agent" else "reference"
        episodes[label, row["step"], row["run"]].append(row["return"])
    result: Curves = defaultdict(lambda: defaultdict(list))
    for (label, step, _), returns in sorted(episodes.items()):
        result[label][step].append(float(np.mean(returns)))
    return result


def draw(name: str, title: str, out: Path, labels: dict[str, str]) -> None:
    """Return against steps: the mean over seeds as a line, each seed as a thin one."""
    figure, axes = pyplot.subplots(figsize=(7.5, 4), layout="constrained")
    for label, points in curves(name).items():
        if label not in labels:
            continue
        steps = sorted(points)
        seeds = np.array([points[step] for step in steps])
        axes.plot(steps, seeds, color=COLOURS[label], alpha=0.25, linewidth=1)
        axes.plot(steps, seeds.mean(1), color=COLOURS[label], linewidth=2.2, label=labels[label])
    axes.set(xlabel="environment steps", ylabel="return", title=title)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    out.parent.mkdir(exist_ok=True)
    figure.savefig(out, dpi=140)
    pyplot.close(figure)


def table(name: str) -> str:
    """Markdown: the evaluation of each run on start states that it never saw."""
    configs, _, evaluations = read(name)
    lines = [
        "| agent | delay | seed | steps | mean return | std | episodes |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for line in evaluations:
        config, e = configs[line["run"]], line["evaluation"]
        cells = [e["agent"], e["delay"], config["seed"], config["schedule"]["steps"]]
        lines.append(
            f"| {' | '.join(map(str, cells))} | {e['mean_return']:.1f} | {e['std_return']:.1f} | {e['episodes']} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Everything that the docs show."""
    images = HERE.parent / "docs" / "img"
    words = {
        "vdpo": "VDPO, delay 5",
        "reference": "its reference, no delay",
        "sac-memoryless": "SAC without memory, delay 5",
    }
    title = "InvertedPendulum-v5, three seeds"
    draw("inverted-pendulum", title, images / "return-against-steps.png", words)
    print(table("inverted-pendulum"), "\n")
    draw("reacher", "Reacher-v5, three seeds", images / "reacher.png", words | {"bpql": "BPQL, delay 5"})
    print(table("reacher"))


if __name__ == "__main__":
    main()
