"""Compute a bundle's policy with the networks that trained it: for comparison, or where JAX is installed anyway."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from delayrl.core import networks
from delayrl.core.transformer import transformer
from delayrl.deploy.backends.network import Act, Arrays, Network


def jax_policy(network: Network, arrays: Arrays) -> Act:
    """Return the policy as a function, which its first call compiles."""
    params = jax.device_put(_tree(arrays))
    low, high = jnp.asarray(network.low), jnp.asarray(network.high)

    @jax.jit
    def act(params: Any, obs: Any, actions: Any, age: Any) -> Any:
        scaled = 2 * (actions - low) / (high - low) - 1
        scaled = jnp.where((jnp.arange(network.max_age) < age)[:, None], scaled, 0)
        x = obs
        if network.input in ("augmented", "forecast"):
            x = jnp.concatenate([obs, scaled.reshape(-1), (age / network.max_age)[None]])
        if network.input == "forecast":
            x = obs + jnp.where(age > 0, networks.mlp(params["forecast"], x), 0)
        if network.input == "transformer":
            x = transformer(params["encoder"], obs, scaled)[age - 1]
        raw = networks.mlp(params["head"], x)
        if network.current is not None:
            raw = jnp.where(age > 0, raw, networks.mlp(params["current"], obs))
        return low + (jnp.tanh(raw) + 1) / 2 * (high - low)

    def on_host(obs: NDArray[np.float32], actions: NDArray[np.float32], age: int) -> NDArray[np.float32]:
        with jax.default_matmul_precision("float32"):  # a GPU rounds factors to fewer digits by default
            return np.asarray(act(params, obs, actions, np.int32(age)))

    return on_host


def _tree(arrays: Arrays) -> Any:
    """Split names at their dots: return nested dictionaries, or lists where the names are numbers."""
    if "" in arrays:
        return arrays[""]
    groups: dict[str, dict[str, Any]] = {}
    for name, array in arrays.items():
        first, _, rest = name.partition(".")
        groups.setdefault(first, {})[rest] = array
    tree = {name: _tree(group) for name, group in groups.items()}
    return [tree[str(i)] for i in range(len(tree))] if all(name.isdigit() for name in tree) else tree
