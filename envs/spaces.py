"""Gymnasium's spaces and `info`, from a spec."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from .spec import ArraySpec, Discrete, EnvSpec, component_names


def box(array: ArraySpec) -> spaces.Box:
    """The space of one array."""
    low, high = array.bounds()
    dtype: Any = np.dtype(array.dtype)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        # As Python's numbers: float64 lacks the largest of int64.
        low = np.clip(low.astype(object), limits.min, limits.max)
        high = np.clip(high.astype(object), limits.min, limits.max)
    return spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)


def observation_space(spec: EnvSpec) -> spaces.Space[Any]:
    """A Box where an observation is one array, else a Dict of them."""
    if len(spec.observation) == 1:
        return box(spec.observation[0])
    return spaces.Dict({array.name: box(array) for array in spec.observation})


def action_space(spec: EnvSpec) -> spaces.Space[Any]:
    """A Box, or Discrete."""
    if isinstance(spec.action, Discrete):
        return spaces.Discrete(spec.action.choices)
    return box(spec.action)


def joined(spec: EnvSpec, arrays: Mapping[str, np.ndarray]) -> Any:
    """Observation arrays as the space has them: the only one, or a dict."""
    return arrays[spec.observation[0].name] if len(spec.observation) == 1 else dict(arrays)


def telemetry_names(spec: EnvSpec) -> tuple[str, ...]:
    """Names of all components of the telemetry, in order."""
    return tuple(name for array in spec.telemetry for name in component_names(array))


def info_columns(spec: EnvSpec, telemetry: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Telemetry (N, *shape) by the names of its components, each a view of shape (N,)."""
    columns: dict[str, np.ndarray] = {}
    for array in spec.telemetry:
        values = telemetry[array.name]
        flat = values.reshape(len(values), -1)
        columns |= zip(component_names(array), flat.T, strict=True)
    return columns
