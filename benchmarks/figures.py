"""Write the pictures and tables of the docs from committed files alone: `python benchmarks/figures.py`."""

import functools
import runpy
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import against
import forecast
import front
import jsonl
import ladder
import lost
import matplotlib
import numpy as np
import pairs
import paper_row
import questions
import sweeps

matplotlib.use("Agg")
from learning import curves as learning
from learning import times
from pages import HERE, insert
from PIL import Image
from speed import tables as speed

from delayrl.agents.base import Agent
from delayrl.agents.registry import AGENTS
from delayrl.cli.main import main as delayrl
from delayrl.envs.making import make
from delayrl.play.policy import spec_of
from delayrl.report.figures import STYLES
from delayrl.report.markup import markdown_table
from delayrl.report.statistics import Stratum, area, common_steps, stratified_bootstrap
from delayrl.report.wording import gradient_steps
from delayrl.run.condition import resolve
from delayrl.run.cost import Cost
from delayrl.training.cost import cost_of

COLOURS = {agent: style[0] for agent, style in STYLES.items()} | {"vdpo reference": STYLES["sac"][0]}

REPORTS = {"first": "", **{name: name for name in ("evidence-1", "evidence-1-paper", "evidence-2", "evidence-3")}}
"""Tables of rows, and the folder of each one's report in docs/results."""
DETAILS = ("speed-floors", "speed-operations")
"""Sections about speed for those who work on it, in speed/README.md."""


