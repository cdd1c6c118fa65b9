"""Base of the envs over UDP, with one drone or many: the `Agent` behind them."""

from typing import Any, Final

import numpy as np

from ...envs.spec import Discrete, EnvSpec
from ...models.errors import InputError, NotCopied
from ..protocol.client import Address
from ..protocol.statistics import Statistics
from ..transport.agent import Agent

__all__ = ["LOST", "ServedEnv", "action_dtype", "checked_actions"]

LOST: Final = "simulator_lost"
"""Key of `info`: why the simulator was lost whose episode ends here as truncated."""


class ServedEnv(NotCopied):
    """An env with drones in remote simulators. For a class that is a Gymnasium env too."""

    _agent: Agent

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        return self._agent.address

    @property
    def statistics(self) -> Statistics:
        """Counts and round trips of the wire, over all simulators."""
        return self._agent.server.statistics

    def _spec_that_came(self) -> EnvSpec:
        spec = self._agent.spec
        assert spec is not None
        return spec


def action_dtype(spec: EnvSpec) -> np.dtype:
    """The dtype of actions as they cross the wire."""
    return np.dtype(np.int64 if isinstance(spec.action, Discrete) else spec.action.dtype)


def checked_actions(action: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """Actions as they cross the wire. The env checks bounds.

    Args:
        action: Argument of `step`.
        dtype: As `action_dtype` gives it.
        shape: Shape that the action must have.

    Raises:
        InputError: It is not of that shape, not real, or cannot be of that dtype.
    """
    array = np.asarray(action)
    if array.shape != shape:
        raise InputError(f"action: expected an array of shape {shape}, got shape {array.shape}")
    if array.dtype == dtype:
        return array
    if array.dtype.kind not in ("iuf" if dtype.kind == "f" else "iu"):
        expected = "real" if dtype.kind == "f" else "whole"
        raise InputError(f"action: expected {expected} numbers, got {array.dtype}")
    if dtype.kind == "f":
        with np.errstate(over="ignore", under="ignore"):  # independent of the program's settings
            return array.astype(dtype)  # an overflow is infinite, and refused as such
    whole = array.astype(dtype)
    if (whole != array).any():
        raise InputError(f"action: expected numbers of {dtype}, got {array}")
    return whole
