"""Define the benchmarks: the same work on two sides, and our cost against size."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Work:
    """One benchmark.

    Attributes:
        name: how the command line names it.
        title: how the table names it.
        steps: environment steps of a slice, by device.
        sides: JSON objects for `ours` and `peer`, with `kind` (a function of worker.py), `env`, `delay`, `seeds` and
            `options`; ours also has `agent` and `preset`.
        pythons: whether there is a row for each version of Python, whose JAX may differ.
    """

    name: str
    title: str
    steps: dict[str, int]
    sides: dict[str, dict[str, Any]]
    pythons: bool = False


def ours(agent: str, preset: str = "paper", delay: int = 0, seeds: int = 1, env: str = "", **options: Any) -> Any:
    """Return a side that runs delayrl; `options` are hyperparameters."""
    fixed = {"kind": "ours", "agent": agent, "preset": preset, "delay": delay, "seeds": seeds}
    return fixed | {"env": env or CHEETAH, "options": options}


def peer(kind: str, delay: int = 0, **options: Any) -> dict[str, Any]:
    """Return a side that runs a peer; `options` are in the peer's words."""
    return {"kind": kind, "env": CHEETAH, "delay": delay, "options": options}


CHEETAH = "HalfCheetah-v5"
_LOCKSTEP = {"ours": ours("vdpo", "small", 5, seeds=4), "peer": ours("vdpo", "small", 5)}


_SHORT = {"cpu": 100, "gpu": 1000}


def _vdpo(delay: int, steps: dict[str, int]) -> Work:
    title = f"VDPO, preset `paper`, HalfCheetah-v5, Δ = {delay}; released code"
    return Work(f"vdpo-{delay}", title, steps, {"ours": ours("vdpo", delay=delay), "peer": peer("vdpo", delay)})


def _vdpo_ten(delay: int) -> Work:
    title = f"VDPO, preset `paper`, HalfCheetah-v5, Δ = {delay}, ten seeds in lockstep; released code, one seed"
    sides = {"ours": ours("vdpo", delay=delay, seeds=10), "peer": peer("vdpo", delay)}
    return Work(f"vdpo-{delay}-ten", title, {"gpu": 1000}, sides)


def _sac(kind: str) -> Work:
    names = {"sbx": "SBX", "sb3": "Stable-Baselines3", "cleanrl": "CleanRL"}
    title = f"SAC, 256 × 256, batch 256, HalfCheetah-v5; {names[kind]}"
    return Work(f"sac-{kind}", title, _SHORT, {"ours": ours("sac"), "peer": peer(kind)})


def _any_age(delay: int, name: str = "any-age", words: str = "", **options: Any) -> Work:
    title = f"any-age{words}, preset `small`, HalfCheetah-v5, Δ = {delay}; BPQL, ours too"
    sides = {"ours": ours("any-age", "small", delay, **options), "peer": ours("bpql", "small", delay)}
    return Work(f"{name}-{delay}", title, _SHORT, sides)


def _bfloat16(name: str, title: str, steps: int, **side: Any) -> Work:
    sides = {"ours": ours(**side, precision="bfloat16"), "peer": ours(**side)}
    return Work(f"{name}-bfloat16", f"{title}, in bfloat16; in float32, ours too", {"cpu": steps}, sides)


WORKS = {
    work.name: work
    for work in (
        Work(
            "vdpo-64",
            "VDPO, width 64, batch 128, HalfCheetah-v5, Δ = 5; released code",
            {"cpu": 20},
            {
                "ours": ours("vdpo", delay=5, width=64, batch_size=128),
                "peer": peer("vdpo", 5, embedding_dim=64, batch_size=128),
            },
        ),
        _sac("sb3"),
        _sac("sbx"),
        Work("lockstep", "VDPO, preset `small`, Δ = 5: 4 seeds in lockstep; one after another", {"cpu": 50}, _LOCKSTEP),
        _vdpo(5, {"cpu": 10, "gpu": 1000}),
        _vdpo_ten(5),
        _sac("cleanrl"),
        *(_any_age(delay) for delay in (25, 50)),
        *(_any_age(delay, "any-age-mlp", " with `encoder=mlp`", encoder="mlp") for delay in (25, 50)),
        Work(
            "replay",
            "SAC, preset `small`, HalfCheetah-v5, a replay with room for 1,000,000 rows; for 20,000, ours too",
            {"cpu": 100},
            {"ours": ours("sac", "small"), "peer": ours("sac", "small") | {"capacity": 20_000}},
            pythons=True,
        ),
        _bfloat16("sac", "SAC, 256 × 256, batch 256, HalfCheetah-v5", 100, agent="sac"),
        _bfloat16("vdpo-5", "VDPO, preset `paper`, HalfCheetah-v5, Δ = 5", 10, agent="vdpo", delay=5),
        _vdpo(25, {"cpu": 10, "gpu": 1000}),
        _vdpo_ten(25),
        _vdpo(50, {"gpu": 1000}),
        _vdpo_ten(50),
    )
}

OWN = {name for name, work in WORKS.items() if work.sides["peer"]["kind"] == "ours"}
"""Benchmarks of ours beside ours."""


def _size(preset: str, env: str, delay: int, seeds: int, steps: int) -> Work:
    name = f"size-{preset}-{env}-{delay}-{seeds}"
    title = f"VDPO, preset `{preset}`, {env}, Δ = {delay}, {seeds} seed{'s' * (seeds > 1)}"
    return Work(name, title, {"cpu": steps}, {"ours": ours("vdpo", preset, delay, seeds, env)})


SIZES = {
    work.name: work
    for work in (
        *(_size("small", CHEETAH, 5, seeds, 100 // seeds) for seeds in (1, 2, 4, 8)),
        *(_size("small", CHEETAH, delay, 1, 40) for delay in (25, 50)),
        *(_size("small", env, 5, 1, 50) for env in ("InvertedPendulum-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5")),
        *(_size("paper", CHEETAH, delay, 1, 10) for delay in (5, 25, 50)),
        _size("paper", "Humanoid-v5", 50, 1, 10),
    )
}
