"""Configuration: frozen dataclasses are flattened to named options, overridden by name, and rebuilt from JSON."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from delayrl.errors import DelayRLError, did_you_mean, near_names

OLDER: Mapping[str, Any] = {
    "entropy_unit": "scaled",
    "at_age_0": "reference",
    "critic_norm": "none",
    "pull": "moments",
    "encoder": "mlp",
    "forecast_learns_from": "states",
    "forecast_error": "squared",
    "encoder_width": 64,
    "encoder_layers": 2,
    "belief_weight": 0.0,
    "student_optimiser": "rmsprop",
    "temperature": "fixed",
    "temperature_every": 1,
    "update_after": 0,
    "tokens": 0,
    "observation_norm": "none",
}
"""Options that were added later, with what an older configuration means that does not mention them."""

TAKEN = {
    *("agent", "env", "delay", "env_kwargs", "wrappers", "flatten", "preset", "seed", "seeds", "out", "device"),
    *("overwrite", "protocol", "track", "threads", "slim", "start_from", "callback", "progress"),
}
"""The parameters of `delayrl.train`, which takes options by their names too."""


@dataclass(frozen=True)
class Option:
    """One hyperparameter: its name, type (a Python type, or the allowed words), default and meaning."""

    name: str
    kind: Any
    default: Any
    help: str
    bounds: tuple[float, float] = (-math.inf, math.inf)
    scales: bool = False  # whether a run of another length has it in proportion

    def check(self, value: Any) -> Any:
        """Return the value in this option's type. Raises DelayRLError if it does not fit."""
        if getattr(value, "ndim", None) == 0:  # a number of NumPy's
            value = value.item()
        if get_origin(self.kind) is Literal:
            if value not in get_args(self.kind):
                allowed = ", ".join(map(str, get_args(self.kind)))
                raise DelayRLError(f"{self.name} must be one of {allowed}; got {value!r}")
            return value
        if get_origin(self.kind) is tuple:
            inner = get_args(self.kind)
            count = len(inner) if inner[-1] is not Ellipsis else None
            if not isinstance(value, tuple | list) or not value or (count and len(value) != count):
                raise DelayRLError(f"{self.name} takes {count or 'one or more'} numbers; got {value!r}")
            numbers = tuple(Option(self.name, inner[0], None, "", self.bounds).check(item) for item in value)
            if self.name.endswith("_range") and numbers[0] >= numbers[-1]:
                raise DelayRLError(f"{self.name} is LOW HIGH, with LOW below HIGH; got {', '.join(map(str, value))}")
            return numbers
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e308:
            raise DelayRLError(f"{self.name} must be a number; got {value!r}")
        if not self.bounds[0] <= value <= self.bounds[1]:
            low, high = self.bounds
            allowed = f"lie in {low:g} .. {high:g}" if math.isfinite(high) else f"be at least {low:g}"
            raise DelayRLError(f"{self.name} must {allowed}; got {value!r}")
        if self.kind is float:
            return float(value)
        bounded = math.isfinite(self.bounds[0])  # else at least 1, or 0 if that is the default
        least = self.bounds[0] if bounded else 0 if self.default == 0 else 1
        if value != int(value) or value < least:
            raise DelayRLError(f"{self.name} must be a whole number, at least {least:g}; got {value!r}")
        return int(value)


def options(part: Any) -> Iterator[Option]:
    """Yield every option of a dataclass and of the dataclasses inside it, but not the fields marked "fixed"."""
    hints = get_type_hints(type(part), include_extras=True)
    for field in fields(part):
        value, hint = getattr(part, field.name), hints[field.name]
        if is_dataclass(value):
            yield from options(value)
        elif get_origin(hint) is Annotated and get_args(hint)[1] != "fixed":
            kind, words, *more = get_args(hint)
            bounds = next((x for x in more if x != "scales"), Option.bounds)
            yield Option(field.name, kind, value, words, bounds, "scales" in more)


def override(part: Any, values: Mapping[str, Any]) -> Any:
    """Return the dataclass with some of its options replaced. Names that it does not have are ignored."""
    changes: dict[str, Any] = {}
    known = {option.name: option for option in options(part)}
    for field in fields(part):
        if is_dataclass(value := getattr(part, field.name)):
            changes[field.name] = override(value, values)
        elif field.name in values and field.name in known:
            changes[field.name] = known[field.name].check(values[field.name])
    return replace(part, **changes)


def check_names(values: Iterable[str], *parts: Any) -> None:
    """Raise DelayRLError, with the nearest names, for a name that is no option of the dataclasses."""
    known = [option.name for part in parts for option in options(part)]
    for name in values:
        if name not in known:
            near = near_names(name, [*known, *sorted(TAKEN - {name})])
            hint = did_you_mean(near, "`delayrl train AGENT --help` lists them")
            raise DelayRLError(f"unknown hyperparameter {name!r}{hint}")


def values_of(part: Any) -> dict[str, Any]:
    """Return all options by name: what `override` needs to rebuild the dataclass."""
    return {option.name: list(o) if isinstance(o := option.default, tuple) else o for option in options(part)}
