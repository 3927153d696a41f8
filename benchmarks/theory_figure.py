"""Draw the pictures of docs/theory.md and print every number that it quotes.

Usage: python benchmarks/theory_figure.py [folder for the pictures]. Takes about ten minutes on one core.
"""

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "agents"))  # the exact solvers are shared with the tests

import fixed_points as fix  # noqa: E402
import gaussians  # noqa: E402
import tabular as tab  # noqa: E402
import trajectories  # noqa: E402

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

Array = tab.Array
BLUE, ORANGE, GREEN, RED, GREY = "#0b5cad", "#d9730d", "#2a8c4a", "#b3243b", "#6b6b6b"
STYLE = {
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.facecolor": "white",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "font.size": 10,
    "legend.frameon": False,
    "legend.fontsize": 9,
}


def heading(text: str) -> None:
    print(f"\n{text}\n{'-' * len(text)}")


def row(label: str, values: list[float], digits: int = 3) -> None:
    print(f"{label:44s}" + "".join(f"{value:10.{digits}f}" for value in values))


# ---- 1. What delay costs -----------------------------------------------------------------------------------


def delay_cost(axes: Any) -> None:
    """Plot J* against the delay, relative to no delay."""
    heading("J* for delays 0, 1, 2, 3")
    delays = range(4)
    for seed in range(5):
        for deterministic in (False, True):
            mdp = tab.random_mdp(np.random.default_rng(seed), deterministic=deterministic)
            best = np.array([tab.optimal_return(tab.augment(mdp, delay).mdp) for delay in delays])
            row(f"seed {seed}, {'deterministic' if deterministic else 'stochastic'}", best.tolist())
            label = None
            if seed == 0:
                label = "deterministic transitions" if deterministic else "stochastic transitions"
            axes.plot(
                delays,
                best / best[0],
                color=GREEN if deterministic else BLUE,
                lw=1.6,
                marker="o",
                ms=4,
                label=label,
            )
    chain = [tab.optimal_return(tab.augment(tab.tracking(), delay).mdp) for delay in delays]
    row("tracking", chain)
    axes.plot(delays, np.array(chain) / chain[0], color=ORANGE, lw=1.6, marker="s", ms=4, label="tracking")
    falls = []
    for seed in range(200):
        mdp = tab.random_mdp(np.random.default_rng(seed))
        falls.append(-np.diff([tab.optimal_return(tab.augment(mdp, delay).mdp) for delay in delays]))
    print(f"200 stochastic MDPs: smallest fall {np.min(falls):.1e}")
    row("  share with a fall > 1e-9 at each step", (np.array(falls) > 1e-9).mean(axis=0).tolist(), 2)
    axes.set(
        xlabel="delay Δ",
        ylabel="J*(Δ) / J*(0)",
        xticks=delays,
        ylim=(0.45, 1.04),
        title="What delay costs at best",
    )
    axes.legend(loc="lower left")


def latching(axes: Any) -> None:
    """Plot the returns of imitation on the tracking chain, by who collected the data and by direction."""
    heading("Tracking, temperature 0.1, delays 0, 1, 2, 3")
    mdp, temperature, delays = tab.tracking(), 0.1, range(4)

    def returns(data: fix.Data, forward: bool) -> list[float]:
        return [
            tab.policy_return(
                tab.augment(mdp, delay).mdp,
                fix.imitation_fixed_point(mdp, delay, temperature, data=data, forward=forward),
            )
            for delay in delays
        ]

    curves = {
        "best delayed policy": [tab.optimal_return(tab.augment(mdp, delay).mdp) for delay in delays],
        "reverse, own data": returns("delayed", False),
        "reverse, argmin data": returns("lower_q", False),
        "reverse, reference's data": returns("reference", False),
        "forward, own data (Eq. 7)": returns("delayed", True),
        "forward, argmin data": returns("lower_q", True),
        "forward, reference's data (Eq. 6)": returns("reference", True),
    }
    for label, values in curves.items():
        row(label, values)
    bpql = [fix.bpql_fixed_point(mdp, delay, temperature).policy for delay in delays]
    adsac = [fix.adsac_fixed_point(mdp, delay, temperature, data="lower_q").policy for delay in delays]
    for label, policies in (("BPQL", bpql), ("AD-SAC, argmin data", adsac)):
        row(label, [tab.policy_return(tab.augment(mdp, d).mdp, p) for d, p in zip(delays, policies, strict=True)])
    own, argmin, reference = (
        {"marker": "o", "ms": 4},
        {"marker": "x", "ms": 8, "ls": "none"},
        {"marker": "v", "ms": 5, "ls": "--"},
    )
    for key, colour, style, label in (
        ("best delayed policy", GREY, {"lw": 4, "alpha": 0.45}, "best delayed policy"),
        ("reverse, own data", BLUE, own, "reverse KL, own data"),
        ("reverse, argmin data", BLUE, argmin, "reverse KL, argmin data"),
        ("forward, own data (Eq. 7)", ORANGE, own, "forward KL, own data"),
        ("reverse, reference's data", BLUE, reference, "reverse KL, reference's data"),
        ("forward, reference's data (Eq. 6)", ORANGE, reference, "forward KL, reference's data"),
    ):
        axes.plot(delays, curves[key], color=colour, label=label, **style)
    axes.axhline(0.5 / (1 - mdp.discount), color="black", lw=0.8, ls=":")
    axes.annotate("the same action for ever", (1.95, 9.62), fontsize=9)
    axes.set(
        xlabel="delay Δ",
        ylabel="return",
        xticks=delays,
        ylim=(9.3, 20.6),
        title="Imitation on a two-state chain",
    )
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.12), fontsize=8.5)


