"""The recipe of docs/robot.md for a command's delay, on plants whose delays are known."""

from pathlib import Path

import numpy as np
import pytest

from delayrl.measure import from_log

PERIOD = 0.02
"""Seconds of the control loop."""


@pytest.mark.parametrize("phase", [0.001, 0.009, 0.017])
@pytest.mark.parametrize("sensor", [0.02, 0.03])
@pytest.mark.parametrize("command_delay", [0.0, 0.02])
def test_a_commands_part_of_the_dead_time(tmp_path: Path, phase: float, sensor: float, command_delay: float) -> None:
    """Dead time less the stamps' median and half the sensor's period, in steps, is the delay of the command."""
    write_logs(tmp_path, phase, sensor, command_delay)
    dead_time, stamped = (from_log(tmp_path / f"{name}.csv", period=PERIOD).delay for name in ("rows", "stamps"))
    assert round((dead_time - stamped - sensor / 2) / PERIOD) == round(command_delay / PERIOD)


def write_logs(folder: Path, phase: float, sensor: float, command_delay: float) -> None:
    """Write 40 seconds of a point mass as rows each 5 ms, and the stamps of its observations, 60 ms late and more."""
    random, ms = np.random.default_rng(0), 0.001
    position = speed = force = command = 0.0
    acting: list[tuple[float, float]] = []  # when, and which force
    travelling: list[tuple[float, float, float, float]] = []  # arrival, stamp, position, speed
    stamps, rows, newest, measured = ["stamp,received"], ["time,command_u,obs_x,obs_v"], (-1.0, 0.0, 0.0), 0
    for tick in range(40_000):
        now = tick * ms
        while acting and acting[0][0] <= now + 1e-9:
            force = acting.pop(0)[1]
        if now >= phase + measured * sensor - 1e-9:
            arrival, measured = now + 0.06 + random.exponential(0.004), measured + 1
            travelling.append((arrival, now, position, speed))
            stamps.append(f"{now:.6f},{arrival:.6f}")
        newest = max([newest, *(message[1:] for message in travelling if message[0] <= now)])
        travelling = [message for message in travelling if message[0] > now]
        if tick % 20 == 0 and newest[0] >= 0:
            command = float(np.clip(-0.8 * newest[1] - newest[2] + random.normal(0, 0.3), -1, 1))
            acting.append((now + command_delay, command))
        if tick % 5 == 0 and newest[0] >= 0:
            rows.append(f"{now:.6f},{command:.6f},{newest[1]:.6f},{newest[2]:.6f}")
        speed += ms * (2 * force - 0.2 * speed)
        position += ms * speed
    (folder / "rows.csv").write_text("\n".join(rows))
    (folder / "stamps.csv").write_text("\n".join(stamps))
