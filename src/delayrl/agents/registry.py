"""The registry of agents and their presets. A new agent needs a file, an entry here and a page in docs/algorithms."""

from dataclasses import replace
from typing import NamedTuple

from delayrl.agents.adsac import ADSAC
from delayrl.agents.any_age import AnyAge
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
    given: bool = False  # whether all presets hold one instance of a user's, whose values are never scaled

    def protocol(self, name: str) -> Protocol:
        """Return the protocol called `name`. Raises DelayRLError if there is none."""
        protocols = {"corrected": CORRECTED, "official": self.official}
        if name not in protocols:
            raise DelayRLError(f"protocol must be corrected or official; got {name!r}")
        return protocols[name]


_VDPO = replace(
    OFFICIAL,
    start_states="same",
    time_limit="terminates",
    opening="one-random",
    evaluation_opening="one-random",
    last_starts="dropped",
    capacity="entries",
)
"""VDPO's released code, and with it SAC, A-SAC and DIDA's expert, which it trains in the same way."""
_BPQL = replace(OFFICIAL, opening="zeros", evaluation_opening="zeros", opening_steps="dropped")
"""BPQL's released code, on which that of policy lifting is built."""
_SMALL = Schedule(steps=15_000, random_steps=1_000, replay_capacity=20_000, evaluate_every=2_500)
_PAPER = Schedule()
_MATCHED = Schedule(steps=100_000, random_steps=5_000, replay_capacity=200_000, evaluate_every=5_000)


def _presets(paper: Agent, matched: Agent, small: Agent, schedule: Schedule = _PAPER) -> dict[str, Preset]:
    """Return the paper's hyperparameters, those for comparing methods, and small ones that train in minutes."""
    return {"paper": Preset(paper, schedule), "matched": Preset(matched, _MATCHED), "small": Preset(small, _SMALL)}


def _soft(summary: str, paper: str, **sees: str) -> Registration:
    """Return the entry of SAC with the views `sees`, which are the only difference between these agents."""
    agents = [replace(agent, **sees) for agent in (SAC(), _MATCHED_SAC, _SMALL_SAC)]  # type: ignore[arg-type]
    return Registration(summary, paper, _presets(agents[0], agents[1], agents[2]), _VDPO)


_MATCHED_SAC = SAC(entropy_unit="scaled")
"""VDPO's SAC, with entropies over [-1, 1]: the preset `matched` builds every agent on it (docs/decisions.md)."""
_MATCHED_BPQL = replace(_MATCHED_SAC, actor_sees="augmented")
# a coin picks one of its two actors, hence four
_MATCHED_ADSAC = ADSAC(replace(_MATCHED_BPQL, critic_sees="augmented", actor_updates=4), temperature_every=2)
_MATCHED_VDPO = VDPO(_MATCHED_SAC, width=64, layers=2, dropout=0.0, clone_every=1, clone_updates=1)
_MATCHED_DIDA = DIDA(
    _MATCHED_SAC,
    expert_steps=50_000,
    student_hidden=(256, 256),
    student_optimiser="adam",
    student_learning_rate=3e-4,
    student_batch_size=256,
)
_MATCHED_DCAC = DCAC(temperature="learned", reward_scale=1.0, log_std_range=(-5.0, 2.0), batch_size=256)
_SMALL_SAC = replace(_MATCHED_SAC, batch_size=128)
_SMALL_BPQL = replace(_SMALL_SAC, actor_sees="augmented")
_SMALL_VDPO = VDPO(
    _SMALL_SAC, width=64, layers=2, dropout=0.0, learning_rate=1e-3, clone_every=250, clone_updates=250, tokens=640
)
_SMALL_DIDA = DIDA(_SMALL_SAC, expert_steps=10_000, round_steps=250, imitation_updates=250)

AGENTS: dict[str, Registration] = {
    "vdpo": Registration(
        "clones a delay-free SAC into a transformer on (last observation, actions since)",
        "Wu et al., NeurIPS 2024",
        _presets(VDPO(), _MATCHED_VDPO, _SMALL_VDPO),
        replace(_VDPO, opening="agent", overrides={**OFFICIAL.overrides, "at_age_0": "random"}),
    ),
    "any-age": Registration(
        "BPQL whose actor acts on a forecast of s_t, learned from states alone, at every age",
        "-",
        _presets(AnyAge(), AnyAge(), AnyAge(replace(_SMALL_BPQL, critic_norm="layer"))),
    ),
    "lifting": Registration(
        "BPQL, pulled towards a delay-free SAC learned beside it, with an annealed weight (D²HPG-BPQL)",
        "Lee et al., 2026, arXiv 2604.03641",
        _presets(
            Lifting(),
            Lifting(_MATCHED_BPQL, lifting_hold=25_000, lifting_end=75_000),
            Lifting(_SMALL_BPQL, lifting_hold=3_750, lifting_end=11_250),
            Schedule(random_steps=10_000, update_after=100),
        ),
        _BPQL,
    ),
    "ad-sac": Registration(
        "learns values for a shorter delay, and improves the actor of the long one by them",
        "Wu et al., ICML 2024",
        _presets(ADSAC(), _MATCHED_ADSAC, ADSAC(replace(_SMALL_BPQL, critic_sees="augmented"))),
        replace(
            _VDPO,
            start_states="own",
            opening="agent",
            evaluation_opening="agent",
            overrides={**OFFICIAL.overrides, "evaluation": "sample"},
        ),
    ),
    "dida": Registration(
        "a student on x_t imitates a delay-free SAC expert (DAgger); the expert's steps are counted",
        "Liotet et al., ICML 2022",
        _presets(DIDA(), _MATCHED_DIDA, _SMALL_DIDA),
        replace(_VDPO, start_states="own", opening="random", evaluation_opening="random"),
    ),
    "dcac": Registration(
        "learns values on past stretches whose actions are sampled again inside the augmented state",
        "Bouteiller, Ramstedt et al., ICLR 2021",
        _presets(DCAC(), _MATCHED_DCAC, DCAC(), Schedule(random_steps=10_000)),
        replace(OFFICIAL, time_limit="dropped"),
    ),
    "bpql": Registration(
        "SAC whose actor sees x_t and whose critic sees s_t",
        "Kim et al., NeurIPS 2023",
        _presets(BPQL, _MATCHED_BPQL, _SMALL_BPQL, Schedule(random_steps=10_000, update_after=1_000)),
        _BPQL,
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
    "random": Registration("uniform actions", "-", _presets(Random(), Random(), Random()), _VDPO),
}


def registered(summary: str, agent: Agent) -> Registration:
    """Return an entry for an agent whose presets differ in the schedule alone."""
    return Registration(summary, "-", _presets(agent, agent, agent))