# ---- 2. Trajectory KL --------------------------------------------------------------------------------------


def trajectory_numbers() -> None:
    heading("Proposition 3.3: seed 0, 3 states, 2 actions, 4 steps, delays 0, 1, 2, 3")
    divergences, gaps = [], []
    for delay in range(4):
        rng = np.random.default_rng(0)
        mdp = tab.random_mdp(rng, states=3, actions=2)
        reference = rng.dirichlet(np.ones(2), size=3)
        delayed = tab.augment(mdp, delay)
        policy = rng.dirichlet(np.ones(2), size=len(delayed.histories))
        divergences.append(trajectories.trajectory_kl(mdp, delay, reference, policy))
        by_belief = tab.mixture(delayed.belief, reference)
        gaps.append(trajectories.trajectory_kl(mdp, delay, reference, by_belief))
    row("KL of the trajectories", [d.trajectory for d in divergences], 4)
    row("sum, (s_t, x_t) jointly from π", [d.joint for d in divergences], 4)
    row("sum, s_t from the belief", [d.belief for d in divergences], 4)
    row("sum, s_t and x_t apart", [d.independent for d in divergences], 4)
    row("printed constant", [d.printed_constant for d in divergences], 4)
    row("mass of the printed law", [d.printed_mass for d in divergences], 4)
    row("KL of Eq. (7), the belief mixture", [d.trajectory for d in gaps], 4)
    row("... above the least possible", [d.minimiser_excess for d in gaps], 4)

    mdp = tab.tracking()
    _, reference = tab.soft_optimal(mdp, 0.1)
    best = tab.mixture(tab.augment(mdp, 1).belief, reference)
    windows = tab.window_process(mdp, 1)
    chain = np.einsum("ya,yaz->yz", reference[windows.state], windows.mdp.transition)
    law = windows.mdp.initial @ chain
    rate = float(law @ tab.kl(reference[windows.state], best[windows.augmented]))
    divergences = []
    for delay in range(4):
        belief_mixture = tab.mixture(tab.augment(mdp, delay).belief, reference)
        divergences.append(trajectories.trajectory_kl(mdp, delay, reference, belief_mixture, horizon=6))
    row("tracking, 6 steps: KL of Eq. (7)", [d.trajectory for d in divergences], 4)
    row("... above the least possible", [d.minimiser_excess for d in divergences], 4)
    print(f"tracking, Δ = 1: every step after the first adds {rate:.4f} to the KL of the best π_Δ")


# ---- 3 and 4. Two means ------------------------------------------------------------------------------------


def gaussian_panel(axes: Any) -> None:
    heading("Gaussians: references N(-1, 0.2²) with b = 0.4 and N(1, 0.5²) with b = 0.6")
    weight = np.array([0.4, 0.6])
    mean, variance = np.array([[-1.0], [1.0]]), np.array([[0.04], [0.25]])
    grid = np.linspace(-2.4, 3.1, 1200)

    def density(centre: float, spread: float) -> Array:
        shape: Array = np.exp(-((grid - centre) ** 2) / (2 * spread)) / np.sqrt(2 * np.pi * spread)
        return shape

    forward = [float(part[0]) for part in gaussians.moment_match(weight, mean, variance)]
    reverse = [float(part[0]) for part in gaussians.precision_weighted(weight, mean, variance)]
    for label, (centre, spread) in (("forward", forward), ("reverse", reverse)):
        print(f"{label}: mean {centre:.4f}, variance {spread:.4f}, deviation {np.sqrt(spread):.4f}")
    mixed = sum(w * density(m[0], v[0]) for w, m, v in zip(weight, mean, variance, strict=True))
    axes.fill_between(grid, mixed, color=GREY, alpha=0.3, lw=0, label="belief mixture of π(·|s)")
    axes.plot(grid, density(*forward), color=ORANGE, lw=2, label="forward: moments of the mixture")
    axes.plot(grid, density(*reverse), color=BLUE, lw=2, label="reverse: precision-weighted")
    axes.set(
        xlabel="action",
        ylabel="density",
        ylim=(0, 2.15),
        title=r"Best Gaussian $\pi_\Delta(\cdot\,|\,x)$",
        yticks=[],
    )
    axes.legend(loc="upper right")


