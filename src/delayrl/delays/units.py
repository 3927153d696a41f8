"""Delays in words: steps where a time was given, and a time where steps were."""

from delayrl.delays.channels import Delay
from delayrl.delays.text import DelayLike, as_delay
from delayrl.errors import DelayRLError, count


def in_other_unit(given: DelayLike, delay: Delay, step_seconds: float) -> str:
    """Say how long a delay is in the unit that was not given.

    Args:
        given: what the user wrote, `80` or `80ms`.
        delay: what it was read as.
        step_seconds: the length of an environment step.

    Returns:
        "80 steps = 3.2 s" for a delay in steps, "2 steps of 40 ms" for one in time; of a random delay the longest. If
        a time becomes more than a number of steps, the law comes first: "episode:2:3, up to 3 steps of 40 ms".
    """
    steps = count(delay.maximum, "step")
    if not (delay.observation.constant and delay.action.constant):
        steps = f"up to {steps}"
    try:
        as_delay(given)
    except DelayRLError:  # a time, which cannot be read without the length of a step
        law = "" if str(delay) == str(delay.maximum) else f"{delay.label()}, "
        return f"{law}{steps} of {_time(step_seconds)}"
    return f"{steps} = {_time(delay.maximum * step_seconds)}"


def _time(seconds: float) -> str:
    return f"{seconds:.4g} s" if seconds >= 1 else f"{1000 * seconds:.4g} ms"