def read(name: str) -> tuple[dict[int, dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    """Return configurations by run, rows, and evaluations of a results file."""
    lines = jsonl.read(HERE / "results" / f"{name}.jsonl")
    configs = {line["run"]: line["config"] for line in lines if "config" in line}
    return configs, [line for line in lines if "step" in line], [line for line in lines if "evaluation" in line]


def evaluations(name: str) -> dict[str, list[tuple[dict[str, Any], dict[str, Any]]]]:
    """Return (configuration, evaluation on unseen start states) of each run, by agent."""
    configs, _, lines = read(name)
    result: dict[str, list[tuple[dict[str, Any], dict[str, Any]]]] = defaultdict(list)
    for line in lines:
        result[line["evaluation"]["agent"]].append((configs[line["run"]], line["evaluation"]))
    return result


def table(name: str) -> str:
    """Return a Markdown table of each agent's returns on unseen start states, by seed and normalised.

    Of the random policy, which learns nothing, all evaluations count.

    The interval of a normalised return is a bootstrap over the agent's seeds and those of both anchors.
    """
    configs, rows, _ = read(name)
    by_agent = evaluations(name)
    means = {agent: [e["mean_return"] for _, e in runs] for agent, runs in by_agent.items()}
    random = [run for run, config in configs.items() if config["agent"] == "random"]
    every = [[row["return"] for row in rows if row["run"] == run] for run in random]
    means |= {"random": [float(np.mean(returns)) for returns in every]} if every else {}
    anchors = "sac" in means and "random" in means
    normalised = ["normalised (interval)"] if anchors else []
    titles = ["agent", "mean return", *normalised, "each seed", "delay", "steps"]
    body = []
    for agent, runs in sorted(by_agent.items(), key=lambda item: -np.mean(means[item[0]])):
        config, evaluation = runs[0]
        seeds = " · ".join(f"{mean:.1f}" for mean in means[agent])
        cells = [f"`{agent}`", f"{np.mean(means[agent]):.1f}"]
        if anchors:
            low, high = np.array(means["random"]), np.array(means["sac"])
            value = (np.mean(means[agent]) - low.mean()) / (high.mean() - low.mean())
            ends = stratified_bootstrap([Stratum(low, high, [np.array(means[agent])])], lambda x: x.mean(-1))
            known = agent not in ("random", "sac") and np.isfinite(ends).all()
            cells.append(f"{value:.2f}" + (f" ({ends[0]:.2f} to {ends[1]:.2f})" if known else ""))
        cells += [seeds, evaluation["delay"], f"{config['schedule']['steps']:,}"]
        body.append(cells)
    return markdown_table(titles, body)


def provenance(name: str) -> str:
    """Return one line on the machine, versions and settings behind the rows."""
    configs, _, lines = read(name)
    versions = configs[0]["versions"]
    commits = sorted({config["versions"]["commit"] or "?" for config in configs.values()})
    episodes = lines[0]["evaluation"]["episodes"] if lines else 0
    return (
        f"{episodes} episodes a seed; preset `{configs[0]['preset']}`; {versions['cores']} x86 cores, "
        f"jax {versions['jax']}, MuJoCo {versions['mujoco']}, Gymnasium {versions['gymnasium']}, "
        f"commit {', '.join(commits)}. "
        f"Rows: `benchmarks/results/{name}.jsonl`."
    )


def entropies(name: str) -> str:
    """Return a Markdown table of what the unit of entropies changes, for runs that differ in nothing else."""
    configs, rows, _ = read(name)
    episodes: dict[str, dict[int, dict[int, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in rows:
        unit = configs[row["run"]]["hyperparameters"]["entropy_unit"]
        episodes[unit][configs[row["run"]]["seed"]][row["step"]].append(row["return"])
    body = []
    for unit, seeds in sorted(episodes.items()):
        steps, returns = common_steps([{step: float(np.mean(x)) for step, x in run.items()} for run in seeds.values()])
        columns = (area(steps, returns), returns[:, -1])
        body.append([f"`{unit}`", len(returns), *(f"{x.mean():.1f} ± {x.std(ddof=1):.1f}" for x in columns)])
    table = markdown_table(["`--entropy-unit`", "seeds", "mean return over training", "after training"], body)
    one = configs[0]
    about = f"{one['env']}, `{one['agent']}`, preset `{one['preset']}`, {one['schedule']['steps']:,} steps"
    return f"{table}\n\n{about}. Rows: `benchmarks/results/{name}.jsonl`."


def overhead() -> str:
    """Return a Markdown table of what the wrappers cost."""
    first, *lines = jsonl.read(HERE / "results" / "overhead.jsonl")
    body = []
    for line in lines:
        low, high = line["quartiles"]
        body.append([f"`{line['wrapper']}`", line["environments"], f"{line['ratio']:.2f}", f"{low:.2f} to {high:.2f}"])
    table = markdown_table(["wrapper, delay", "environments", "ratio of times", "quartiles"], body)
    versions = first["versions"]
    libraries = f"NumPy {versions['numpy']}, MuJoCo {versions['mujoco']}, Gymnasium {versions['gymnasium']}"
    where = (
        f"{versions['cores']} shared x86 cores, Python {versions['python']}, {libraries}, commit {versions['commit']}"
    )
    return f"{table}\n\nProcessor time, {first['rounds']} rounds; {where}. Rows: `benchmarks/results/overhead.jsonl`."


@functools.cache
def matched(agent: str, env: str, delay: int, **overrides: str) -> tuple[Agent, Cost]:
    """Return an agent of the preset `matched`, and what its learning costs."""
    setup = resolve(agent, env, delay, "matched", "corrected", overrides)
    return setup.agent, cost_of(setup.agent, spec_of(make(env, delay, rescale=True)), setup.schedule)


def costs(env: str, delays: tuple[int, ...]) -> str:
    """Return a Markdown table of what each agent's learning costs with the preset `matched`; nothing is run."""
    titles = ["agent", "reads the true state", "parameters", "gradient steps"]
    body, variants = [], [*((agent, {}) for agent in AGENTS if agent != "random"), ("any-age", {"encoder": "mlp"})]
    for agent, overrides in variants:
        own = [0] * len(delays) if agent == "sac" else delays
        agents, known = zip(*(matched(agent, env, delay, **overrides) for delay in own), strict=True)
        words = ", ".join([f"`{agent}`", *(f"`{name}={value}`" for name, value in overrides.items())])
        words += ", no delay" if agent == "sac" else ""
        privileged = "in training" if agents[-1].privileged else "no"
        cells = [words, privileged, f"{known[-1].parameters:,}", gradient_steps(known[-1])]
        body.append([*cells, *(f"{cost.flops / 1e9:.2f}" for cost in known)])
    table = markdown_table([*titles, *(f"GFLOP, Δ = {delay}" for delay in delays)], body)
    return f"{table}\n\n{env}, for each environment step of one seed; parameters at Δ = {delays[-1]}."


def relative_costs(env: str, delays: tuple[int, ...]) -> str:
    """Return a Markdown table of the arithmetic of each late agent's updates over BPQL's, with the preset `matched`."""
    known = {f"`{a}`": [matched(a, env, delay) for delay in delays] for a in AGENTS if a not in ("random", "sac")}
    known["`vdpo`, `tokens=1280`"] = [matched("vdpo", env, delay, tokens=1280) for delay in delays]
    body = []
    for label, own in sorted(known.items(), key=lambda item: item[1][-1][1].flops):
        mark = " †" if own[-1][0].privileged else ""
        pairs = zip(own, known["`bpql`"], strict=True)
        body.append([f"{label}{mark}", *(f"{cost.flops / base.flops:.1f}" for (_, cost), (_, base) in pairs)])
    table = markdown_table(["agent", *(f"Δ = {delay}" for delay in delays)], body)
    rest = (
        "DIDA's is a mean over its expert's steps and its student's. VDPO's results with `matched` have `tokens=1280`."
    )
    return f"{table}\n\n{env}. {rest}"


def udp_table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table of the UDP demonstration: each network and controller over its episodes."""
    first, rows = lines[0], [line for line in lines if "statistics" in line]
    body = []
    for row in rows:
        key = (row["scenario"], row["controller"])
        played = [line for line in lines if "return" in line and (line["scenario"], line["controller"]) == key]
        returns, statistics = [episode["return"] for episode in played], row["statistics"]
        age = "–" if statistics["age_mean"] is None else f"{statistics['age_mean']:.2f} ± {statistics['age_std']:.2f}"
        words = {
            "delayed": "with its history",
            "deaf": "the same, not told which commands were lost",
            "blind": "blind to the delay",
        }[row["controller"]]
        overruns = f"{statistics['overruns']:,} of {statistics['decisions']:,}"
        held = f"; {sum(episode['held'] for episode in played):,} actions too late" if row["real_time"] else ""
        body.append([row["scenario"], words, f"{np.mean(returns):.0f}", f"{min(returns):.0f}", age, overruns + held])
    policy, versions = first["policy"], first["versions"]
    about = (
        f"{first['episodes']} episodes each, the best possible is 1000; `{policy['agent']}` trained with delay "
        f"{policy['delay']}, preset `{policy['preset']}`, seed {policy['seed']}; `on_overrun` is `clip`; "
        f"{versions['cores']} shared x86 cores, MuJoCo {versions['mujoco']}, Gymnasium {versions['gymnasium']}, "
        f"commit {versions['commit']}. Rows: `benchmarks/results/udp.jsonl`."
    )
    head = ["observations", "policy", "mean return", "worst", "age (steps)", "overruns"]
    return f"{markdown_table(head, body)}\n\n{about}"


def overruns_table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table of mean returns on links slower than the trained delay, by the answer to it."""
    policy, versions, rows = lines[0]["policy"], lines[0]["versions"], lines[1:]
    body = []
    for i in range(0, len(rows), 3):
        link = rows[i]["link"]
        assert [row["answer"] for row in rows[i : i + 3]] == ["clip", "hold", "last"]
        words = f"{link['low']} to {link['high']}" if link["low"] < link["high"] else f"{link['low']}"
        lost = f", {100 * link['loss']:.0f} % lost" if link["loss"] else ""
        body.append([words + lost, *(f"{np.mean(row['returns']):.0f}" for row in rows[i : i + 3])])
    about = (
        f"{policy['env']}, {len(rows[0]['returns'])} episodes each, the best possible is 1000; `{policy['agent']}` "
        f"trained with delay {policy['delay']}, preset `{policy['preset']}`, seed {policy['seed']}; "
        f"MuJoCo {versions['mujoco']}, commit {versions['commit']}. Rows: `benchmarks/results/overruns.jsonl`."
    )
    return f"{markdown_table(['travel time, steps', '`clip`', '`hold`', 'the last Δ actions'], body)}\n\n{about}"


def younger_table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table of mean returns at younger ages than were learned, held back and not."""
    policy, versions, rows = lines[0]["policy"], lines[0]["versions"], lines[1:]
    body: list[list[str]] = []
    travels = list(dict.fromkeys((row["link"]["low"], row["link"]["high"]) for row in rows))
    for low, high in travels:
        played = [row for row in rows if (row["link"]["low"], row["link"]["high"]) == (low, high)]
        cells = []
        for at_once in (False, True):
            means = [np.mean(row["returns"]) for row in played if (row["min_age"] == 0) == at_once]
            cells.append(f"{np.mean(means):,.0f} ± {np.std(means, ddof=1):,.0f}")
        body.append([f"{low} to {high}" if low < high else f"{low}", *cells])
    seeds = len({row["seed"] for row in rows})
    about = (
        f"{policy['env']}; `{policy['agent']}` trained with delay {policy['delay']}, preset `{policy['preset']}`, "
        f"{policy['schedule']['steps']:,} steps, {seeds} seeds, {len(rows[0]['returns'])} episodes each; ± is the "
        f"standard deviation over seeds. MuJoCo {versions['mujoco']}, commit {versions['commit']}. Rows: "
        "`benchmarks/results/younger.jsonl`."
    )
    return f"{markdown_table(['travel time, steps', 'held back', 'shown at once (`min_age=0`)'], body)}\n\n{about}"


def measured(out: Path) -> None:
    """Draw what `delayrl measure` finds in the log of examples/make_log.py, as docs/measure.md shows it."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "arm.csv"
        subprocess.run([sys.executable, HERE.parent / "examples" / "make_log.py", log], check=True)
        delayrl(["measure", str(log), "--period", "20ms", "--plot", str(out)])


def last_frame(video: Path) -> None:
    """Write the last frame of a GIF beside it, for readers who switched motion off."""
    with Image.open(video) as frames:
        frames.seek(frames.n_frames - 1)
        frames.convert("RGB").quantize(64).save(video.with_suffix(".png"), optimize=True)


def main() -> None:
    """Write every generated picture and section of the docs."""
    root = HERE.parent
    images = root / "docs" / "img"
    last_frame(images / "episodes.gif")
    measured(images / "measure.png")
    title = "delayrl/Pusher-v4, trained under paper-stochastic-5, three seeds"
    shown = {agent: COLOURS[agent] for agent in ("vdpo", "bpql", "a-sac", "sac-memoryless")}
    sweeps.draw(sweeps.read(HERE / "results" / "pusher-random.jsonl"), title, images / "pusher-delays.png", shown)
    for name in ("pendulum", "reacher", "walk", "walk-random", "pusher-random"):
        insert(root / "docs" / "benchmarks.md", name, table(name) + "\n\n" + provenance(name))
    insert(root / "docs" / "protocols.md", "entropies", entropies("pusher-entropy"))
    insert(root / "docs" / "delays.md", "overhead", overhead())
    udp, overruns, younger = (jsonl.read(HERE / "results" / f"{name}.jsonl") for name in ("udp", "overruns", "younger"))
    insert(root / "docs" / "runtime.md", "younger", younger_table(younger))
    insert(root / "docs" / "runtime.md", "overruns", overruns_table(overruns))
    insert(root / "docs" / "runtime.md", "udp", udp_table(udp))
    draw_udp = runpy.run_path(str(root / "examples" / "udp_demo" / "picture.py"))["draw"]
    draw_udp(udp, images / "udp.png")
    for name, folder in REPORTS.items():
        out = root / "docs" / "results" / folder
        delayrl(["bench", "report", str(HERE / "results" / f"{name}.sqlite"), "--out", str(out)])
    text = learning.section(HERE / "results" / "learning", images / "learning.png")
    insert(root / "docs" / "benchmarks.md", "learning", text)
    any_age = root / "docs" / "algorithms" / "any-age-results.md"
    arms, goals = ladder.sections(HERE / "results" / "any-age-ladder.sqlite", images / "ladder.png")
    insert(any_age, "ladder", arms)
    insert(root / "docs" / "algorithms" / "any-age-trials.md", "goals", goals)
    usual, every = (HERE / "results" / f"halfcheetah-ages{name}.jsonl" for name in ("", "-any"))
    title, wide = "HalfCheetah-v5, trained under uniform:1:25, five seeds", "any-age second_age=any"
    played = sweeps.read(usual) | {wide: sweeps.read(every)["any-age"]}
    sweeps.draw(played, title, images / "ages.png", COLOURS | {wide: STYLES["any-age"][1]})
    for name, file in {"ages": usual, "ages-any": every}.items():
        insert(any_age, name, sweeps.section(file, "any-age"))
    rows = [HERE / "results" / f"{name}.sqlite" for name in ("evidence-1", "evidence-2", "any-age-ladder")]
    insert(any_age, "against", against.section(rows))
    poles = against.section(rows, "InvertedDoublePendulum-v5")
    insert(any_age, "against-poles", poles)
    insert(any_age, "added-seeds", against.added(rows))
    insert(any_age, "simpler", against.simpler(rows))
    result = front.section(rows, images)
    for page in ("README.md", "docs/index.md"):
        insert(root / page, "result", result)
    for key, text in pairs.sections(rows).items():
        insert(root / "docs" / "benchmarks.md", key, text)
    paper = paper_row.section(HERE / "results" / "evidence-1-paper.sqlite")
    insert(root / "docs" / "benchmarks.md", "paper-row", paper)
    asked = questions.section(HERE / "results" / "evidence-3.sqlite")
    insert(root / "docs" / "algorithms" / "vdpo.md", "questions", asked)
    insert(root / "docs" / "benchmarks.md", "lost", lost.section(rows, images / "lost.png"))
    insert(root / "docs" / "algorithms" / "any-age-trials.md", "forecast", forecast.section())
    text = times.section(HERE / "results" / "times", images / "times.png")
    insert(root / "docs" / "performance.md", "times", text)
    insert(root / "docs" / "performance.md", "costs", costs("HalfCheetah-v5", (5, 25, 50)))
    insert(root / "docs" / "which-agent.md", "relative-costs", relative_costs("HalfCheetah-v5", (5, 25, 50)))
    for key, text in speed.pages(root).items():
        insert(HERE / "speed" / "README.md" if key in DETAILS else root / "docs" / "performance.md", key, text)


if __name__ == "__main__":
    main()