def veto_panel(axes: Any) -> None:
    heading("Two states disagree on two actions, both accept a third")
    belief = np.array([0.5, 0.5])
    policy = np.array([[0.899, 0.001, 0.100], [0.001, 0.899, 0.100]])
    forward, reverse = tab.mixture(belief, policy), tab.geometric_mean(belief, policy)
    row("mixture", forward.tolist(), 4)
    row("geometric mean", reverse.tolist(), 4)
    place = np.arange(3)
    for offset, values, colour, label in (
        (-0.3, policy[0], "#c9c9c9", "π(·|s₁), b = ½"),
        (-0.1, policy[1], "#9a9a9a", "π(·|s₂), b = ½"),
        (0.1, forward, ORANGE, "mixture (forward)"),
        (0.3, reverse, BLUE, "geometric mean (reverse)"),
    ):
        axes.bar(place + offset, values, width=0.19, color=colour, label=label)
    axes.set(xticks=place, ylim=(0, 1.3), ylabel="probability", title="One state can veto an action")
    axes.set_xticklabels(["best in s₁,\nruled out in s₂", "best in s₂,\nruled out in s₁", "passable\nin both"])
    axes.set_yticks([0, 0.5, 1])
    axes.legend(loc="upper center", ncols=2, columnspacing=1, handlelength=1.2)


def game_panel(axes: Any) -> None:
    heading("Guessing game, delay 1, temperature 0.02")
    costs = np.linspace(0, 3, 31)
    lines: dict[str, list[float]] = {
        "mixture": [],
        "geometric mean": [],
        "BPQL": [],
        "AD-SAC": [],
        "best delayed policy": [],
    }
    for cost in costs:
        mdp = tab.guessing_game(float(cost))
        delayed = tab.augment(mdp, 1)
        _, reference = tab.soft_optimal(mdp, 0.02)
        policies = {
            "mixture": tab.mixture(delayed.belief, reference),
            "geometric mean": tab.geometric_mean(delayed.belief, reference),
            "BPQL": fix.bpql_fixed_point(mdp, 1, 0.02).policy,
            "AD-SAC": fix.adsac_fixed_point(mdp, 1, 0.02).policy,
            "best delayed policy": tab.optimal_policy(delayed.mdp),
        }
        for label, policy in policies.items():
            lines[label].append(tab.policy_return(delayed.mdp, policy))
    quoted = [0, 5, 10, 14, 20, 30]
    row("cost of the wrong guess", costs[quoted].tolist(), 1)
    for label, values in lines.items():
        row(label, [values[i] for i in quoted])
    axes.plot(costs, lines["best delayed policy"], color=GREY, lw=5, alpha=0.4, label="best delayed policy")
    axes.plot(costs, lines["mixture"], color=ORANGE, lw=2, label="mixture (forward): guesses")
    axes.plot(costs, lines["geometric mean"], color=BLUE, lw=2, label="geometric (reverse): waits")
    axes.set(xlabel="cost of a wrong guess", ylabel="return", title="Either can be the better one", ylim=(-1, 0.85))
    axes.legend(loc="upper right")


# ---- 5. Fixed points ---------------------------------------------------------------------------------------


def fixed_point_numbers() -> None:
    heading("Largest difference in probability between fixed points (random MDP 0, delay 2, temperature 0.3)")
    mdp, temperature = tab.random_mdp(np.random.default_rng(0)), 0.3
    delayed = tab.augment(mdp, 2)
    _, reference = tab.soft_optimal(mdp, temperature)
    policies = {
        "Eq. (7)": tab.mixture(delayed.belief, reference),
        "DIDA, log loss": fix.imitation_fixed_point(mdp, 2, temperature, data="delayed", forward=True),
        "Eq. (6)": fix.imitation_fixed_point(mdp, 2, temperature, data="reference", forward=True),
        "Eq. (11)": tab.geometric_mean(delayed.belief, reference),
        "AD-SAC 0": fix.adsac_fixed_point(mdp, 2, temperature).policy,
        "AD-SAC 0 argmin": fix.adsac_fixed_point(mdp, 2, temperature, data="lower_q").policy,
        "AD-SAC 1": fix.adsac_fixed_point(mdp, 2, temperature, shorter=1).policy,
        "BPQL": fix.bpql_fixed_point(mdp, 2, temperature).policy,
        "A-SAC": tab.soft_optimal(delayed.mdp, temperature)[1],
    }
    print(" " * 16 + "".join(f"{name:>15s}" for name in policies))
    for name, policy in policies.items():
        gaps = "".join(f"{np.abs(policy - other).max():15.3f}" for other in policies.values())
        print(f"{name:16s}{gaps}")


