"""A bundle's policy as an ONNX graph, built node by node and run with onnxruntime on one thread.

The graph maps (obs [S], actions [Δ, A], age []) to an action [A]. It is stateless, works in the task's units, and may
hold metadata. It computes the same folded form as `numpy_policy`, with standard operators of opset 17 only and
without control flow.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delayrl.deploy.backends.network import Act, Arrays, Network
from delayrl.deploy.backends.numpy_policy import Encoder, Layer, fold, layer_norms, layers
from delayrl.errors import one_line

OPSET, IR = 17, 8


class Graph:
    """Collect nodes and constants. Their names number them in order of creation."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: ArrayLike, kind: Any = np.float32) -> str:
        """Add an array; return its name, an input for nodes."""
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def __call__(self, operator: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        from onnx import helper

        output = output or f"x{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def linear(self, layer: Layer, x: str) -> str:
        """Add x w + b; return its name."""
        return self("Add", self("MatMul", x, self.constant(layer[0])), self.constant(layer[1]))

    def mlp(self, layers: list[Layer], x: str, norms: Sequence[Layer] = ()) -> str:
        """Add an MLP with ReLU between its layers, and layer norms before them if there are any; return its name."""
        for i, layer in enumerate(layers[:-1]):
            x = self.linear(layer, x)
            x = self("Relu", self.norm(x, *norms[i]) if norms else x)
        return self.linear(layers[-1], x)

    def norm(self, x: str, scale: ArrayLike, shift: ArrayLike) -> str:
        """Add a layer norm; return its name."""
        return self("LayerNormalization", x, self.constant(scale), self.constant(shift), axis=-1, epsilon=1e-5)


def onnx_graph(network: Network, arrays: Arrays, metadata: Mapping[str, Any]) -> bytes:
    """Return the serialised model. Raises DelayRLError if the package `onnx` is not installed."""
    with one_line("the graph cannot be made"):
        import onnx
        from onnx import TensorProto, helper
    graph = Graph()
    low, high = np.asarray(network.low, np.float32), np.asarray(network.high, np.float32)
    delayed = graph("Greater", "age", graph.constant(0, np.int64))
    row = graph("Reshape", "obs", graph.constant([1, network.obs_size], np.int64))
    if network.input == "observation":
        raw = graph.mlp(layers(arrays, "head"), row)
    else:
        shifted = graph("Mul", graph("Sub", "actions", graph.constant(low)), graph.constant(2 / (high - low)))
        scaled = graph("Sub", shifted, graph.constant(1))
        if network.input == "transformer":
            encoder, head = fold(network, arrays)
            x = _encoded(graph, encoder, row, scaled)
        else:
            head, x = layers(arrays, "head"), _augmented(graph, network, row, scaled)
        if network.input == "forecast":
            change = graph.mlp(layers(arrays, "forecast"), x, layer_norms(arrays, "forecast"))
            x = graph("Where", delayed, graph("Add", row, change), row)
        raw = graph.mlp(head, x)
    if current := layers(arrays, "current"):
        raw = graph("Where", delayed, raw, graph.mlp(current, row))
    unit = graph("Reshape", graph("Tanh", raw), graph.constant([network.action_size], np.int64))
    gained = graph("Mul", graph("Add", unit, graph.constant(1)), graph.constant((high - low) / 2))
    action = graph("Add", gained, graph.constant(low))
    graph("Min", action, graph.constant(high), output="action")  # rounding may have brought it beyond

    declare, real = helper.make_tensor_value_info, TensorProto.FLOAT
    inputs = [declare("obs", real, [network.obs_size])]
    inputs += [declare("actions", real, [network.max_age, network.action_size]), declare("age", TensorProto.INT64, [])]
    outputs = [declare("action", real, [network.action_size])]
    body = helper.make_graph(graph.nodes, "delayrl", inputs, outputs, graph.constants)
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(body, producer_name="delayrl", opset_imports=opsets, ir_version=IR)
    helper.set_model_props(model, {"delayrl": json.dumps(metadata, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def onnx_policy(network: Network, arrays: Arrays) -> Act:
    """Return the policy as a function: a graph of the checked arrays, run on one thread.

    A file with a graph is never run. It could hang, fill the memory, or act otherwise on inputs that no check has met.
    Raises DelayRLError if onnx or onnxruntime is not installed.
    """
    with one_line("the backend onnx cannot be imported"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    model = onnx_graph(network, arrays, {})
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    def act(obs: NDArray[np.float32], actions: NDArray[np.float32], age: int) -> NDArray[np.float32]:
        return session.run(["action"], {"obs": obs, "actions": actions, "age": np.asarray(age, np.int64)})[0]

    return act


def _augmented(graph: Graph, network: Network, row: str, scaled: str) -> str:
    slots = graph.constant(np.arange(network.max_age)[:, None], np.int64)
    known = graph("Where", graph("Less", slots, "age"), scaled, graph.constant(0))
    flat = graph("Reshape", known, graph.constant([1, -1], np.int64))
    share = graph("Div", graph("Cast", "age", to=1), graph.constant(network.max_age))
    return graph("Concat", row, flat, graph("Reshape", share, graph.constant([1, 1], np.int64)), axis=1)


def _encoded(graph: Graph, encoder: Encoder, row: str, scaled: str) -> str:
    """Return the last token's output, [1, width]. At age 0 it is computed from one token, and not used."""
    width = encoder.obs.shape[1]
    ones, zeros = np.ones(width, np.float32), np.zeros(width, np.float32)
    start, end = graph.constant([0], np.int64), graph.constant([2**31], np.int64)
    age = graph("Reshape", graph("Max", "age", graph.constant(1, np.int64)), graph.constant([1], np.int64))

    def norm(x: str, scale: ArrayLike = ones, shift: ArrayLike = zeros) -> str:
        return graph.norm(x, scale, shift)

    tokens = graph("MatMul", graph("Slice", scaled, start, age), graph.constant(encoder.action))
    tokens = graph("Add", tokens, graph("Slice", graph.constant(encoder.position), start, age))
    x = norm(graph("Add", tokens, graph("MatMul", row, graph.constant(encoder.obs))), *encoder.norm_in)
    length = len(encoder.position)
    future = graph.constant(np.triu(np.full((length, length), -np.inf), 1))
    both = graph("Concat", age, age, axis=0)
    future = graph("Slice", future, graph.constant([0, 0], np.int64), both, graph.constant([0, 1], np.int64))
    for i, block in enumerate(encoder.blocks):
        asking = x = norm(x, block.scale, block.shift)
        if i == len(encoder.blocks) - 1:
            asking = graph("Slice", x, graph.constant([-1], np.int64), end, start)
        scores = graph("MatMul", graph.linear(block.attend, asking), graph("Transpose", x, perm=[1, 0]))
        if i < len(encoder.blocks) - 1:
            scores = graph("Add", scores, future)
        mixed = graph("MatMul", graph("Softmax", scores, axis=-1), x)
        x = graph("Add", asking, graph.linear(block.value, mixed))
        hidden = graph.linear(block.first, norm(x))
        bell = graph("Add", graph("Erf", graph("Mul", hidden, graph.constant(0.5**0.5))), graph.constant(1))
        gelu = graph("Mul", graph("Mul", hidden, bell), graph.constant(0.5))
        x = graph("Add", x, graph.linear(block.second, gelu))
    return norm(x)
