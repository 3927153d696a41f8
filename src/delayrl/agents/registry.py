"""The registry: every agent with its presets. To add one: its file, its line here, its page in docs/algorithms."""

from dataclasses import replace

from delayrl.agents.adsac import ADSAC
from delayrl.agents.base import Entry, Preset, Schedule
from delayrl.agents.dcac import DCAC
from delayrl.agents.dida import DIDA
from delayrl.agents.lifting import Lifting
from delayrl.agents.random import Random
from delayrl.agents.sac import BPQL, SAC
from delayrl.agents.vdpo import VDPO

_PAPER = Schedule()
_SMALL = Schedule(
    steps=15_000, random_steps=1_000, replay_capacity=20_000, evaluate_every=2_500, evaluation_episodes=10
)


def _soft(summary: str, paper: str, **sees: str) -> Entry:
    """SAC on two views: it differs in what is seen alone, so that nothing else explains a difference."""
    agent = SAC(**sees)  # type: ignore[arg-type]
    presets = {"paper": Preset(agent, _PAPER), "small": Preset(replace(agent, batch_size=128), _SMALL)}
    return Entry(summary, paper, presets)


_small_vdpo = VDPO(
    SAC(batch_size=128), width=64, layers=2, dropout=0.0, learning_rate=1e-3, clone_every=250, clone_updates=250
)
_small_adsac = ADSAC(SAC(actor_sees="augmented", critic_sees="augmented", batch_size=128))
_small_lifting = Lifting(SAC(actor_sees="augmented", batch_size=128), lifting_hold=3_750, lifting_end=11_250)
_small_dida = DIDA(SAC(batch_size=128), expert_steps=10_000, round_steps=250, imitation_updates=250)

AGENTS: dict[str, Entry] = {
    "vdpo": Entry(
        "clones a delay-free SAC into a transformer on (last observation, actions since)",
        "Wu et al., NeurIPS 2024",
        {"paper": Preset(VDPO(), _PAPER), "small": Preset(_small_vdpo, _SMALL)},
        drops_last_starts=True,
    ),
    "lifting": Entry(
        "BPQL, pulled towards a delay-free SAC learned beside it, with an annealed weight (D²HPG-BPQL)",
        "Lee et al., 2026, arXiv 2604.03641",
        {"paper": Preset(Lifting(), replace(_PAPER, random_steps=10_000)), "small": Preset(_small_lifting, _SMALL)},
    ),
    "ad-sac": Entry(
        "learns values for a shorter delay, and improves the actor of the long one by them",
        "Wu et al., ICML 2024",
        {"paper": Preset(ADSAC(), _PAPER), "small": Preset(_small_adsac, _SMALL)},
        official={"evaluation": "sample"},
        drops_last_starts=True,
    ),
    "dida": Entry(
        "a student on x_t imitates a delay-free SAC expert (DAgger); the expert's steps are counted",
        "Liotet et al., ICML 2022",
        {"paper": Preset(DIDA(), _PAPER), "small": Preset(_small_dida, _SMALL)},
    ),
    "dcac": Entry(
        "learns values on past stretches whose actions are sampled again inside the augmented state",
        "Bouteiller, Ramstedt et al., ICLR 2021",
        {"paper": Preset(DCAC(), replace(_PAPER, random_steps=10_000)), "small": Preset(DCAC(), _SMALL)},
    ),
    "bpql": Entry(
        "SAC whose actor sees x_t and whose critic sees s_t",
        "Kim et al., NeurIPS 2023",
        {
            "paper": Preset(BPQL, replace(_PAPER, random_steps=10_000)),
            "small": Preset(SAC(actor_sees="augmented", batch_size=128), _SMALL),
        },
    ),
    "a-sac": _soft(
        "SAC on the augmented state x_t = (last observation, actions since)",
        "Haarnoja et al., ICML 2018; Altman & Nain 1992",
        actor_sees="augmented",
        critic_sees="augmented",
    ),
    "sac-memoryless": _soft(
        "SAC that takes the last observation for the current one",
        "Haarnoja et al., ICML 2018",
        actor_sees="delayed",
        critic_sees="delayed",
    ),
    "sac": _soft("the delay-free reference: trains with --delay 0", "Haarnoja et al., ICML 2018"),
    "random": Entry(
        "uniform actions",
        "-",
        {name: Preset(Random(), s) for name, s in (("paper", _PAPER), ("small", _SMALL))},
    ),
}
