"""Policies with random weights, and bundles and run folders of them, made without training."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from conftest import TINY, TINY_SAC
from delayrl.agents.normalised import NormalisedObservations
from delayrl.agents.registry import AGENTS as REGISTRY
from delayrl.core.types import Spec
from delayrl.deploy.export import network_of
from delayrl.deploy.files import write_files
from delayrl.deploy.packing import pack
from delayrl.play.policy import Policy
from delayrl.run.arrays import flatten_tree
from delayrl.run.configuration import values_of
from delayrl.run.folder import RunFolder
from random_states import random_state

AGENTS = {"sac": TINY_SAC, **TINY}
AGENTS |= {f"vdpo, {name}": replace(TINY["vdpo"], representation=name) for name in ("transformer-no-belief", "mlp")}
AGENTS["any-age, mlp"] = replace(TINY["any-age"], encoder="mlp")
AGENTS["any-age, transformer"] = replace(TINY["any-age"], encoder="transformer", encoder_width=8)
for name in ("bpql", "vdpo", "any-age"):
    AGENTS[f"{name}, normalised"] = NormalisedObservations(AGENTS[name])
DELAY = 4
OBS, LOW, HIGH = 10, np.array([-0.4, -2.0], np.float32), np.array([0.4, 3.0], np.float32)
"""Reacher's sizes; a range of actions that is neither symmetric nor the same for all."""


def policy_of(name: str, seed: int = 0, delay: int = DELAY) -> Policy:
    spec = Spec(OBS, len(LOW), 0 if name == "sac" else delay)
    return Policy(AGENTS[name], random_state(AGENTS[name], spec, seed), spec, LOW, HIGH)


def bundle_of(path: Path, policy: Policy, **metadata: Any) -> Path:
    described = {"agent": "some", "env": "Reacher-v5", "delay": policy.spec.delay, "dt": 0.02, **metadata}
    write_files(path, pack(*network_of(policy), described))
    return path


def run_of(path: Path, name: str = "vdpo", env: str = "Reacher-v5", delay: int = 3, sizes: tuple[int, int] = (OBS, 2)):
    """A complete run folder with a checkpoint at step 240, as the loop would leave it."""
    agent = AGENTS[name] if name in AGENTS else REGISTRY[name].presets["small"].agent
    run = RunFolder(path)
    described = {"agent": name, "preset": "small", "env": env, "delay": delay, "protocol": "corrected"}
    described |= {"privileged": agent.privileged, "hyperparameters": values_of(agent), "schedule": {"steps": 1}}
    run.create(described | {"seed": 3, "versions": {"numpy": "2"}})
    rows = [
        {"step": step, "policy": policy, "episode": i, "reset_seed": i, "return": float(step + i), "length": 50}
        for step in (120, 240)
        for policy in ("agent", "reference")
        for i in range(2)
    ]
    run.append("rows", rows)
    run.save(240, flatten_tree(random_state(agent, Spec(*sizes, delay))), None, {}, complete=True)
    return run
