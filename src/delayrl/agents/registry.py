"""The registry of agents and their presets. A new agent needs a file, an entry here and a page in docs/algorithms."""

import difflib
from dataclasses import replace
from typing import NamedTuple

from delayrl.agents.adsac import ADSAC
from delayrl.agents.base import Agent, Schedule
from delayrl.agents.dcac import DCAC
from delayrl.agents.dida import DIDA
from delayrl.agents.lifting import Lifting
from delayrl.agents.random import Random
from delayrl.agents.sac import BPQL, SAC
from delayrl.agents.vdpo import VDPO
from delayrl.core.protocol import CORRECTED, OFFICIAL, Protocol
from delayrl.errors import DelayRLError


class Preset(NamedTuple):
    """An agent's hyperparameters with the schedule that belongs to them."""

    agent: Agent
    schedule: Schedule


class Registration(NamedTuple):
    """An entry of the registry."""

    summary: str
    paper: str
    presets: dict[str, Preset]
    official: Protocol = OFFICIAL

    def protocol(self, name: str) -> Protocol:
        """Return the protocol called `name`. Raises DelayRLError if there is none."""
        protocols = {"corrected": CORRECTED, "official": self.official}
        if name not in protocols:
            raise DelayRLError(f"protocol must be corrected or official; got {name!r}")
        return protocols[name]


_CLEARED = replace(OFFICIAL, last_starts="dropped")
"""The protocol of released code that clears its n-step window at the end of an episode."""
_SMALL = Schedule(steps=15_000, random_steps=1_000, replay_capacity=20_000, evaluate_every=2_500)


def _presets(paper: Agent, small: Agent, random_steps: int = 5_000) -> dict[str, Preset]:
    """Return the paper's hyperparameters with its random steps, and small ones that train in minutes on a laptop."""
    return {"paper": Preset(paper, Schedule(random_steps=random_steps)), "small": Preset(small, _SMALL)}


def _soft(summary: str, paper: str, **sees: str) -> Registration:
    """Return the entry of SAC with the views `sees`, which are the only difference between these agents."""
    agent = SAC(**sees)  # type: ignore[arg-type]
    return Registration(summary, paper, _presets(agent, replace(agent, batch_size=128)))


_SMALL_SAC = SAC(batch_size=128)
_SMALL_BPQL = replace(_SMALL_SAC, actor_sees="augmented")
_SMALL_VDPO = VDPO(_SMALL_SAC, width=64, layers=2, dropout=0.0, learning_rate=1e-3, clone_every=250, clone_updates=250)
_SMALL_DIDA = DIDA(_SMALL_SAC, expert_steps=10_000, round_steps=250, imitation_updates=250)

AGENTS: dict[str, Registration] = {
    "vdpo": Registration(
        "clones a delay-free SAC into a transformer on (last observation, actions since)",
        "Wu et al., NeurIPS 2024",
        _presets(VDPO(), _SMALL_VDPO),
        _CLEARED,
    ),
    "lifting": Registration(
        "BPQL, pulled towards a delay-free SAC learned beside it, with an annealed weight (D²HPG-BPQL)",
        "Lee et al., 2026, arXiv 2604.03641",
        _presets(Lifting(), Lifting(_SMALL_BPQL, lifting_hold=3_750, lifting_end=11_250), random_steps=10_000),
    ),
    "ad-sac": Registration(
        "learns values for a shorter delay, and improves the actor of the long one by them",
        "Wu et al., ICML 2024",
        _presets(ADSAC(), ADSAC(replace(_SMALL_BPQL, critic_sees="augmented"))),
        replace(_CLEARED, overrides={"evaluation": "sample"}),
    ),
    "dida": Registration(
        "a student on x_t imitates a delay-free SAC expert (DAgger); the expert's steps are counted",
        "Liotet et al., ICML 2022",
        _presets(DIDA(), _SMALL_DIDA),
    ),
    "dcac": Registration(
        "learns values on past stretches whose actions are sampled again inside the augmented state",
        "Bouteiller, Ramstedt et al., ICLR 2021",
        _presets(DCAC(), DCAC(), random_steps=10_000),
    ),
    "bpql": Registration(
        "SAC whose actor sees x_t and whose critic sees s_t",
        "Kim et al., NeurIPS 2023",
        _presets(BPQL, _SMALL_BPQL, random_steps=10_000),
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
    "random": Registration("uniform actions", "-", _presets(Random(), Random())),
}


def find_agent(name: str) -> Registration:
    """Return the registry's entry for an agent. Raises DelayRLError with the nearest names if there is none."""
    if name not in AGENTS:
        near = difflib.get_close_matches(name, AGENTS, n=2, cutoff=0.4) or AGENTS
        raise DelayRLError(f"unknown agent {name!r}; did you mean {', '.join(near)}?")
    return AGENTS[name]
