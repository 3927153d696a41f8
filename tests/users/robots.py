"""Points 12 to 14: on robots, with the normalised observations of point 4. Run with `arm.py` and the extra `deploy`."""

import heapq
from pathlib import Path

import numpy as np
from arm import make
from trying import holds, point, raises, refused, typed

import delayrl
from delayrl.deploy import Controller, adapt, export_layers, load_bundle

LENGTH = "--steps 200 --random-steps 100 --evaluate-every 100 --evaluation-episodes 2"
TRAIN = f"delayrl train bpql --env arm:make --preset small {LENGTH} --hidden 8,8 --batch-size 8"
PERIOD = 0.02  # of the arm's control loop, in seconds


def overruns(policy, delay, phase, steps=50):
    """Run a control loop with a sensor that is `phase` after it and `delay` late, in seconds; return the overruns."""
    controller = Controller(policy, stamps="seconds", clock=lambda: 0.0)
    controller.reset(0.0)
    events = [(k * PERIOD, 1, 0.0) for k in range(steps)]  # when, whether it is a decision, the stamp
    events += [(k * PERIOD + phase + delay, 0, k * PERIOD + phase) for k in range(steps)]
    heapq.heapify(events)
    while events:
        now, decides, stamp = heapq.heappop(events)
        if not decides:
            controller.observe(np.zeros(1), stamp, now)
        elif controller.ready:
            controller.act(now)
    return controller.statistics.overruns


point(12, "a delay at every phase of the sensor")
typed(
    f"{TRAIN} --delay 80ms~ --observation-norm running --out phase",
    "delay: episode:4:5, up to 5 steps of 20 ms",
    "delay episode:4:5",
)
holds("80 ms are 4 or 5 steps of 20 ms, and a phase stays", delayrl.Run("phase").config["delay"] == "episode:4:5")
late = "a sensor up to 100 ms late in step with the control loop, up to 90 ms at any phase"
served = f"{late}; held back until 80 ms late"
typed("delayrl export phase --out phase-bundle", "ages 4..5", served)
bundle = load_bundle("phase-bundle")
serves = Controller(bundle, stamps="seconds").serves
holds("Controller(bundle).serves", serves == served, serves)
phases = np.linspace(0, PERIOD, 16, endpoint=False) + 1e-4
found = [overruns(bundle, 0.08, phase) for phase in phases]
holds("a sensor that is 80 ms late has no overrun at any phase", not any(found), found)
without = adapt(lambda obs, actions, age: np.zeros(1), delayrl.make(make, "80ms"))
found = [overruns(without, 0.08, phase) for phase in phases]
holds("without ~ every decision is one at some phases", max(found) > 40 and min(found) == 0, found)
rows = [f"{k * PERIOD},{k * PERIOD + 0.08}" for k in range(400)]
Path("stamps.csv").write_text("\n".join(["stamp,received", *rows, ""]))
typed("delayrl measure stamps.csv --period 20ms", "train with: --delay episode:4:5", "or: --delay 4")
holds(
    "80ms~15ms adds jitter",
    str(delayrl.make(make, "80ms~15ms").delay) == "uniform:4:6",
    str(delayrl.make(make, "80ms~15ms").delay),
)

point(4, "normalised observations in checkpoints, bundles and ONNX")
policy, random = delayrl.load("phase"), np.random.default_rng(0)
graph = load_bundle("phase-bundle", "onnx")
for age in (0, 3, 5):
    obs, actions = random.normal(size=1).astype(np.float32), random.uniform(-1, 1, (5, 1)).astype(np.float32)
    acted = [policy.act(obs, {"age": age, "actions": actions}), bundle(obs, actions, age), graph(obs, actions, age)]
    holds(f"checkpoint, bundle and ONNX agree at age {age}", np.ptp(acted) < 1e-5, acted)
moments = policy.state.moments
deviation = float(np.sqrt(moments.squares[0] / moments.number))
holds("the checkpoint holds the moments of the angles that were seen", 0.1 < deviation < 2, moments)

point(13, "a delay that is constant in an episode")
env, episodes = delayrl.make(make, "episode:2:4"), []
for seed in range(20):
    env.reset(seed=seed)
    ages = [env.step(np.zeros(1, np.float32))[4]["age"] for _ in range(30)]
    episodes.append(set(ages[4:]))  # after the start, where nothing can be old
holds("each episode has one delay", all(len(ages) == 1 for ages in episodes), episodes)
holds("which is 2, 3 or 4 steps", set.union(*episodes) == {2, 3, 4}, episodes)
typed(f"{TRAIN} --delay episode:2:4 --out episode --quiet", "delay episode:2:4")
for delay in ("2", "4", "episode:2:3", "episode:choice:1=0.5,4=0.5"):
    typed(f"delayrl evaluate episode --episodes 2 --delay {delay}", f"delay {delay}")
refused("delayrl evaluate episode --delay 5", "takes delays up to 4 steps; got 5; train with --delay 5")
refused("delayrl train random --env arm:make --delay episode:4:2", "LOW ≤ HIGH")

point(14, "policies of other libraries; Stable-Baselines3's is examples/stable_baselines_robot.py")
env = delayrl.AugmentedObservation(delayrl.make(make, 3))
layers = [(random.normal(size=(5, 8)), np.zeros(8)), (random.normal(size=(8, 1)), np.zeros(1))]


def act(vector):
    (w, b), (last, c) = layers
    return np.tanh(np.maximum(vector @ w + b, 0) @ last + c)


export_layers(layers, act, env, "mlp", agent="mine")
of_function, of_bundle = Controller(adapt(act, env)), Controller(load_bundle("mlp"))
vector, info = env.reset(seed=0)
truths, differences = [info["truth"]], []
for step in range(50):
    for controller in (of_function, of_bundle):
        controller.observe(truths[step - info["age"]], step - info["age"], step)
    actions = [of_function.act(step), of_bundle.act(step), act(vector)]
    differences.append(np.ptp(actions))
    vector, _, _, _, info = env.step(actions[0].astype(np.float32))
    truths.append(info["truth"])
holds("function, controller and bundle give the same actions for 50 steps", max(differences) < 1e-5, max(differences))
raises(
    "other layers",
    lambda: export_layers(layers[::-1], act, env, "other"),
    "the first layer must take the vector of size 5",
)
wrong = [(-layers[0][0], layers[0][1]), layers[1]]
raises("layers of another policy", lambda: export_layers(wrong, act, env, "other"), "do not compute the policy")
