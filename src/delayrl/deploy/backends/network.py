"""The description of a bundle's network in plain numbers, and the arrays that it needs."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError

Arrays = Mapping[str, NDArray[np.float32]]
Act = Callable[[NDArray[np.float32], NDArray[np.float32], int], NDArray[np.float32]]
"""Maps obs [S], actions [Δ, A] and the age to an action [A]; actions are in the task's units."""
INPUTS = ("observation", "augmented", "forecast", "transformer")
LONGEST_AGE, LARGEST_HISTORY = 10_000, 10_000_000
"""Bounds of the steps, and of the numbers, in a policy's history: a small file must not ask for much memory."""


@dataclass(frozen=True)
class Network:
    """Describe a deterministic policy: tanh of an MLP with ReLU, scaled from [-1, 1] to low .. high.

    `input` is what the MLP `head` reads: "observation" [S]; "augmented" [S + Δ·A + 1], which is the observation, the
    scaled actions since (zeros after the first `age`) and age / Δ; "forecast" [S], the observation plus, above
    age 0, the output of the MLP `forecast`, which reads that vector and has a layer norm before each ReLU; or
    "transformer" [width], the encoder's output at the age. A last MLP, `current`, may act at age 0. It reads the
    observation.
    """

    obs_size: int  # S
    action_size: int  # A
    max_age: int  # Δ, the longest age that it was trained for, in steps
    low: tuple[float, ...]  # the range of the actions, [A], in the task's units
    high: tuple[float, ...]
    input: str
    hidden: tuple[int, ...]  # widths of the head's hidden layers
    current: tuple[int, ...] | None = None  # widths of its hidden layers; None if there is no such MLP
    width: int = 0  # sizes of the encoder; 0 if there is none
    blocks: int = 0
    forecast: tuple[int, ...] | None = None  # widths of its hidden layers; None if there is no such MLP

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the names and shapes of all arrays. Weights such as `head.0.w` are [inputs, outputs]."""
        shapes: dict[str, tuple[int, ...]] = {}

        def layer(name: str, inputs: int, outputs: int) -> None:
            shapes[f"{name}.w"], shapes[f"{name}.b"] = (inputs, outputs), (outputs,)

        def mlp(name: str, inputs: int, hidden: tuple[int, ...], outputs: int = self.action_size) -> None:
            for i, (rows, columns) in enumerate(itertools.pairwise((inputs, *hidden, outputs))):
                layer(f"{name}.{i}", rows, columns)

        def norm(name: str, width: int = self.width) -> None:
            shapes[f"{name}.scale"] = shapes[f"{name}.shift"] = (width,)

        augmented = self.obs_size + self.max_age * self.action_size + 1
        mlp("head", {"augmented": augmented, "transformer": self.width}.get(self.input, self.obs_size), self.hidden)
        if self.current is not None:
            mlp("current", self.obs_size, self.current)
        if self.forecast is not None:
            mlp("forecast", augmented, self.forecast, self.obs_size)
            for i, width in enumerate(self.forecast):
                norm(f"forecast.{i}.norm", width)
        if self.input == "transformer":
            layer("encoder.obs", self.obs_size, self.width)
            layer("encoder.action", self.action_size, self.width)
            layer("encoder.join", 2 * self.width, self.width)
            shapes["encoder.position"] = (self.max_age, self.width)
            norm("encoder.norm_in")
            norm("encoder.norm_out")
            for i in range(self.blocks):
                block = f"encoder.blocks.{i}"
                norm(f"{block}.norm1")
                norm(f"{block}.norm2")
                layer(f"{block}.qkv", self.width, 3 * self.width)
                for name in ("out", "mlp.0", "mlp.1"):
                    layer(f"{block}.{name}", self.width, self.width)
        return shapes

    def check(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Raise DelayRLError unless the arrays have this network's names and shapes, in finite float32 numbers."""
        shapes = self.shapes()
        for name in sorted(shapes.keys() ^ arrays.keys()):
            raise DelayRLError(f"the weights {'lack' if name in shapes else 'have an unknown'} array {name[:80]!r}")
        for name, shape in shapes.items():
            array = arrays[name]
            if array.shape != shape or array.dtype != np.float32:
                given = f"{array.dtype}{list(array.shape)}"
                raise DelayRLError(f"the weights' {name} is {given}, expected float32{list(shape)}")
            if not np.isfinite(array).all():
                raise DelayRLError(f"the weights' {name} holds numbers that are not finite")

    def document(self) -> dict[str, Any]:
        """Return the description as JSON can hold it."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}


def parse(document: Any) -> Network:
    """Return the network that a `document` describes. Raises DelayRLError for anything that does not fit."""
    if not isinstance(document, dict):
        raise DelayRLError("its policy is not described")

    def integer(name: str, least: int, value: Any, most: int = 1_000_000) -> int:
        if type(value) is not int or not least <= value <= most:
            raise DelayRLError(f"its policy's {name} must be a whole number in {least} .. {most}")
        return value

    def widths(name: str) -> tuple[int, ...]:
        given = document.get(name)
        if not isinstance(given, list) or len(given) > 100:
            raise DelayRLError(f"its policy's {name} must be a list of at most 100 widths")
        return tuple(integer(name, 1, value) for value in given)

    def bounds(name: str, count: int) -> tuple[float, ...]:
        given = document.get(name)
        if not isinstance(given, list) or len(given) != count or not all(type(x) in (int, float) for x in given):
            raise DelayRLError(f"its policy's {name} must be {count} numbers")
        if not all(abs(x) < 1e30 for x in given):  # NaN is below nothing
            raise DelayRLError(f"its policy's {name} must be finite")
        return tuple(np.asarray(given, np.float32).tolist())

    bounded = (("obs_size", 1), ("action_size", 1), ("max_age", 0))
    sizes = {name: integer(name, least, document.get(name)) for name, least in bounded}
    low, high = (bounds(name, sizes["action_size"]) for name in ("low", "high"))
    if not all(b - a > 1e-30 for a, b in zip(low, high, strict=True)):
        raise DelayRLError("its policy's low must lie below its high")
    if sizes["max_age"] > LONGEST_AGE or sizes["max_age"] * sizes["action_size"] > LARGEST_HISTORY:
        raise DelayRLError(f"its policy's max_age is above {LONGEST_AGE:,}, or its history too large")
    kind = document.get("input")
    if kind not in INPUTS or (sizes["max_age"] == 0 and kind != "observation"):
        raise DelayRLError(f"its policy's input must be one of {', '.join(INPUTS)}; all but the first need an age")
    if kind == "transformer" and sizes["max_age"] ** 2 > LARGEST_HISTORY:
        raise DelayRLError(f"its policy's max_age is too large for a transformer: {sizes['max_age']:,} steps")
    if kind == "transformer" and document.get("current") is None:
        raise DelayRLError("its policy's input is transformer, which has no output at age 0: it needs a current")
    hidden = widths("hidden")
    current = None if document.get("current") is None else widths("current")
    if (kind == "forecast") != (document.get("forecast") is not None):
        raise DelayRLError("its policy needs a forecast if its input is forecast, and must have none otherwise")
    forecast = widths("forecast") if kind == "forecast" else None
    least = int(kind == "transformer")
    width = integer("width", least, document.get("width"))
    blocks = integer("blocks", least, document.get("blocks"), 1000)
    counts = {**sizes, "width": width, "blocks": blocks}
    return Network(**counts, low=low, high=high, input=kind, hidden=hidden, current=current, forecast=forecast)
