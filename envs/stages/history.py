"""Observations of the last steps side by side."""

from dataclasses import replace

import numpy as np

from ..spec import ArraySpec
from .record import Record, Stage
from .ring import Values, later


class History(Stage):
    """The last observations side by side, the oldest first.

    At the start of an episode all of them are the first one.

    Args:
        steps: How many.
        names: Of the arrays that have a history.
        axis: First axis of an array of one drone.
    """

    arrays = ("history",)

    def __init__(self, steps: int, names: tuple[str, ...], axis: int) -> None:
        self._steps = steps
        self._names = names
        self._axis = axis

    def step(self, record: Record) -> None:
        """A drone that begins fills its history with the present."""
        past = vars(record).get("history", {})
        history = {}
        rows = {}
        for name in self._names:
            values = record.observations[name]
            if values.ndim == self._axis:  # a number
                values = values[..., None]
            history[name] = later(past.get(name), values, self._steps, record)
            rows[name] = self._side_by_side(history[name])
        record.history = history
        record.observations = {**record.observations, **rows}

    def _side_by_side(self, history: Values) -> Values:
        lead = history.shape[: self._axis]
        rest = history.shape[self._axis + 2 :]
        return history.reshape(*lead, -1, *rest)


def with_history(array: ArraySpec, steps: int) -> ArraySpec:
    """The spec of `steps` values of an array, side by side along its first axis."""
    if steps == 1:
        return array
    length, *rest = array.shape or (1,)
    low, high = array.bounds()
    names = []
    for age in reversed(range(steps)):
        ago = f", {age} step{'s' * (age > 1)} ago" if age else ""
        names += [name + ago for name in array.components]
    return replace(
        array,
        shape=(steps * length, *rest),
        low=tuple(np.tile(low.ravel(), steps).tolist()),
        high=tuple(np.tile(high.ravel(), steps).tolist()),
        unit=array.unit if isinstance(array.unit, str) else array.unit * steps,
        components=tuple(names),
    )
