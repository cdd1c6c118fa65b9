"""The rigid body in torch: on a CPU or a GPU, differentiable."""

from typing import Any

import torch

from ...models.vehicle import Vehicle
from ..effects import EffectOptions
from ..randomize import Randomization
from .rigid import Rigid
from .tensors import TensorWorld, torch_device


class RigidTensorWorld(Rigid, TensorWorld):
    """`Rigid` in torch tensors, on one device.

    With `dtype` float64 a seed gives the draws that it gives `mujoco`, one stream for each world.
    Where thrusts require a gradient, the state has it; `detach` ends it.

    With `compiled` torch compiles a physics step at the first one: it needs a C++ compiler, and
    takes half a minute, or some seconds where torch's cache has it.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        shape: tuple[int, int],
        effects: EffectOptions | None,
        randomize: Randomization | None,
        dtype: str,
        compiled: bool | None,
        device: str | None,
    ) -> None:
        kind = getattr(torch, dtype)
        super().__init__(vehicle, shape, effects, randomize, torch_device(device), kind)
        body = self._body

        def fly(rows: Any, thrust: Any, wrench: Any, steps: int) -> torch.Tensor:
            return torch.stack(body.fly(rows, thrust, wrench, steps))

        self._flown: Any = torch.compile(fly) if compiled else fly
        if compiled:
            self._at_once = 1

    def detach(self) -> None:
        """End the graph of gradients: what comes next does not depend on what was before."""
        state = self.state
        self._rows, self._acting = self._rows.detach(), self._acting.detach()
        state.command, state.thrust = state.command.detach(), state.thrust.detach()
        self._wrench = None if self._wrench is None else self._wrench.detach()
        self._show()
        if self.effects is not None:
            self.effects.detach()

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=self.dtype, device=self.device)

    def _as_rows(self, values: torch.Tensor) -> torch.Tensor:
        return values.reshape(-1, values.shape[-1]).T.contiguous()
