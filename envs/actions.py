"""What an agent sends, checked."""

from collections.abc import Sequence
from math import prod
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, shortened
from .spec import ArraySpec, Discrete, EnvSpec


def asked_bits(asks: Sequence[str]) -> int:
    """The bits of the events that may be asked for."""
    return sum(1 << bit for bit, kind in enumerate(asks) if kind)


class Asking:
    """Requests for events of an env, which its next step takes along."""

    env_spec: EnvSpec
    num_envs = 1
    _asks: NDArray[np.uint64] | None = None

    def ask(self, event: int, drones: NDArray[np.bool_] | None = None) -> None:
        """Let an event happen in the next step, to all drones or to those of a mask, (N,).

        `event` is its number in the option `events`, where it has the condition "asked". Raises
        `InputError` for one that is not on offer.
        """
        offered = [number for number, kind in enumerate(self.env_spec.asks) if kind]
        if event not in offered:
            raise InputError(f"ask: expected an event on offer, one of {offered}, got {event!r}")
        bits = np.zeros(self.num_envs, np.uint64) if self._asks is None else self._asks
        bits[... if drones is None else drones] |= np.uint64(1 << event)
        self._asks = bits

    def _taken_asks(self) -> NDArray[np.uint64] | None:
        """Requests since the last step, uint64, (N,), as of a Command."""
        asks = self._asks
        self._asks = None
        return asks


class Actions:
    """Checks actions of numbers, or of one choice out of 0 to `choices` - 1.

    Args:
        lead: Leading axes, of the drones.
        row: Shape of one drone's action.
        dtype: That of checked actions.
        choices: 0 where an action is numbers.
    """

    def __init__(
        self, lead: tuple[int, ...], row: tuple[int, ...], dtype: np.dtype, choices: int
    ) -> None:
        self.dtype = dtype
        self.shape = (*lead, *row)
        self._lead = lead
        self._row = row
        self._choices = choices

    @classmethod
    def of(cls, action: ArraySpec | Discrete, drones: int) -> Self:
        """Actions of so many drones as they cross the wire."""
        if isinstance(action, Discrete):
            return cls((drones,), (), np.dtype("<i8"), action.choices)
        return cls((drones,), action.shape, np.dtype(action.dtype).newbyteorder("<"), 0)

    def checked(
        self, given: object, flown: NDArray[np.bool_] | None = None, name: str = "actions"
    ) -> np.ndarray:
        """Actions of the shape and the dtype, all finite. Raises `InputError`.

        Actions of drones that do not fly are ignored. Bounds are not checked.
        """
        try:
            actions = np.asarray(given)
        except ValueError:  # rows of several lengths
            actions = np.asarray(None)
        if actions.dtype.kind not in "iuf":
            raise InputError(f"{name}: expected real numbers, got {shortened(given)}")
        drones = prod(self._lead)
        fits = self._choices or actions.shape[actions.ndim - len(self._row) :] == self._row
        if actions.size != prod(self.shape) or not fits:
            shape = (drones, *self._row) if drones > 1 else self._row
            raise InputError(f"{name}: expected shape {shape}, got {actions.shape}")
        values = actions.reshape(self.shape)
        sent = values
        if values.dtype != self.dtype:
            with np.errstate(all="ignore"):  # what does not fit is refused
                sent = values.astype(self.dtype)
        if self._choices:
            right = (values >= 0) & (values < self._choices) & (np.floor(values) == values)
            expected = f"a whole number 0 to {self._choices - 1}"
        elif self.dtype.kind == "f":
            right = np.isfinite(sent)
            expected = "finite numbers"
        else:
            right = sent == values
            expected = f"numbers of {self.dtype}"
        if np.count_nonzero(right) < right.size:  # faster than NumPy's all
            wrong = ~right.reshape(*self._lead, -1).all(axis=-1)
            refused = wrong if flown is None else wrong & flown
            if refused.any():
                first = int(np.flatnonzero(refused)[0])
                got = values.reshape(drones, -1)[first].tolist()
                whose = f" for env {first}" if drones > 1 else ""
                raise InputError(f"{name}: expected {expected}, got {got}{whose}")
            sent = np.where(right, sent, 0)
        return np.ascontiguousarray(sent)

    def neutral(self) -> NDArray[np.float64]:
        """Actions that change nothing."""
        number = (self._choices - 1) // 2 if self._choices else 0
        return np.full(self.shape, float(number))
