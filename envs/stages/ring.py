"""Arrays of the last control steps, (W, A, steps, *shape): the oldest step first."""

import numpy as np

from ...sim.state import Array
from .record import Record, where

Values = np.ndarray


def filled(values: Values, steps: int, axis: int) -> Values:
    """Values (W, A, *shape), repeated for `steps` steps along a new axis."""
    return np.repeat(np.expand_dims(values, axis), steps, axis)


def pushed(past: Values, values: Values, axis: int) -> Values:
    """The past one step later: without its oldest values, and with new ones."""
    kept = past[(slice(None),) * axis + (slice(1, None),)]
    return np.concatenate((kept, np.expand_dims(values, axis)), axis)


def later(past: Values | None, values: Values, steps: int, record: Record) -> Values:
    """The past of `steps` steps, one step later; of drones that begin it is the present."""
    axis = len(record.shape)
    if past is None:
        return filled(values, steps, axis)
    new = pushed(past, values, axis)
    if record.begun is None:
        return new
    merged: Values = where(record.begun, filled(values, steps, axis), new)
    return merged


def taken(past: Values, age: Array, axis: int) -> Values:
    """Values of `age` steps ago; the age has the shape (W, A), whole numbers."""
    index = past.shape[axis] - 1 - np.asarray(age).astype(int)
    if not axis:
        present: Values = past[int(index)]
        return present
    index = index.reshape(index.shape + (1,) * (past.ndim - axis))
    chosen: Values = np.take_along_axis(past, index, axis).squeeze(axis)
    return chosen
