"""ONNX: a graph of Gemm, Relu or Tanh, Mul, Add, Max and Min, built node by node.

A convolution gathers its windows, and a memory is a GRU with its state as input and output.
"""

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ..convolutions import Convolution, Encoder
from ..layers import BRIGHTEST, Affine, Layer, Scaling
from ..memory import GRU
from ..policies import NetworkPolicy, flat_size
from . import write_layers

OPSET = 13  # the first in which ArgMax, Max and Min are as they are today
_IR = 7  # the format of files that came with this opset


class _Graph:
    """Nodes in a row, and the constants that they use.

    Attributes:
        at: Name of the last output.
    """

    def __init__(self, size: int) -> None:
        """For observations of a size."""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.at = "observation"
        self._size = size

    def node(self, operator: str, *names: str, **attributes: int) -> str:
        """Append a node on some inputs; the name of its output."""
        self.at = f"x{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [self.at], **attributes))  # type: ignore[arg-type]
        return self.at

    def then(self, operator: str, *constants: np.ndarray, **attributes: int) -> str:
        """Append a node on the last output and some constants; the name of its output."""
        names = [self._kept(constant) for constant in constants]
        return self.node(operator, self.at, *names, **attributes)

    def affine(self, layer: Affine) -> None:
        self.then("Gemm", layer.weight[:, 1:], layer.weight[:, 0], transB=1)

    def relu(self, layer: Layer) -> None:
        self.then("Relu")

    def tanh(self, layer: Layer) -> None:
        self.then("Tanh")

    def encoder(self, layer: Encoder) -> None:
        """Each array by its own layers, joined."""
        inputs = self.at
        parts = []
        for chain, taken in zip(layer.chains, layer.taken, strict=True):
            self.at = inputs
            if not chain.layers:
                self.then("Gather", np.arange(taken.start, taken.stop), axis=1)
            write_layers(self, chain.layers)
            parts.append(self.at)
        self.node("Concat", *parts, axis=1)

    def convolution(self, layer: Convolution) -> None:
        """Weights times all windows, (batch, filters, places), flat."""
        self.then("Gather", layer.places[1:] - 1, axis=1)
        windows = self.at
        self.at = self._kept(layer.weight[:, 1:])
        self.node("MatMul", self.at, windows)
        self.then("Add", layer.weight[:, :1])
        self.then("Flatten")

    def gru(self, layer: GRU) -> None:
        """A step from `state` to `next_state`."""
        axis = np.zeros(1, np.int64)
        step = self.then("Unsqueeze", axis)
        self.at = "state"
        state = self.then("Unsqueeze", axis)
        bias = np.append(layer.weight[:, 0], np.zeros_like(layer.weight[:, 0]))
        arrays = [layer.weight[:, 1:], layer.recurrent, bias]
        names = [self._kept(array[np.newaxis]) for array in arrays]
        settings = {"hidden_size": layer.units, "linear_before_reset": 1}
        inputs = [step, *names, "", state]
        self.nodes.append(helper.make_node("GRU", inputs, ["", "recalled"], **settings))  # type: ignore[arg-type]
        self.at = "recalled"
        self.then("Squeeze", axis)
        self.nodes[-1].output[0] = self.at = "next_state"

    def scaling(self, layer: Scaling) -> None:
        """2 m / (1 + m x / 2) - m / 2 + f x / (1 + |l x|), where m is 1 and f is 0 for a distance;
        for others m is 0, and f is 1 / 255 for a picture, or 1; l is one over the reach of a
        length, or 0.

        A distance below 0 counts as 0.
        """
        mask = np.zeros((1, self._size), np.float32)
        for place in layer.distances:
            mask[:, place] = 1.0
        factor = np.float32(1.0) - mask
        for place in layer.pictures:
            factor[:, place] /= BRIGHTEST
        softer = np.zeros_like(mask)
        for place in layer.lengths:
            softer[:, place] = 1.0 / layer.reach
            factor[:, place] /= layer.unit
        half = np.float32(0.5)
        self.then("Mul", half * mask)
        self.then("Relu")
        self.then("Add", np.ones_like(mask))
        self.then("Reciprocal")
        self.then("Mul", mask / half)
        seen = self.then("Add", -half * mask)
        self.at = "observation"
        self.then("Mul", softer)
        self.then("Abs")
        softened = self.then("Add", np.ones_like(mask))
        self.at = "observation"
        self.then("Mul", factor)
        others = self.node("Div", self.at, softened)
        self.node("Add", seen, others)

    def _kept(self, constant: np.ndarray) -> str:
        """The name of a new constant."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(constant, name))
        return name


def write(policy: NetworkPolicy, facts: Mapping[str, str]) -> bytes:
    """A model: `observation` (batch, n), float32, to `action`, (batch, k), float32.

    A discrete action is int64, (batch,). With a memory there is also `state`, (batch, H), which is
    0 when an episode begins, to `next_state`.
    """
    size = flat_size(policy.spec)
    graph = _Graph(size)
    actions = policy.actions
    write_layers(graph, policy.layers)
    kind: int = TensorProto.INT64
    shape: list[str | int | None] = ["batch"]
    if actions.discrete:
        graph.then("ArgMax", axis=1, keepdims=0)
    else:
        graph.then("Mul", actions.half)
        graph.then("Add", actions.middle)
        graph.then("Max", actions.low)
        graph.then("Min", actions.high)
        kind = TensorProto.FLOAT
        shape.append(actions.outputs)
    graph.nodes[-1].output[0] = "action"
    inputs = [_value("observation", "batch", size)]
    outputs = [helper.make_tensor_value_info("action", kind, shape)]
    if policy.memory:
        inputs.append(_value("state", "batch", policy.memory.units))
        outputs.append(_value("next_state", "batch", policy.memory.units))
    made = helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(made, producer_name="rotorgram", opset_imports=[opset])
    model.ir_version = _IR
    helper.set_model_props(model, dict(facts))
    return bytes(model.SerializeToString(deterministic=True))


def _value(name: str, *shape: str | int) -> onnx.ValueInfoProto:
    """An input or output of float32."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
