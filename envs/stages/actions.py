"""What an agent sends, checked; and actions that are late."""

import math
from dataclasses import dataclass

import numpy as np

from ...models.errors import InputError
from ...sim import World
from ...sim.state import filled, pushed, taken
from .record import Floats, Mask, Record, Stage, is_finite


class Actions:
    """Checks actions of k numbers, or of one choice out of 0 to `choices` - 1.

    Args:
        shape: (W, A).
        width: k.
        choices: 0 where an action is k numbers.
    """

    def __init__(self, shape: tuple[int, ...], width: int, choices: int) -> None:
        self._shape = (*shape, width)
        self._width = width
        self._choices = choices
        self._count = math.prod(shape)

    def checked(self, given: object, flown: Mask | None) -> np.ndarray:
        """Actions, float32, shape (W, A, k), finite. Raises `InputError`.

        Actions of drones that do not fly are ignored.
        """
        actions = np.asarray(given)
        if actions.dtype.kind not in "iuf":
            raise InputError(f"actions: expected real numbers, got {actions.dtype}")
        if actions.size != self._count * self._width:
            shape = (self._count, self._width)
            raise InputError(f"actions: expected shape {shape}, got {actions.shape}")
        values = actions.reshape(self._shape)
        if self._choices:
            right = (values >= 0) & (values < self._choices) & (np.floor(values) == values)
            expected = f"a whole number 0 to {self._choices - 1}"
            return self._refused(values, right, expected, flown)
        if values.dtype != np.float32:
            with np.errstate(over="ignore"):  # an overflow is infinite, and refused as such
                values = values.astype(np.float32)
        if is_finite(values):
            return np.ascontiguousarray(values)
        return self._refused(values, np.isfinite(values), "finite numbers", flown)

    def neutral(self) -> Floats:
        """Actions that change nothing, shape (W, A, k)."""
        number = (self._choices - 1) // 2 if self._choices else 0
        return np.full(self._shape, float(number))

    def _refused(
        self, values: np.ndarray, right: np.ndarray, expected: str, flown: Mask | None
    ) -> np.ndarray:
        wrong = ~right.all(axis=-1)
        refused = wrong if flown is None else wrong & flown
        if refused.any():
            first = int(np.flatnonzero(refused)[0])
            got = values.reshape(self._count, -1)[first].tolist()
            raise InputError(f"actions: expected {expected}, got {got} for env {first}")
        return np.where(right, values, 0).astype(np.float32)


@dataclass
class Receive(Stage):
    """The action of an agent arrives."""

    arrays = ("action",)

    neutral: Floats
    """Of a drone that begins, (W, A, k)."""

    def begin(self, record: Record) -> None:
        """No action yet."""
        record.action = record.received = self.neutral

    def step(self, record: Record) -> None:
        """At once, unless a later stage delays it."""
        record.action = record.received = record.sent.astype(np.float64)


@dataclass
class ActionDelay(Stage):
    """An action takes effect late by a number of control steps that each episode draws."""

    arrays = ("actions_sent",)

    world: World
    """Its parameter `action_delay`, control steps."""
    longest: int
    """No delay is longer."""
    neutral: Floats
    """Actions that are on their way when an episode begins, (W, A, k)."""

    def begin(self, record: Record) -> None:
        """Actions on their way change nothing."""
        record.actions_sent = filled(self.neutral, self.longest + 1)

    def step(self, record: Record) -> None:
        """The action that was sent as long ago as the delay."""
        record.actions_sent = sent = pushed(record.actions_sent, record.received)
        record.received = taken(sent, self.world.parameters["action_delay"])