def minimum_numbers(count: int = 4) -> None:
    heading(f"AD-SAC without auxiliary delay, {count} random MDPs, delay 2, temperature 0.3; then without noise")
    print(" " * 4 + "policy: from Eq. (11), from BPQL; Q: highest and lowest below Q*, highest below BPQL's; returns:")
    print(" " * 4 + "Eq. (11), BPQL, AD-SAC, AD-SAC on argmin data, best delayed policy")
    for seed, deterministic in product(range(count), (False, True)):
        mdp, temperature = tab.random_mdp(np.random.default_rng(seed), deterministic=deterministic), 0.3
        delayed = tab.augment(mdp, 2)
        free_q, reference = tab.soft_optimal(mdp, temperature)
        reverse = tab.geometric_mean(delayed.belief, reference)
        bpql, adsac = fix.bpql_fixed_point(mdp, 2, temperature), fix.adsac_fixed_point(mdp, 2, temperature)
        released = fix.adsac_fixed_point(mdp, 2, temperature, data="lower_q")
        gaps = [np.abs(adsac.policy - policy).max() for policy in (reverse, bpql.policy)]
        values = [(free_q - adsac.q).max(), (free_q - adsac.q).min(), (bpql.q - adsac.q).max()]
        policies = (reverse, bpql.policy, adsac.policy, released.policy)
        returns = [tab.policy_return(delayed.mdp, policy) for policy in policies]
        row(f"seed {seed}", [*gaps, *values, *returns, tab.optimal_return(delayed.mdp)])


def any_age_numbers() -> None:
    heading("Any-age at constant weight: return at age 0; late: no pull, loss, KL 10, squares 0.1, 1, 10, best; gaps")
    print(" " * 4 + "gaps: largest difference in probability from no pull, of KL 10 and squares 0.1, 1, 10")
    problems = [(f"random MDP {seed}", tab.random_mdp(np.random.default_rng(seed)), 2, 0.3) for seed in range(4)]
    problems += [(f"tracking, delay {delay}", tab.tracking(), delay, 0.1) for delay in (1, 2, 3)]
    for name, mdp, delay, temperature in problems:
        delayed, bpql = tab.augment(mdp, delay), fix.bpql_fixed_point(mdp, delay, temperature)
        pulls: list[tuple[float, fix.Distance]] = [(10.0, "kl"), *((w, "squares") for w in (0.1, 1.0, 10.0))]
        pulled = [fix.any_age_fixed_point(mdp, delay, temperature, *pull).policy for pull in pulls]
        returns = [tab.policy_return(delayed.mdp, policy) for policy in (bpql.policy, *pulled)]
        fresh = tab.policy_return(mdp, tab.softmax(bpql.q / temperature))
        row(name, [fresh, returns[0], fresh - returns[0], *returns[1:], tab.optimal_return(delayed.mdp)])
        row("", [np.abs(policy - bpql.policy).max() for policy in pulled])


def released_adsac(mdp: tab.MDP, delay: int, temperature: float) -> Array | None:
    """Return AD-SAC's policy on the data of its released rule for acting; None where policy and data only cycle."""
    try:
        return fix.adsac_fixed_point(mdp, delay, temperature, data="lower_q").policy
    except RuntimeError:
        return None


