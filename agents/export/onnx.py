"""ONNX: a graph of Gemm, Relu or Tanh, Mul, Add, Max and Min, built node by node."""

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ..networks import Affine, Nearness
from ..policies import NetworkPolicy, flat_size

OPSET = 13  # the first in which ArgMax, Max and Min are as they are today
_IR = 7  # the format of files that came with this opset


class _Graph:
    """Nodes in a row, and the constants that they use."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def then(self, operator: str, *constants: np.ndarray, **attributes: int) -> None:
        """Append a node on the last output and some constants."""
        before = self.nodes[-1].output[0] if self.nodes else "observation"
        output = f"x{len(self.nodes)}"
        names = [self._kept(constant) for constant in constants]
        self.nodes.append(helper.make_node(operator, [before, *names], [output], **attributes))  # type: ignore[arg-type]

    def near(self, layer: Nearness, size: int) -> None:
        """2 m / (1 + m x / 2) - m / 2 + (1 - m) x, where m is 1 for a distance and 0 otherwise.

        A distance below 0 counts as 0.
        """
        mask = np.zeros((1, size), np.float32)
        for place in layer.places:
            mask[:, place] = 1.0
        half = np.float32(0.5)
        self.then("Mul", half * mask)
        self.then("Relu")
        self.then("Add", np.ones_like(mask))
        self.then("Reciprocal")
        self.then("Mul", mask / half)
        self.then("Add", -half * mask)
        seen = self.nodes[-1].output[0]
        others = self._kept(np.float32(1.0) - mask)
        self.nodes.append(helper.make_node("Mul", ["observation", others], ["others"]))
        self.nodes.append(helper.make_node("Add", [seen, "others"], ["inputs"]))

    def _kept(self, constant: np.ndarray) -> str:
        """The name of a new constant."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(constant, name))
        return name


def write(policy: NetworkPolicy, facts: Mapping[str, str]) -> bytes:
    """A model: `observation` (batch, n), float32, to `action`, (batch, k), float32.

    A discrete action is int64, (batch,).
    """
    graph = _Graph()
    actions = policy.actions
    for layer in policy.network.layers:
        if isinstance(layer, Affine):
            graph.then("Gemm", layer.weight[:, 1:], layer.weight[:, 0], transB=1)
        elif isinstance(layer, Nearness):
            graph.near(layer, flat_size(policy.spec))
        else:
            graph.then(type(layer).__name__)  # Relu or Tanh
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
    sizes: list[str | int | None] = ["batch", flat_size(policy.spec)]
    made = helper.make_graph(
        graph.nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, sizes)],
        [helper.make_tensor_value_info("action", kind, shape)],
        graph.constants,
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(made, producer_name="rotorgram", opset_imports=[opset])
    model.ir_version = _IR
    helper.set_model_props(model, dict(facts))
    return bytes(model.SerializeToString(deterministic=True))
