"""What backends of torch tensors share: draws, noise, seeds, and the check of actions."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import array_api_compat.torch as torch_api
import numpy as np
import torch

from ...models.errors import InputError
from ...models.vehicle import Vehicle
from ..effects import EffectOptions
from ..random import Draw, Noise, NumpyDraw, NumpyNoise, Streams
from ..randomize import Randomization
from ..state import Array
from .base import BaseWorld


class TensorWorld(BaseWorld):
    """Base of worlds whose state is torch tensors of one dtype on one device.

    In float32 one generator draws the numbers of all worlds on the device: the host need not know
    which of them draw. In float64 each world has its stream on the host, and a seed gives the
    numbers that it gives `mujoco`: slower, for comparisons.
    """

    xp: Any = torch_api

    def __init__(
        self,
        vehicle: Vehicle,
        shape: tuple[int, int],
        effects: EffectOptions | None,
        randomize: Randomization | None,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.device, self.dtype = device, dtype
        self._exact = dtype == torch.float64
        super().__init__(vehicle, shape, effects, randomize)

    def noise(self, size: int, use: int | tuple[int, ...]) -> Noise:
        """As `World.noise`."""
        if self._exact:
            self._noises.append(_HostNoise(self.shape, size, use, self.device))
        else:
            self._noises.append(TorchNoise((*self.shape, size), use, self.device))
        return self._noises[-1]

    def _source(self, use: int | tuple[int, ...]) -> Any:
        """What draws the numbers of a use."""
        return Streams(self.shape[0], use) if self._exact else _Generator(use, self.device)

    def _drawing(self, source: Any, mask: torch.Tensor, chosen: Mapping[str, Array]) -> Draw:
        put = {
            name: torch.as_tensor(values, dtype=self.dtype, device=self.device)
            for name, values in chosen.items()
        }
        if self._exact:
            return _HostDraw(source, self._ids(mask).tolist(), self.shape, put, self.device)
        return TorchDraw(source, mask, put)

    def _ids(self, mask: torch.Tensor) -> torch.Tensor:
        return mask[:, 0].nonzero().flatten()

    def checked(self, actions: Array, width: int, choices: int, flown: Array | None) -> Array:
        """As `World.checked`: a tensor on `device` or a NumPy array, rounded to float32.

        The graph of actions that require a gradient goes on.
        """
        if isinstance(actions, torch.Tensor) and actions.device != self.device:
            raise InputError(f"actions: expected a tensor on {self.device}, got {actions.device}")
        if isinstance(actions, np.ndarray):
            actions = np.require(actions, requirements="W")  # those of a datagram are read-only
        try:
            values = torch.as_tensor(actions, device=self.device)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"actions: expected real numbers, got {actions!r:.80}") from None
        shape = (prod(self.shape), width)
        if values.is_complex() or values.numel() != shape[0] * width:
            raise InputError(
                f"actions: expected real numbers of shape {shape}, "
                f"got {values.dtype} of shape {tuple(values.shape)}"
            )
        values = values.reshape(shape).to(torch.float32)
        right = values.isfinite()
        if choices:
            right = (values >= 0) & (values < choices) & (values % 1 == 0)
        if right.all():
            return values.to(self.dtype)
        wrong = ~right.all(dim=1)
        if flown is not None:
            wrong = wrong & flown
        if wrong.any():
            first = int(wrong.nonzero()[0])
            expected = f"a whole number 0 to {choices - 1}" if choices else "finite numbers"
            got = values[first].tolist()
            raise InputError(f"actions: expected {expected}, got {got} for env {first}")
        return torch.where(right, values, 0.0).to(self.dtype)


class TorchDraw(Draw):
    """Float32, from one generator for all worlds."""

    def __init__(
        self, source: "_Generator", mask: torch.Tensor, chosen: Mapping[str, Array]
    ) -> None:
        super().__init__(chosen)
        self._generator, self._mask = source.generator, mask

    def _draw(self, kind: str, parameters: tuple[float, float], size: tuple[int, ...]) -> Array:
        first, second = parameters
        shape, device = (*self._mask.shape, *size), self._mask.device
        if kind == "uniform":
            numbers = torch.rand(shape, generator=self._generator, device=device)
            numbers = first + (second - first) * numbers
        else:
            numbers = second * torch.randn(shape, generator=self._generator, device=device)
        mask = self._mask.reshape(*self._mask.shape, *[1] * len(size))
        return torch.where(mask, numbers, 0.0)


class TorchNoise:
    """A `Noise` in float32 from one generator for all worlds, which every call moves on."""

    def __init__(
        self, shape: tuple[int, ...], use: int | tuple[int, ...], device: torch.device
    ) -> None:
        self._shape, self._source = shape, _Generator(use, device)
        self.seed = self._source.seed

    def normal(self, mask: Array | None = None) -> Array:
        """As `Noise.normal`."""
        generator = self._source.generator
        numbers = torch.randn(self._shape, generator=generator, device=generator.device)
        return numbers if mask is None else torch.where(mask[..., None], numbers, 0.0)


class _HostDraw(NumpyDraw):
    """`NumpyDraw`, its numbers as tensors."""

    def __init__(self, *arguments: Any) -> None:
        *rest, self._device = arguments
        super().__init__(*rest)

    def _draw(self, kind: str, parameters: tuple[float, float], size: tuple[int, ...]) -> Array:
        return torch.as_tensor(super()._draw(kind, parameters, size), device=self._device)


class _HostNoise(NumpyNoise):
    """`NumpyNoise`, its numbers as tensors."""

    def __init__(self, shape: tuple[int, ...], size: int, use: Any, device: torch.device) -> None:
        super().__init__(shape, size, use)
        self._device = device

    def normal(self, mask: Array | None = None) -> Array:
        """As `Noise.normal`."""
        where = None if mask is None else mask.cpu().numpy()
        return torch.as_tensor(super().normal(where), device=self._device)


class _Generator:
    """A generator of one use for all worlds, unpredictable until it is seeded."""

    def __init__(self, use: int | tuple[int, ...], device: torch.device) -> None:
        self._key = use if isinstance(use, tuple) else (use,)
        self.generator = torch.Generator(device)
        self.generator.seed()

    def seed(self, ids: Sequence[int], seeds: Sequence[int | None]) -> None:
        """With all the seeds together; with none it goes on."""
        del ids
        if given := [int(seed) for seed in seeds if seed is not None]:
            sequence = np.random.SeedSequence(given, spawn_key=self._key)
            self.generator.manual_seed(int(sequence.generate_state(1, np.uint64)[0]))


def torch_device(name: str | None) -> torch.device:
    """The device of a name; None takes a CUDA device if there is one. Raises `InputError`."""
    if name is None:
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        return torch.empty(0, device=device).device  # cuda:0 for cuda
    except (ValueError, RuntimeError, AssertionError, TypeError):
        expected = "'cpu', or a CUDA device that torch finds"
        raise InputError(f"device: expected {expected}, got {name!r}") from None
