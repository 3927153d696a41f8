"""Matrix products of a program, and how often it runs them, found from its trace: nothing is compiled or computed."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from numpy.typing import NDArray

from delayrl.agents.base import Agent, Phase, template
from delayrl.core import replay as ring
from delayrl.core.types import Spec

Value = NDArray[Any] | None
"""A scalar of a program in each of C updates, [C] or one for all; None if it depends on data."""


class Product(NamedTuple):
    """A matrix product: its equation, and how often it runs in each of C updates, [C] or a number."""

    equation: Any
    times: NDArray[np.float64] | float

    @property
    def flops(self) -> float:
        """Its multiplications and additions, in the mean over the updates."""
        (contracted, _), _ = self.equation.params["dimension_numbers"]
        inner = math.prod(self.equation.invars[0].aval.shape[axis] for axis in contracted)
        return float(2 * inner * math.prod(self.equation.outvars[0].aval.shape) * np.mean(self.times))


SCALAR: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "rem": np.fmod,
    "div": np.true_divide,
    "convert_element_type": lambda x: np.multiply(x, 1),  # booleans become numbers
    "sign": np.sign,
    "min": np.minimum,
    "max": np.maximum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
}
"""The operations that decide which branch an update takes."""


@functools.lru_cache(4)  # a run needs the traces several times
def traced_updates(agent: Agent, spec: Spec) -> list[tuple[Phase, Any]]:
    """Return each phase with the trace of its update for one seed (`jax.stages.Traced`). Touches no device."""
    shapes = [(phase, update_shapes(phase, agent, spec)) for phase in agent.phases()]
    with jax.default_matmul_precision("float32"):  # in bfloat16 gradients that XLA deletes are written out
        return [(phase, jax.jit(phase.update).trace(*args)) for phase, args in shapes]


def update_shapes(phase: Phase, agent: Agent, spec: Spec) -> tuple[Any, ...]:
    """Return the shapes and types of the arguments of a phase's update for one seed. Touches no device."""
    reach = (phase.batch, spec.delay, agent.ahead(spec))
    replay = jax.eval_shape(lambda: ring.init(spec, 2))
    key, number = jax.eval_shape(lambda: jax.random.key(0)), jax.ShapeDtypeStruct((), jnp.int32)
    windows = jax.eval_shape(lambda replay, key, hidden: ring.sample(replay, key, *reach, hidden), replay, key, number)
    return template(agent, spec), windows, key, number


def matmul_flops(function: Callable[..., Any], *args: Any) -> float:
    """Count the multiplications and additions of all matrix products of a function on arguments of these shapes."""
    with jax.default_matmul_precision("float32"):
        products, _ = follow(jax.make_jaxpr(function)(*args).jaxpr)
    return sum(product.flops for product in products)


def follow(program: Any, inputs: Sequence[Value] = ()) -> tuple[list[Product], list[Value]]:
    """Follow a program: find its matrix products, and compute its integers as far as they are known.

    A branch counts where it is taken, or, if that depends on data, as the mean of its cases. A loop counts as often as
    it runs: NaN times if that depends on data.

    Args:
        program: a jaxpr.
        inputs: its inputs, None where they are unknown; empty if all are.

    Returns:
        The products, and the outputs as far as they are known.
    """
    known: dict[Any, Value] = dict(zip(program.invars, inputs, strict=bool(inputs)))
    products: list[Product] = []

    def value(x: Any) -> Value:
        if not isinstance(x, Literal):
            return known.get(x)
        return np.asarray(x.val) if np.shape(x.val) == () else None

    for equation in program.eqns:
        name, params = equation.primitive.name, equation.params
        values = [value(x) for x in equation.invars]
        outputs: Sequence[Value] = ()
        if name == "dot_general":
            products.append(Product(equation, 1.0))
        elif name == "cond":
            found, outputs = _follow_branches(params["branches"], *values)
            products += found
        elif name in SCALAR and all(x is not None for x in values):
            outputs = [_computed(equation, *values)] if equation.outvars[0].aval.shape == () else ()
        else:
            for inside in _programs(list(params.values())):
                once = name not in ("scan", "while") and len(inside.invars) == len(values)
                found, outputs = follow(inside, values if once else ())
                outputs = outputs if once else ()
                repeats = np.nan if name == "while" else params.get("length", 1)
                products += [Product(p.equation, p.times * repeats) for p in found]
        known |= zip(equation.outvars, outputs, strict=bool(outputs))
    return products, [value(x) for x in program.outvars]


def _computed(equation: Any, *values: Any) -> Value:
    """Return the scalar that an operation gives, of its type where it is known; None if NumPy has no such operation."""
    name, made = equation.primitive.name, equation.outvars[0].aval.dtype
    try:
        result = np.asarray(SCALAR[name](*values))
    except TypeError:  # such as bits of a mean over branches
        return None
    if jnp.issubdtype(made, jnp.bool_):
        return result != 0
    if not jnp.issubdtype(made, jnp.integer):
        return result
    if name == "div" or jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating):
        result = np.trunc(result)  # towards 0, as XLA does
    exact = np.isfinite(result) & (result == np.trunc(result))
    return result.astype(np.int64).astype(made) if exact.all() else result


def _follow_branches(branches: Sequence[Any], index: Value, *inputs: Value) -> tuple[list[Product], list[Value]]:
    products, results = [], []
    for number, branch in enumerate(branches):
        found, outputs = follow(branch.jaxpr, inputs)
        taken = 1 / len(branches) if index is None else (index == number).astype(float)
        products += [Product(p.equation, p.times * taken) for p in found]
        results.append(outputs)
    values = [_merge(index, xs) for xs in zip(*results, strict=True)]
    return products, values


def _merge(index: Value, values: Sequence[Value]) -> Value:
    """Return an output of branches: of the branch that is taken, NaN where that is unknown; else the mean of all."""
    if all(x is None for x in values) or (index is None and any(x is None for x in values)):
        return None
    if index is None:
        return np.mean(np.broadcast_arrays(*values), axis=0)  # type: ignore[arg-type]
    return np.choose(index, [np.nan if x is None else x for x in values])


def _programs(values: Any) -> list[Any]:
    """Return the programs among the parameters of an operation."""
    if isinstance(values, tuple | list):
        return [program for value in values for program in _programs(value)]
    values = getattr(values, "jaxpr", values)  # closed or not
    return [values] if hasattr(values, "eqns") else []
