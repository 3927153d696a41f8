"""Run the plant in its own process: a Gymnasium task behind a bad network. Prints JSON: its port, then each episode.

In lockstep (the default), each step sends the observations that arrive now and a tick that names them. It repeats both
until the action for this step is back. The result does not depend on how busy the machine is.

In real time, there is a step every dt seconds. The observation is made and sent at the beginning of a step. Half a step
later the newest action that has arrived is applied, whichever step it was chosen for.

The actuator reports without delay what it did in a step: it is next to the controller, only the sensor is far away.
"""

import argparse
import json
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from link import Link, Travelling
from wire import ACTION, APPLIED, END, HELLO, OBSERVATION, PAUSE, TICK, decode, encode

TRACED = 151  # steps of the first episode whose first two numbers are printed
PATIENCE = 120.0  # seconds to wait for the controller, which may have to load and compile first


class Line:
    """The simulator's end of the connection, to the one controller that says hello."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.peer: Any = None

    def await_hello(self) -> None:
        """Wait for the controller."""
        deadline = time.monotonic() + PATIENCE
        while self.peer is None:
            data, sender = self._receive(max(0.0, deadline - time.monotonic()))
            packet = decode(data)
            if packet is not None and packet.kind == HELLO:
                self.peer = sender

    def send(self, *packets: bytes) -> None:
        """Send packets to the controller."""
        for packet in packets:
            self.socket.sendto(packet, self.peer)

    def action(self, episode: int, timeout: float, steps: range) -> tuple[int, np.ndarray] | None:
        """Receive the next action of an episode for one of these steps, with its step; None if none comes in time."""
        deadline = time.monotonic() + timeout
        while True:
            try:
                data, sender = self._receive(deadline - time.monotonic())
            except TimeoutError:
                return None
            packet = decode(data)
            if sender != self.peer or packet is None or packet.kind != ACTION:
                continue
            if packet.episode == episode and packet.step in steps:
                return packet.step, packet.values

    def _receive(self, timeout: float) -> tuple[bytes, Any]:
        self.socket.settimeout(max(timeout, 1e-4))
        return self.socket.recvfrom(65_535)


Play = Callable[[gym.Env, Line, Travelling, int, int], dict[str, Any]]


def lockstep(env: gym.Env, line: Line, travelling: Travelling, episode: int, seed: int) -> dict[str, Any]:
    """Play one episode; time stands still until the controller has answered."""
    obs, _ = env.reset(seed=seed)
    made, total, trace = {}, 0.0, []
    action, applied = np.zeros(env.action_space.shape, env.action_space.dtype), []
    for step in range(10**9):
        made[step] = obs
        trace.append(obs[:2])
        travelling.send(step)
        due = travelling.due(step)
        packets = [encode(OBSERVATION, episode, k, k, made[k]) for k in due]
        packets += applied
        packets.append(encode(TICK, episode, step, step, np.float64(due)))
        deadline, answer = time.monotonic() + PATIENCE, None
        while answer is None:
            if time.monotonic() > deadline:
                raise TimeoutError
            line.send(*packets)
            answer = line.action(episode, 0.5, range(step, step + 1))
        action = action if travelling.missed() else answer[1].astype(action.dtype)
        applied = [encode(APPLIED, episode, step, step, action)]
        obs, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
        if terminated or truncated:
            return {"return": total, "length": step + 1, "held": 0, "trace": [*trace, obs[:2]]}
    raise AssertionError


def real_time(env: gym.Env, line: Line, travelling: Travelling, episode: int, seed: int) -> dict[str, Any]:
    """Play one episode in real time."""
    dt = env.unwrapped.dt
    obs, _ = env.reset(seed=seed)
    made, total, trace, held = {}, 0.0, [], 0
    action, newest = np.zeros(env.action_space.shape, env.action_space.dtype), -1
    start = time.monotonic()
    for step in range(10**9):
        made[step] = obs
        trace.append(obs[:2])
        travelling.send(step)
        while True:  # for half a step, deliver observations and receive actions
            now = (time.monotonic() - start) / dt
            for k in travelling.due(now):
                line.send(encode(OBSERVATION, episode, k, start + k * dt, made[k]))
            if now >= step + 0.5:
                break
            answer = line.action(episode, (min(step + 0.5, travelling.next()) - now) * dt, range(newest + 1, step + 1))
            if answer is not None:
                newest, action = answer[0], answer[1].astype(action.dtype)
        held += newest < step
        line.send(encode(APPLIED, episode, step, start + step * dt, action))
        obs, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
        if terminated or truncated:
            line.send(encode(PAUSE, episode, step))
            time.sleep(5 * dt)
            return {"return": total, "length": step + 1, "held": held, "trace": [*trace, obs[:2]]}
        while (now := (time.monotonic() - start) / dt) < step + 1:
            time.sleep((min(step + 1, max(now, travelling.next())) - now) * dt)
            for k in travelling.due((time.monotonic() - start) / dt):
                line.send(encode(OBSERVATION, episode, k, start + k * dt, made[k]))
    raise AssertionError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="InvertedPendulum-v5")
    parser.add_argument("--low", type=int, default=0, help="shortest travel of an observation, in steps")
    parser.add_argument("--high", type=int, default=0, help="longest travel, in steps")
    parser.add_argument("--loss", type=float, default=0.0, help="probability that an observation is lost")
    parser.add_argument("--double", type=float, default=0.0, help="probability that it arrives twice")
    parser.add_argument("--missed", type=float, default=0.0, help="probability that a command is lost")
    parser.add_argument("--first", type=int, default=0, help="travel of the first observation, in steps")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--steps", type=int, help="end episodes early")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real-time", action="store_true")
    given = parser.parse_args()

    link = Link(given.low, given.high, given.loss, given.double, given.missed, given.first)
    play: Play = real_time if given.real_time else lockstep
    env = gym.make(given.env, disable_env_checker=True, max_episode_steps=given.steps)
    line = Line()
    print(json.dumps({"port": line.socket.getsockname()[1]}), flush=True)
    try:
        line.await_hello()
        for episode in range(1, given.episodes + 1):
            reset_seed = int(np.random.SeedSequence([given.seed, episode]).generate_state(1)[0] >> 1)
            travelling = Travelling(link, [given.seed, episode], whole_steps=not given.real_time)
            result = play(env, line, travelling, episode, reset_seed)
            result["trace"] = np.round(result["trace"][:TRACED], 4).tolist() if episode == 1 else None
            print(json.dumps({"episode": episode, "reset_seed": reset_seed} | result), flush=True)
        line.send(*[encode(END, 0, 0)] * 3)
    except TimeoutError:
        sys.exit(f"simulator: no controller has answered for {PATIENCE:.0f} s")


if __name__ == "__main__":
    main()
