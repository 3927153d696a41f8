"""Run a bundle's policy.onnx with onnxruntime, on one thread."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.deploy.backends.network import Act, Network
from delayrl.errors import DelayRLError, first_line

LOCATION = b"location"
"""The key with which a graph refers to a file with its numbers. Older versions of onnxruntime would read any file."""


def onnx_policy(network: Network, model: bytes, reference: Act) -> Act:
    """Return the policy in the graph as a function.

    The graph may come from anywhere. Its inputs and outputs must be those of our graphs, and its actions must agree
    with `reference`, the policy in the weights, on a few inputs.

    Raises:
        DelayRLError: onnxruntime is not installed, or the graph is not this policy.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise DelayRLError("the backend onnx needs the package onnxruntime: pip install 'delayrl[deploy]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.load_model_format", "ONNX")
    if LOCATION in model:
        raise DelayRLError("it refers to another file")
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no common name
        raise DelayRLError(f"onnxruntime cannot load it ({_quoted(error)})") from error
    given = [(x.name, x.type, x.shape) for x in (*session.get_inputs(), *session.get_outputs())]
    expected: list[Any] = [
        ("obs", "tensor(float)", [network.obs_size]),
        ("actions", "tensor(float)", [network.max_age, network.action_size]),
        ("age", "tensor(int64)", []),
        ("action", "tensor(float)", [network.action_size]),
    ]
    if given != expected:
        raise DelayRLError("its inputs and outputs are not obs, actions, age and action in the policy's sizes")

    def act(obs: NDArray[np.float32], actions: NDArray[np.float32], age: int) -> NDArray[np.float32]:
        return session.run(["action"], {"obs": obs, "actions": actions, "age": np.asarray(age, np.int64)})[0]

    random = np.random.default_rng(0)
    low, high = np.asarray(network.low, np.float32), np.asarray(network.high, np.float32)
    for age in sorted({0, 1, network.max_age // 2, network.max_age} & set(range(network.max_age + 1))):
        obs = random.standard_normal(network.obs_size).astype(np.float32)
        actions = random.uniform(low, high, (network.max_age, network.action_size)).astype(np.float32)
        try:
            same = np.abs(act(obs, actions, age) - reference(obs, actions, age)) <= 1e-3 * (high - low)
        except Exception as error:
            raise DelayRLError(f"it does not run ({_quoted(error)})") from error
        if not same.all():
            raise DelayRLError("it gives other actions than the weights beside it")
    return act


def _quoted(error: Exception) -> str:
    return repr(first_line(error)[:120])  # it may contain text of the graph
