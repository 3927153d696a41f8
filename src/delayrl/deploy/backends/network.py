"""What network a bundle holds: a description in plain numbers, and the arrays that it asks for."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.errors import DelayRLError

Arrays = Mapping[str, NDArray[np.float32]]
Act = Callable[[NDArray[np.float32], NDArray[np.float32], int], NDArray[np.float32]]
"""obs [S], actions [Δ, A] in the task's units, age -> action [A] in the task's units."""
INPUTS = ("observation", "augmented", "transformer")
LONGEST_AGE, LARGEST_HISTORY = 10_000, 10_000_000
"""No policy has more steps, or numbers, in its history: a small file must not ask for much memory."""


@dataclass(frozen=True)
class Network:
    """A deterministic policy: tanh of an MLP with ReLU, scaled from [-1, 1] to low .. high.

    Attributes:
        obs_size, action_size: S and A.
        max_age: Δ, the longest age that it was trained for.
        low, high: the range of the actions, [A], in the task's own units.
        input: what the MLP `head` reads: "observation" [S]; "augmented" [S + Δ·A + 1], the observation, the scaled
            actions since (zeros after the first `age`) and age / Δ; or "transformer" [width], what the encoder gives at
            the age.
        hidden: widths of the head's hidden layers.
        current: those of an MLP on the observation that acts instead at age 0; None where there is no such MLP.
        width, blocks: of the encoder; 0 where there is none.
    """

    obs_size: int
    action_size: int
    max_age: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    input: str
    hidden: tuple[int, ...]
    current: tuple[int, ...] | None = None
    width: int = 0
    blocks: int = 0

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all its arrays: `head.0.w` maps from the rows' index to the columns'."""
        found: dict[str, tuple[int, ...]] = {}

        def layer(name: str, inputs: int, outputs: int) -> None:
            found[f"{name}.w"], found[f"{name}.b"] = (inputs, outputs), (outputs,)

        def mlp(name: str, inputs: int, hidden: tuple[int, ...]) -> None:
            for i, (rows, columns) in enumerate(itertools.pairwise((inputs, *hidden, self.action_size))):
                layer(f"{name}.{i}", rows, columns)

        def norm(name: str) -> None:
            found[f"{name}.scale"] = found[f"{name}.shift"] = (self.width,)

        sizes = {
            "observation": self.obs_size,
            "augmented": self.obs_size + self.max_age * self.action_size + 1,
            "transformer": self.width,
        }
        mlp("head", sizes[self.input], self.hidden)
        if self.current is not None:
            mlp("current", self.obs_size, self.current)
        if self.input == "transformer":
            layer("encoder.obs", self.obs_size, self.width)
            layer("encoder.action", self.action_size, self.width)
            layer("encoder.join", 2 * self.width, self.width)
            found["encoder.position"] = (self.max_age, self.width)
            norm("encoder.norm_in")
            norm("encoder.norm_out")
            for i in range(self.blocks):
                block = f"encoder.blocks.{i}"
                norm(f"{block}.norm1")
                norm(f"{block}.norm2")
                layer(f"{block}.qkv", self.width, 3 * self.width)
                for name in ("out", "mlp.0", "mlp.1"):
                    layer(f"{block}.{name}", self.width, self.width)
        return found

    def check(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """DelayRLError where the arrays are not this network's: another name, shape or type, or a number not finite."""
        shapes = self.shapes()
        for name in sorted(shapes.keys() ^ arrays.keys()):
            raise DelayRLError(f"the weights {'lack' if name in shapes else 'have an unknown'} array {name[:80]!r}")
        for name, shape in shapes.items():
            array = arrays[name]
            if array.shape != shape or array.dtype != np.float32:
                found = f"{array.dtype}{list(array.shape)}"
                raise DelayRLError(f"the weights' {name} is {found}, expected float32{list(shape)}")
            if not np.isfinite(array).all():
                raise DelayRLError(f"the weights' {name} holds numbers that are not finite")

    def document(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}


def parse(document: Any) -> Network:
    """The network of a `document`; whatever is not as it must be is a DelayRLError."""
    if not isinstance(document, dict):
        raise DelayRLError("its policy is not described")

    def whole(name: str, least: int, value: Any, most: int = 1_000_000) -> int:
        if type(value) is not int or not least <= value <= most:
            raise DelayRLError(f"its policy's {name} must be a whole number in {least} .. {most}")
        return value

    def widths(name: str) -> tuple[int, ...]:
        given = document.get(name)
        if not isinstance(given, list) or len(given) > 100:
            raise DelayRLError(f"its policy's {name} must be a list of at most 100 widths")
        return tuple(whole(name, 1, value) for value in given)

    def bounds(name: str, count: int) -> tuple[float, ...]:
        given = document.get(name)
        if not isinstance(given, list) or len(given) != count or not all(type(x) in (int, float) for x in given):
            raise DelayRLError(f"its policy's {name} must be {count} numbers")
        if not all(abs(x) < 1e30 for x in given):  # what is not a number is not below anything
            raise DelayRLError(f"its policy's {name} must be finite")
        return tuple(np.asarray(given, np.float32).tolist())

    sizes = {n: whole(n, least, document.get(n)) for n, least in (("obs_size", 1), ("action_size", 1), ("max_age", 0))}
    low, high = (bounds(name, sizes["action_size"]) for name in ("low", "high"))
    if not all(b - a > 1e-30 for a, b in zip(low, high, strict=True)):
        raise DelayRLError("its policy's low must lie below its high")
    if sizes["max_age"] > LONGEST_AGE or sizes["max_age"] * sizes["action_size"] > LARGEST_HISTORY:
        raise DelayRLError(f"its policy's max_age is above {LONGEST_AGE:,}, or its history too large")
    kind = document.get("input")
    if kind not in INPUTS or (sizes["max_age"] == 0 and kind != "observation"):
        raise DelayRLError(f"its policy's input must be one of {', '.join(INPUTS)}; the latter two need an age")
    if kind == "transformer" and document.get("current") is None:
        raise DelayRLError("its policy's input is transformer, which gives nothing at age 0: it needs a current")
    least = int(kind == "transformer")
    return Network(
        **sizes,
        low=low,
        high=high,
        input=kind,
        hidden=widths("hidden"),
        current=None if document.get("current") is None else widths("current"),
        width=whole("width", least, document.get("width")),
        blocks=whole("blocks", least, document.get("blocks"), 1000),
    )
