"""Train a policy under a 3-step delay, load it, and act with it: under a minute on a CPU.

The task is to hold s' = s + a at 0 when observations are three steps old.
"""

import tempfile

import delayrl

with tempfile.TemporaryDirectory() as folder:
    run = delayrl.train(
        "a-sac", "delayrl/Walk-v0", delay=3, preset="small", steps=2_000, random_steps=500, hidden=(64, 64), out=folder
    )
    policy = delayrl.load(run)

env = delayrl.make("delayrl/Walk-v0", delay=3)
obs, info = env.reset(seed=0)
total, done = 0.0, False
while not done:
    action = policy.act(obs, info)  # `info` has the age of `obs` and the actions taken since
    obs, reward, terminated, truncated, info = env.step(action)
    total += float(reward)
    done = terminated or truncated
print(f"return {total:.2f} under a delay of 3 steps (uniformly random actions: about -500)")
