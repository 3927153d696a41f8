"""The controller: a policy in a process of its own, which sees the plant only through UDP. Prints its statistics."""

import argparse
import dataclasses
import json
import math
import socket
import sys
import threading
import time
from typing import Any

import numpy as np
from policies import load
from wire import ACTION, APPLIED, END, HELLO, OBSERVATION, PAUSE, TICK, Packet, decode, encode

from delayrl.deploy import ClockError, Controller
from delayrl.errors import DelayRLError

PATIENCE = 120.0  # seconds of silence after which the simulator is gone


class Told:
    """What the actuator says that it did, until the controller has come to that step."""

    def __init__(self, controller: Controller, listens: bool) -> None:
        self._controller, self._listens = controller, listens
        self._actions: dict[int, np.ndarray] = {}

    def take(self, packet: Packet) -> None:
        """What was done in a step; it may be told before the controller has acted for it, if that is late."""
        if self._listens:
            self._actions[packet.step] = packet.values
            self.settle()

    def settle(self) -> None:
        """Correct the history as far as it goes."""
        for step in [step for step in self._actions if step <= self._controller.step]:
            self._controller.applied(self._actions.pop(step), step)

    def forget(self) -> None:
        """An episode is over."""
        self._actions.clear()


def lockstep(controller: Controller, line: socket.socket, told: Told) -> None:
    """Answer every tick once; a tick that comes again gets the same answer.

    Before the first observation it answers zeros, which the plant does by itself: no command.
    """
    arrived: dict[int, np.ndarray] = {}
    answer, answered = b"", -1
    line.send(encode(HELLO, 0, 0))
    while True:
        packet = decode(line.recv(65_535))
        if packet is None:
            continue
        if packet.kind == END:
            return
        if packet.episode == controller.episode + 1:
            controller.reset()
            arrived.clear()
            told.forget()
            answered = -1
        if packet.episode != controller.episode:
            continue
        if packet.kind == OBSERVATION:
            arrived[packet.step] = packet.values
        elif packet.kind == APPLIED:
            told.take(packet)
        elif packet.kind == TICK and packet.step == answered + 1:
            due = [int(k) for k in packet.values]
            if all(k in arrived for k in due):  # else it comes again
                for k in due:
                    controller.observe(arrived[k], k, packet.step)
                nothing = np.zeros(controller.policy.action_size, np.float32)
                action = controller.act(packet.step) if controller.ready else nothing
                answer, answered = encode(ACTION, packet.episode, packet.step, 0.0, action), packet.step
                line.send(answer)
        elif packet.kind == TICK and packet.step == answered:
            line.send(answer)


def real_time(controller: Controller, line: socket.socket, told: Told) -> None:
    """One thread listens, this one acts: a quarter of a step after each step's beginning, for its beginning."""
    dt = controller.policy.dt
    assert dt is not None
    turn = threading.Condition()
    begun: float | None = None  # when step 0 began; None between two episodes
    over = False
    broken: list[BaseException] = []

    def listen() -> None:
        nonlocal begun, over
        try:
            while not over:
                packet = decode(line.recv(65_535))
                if packet is None:
                    continue
                with turn:
                    if packet.kind == END:
                        over = True
                    elif packet.kind == PAUSE and packet.episode == controller.episode:
                        begun = None
                    elif packet.kind == OBSERVATION and packet.episode == controller.episode + 1:
                        begun = packet.stamp - packet.step * dt
                        controller.reset(begun)
                        told.forget()
                    if packet.kind == OBSERVATION:
                        controller.observe(packet.values, packet.stamp, episode=packet.episode)
                    elif packet.kind == APPLIED and packet.episode == controller.episode:
                        told.take(packet)
                    turn.notify()
        except BaseException as error:
            broken.append(error)
            with turn:
                over = True
                turn.notify()

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    line.send(encode(HELLO, 0, 0))
    step, episode = -1, 0
    while True:
        with turn:
            turn.wait_for(lambda: over or begun is not None)
            if over:
                break
            assert begun is not None
            if episode != controller.episode:
                episode, step = controller.episode, -1
            step = max(step + 1, math.floor((time.monotonic() - begun) / dt - 0.25))  # later ones were missed
            at = begun + step * dt
        time.sleep(max(0.0, at + 0.25 * dt - time.monotonic()))
        with turn:
            if begun is None or over or controller.episode != episode:
                continue
            try:
                action = controller.act(at)
            except ClockError:  # woken so late that newer observations are here: the next tick's turn
                continue
            told.settle()
        line.send(encode(ACTION, episode, step, at, action))
    if broken:
        raise broken[0]


def finite(value: Any) -> Any:
    """JSON knows no NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", required=True, help="a run folder, a bundle, or: predictor")
    parser.add_argument("--blind", action="store_true", help="take every observation for current")
    parser.add_argument("--deaf", action="store_true", help="do not listen to what the actuator did")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--on-overrun", choices=["hold", "clip", "raise"], default="clip")
    parser.add_argument("--real-time", action="store_true")
    given = parser.parse_args()
    try:
        stamps = "seconds" if given.real_time else "steps"
        policy = load(given.policy, given.blind)
        # this plant carries out commands at once, whatever the policy was trained for
        controller = Controller(policy, stamps=stamps, action_delay=0, on_overrun=given.on_overrun)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.settimeout(PATIENCE)
            line.connect(("127.0.0.1", given.port))  # packets of others are not delivered
            (real_time if given.real_time else lockstep)(controller, line, Told(controller, not given.deaf))
    except (DelayRLError, OSError) as error:
        sys.exit(f"controller: {error}")
    statistics = dataclasses.asdict(controller.statistics)
    print(json.dumps({name: finite(value) for name, value in statistics.items()}))


if __name__ == "__main__":
    main()
