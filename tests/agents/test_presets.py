"""The preset `paper` of every agent, held against the tables of its source; and what `matched` has in common."""

import pytest

from delayrl.agents.dcac import TEMPERATURE_RATE
from delayrl.agents.registry import AGENTS
from delayrl.run.condition import resolve
from delayrl.run.configuration import values_of
from delayrl.run.stored import overrides_of

ANY_AGE = {
    "second_age": "random",
    "pull": "moments",
    "pull_weight": 0.0,
    "pull_hold": 0.25,
    "pull_end": 0.75,
    "encoder": "forecast",
    "forecast_learns_from": "states",
    "forecast_error": "squared",
    "encoder_width": 64,
    "encoder_layers": 2,
    "belief_weight": 0.0,
}
VDPO_SAC = {  # VDPO: appendix, table of hyperparameters; log-std, n-step, actor_updates, start: its released code
    "hidden": [256, 256],
    "critic_norm": "none",
    "actor_learning_rate": 3e-4,
    "critic_learning_rate": 1e-3,
    "temperature_learning_rate": 1e-3,
    "initial_temperature": 1.0,
    "entropy_per_action": -1.0,
    "entropy_unit": "task",
    "discount": 0.99,
    "target_rate": 5e-3,
    "n_steps": 3,
    "actor_every": 2,
    "actor_updates": 2,
    "log_std_range": [-5.0, 2.0],
    "log_std_bounds": "rescale",
    "batch_size": 256,
    "update_every": 1,
    "updates": 1,
}
MATCHED = VDPO_SAC | {"entropy_unit": "scaled"}
BPQL = VDPO_SAC | {  # BPQL: released code, main.py
    "critic_learning_rate": 3e-4,
    "temperature_learning_rate": 3e-4,
    "n_steps": 1,
    "actor_every": 1,
    "actor_updates": 1,
    "log_std_range": [-20.0, 2.0],
    "log_std_bounds": "clip",
    "update_every": 50,
    "updates": 50,
}
SCHEDULE = {
    "steps": 1_000_000,
    "random_steps": 5_000,
    "update_after": 0,
    "replay_capacity": 1_000_000,
    "evaluate_every": 10_000,
    "evaluation_episodes": 10,
    "updates_per_call": 1,
    "precision": "float32",
    "observation_norm": "none",
}
PAPER = {
    "vdpo": VDPO_SAC
    | {
        "representation": "transformer",
        "width": 256,
        "layers": 3,
        "dropout": 0.1,
        "learning_rate": 3e-4,
        "clone_every": 1000,
        "clone_updates": 1000,
        "direction": "reverse",
        "behaviour": "lower-q",
        "tokens": 0,
        "at_age_0": "reference",
    },
    "ad-sac": VDPO_SAC | {"auxiliary_delay": 0, "behaviour": "lower-q", "temperature_every": 1, "evaluation": "mode"},
    "dida": VDPO_SAC  # student: DIDA's code, train_dida.py; expert_steps and imitation_updates: ours (docs)
    | {
        "expert_steps": 500_000,
        "round_steps": 1000,
        "imitation_updates": 1000,
        "student_hidden": [100, 100],
        "student_optimiser": "rmsprop",
        "student_learning_rate": 1e-3,
        "student_decay": 0.9,
        "student_batch_size": 32,
    },
    "dcac": {  # rlrd: sac.py and dcac.py, class Agent
        "hidden": [256, 256],
        "learning_rate": 3e-4,
        "actor_share": 0.2,
        "reward_scale": 5.0,
        "temperature": "fixed",
        "entropy_scale": 1.0,
        "discount": 0.99,
        "target_rate": 5e-3,
        "log_std_range": [-20.0, 2.0],
        "batch_size": 128,
    },
    "any-age": MATCHED | ANY_AGE | {"critic_norm": "layer"},  # ours
    "bpql": BPQL,
    "lifting": BPQL  # DHRL: agents/d2hpg_bpql.py
    | {"initial_temperature": 0.2, "lifting_weight": 10.0, "lifting_hold": 250_000, "lifting_end": 750_000},
    "a-sac": VDPO_SAC,
    "sac-memoryless": VDPO_SAC,
    "sac": VDPO_SAC,
    "random": {},
}
OWN_SCHEDULE = {
    "bpql": {"random_steps": 10_000, "update_after": 1_000},
    "lifting": {"random_steps": 10_000, "update_after": 100},
    "dcac": {"random_steps": 10_000},
}


