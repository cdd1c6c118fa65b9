"""ONNX: a graph of Sub, Mul, Gemm, Relu or Tanh, Add, Max and Min, built node by node."""

from collections.abc import Mapping
from typing import Any, Final

import onnx
import onnx.checker
from onnx import TensorProto, helper, numpy_helper

from ..policies import NetworkPolicy
from ._source import tables

OPSET: Final = 13  # the first in which ArgMax, Max and Min are as they are today
_IR: Final = 7  # the format of files that came with this opset


def write(policy: NetworkPolicy, told: Mapping[str, str]) -> bytes:
    """A model: `observation` (batch, n), float32, to `action`, (batch, k), float32.

    A discrete action is int64, (batch,).
    """
    constants, actions = tables(policy), policy.actions
    nodes: list[Any] = []

    def then(operator: str, *names: str, **attributes: Any) -> None:
        """Append a node on the last output and some constants."""
        before = nodes[-1].output[0] if nodes else "observation"
        output = f"x{len(nodes)}"
        nodes.append(helper.make_node(operator, [before, *names], [output], **attributes))

    if policy.mean is not None:
        then("Sub", "mean")
        then("Mul", "scale")
    for i in range(len(policy.layers)):
        if i:
            then({"relu": "Relu", "tanh": "Tanh"}[policy.activation])
        then("Gemm", f"weight_{i}", f"bias_{i}", transB=1)
    if actions.discrete:
        then("ArgMax", axis=1, keepdims=0)
    else:
        if policy.squash:
            then("Tanh")
        then("Mul", "action_half")
        then("Add", "action_middle")
        then("Max", "action_low")
        then("Min", "action_high")
    nodes[-1].output[0] = "action"
    kind = TensorProto.INT64 if actions.discrete else TensorProto.FLOAT
    shape: list[Any] = ["batch"] if actions.discrete else ["batch", actions.outputs]
    inputs = policy.layers[0][0].shape[1]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", inputs])],
        [helper.make_tensor_value_info("action", kind, shape)],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, producer_name="rotorgram", opset_imports=[opset])
    model.ir_version = _IR
    helper.set_model_props(model, dict(told))
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString(deterministic=True)
    return content
