"""Run a policy in its own process, which sees the plant only through UDP. Prints the controller's statistics."""

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

PATIENCE = 120.0  # seconds to wait for the simulator


class AppliedActions:
    """Keep what the actuator reports until the controller has reached that step, then correct the history."""

    def __init__(self, controller: Controller, listens: bool) -> None:
        self._controller, self._listens = controller, listens
        self._actions: dict[int, np.ndarray] = {}

    def take(self, packet: Packet) -> None:
        """Take in the report of a step, which may arrive before the controller has acted for it."""
        if self._listens:
            self._actions[packet.step] = packet.values
            self.settle()

    def settle(self) -> None:
        """Correct the history up to the controller's step."""
        for step in [step for step in self._actions if step <= self._controller.step]:
            self._controller.applied(self._actions.pop(step), step)

    def forget(self) -> None:
        """Drop all reports, because their episode is over."""
        self._actions.clear()


def lockstep(controller: Controller, line: socket.socket, applied: AppliedActions) -> None:
    """Answer every tick once; a repeated tick gets the same answer.

    Before the first observation the answer is zeros. They are not a command: the plant does the same on its own.
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
            applied.forget()
            answered = -1
        if packet.episode != controller.episode:
            continue
        if packet.kind == OBSERVATION:
            arrived[packet.step] = packet.values
        elif packet.kind == APPLIED:
            applied.take(packet)
        elif packet.kind == TICK and packet.step == answered + 1:
            due = [int(k) for k in packet.values]
            if all(k in arrived for k in due):  # otherwise the tick comes again
                for k in due:
                    controller.observe(arrived[k], k, packet.step)
                nothing = np.zeros(controller.policy.action_size, np.float32)
                action = controller.act(packet.step) if controller.ready else nothing
                answer, answered = encode(ACTION, packet.episode, packet.step, 0.0, action), packet.step
                line.send(answer)
        elif packet.kind == TICK and packet.step == answered:
            line.send(answer)


def real_time(controller: Controller, line: socket.socket, applied: AppliedActions) -> None:
    """Listen in another thread; act a quarter of a step after the beginning of each step, for its beginning."""
    dt = controller.policy.dt
    assert dt is not None
    turn = threading.Condition()
    begun: float | None = None  # when step 0 began; None between episodes
    over = False
    errors: list[BaseException] = []

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
                        applied.forget()
                    if packet.kind == OBSERVATION:
                        controller.observe(packet.values, packet.stamp, episode=packet.episode)
                    elif packet.kind == APPLIED and packet.episode == controller.episode:
                        applied.take(packet)
                    turn.notify()
        except BaseException as error:
            errors.append(error)
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
            step = max(step + 1, math.floor((time.monotonic() - begun) / dt - 0.25))  # skip steps that were missed
            at = begun + step * dt
        time.sleep(max(0.0, at + 0.25 * dt - time.monotonic()))
        with turn:
            if begun is None or over or controller.episode != episode:
                continue
            try:
                action = controller.act(at)
            except ClockError:  # woke up after a newer observation: wait for the next step
                continue
            applied.settle()
        line.send(encode(ACTION, episode, step, at, action))
    if errors:
        raise errors[0]


def finite(value: Any) -> Any:
    """Return None for NaN, which JSON does not have."""
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
        # this plant executes commands at once, whatever the policy was trained for
        controller = Controller(policy, stamps=stamps, action_delay=0, on_overrun=given.on_overrun)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.settimeout(PATIENCE)
            line.connect(("127.0.0.1", given.port))  # packets from elsewhere are not delivered
            (real_time if given.real_time else lockstep)(controller, line, AppliedActions(controller, not given.deaf))
    except (DelayRLError, OSError) as error:
        sys.exit(f"controller: {error}")
    statistics = dataclasses.asdict(controller.statistics)
    print(json.dumps({name: finite(value) for name, value in statistics.items()}))


if __name__ == "__main__":
    main()
