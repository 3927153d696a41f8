"""Record the golden trajectories: Gymnasium's own -v4 of the nine tasks on MuJoCo 2.3.7.

MuJoCo 2.3.7 needs Python 3.11 or older, so the script runs in a separate environment without delayrl:

    python3.11 -m venv golden
    golden/bin/pip install mujoco==2.3.7 "gymnasium[mujoco]==1.4.0"
    golden/bin/python benchmarks/golden/record.py tests/data/golden-mujoco-2.3.7.npz

Each episode is stored as `<task>/<k>/{seed,actions,observations,rewards,terminated}`. `seed` is the seed of `reset`,
`observations` [T + 1, ...] begin with that of `reset`, and `actions` [T, ...] are float32, as an agent's are.
`tests/envs/test_paper.py` replays the actions.
"""

import sys
import warnings

import gymnasium
import mujoco
import numpy as np

# Seeds, and the step at which an episode is cut. Ant, Hopper, Humanoid and Walker2d also terminate by themselves.
EPISODES = {
    "Ant": ((7, 3, 48), 100),
    "HalfCheetah": ((7, 8), 100),
    "Hopper": ((7, 8, 9, 10), 100),
    "Humanoid": ((7, 8), 40),
    "HumanoidStandup": ((7, 8), 20),
    "Pusher": ((7, 8, 9), 100),
    "Reacher": ((7, 8), 50),
    "Swimmer": ((7, 8), 100),
    "Walker2d": ((7, 8, 9, 10), 100),
}
SCRIPTED = {("Pusher", 8), ("Pusher", 9)}  # random actions never touch Pusher's object


def push(model: "mujoco.MjModel", data: "mujoco.MjData") -> np.ndarray:
    """Return torques [7] in N m that press the fingertip into the object by a spring and a damper."""
    tip, target = data.body("tips_arm"), data.body("object").xpos
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, tip.xpos, tip.id)
    velocity = jacobian[:, :7] @ data.qvel[:7]
    force = 20.0 * (target - tip.xpos) - 3.0 * velocity
    return jacobian[:, :7].T @ force


def episode(task: str, seed: int, steps: int) -> dict[str, np.ndarray]:
    """Play one episode of at most `steps` steps and return its arrays."""
    env = gymnasium.make(f"{task}-v4")
    model, data = env.unwrapped.model, env.unwrapped.data
    low, high = env.action_space.low, env.action_space.high
    rng = np.random.default_rng(seed)
    observations, actions, rewards, terminated = [env.reset(seed=seed)[0]], [], [], False
    while len(actions) < steps and not terminated:
        action = push(model, data) if (task, seed) in SCRIPTED else rng.uniform(low, high)
        actions.append(np.clip(action, low, high).astype(np.float32))
        observation, reward, terminated, _, _ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    return {
        "seed": np.array(seed),
        "actions": np.array(actions),
        "observations": np.array(observations),
        "rewards": np.array(rewards, dtype=np.float64),
        "terminated": np.array(terminated),
    }


def main(path: str) -> None:
    """Record all episodes into one compressed file."""
    warnings.simplefilter("ignore", DeprecationWarning)  # "-v4 is out of date"
    if mujoco.__version__ != "2.3.7":
        sys.exit(f"golden trajectories need MuJoCo 2.3.7, got {mujoco.__version__}; install mujoco==2.3.7")
    arrays = {"versions": np.array([f"mujoco {mujoco.__version__}", f"gymnasium {gymnasium.__version__}"])}
    for task, (seeds, steps) in EPISODES.items():
        for k, seed in enumerate(seeds):
            recorded = episode(task, seed, steps)
            arrays |= {f"{task}/{k}/{name}": array for name, array in recorded.items()}
            length, total, end = len(recorded["actions"]), recorded["rewards"].sum(), recorded["terminated"]
            print(f"{task}, seed {seed}: {length} steps, return {total:.4f}, terminated: {end}")
    np.savez_compressed(path, **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
