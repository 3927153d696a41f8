"""What a user has beside `arm.py`: an id, nested observations, wrappers, a robot that runs away, code that fails."""

import gymnasium
import numpy as np
from arm import Arm, make
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.spaces import Dict, Discrete
from gymnasium.wrappers import TimeLimit
from late_ddpg import LateDDPG

gymnasium.register("Workshop/Arm-v0", entry_point="arm:Arm", max_episode_steps=100)
WIDE = LateDDPG(width=24)
READY = make()  # an environment, where something that makes one is asked for


class Gripper(Arm):
    """Shows {"joint": {"angle": [1]}, "closed": 0 or 1}."""

    observation_space = Dict({"joint": Dict({"angle": Arm.observation_space}), "closed": Discrete(2)})

    def reset(self, *, seed=None, options=None):
        angle, info = super().reset(seed=seed)
        return self.nested(angle), info

    def step(self, action):
        angle, *rest = super().step(action)
        return self.nested(angle), *rest

    def nested(self, angle):
        return {"joint": {"angle": angle}, "closed": int(abs(angle[0]) < 0.1)}


class Scaled(gymnasium.ObservationWrapper):
    """Observations times `by`."""

    def __init__(self, env, by=2.0):
        super().__init__(env)
        self.by = by

    def observation(self, obs):
        return (self.by * obs).astype(np.float32)


class Runaway(HalfCheetahEnv):
    """A cheetah that is carried 6 metres a step, out of the sight of a camera that stays."""

    def step(self, action):
        result = super().step(action)
        self.data.qpos[0] += 6
        return result


class Broken(Arm):
    """Cannot be made."""

    def __init__(self, gain=0.1):
        raise ValueError("the serial port is closed")


def run_away(render_mode=None):
    return TimeLimit(Runaway(render_mode=render_mode), 15)


def same():
    return READY
