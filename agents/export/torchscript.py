"""TorchScript: a traced module, for `torch.jit.load` and LibTorch."""

import io
import json
import warnings
from collections.abc import Mapping
from typing import Any, Final

import torch

from ..policies import NetworkPolicy
from ._source import tables

FILE: Final = "rotorgram.json"
"""Extra file with the metadata."""


class _Flight(torch.nn.Module):
    """Observation to action. What it computes with are buffers: `to(device)` moves them."""

    def __init__(self, policy: NetworkPolicy) -> None:
        super().__init__()
        self.normalised, self.squash = policy.mean is not None, policy.squash
        self.discrete, self.depth = policy.actions.discrete, len(policy.layers)
        self.activation = {"relu": torch.relu, "tanh": torch.tanh}[policy.activation]
        for name, array in tables(policy).items():
            self.register_buffer(name, torch.from_numpy(array.copy()))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        number = self.get_buffer
        if self.normalised:
            x = (x - number("mean")) * number("scale")
        for i in range(self.depth):
            x = self.activation(x) if i else x
            x = torch.nn.functional.linear(x, number(f"weight_{i}"), number(f"bias_{i}"))
        if self.discrete:
            return x.argmax(1)
        x = torch.tanh(x) if self.squash else x
        x = number("action_middle") + number("action_half") * x
        return torch.minimum(torch.maximum(x, number("action_low")), number("action_high"))


def write(policy: NetworkPolicy, told: Mapping[str, str]) -> bytes:
    """A module: observation (batch, n), float32, to action (batch, k), float32.

    A discrete action is int64, (batch,).
    """
    file = io.BytesIO()
    with warnings.catch_warnings():
        # torch has declared TorchScript deprecated, with no end named. LibTorch loads it.
        warnings.simplefilter("ignore", DeprecationWarning)
        example = torch.zeros(2, policy.layers[0][0].shape[1])
        trace: Any = torch.jit.trace
        traced = trace(_Flight(policy).eval(), example)
        extra = {FILE: json.dumps(dict(told), ensure_ascii=False)}
        torch.jit.save(traced, file, _extra_files=extra)
    return file.getvalue()