@pytest.mark.parametrize("agent", AGENTS)
def test_paper(agent: str) -> None:
    preset = AGENTS[agent].presets["paper"]
    assert values_of(preset.agent) == PAPER[agent]
    assert values_of(preset.schedule) == SCHEDULE | OWN_SCHEDULE.get(agent, {})


@pytest.mark.parametrize("agent", [agent for agent in AGENTS if agent not in ("random", "dcac")])
def test_matched(agent: str) -> None:
    """Every option that agents share has one value. AD-SAC has two actors, of which an update improves one.

    So every network of every agent is updated once a step, temperatures included.
    """
    values = values_of(AGENTS[agent].presets["matched"].agent)
    own_values = {"ad-sac": {"actor_updates": 4, "temperature_every": 2}}
    shared = MATCHED | {**own_values, "any-age": {"critic_norm": "layer"}}.get(agent, {})
    assert {name: values[name] for name in shared} == shared
    own = {"learning_rate": 3e-4, "student_learning_rate": 3e-4, "student_hidden": [256, 256]}
    own |= {"student_batch_size": 256, "student_optimiser": "adam"}
    assert {name: values[name] for name in own if name in values} == {n: x for n, x in own.items() if n in values}
    rounds = [("clone_every", "clone_updates"), ("round_steps", "imitation_updates"), ("update_every", "updates")]
    assert all(values[every] == values[updates] for every, updates in rounds if every in values)


def test_matched_dcac() -> None:
    """It has values of states instead of actions, and one optimiser; all else is shared."""
    values = values_of(AGENTS["dcac"].presets["matched"].agent)
    assert {name: values[name] for name in values if name in MATCHED} == {
        name: x for name, x in MATCHED.items() if name in values
    }
    assert (values["learning_rate"], values["temperature"], values["reward_scale"]) == (3e-4, "learned", 1.0)
    assert MATCHED["temperature_learning_rate"] == TEMPERATURE_RATE


def test_matched_schedules() -> None:
    assert len({preset.schedule for preset in (entry.presets["matched"] for entry in AGENTS.values())}) == 1


@pytest.mark.parametrize(
    ("agent", "preset", "steps", "expected"),
    [
        ("lifting", "small", 100_000, {"lifting_hold": 25_000, "lifting_end": 75_000, "random_steps": 6_667}),
        ("lifting", "small", 100_000, {"replay_capacity": 133_334, "evaluate_every": 16_667}),
        ("lifting", "paper", 100_000, {"lifting_hold": 25_000, "lifting_end": 75_000, "random_steps": 10_000}),
        ("lifting", "small", 1_500, {"lifting_hold": 375, "lifting_end": 1_125, "random_steps": 1_000}),
        ("lifting", "small", 1_500, {"replay_capacity": 20_000, "evaluate_every": 2_500}),
        ("dida", "matched", 300_000, {"expert_steps": 150_000, "random_steps": 5_000, "replay_capacity": 600_000}),
        ("dida", "paper", 200_000, {"expert_steps": 100_000, "replay_capacity": 1_000_000, "evaluate_every": 10_000}),
    ],
)
def test_presets_follow_the_length_of_the_run(agent: str, preset: str, steps: int, expected: dict[str, int]) -> None:
    """Parts of a run always, what a longer one needs more of only there; and what follows is no override."""
    setup = resolve(agent, "Reacher-v5", 3, preset, "corrected", {"steps": steps})
    found = {**setup.config["hyperparameters"], **setup.config["schedule"]}
    assert {name: found[name] for name in expected} == expected
    assert overrides_of(setup.config) == {"steps": steps}
    given = resolve(agent, "Reacher-v5", 3, preset, "corrected", {"steps": steps, "replay_capacity": 77_777})
    assert given.config["schedule"]["replay_capacity"] == 77_777
