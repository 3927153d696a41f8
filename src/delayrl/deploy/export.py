"""Export a run folder as a bundle. Apart from the backend `jax`, only this module of the package needs JAX."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Arrays, Network
from delayrl.deploy.files import check_target, write_files
from delayrl.deploy.packing import check_same, pack, space_json
from delayrl.envs.making import make, seconds_of
from delayrl.envs.task import Task, TaskLike, closing_quietly, stored_task
from delayrl.play.policy import Policy, restored
from delayrl.play.run import Run
from delayrl.run.agents import AgentLike
from delayrl.run.arrays import flatten_tree
from delayrl.run.folder import RunFolder, RunLike, path_of
from delayrl.run.provenance import versions
from delayrl.run.rows import deviation


def export_run(
    run: RunLike,
    out: str | Path,
    *,
    force: bool = False,
    env: TaskLike | None = None,
    agent: AgentLike | None = None,
) -> dict[str, Any]:
    """Write the policy in the newest good checkpoint of a run folder as a bundle; return its metadata.

    Args:
        run: the run folder.
        out: a new or empty folder.
        force: replace a bundle in `out`.
        env: what makes the run's environment, as `delayrl.load`.
        agent: as `delayrl.load`.

    Raises:
        DelayRLError: no run, an agent without a deterministic policy or with another one than acts, observations too
            far from 0 for single precision, or a folder that holds something else.
    """
    check_target(Path(out), force=force)
    source = RunFolder(path_of(run))
    config, checkpoint = source.config, source.latest()  # read once, because training may continue
    task = stored_task(config["env"], source.path, env)
    policy = restored(source, config, checkpoint, task, agent)
    metadata = describe(source, config, checkpoint.step, policy, task)
    network, arrays = network_of(policy)

    def act(obs: NDArray[Any], actions: NDArray[Any], age: int) -> NDArray[np.float32]:
        return policy.act(obs, {"age": age, "actions": actions})

    first = np.zeros(network.obs_size), np.zeros((network.max_age, network.action_size)), 0
    if np.array_equal(act(*first), act(*first)):  # else it samples in evaluation, and its network gives the mode
        otherwise = f"{config['agent']}: its `deterministic` does not give the actions of its `act`"
        normalised: Any = policy.agent if config["schedule"].get("observation_norm") == "running" else None
        check_same(network, arrays, act, otherwise, normalised and normalised.usual(policy.state))
    write_files(Path(out), pack(network, arrays, metadata), force=force)
    return metadata


def network_of(policy: Policy) -> tuple[Network, Arrays]:
    """Return the description and the arrays of the networks that compute a policy's deterministic actions."""
    spec, parts = policy.spec, policy.agent.deterministic(policy.state)
    size = spec.action_size

    def mean(mlp: Any) -> Any:
        """Drop the outputs for the log-std, which a deterministic action does not need."""
        *hidden, last = mlp
        return [*hidden, {"w": last["w"][:, :size], "b": last["b"][:size]}]

    def hidden(mlp: Any) -> tuple[int, ...]:
        return tuple(layer["b"].shape[0] for layer in mlp[:-1])

    kind = "augmented" if parts.sees == "augmented" and spec.delay else "observation"
    tree = {"head": mean(parts.head)}
    sizes: dict[str, Any] = {}
    if parts.current is not None:
        tree["current"], sizes["current"] = mean(parts.current), hidden(parts.current)
    if parts.forecast is not None:
        kind, tree["forecast"], sizes["forecast"] = "forecast", parts.forecast, hidden(parts.forecast)
    if parts.encoder is not None:
        kind, tree["encoder"] = "transformer", parts.encoder
        sizes |= {"width": parts.encoder["position"].shape[1], "blocks": len(parts.encoder["blocks"])}
    low, high = tuple(policy.low.tolist()), tuple(policy.high.tolist())
    network = Network(spec.obs_size, size, spec.delay, low, high, kind, hidden(parts.head), **sizes)
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in flatten_tree(tree).items()}
    network.check(arrays)
    return network, arrays


def describe(run: RunFolder, config: dict[str, Any], step: int, policy: Policy, task: Task) -> dict[str, Any]:
    """Return what a bundle says about its run: task, spaces, seconds a step, delay, training, last evaluation."""
    with closing_quietly(make(task, policy.delay)) as env:
        seconds = seconds_of(env)
    copied = ("agent", "preset", "env", "delay", "protocol", "privileged", "seed", "hyperparameters")
    return {
        **{name: config.get(name) for name in copied},
        "ages": [policy.min_age, policy.spec.delay],
        "action_delay": env.delay.action.maximum,
        "dt": seconds,
        "observation": space_json(env.observation_space),
        "action": space_json(env.action_space),
        "normalisation": {
            "observation": "inside the networks: the bundle takes the task's own numbers"
            if config["schedule"].get("observation_norm") == "running"
            else "none: the task's own numbers",
            "action": "inside, low .. high is -1 .. 1; the bundle takes and gives the task's own units",
        },
        "step": step,
        "evaluation": _evaluation(run, config, step),
        "trained_with": config.get("versions"),
        "exported_with": versions(),
    }


def _evaluation(run: RunFolder, config: dict[str, Any], step: int) -> dict[str, Any] | None:
    """Summarise the last whole evaluation up to the checkpoint at `step`; None if there was none."""
    steps, returns = Run(run.path).curve()
    if not (steps <= step).any():
        return None
    last, played = steps[steps <= step][-1], returns[steps <= step][-1]
    moments = {"mean_return": float(played.mean()), "std_return": deviation(played)}
    return {"step": int(last), "episodes": len(played), **moments, "protocol": config.get("protocol")}
