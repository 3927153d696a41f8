"""How old observations get in a log with stamps: the newest one ages until a newer one arrives.

An observation that is lost, or overtaken, leaves the one before it in use. The log shows this as a longer wait.
"""

import numpy as np
from numpy.typing import NDArray

from delayrl.measure.correlate import Array, Mask
from delayrl.measure.reading import GAP

TOLERANCE = 1e-3  # of a step: a smaller excess over whole steps is not rounded up
IN_STEP = 0.05  # of a step: by how much the period of a sensor in step with the loop may differ

Steps = NDArray[np.int64]


def rounded_up_steps(seconds: float, period: float) -> int:
    """Return a delay in steps, rounded up: an action on its way must be in the history. See `TOLERANCE`."""
    return max(0, int(np.ceil(seconds / period - TOLERANCE)))


def in_use(arrived: Array | Steps) -> Mask:
    """Return which observations are ever the newest, [N]; one that arrives no earlier than a later one never is."""
    first_of_later = np.minimum.accumulate(arrived[::-1])[::-1]
    return arrived < np.append(first_of_later[1:], np.inf)


def without_pauses(made: Array, sensor: float) -> Array:
    """Shorten gaps of more than `GAP` periods of the sensor to one period: a new recording begins there, [N]."""
    gaps = np.diff(made, prepend=made[:1])
    return made[0] + np.cumsum(np.where(gaps > GAP * sensor, sensor, gaps))


def at_the_next(made: Array, delays: Array) -> Array:
    """Return how old observations are when the next one in use arrives, in seconds, [M]."""
    arrived = made + delays
    used = in_use(arrived)
    if used.sum() == 1:  # all arrived at once
        return arrived[used] - made[:1]
    return arrived[used][1:] - made[used][:-1]


def steps_before_the_next(made: Array, delays: Array, period: float) -> Steps:
    """Return the largest age of each observation in use, for a sensor in step with the control loop, in steps, [M].

    It is the delay of the next one, and a step for each that shows nothing new: the sensor is slower, or lost some.
    """
    used = in_use(made + delays)
    missing = np.maximum(np.rint(np.diff(made[used]) / period).astype(np.int64) - 1, 0)
    rounded = np.array([rounded_up_steps(delay, period) for delay in delays[used]])
    return rounded + np.append(0, missing)


def replay(made: Array, delays: Array, sensor: float, period: float) -> tuple[tuple[int, int], ...]:
    """Put observations on the steps of a control loop.

    Args:
        made: when each was made, in seconds, [N].
        delays: of each, in seconds, [N].
        sensor: its period, in seconds.
        period: of control, in seconds.

    Returns:
        Of each observation in use its delay, and how long after the one in use before it it was made, both in steps.
    """
    place = (made - made[0]) / period
    step = np.floor(place + 0.5).astype(np.int64)  # ages count from the nearest decision
    if abs(sensor / period - 1) <= IN_STEP:
        place = step.astype(float)  # the rest is jitter
    arrives = np.ceil(place + delays / period - TOLERANCE).astype(np.int64)
    used = in_use(arrives)
    since = np.diff(step[used], prepend=-1)
    travel, new = np.maximum(arrives - step, 0)[used], since > 0  # a faster sensor makes several in a step
    return tuple(zip(travel[new].tolist(), since[new].tolist(), strict=True))


def of_each_step(replayed: tuple[tuple[int, int], ...]) -> list[int]:
    """Return a delay for each control step, such that `recorded` under the rule `newest` shows the ages of the log.

    What is missing in a step arrives together with the observation after it.
    """
    return [travel + missing for travel, since in replayed for missing in range(since - 1, -1, -1)]
