"""What learning costs an agent on a task: known before a run begins, and kept in its configuration."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from delayrl.errors import DelayRLError


@dataclass(frozen=True)
class Cost:
    """An agent's size and its work per environment step, averaged over the steps of a run from its first update on."""

    parameters: int  # trained numbers, without target networks and optimiser states
    gradient_steps: Mapping[str, float]  # of each optimiser, by name
    batches: tuple[int, ...]  # windows per batch, one number for each phase
    flops: float  # of the updates' matrix products, for one seed; NaN if that depends on data

    @property
    def json(self) -> dict[str, Any]:
        """All fields, as a run's configuration holds them."""
        flops = None if math.isnan(self.flops) else self.flops
        return asdict(self) | {"batches": list(self.batches), "flops": flops}

    @classmethod
    def from_json(cls, values: Any) -> Self:
        """Make a cost of stored values. Raises DelayRLError if one is missing or of another type."""
        try:
            steps = {str(name): float(number) for name, number in values["gradient_steps"].items()}
            batches = tuple(int(batch) for batch in values["batches"])
            flops = values["flops"]
            numbers = [float(values["parameters"]), *steps.values(), *batches, 0.0 if flops is None else float(flops)]
            if not all(map(math.isfinite, numbers)):
                raise ValueError("a number is not finite")
            return cls(int(values["parameters"]), steps, batches, math.nan if flops is None else float(flops))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DelayRLError(f"no good cost: {str(values)[:100]}") from error