def random_mdps(axes: Any, count: int = 50) -> None:
    """Plot returns on random MDPs, from 0 for uniformly random actions to 1 for the best delayed policy."""
    heading(f"{count} random MDPs, delay 2, temperature 0.1: 0 = random actions, 1 = best delayed policy")
    temperature, delay = 0.1, 2
    scores: dict[str, list[float]] = {}
    modes: dict[str, list[float]] = {}
    for seed in range(count):
        mdp = tab.random_mdp(np.random.default_rng(seed))
        delayed = tab.augment(mdp, delay)
        best = tab.optimal_return(delayed.mdp)
        uniform = tab.policy_return(delayed.mdp, np.full_like(delayed.mdp.reward, 1 / 3))

        def imitate(data: fix.Data, forward: bool, mdp: tab.MDP = mdp) -> Array:
            return fix.imitation_fixed_point(mdp, delay, temperature, data=data, forward=forward)

        policies: dict[str, Array | None] = {
            "A-SAC": tab.soft_optimal(delayed.mdp, temperature)[1],
            "BPQL": fix.bpql_fixed_point(mdp, delay, temperature).policy,
            "AD-SAC, auxiliary delay 1": fix.adsac_fixed_point(mdp, delay, temperature, shorter=1).policy,
            "AD-SAC, auxiliary delay 0,\nargmin data (as released)": released_adsac(mdp, delay, temperature),
            "AD-SAC, auxiliary delay 0,\nown data": fix.adsac_fixed_point(mdp, delay, temperature).policy,
            "reverse, own data": imitate("delayed", False),
            "reverse, argmin data\n(as released VDPO)": imitate("lower_q", False),
            "reverse, reference's data": imitate("reference", False),
            "forward, own data\n(Eq. 7; DIDA, log loss)": imitate("delayed", True),
            "forward, reference's data\n(Eq. 6)": imitate("reference", True),
        }
        for label, policy in policies.items():
            if policy is None:
                continue
            likeliest = np.eye(3)[policy.argmax(axis=1)]
            for where, acting in ((scores, policy), (modes, likeliest)):
                score = (tab.policy_return(delayed.mdp, acting) - uniform) / (best - uniform)
                where.setdefault(label, []).append(score)
    print(f"{'sampled actions; then the likeliest action':44s}" + 2 * "      mean    median       min")
    for label, values in scores.items():
        columns = [float(f(v)) for v in (values, modes[label]) for f in (np.mean, np.median, np.min)]
        row(label.replace("\n", " "), columns)
    print(f"number of MDPs in each row: {[len(values) for values in scores.values()]}")
    jitter = np.random.default_rng(0).uniform(-0.22, 0.22, size=count)
    for place, (label, values) in enumerate(scores.items()):
        colour = ORANGE if label.startswith("forward") else BLUE if label.startswith("reverse") else GREEN
        axes.scatter(values, place + jitter[: len(values)], s=11, color=colour, alpha=0.45, lw=0)
        axes.plot([np.mean(values)] * 2, [place - 0.36, place + 0.36], color=colour, lw=2.5)
        axes.plot(np.mean(modes[label]), place, marker="D", ms=6, mfc="white", mec=colour, mew=1.5, ls="none")
    axes.axvline(1, color="black", lw=0.8, ls=":")
    axes.set(yticks=range(len(scores)), xlim=(-0.3, 1.06), ylim=(len(scores) - 0.4, -0.6))
    axes.set_yticklabels(list(scores))
    axes.set(
        xlabel="return (0: random actions, 1: best delayed policy)",
        title=f"Fixed points on {count} random MDPs, Δ = 2",
    )


def direction_numbers() -> None:
    heading("Share of 200 random MDPs where the geometric mean returns more than the mixture")
    for delay in (1, 2, 3):
        wins = []
        for temperature in (0.03, 0.1, 0.3, 1.0):
            better = 0
            for seed in range(200):
                mdp = tab.random_mdp(np.random.default_rng(seed))
                delayed = tab.augment(mdp, delay)
                _, reference = tab.soft_optimal(mdp, temperature)
                by_mixture = tab.policy_return(delayed.mdp, tab.mixture(delayed.belief, reference))
                by_geometric = tab.policy_return(delayed.mdp, tab.geometric_mean(delayed.belief, reference))
                better += by_geometric > by_mixture
            wins.append(better / 200)
        row(f"delay {delay}, temperature 0.03, 0.1, 0.3, 1", wins)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "docs" / "img", help="for the pictures")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    plt.rcParams.update(STYLE)

    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.3), layout="constrained")
    delay_cost(left)
    latching(right)
    figure.savefig(folder / "theory-delay.png", dpi=150)

    trajectory_numbers()

    figure, panels = plt.subplots(1, 3, figsize=(12.5, 3.9), layout="constrained")
    gaussian_panel(panels[0])
    veto_panel(panels[1])
    game_panel(panels[2])
    figure.savefig(folder / "theory-two-means.png", dpi=150)

    fixed_point_numbers()
    direction_numbers()
    minimum_numbers()
    any_age_numbers()

    figure, panel = plt.subplots(figsize=(8.5, 5.4), layout="constrained")
    random_mdps(panel)
    figure.savefig(folder / "theory-random.png", dpi=150)


if __name__ == "__main__":
    main()
