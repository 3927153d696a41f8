"""Delays as numbers of environment steps: checked, and converted from times."""

import math
import re
from typing import Any

import numpy as np

from delayrl.errors import DelayRLError

LONGEST = 100_000
"""Steps. A longer delay is a mistake, and buffers for it would fill the memory."""


def whole_steps(steps: Any) -> int:
    """Check a delay. Raises DelayRLError for anything but a whole number of 0 to `LONGEST` steps."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        raise DelayRLError(f"a delay counts whole environment steps; got {steps!r}")
    if steps < 0:
        raise DelayRLError(f"a delay cannot be negative; got {steps:g}")
    if steps > LONGEST:
        raise DelayRLError(f"a delay is at most {LONGEST} steps; got {float(steps):g}")
    return int(steps)


def in_steps(number: float, unit: str, step_seconds: float | None) -> float:
    """Convert a number with a unit ("" for steps, "s" or "ms") to environment steps, without rounding.

    Raises:
        DelayRLError: a time, although the length of a step is unknown.
    """
    if not unit:
        return number
    if not step_seconds:
        raise DelayRLError(
            "the task does not say how long a step is (it has no `dt`): give the delay in steps, or pass step_seconds"
        )
    return number * {"s": 1.0, "ms": 1e-3}[unit] / step_seconds


def rounded_up(steps: float) -> int:
    """Round a delay up to whole steps: a message that arrives between two steps is seen at the later one."""
    if not math.isfinite(steps):
        raise DelayRLError(f"a delay must be finite; got {steps:g} steps")
    # a millionth of a step is rounding error
    return whole_steps(math.ceil(steps - 1e-6) if steps > 0 else math.floor(steps))


def is_number(text: str) -> bool:
    """Tell whether a text is a number, nan or infinity. Callers refuse the last two with messages of their own."""
    number = r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)"
    return bool(re.fullmatch(number, text.strip(), re.IGNORECASE))
