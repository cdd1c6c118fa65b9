"""State of worlds: arrays whose first two axes are W worlds and the A drones of each.

Frames: world x, y, z with z up, right-handed; body x forward, y left, z up. SI units, quaternions
scalar first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .compile import TracedArray

FAR = 1000.0
"""Largest distance to what stands around, m: also where nothing does."""
_NUMBERS = (float, int)

Array = Any
"""A NumPy array, or one of code that is compiled."""
ByName = dict[str, Array]


@dataclass(kw_only=True, slots=True)
class WorldState:
    """Live arrays: a step or a reset of the world writes into them. Read them, never write."""

    position: Array = None
    """Of each body's origin, world frame, m, shape (W, A, 3)."""
    quaternion: Array = None
    """From body to world frame, scalar first, shape (W, A, 4)."""
    velocity: Array = None
    """Of each body's origin, world frame, m/s, shape (W, A, 3)."""
    body_rates: Array = None
    """Angular velocity, body frame, rad/s, shape (W, A, 3)."""
    command: Array
    """Thrust that the controller last asked of each rotor, N, shape (W, A, R)."""
    thrust: Array
    """Of each rotor at the end of the last step, N, shape (W, A, R). Without effects on rotors it
    is the command."""
    touching: Array
    """Whether any part was in contact since the last step or reset, bool, shape (W, A). On the
    backend `rigid` two drones touch where their spheres overlap."""
    colliding: Array = None
    """Whether it was in contact with another drone; None in worlds of one drone."""
    craft: Array = None
    """Numbers of the craft that each drone is, (W, A, k), as of `models.drawn.columns`; None where
    the vehicle is one for all."""
    payload: Array = None
    """Position of each drone's payload, world frame, m, shape (W, A, 3), which all drones of a
    world share; None without payloads."""
    payload_velocity: Array = None
    """Its velocity, world frame, m/s, shape (W, A, 3)."""

    def of(self, drones: Sequence[int]) -> "WorldState":
        """Of some drones of each world."""
        arrays = {name: getattr(self, name) for name in self.__slots__}
        return WorldState(
            **{name: None if x is None else x[:, drones] for name, x in arrays.items()}
        )

    @property
    def tilt_cosine(self) -> Array:
        """Cosine of the angle between each body's z axis and the vertical, shape (W, A)."""
        _, x, y, _ = parts_of(self.quaternion)
        return 1 - 2 * (x * x + y * y)


@dataclass(kw_only=True, slots=True)
class InitialState:
    """Initial state of worlds. None means level, at rest, or at hover thrust."""

    position: Array
    """World frame, m, shape (W, A, 3)."""
    quaternion: Array | None = None
    """From body to world frame, scalar first, shape (W, A, 4)."""
    velocity: Array | None = None
    """World frame, m/s, shape (W, A, 3)."""
    body_rates: Array | None = None
    """Body frame, rad/s, shape (W, A, 3)."""
    thrust: Array | None = None
    """N, shape (W, A, R)."""
    payload: Array | None = None
    """Of the payload, world frame, m, shape (W, A, 3), the same for all drones of a world. None:
    straight below the drone, in worlds of one drone only."""


def clip(array: Array, low: Array, high: Array) -> Array:
    """The nearest numbers within bounds."""
    return np.minimum(np.maximum(array, low), high)  # a third of the time of NumPy's clip


def parts_of(array: Array) -> list[Array]:
    """Components of the last axis."""
    return [array[..., index] for index in range(array.shape[-1])]


def chosen(mask: Array, new: Array, old: Array) -> Array:
    """`new`, (W, A, ...), where the mask, (W, A), is true, elsewhere `old`; None stands for all."""
    if mask is None or old is None:
        return new
    more = max(np.ndim(new), np.ndim(old)) - mask.ndim
    return np.where(mask.reshape(mask.shape + (1,) * more), new, old)


def filled(values: Array, steps: int) -> Array:
    """Array (W, A, *shape), repeated for `steps` steps along a new axis."""
    return np.repeat(values[:, :, None], steps, 2)


def pushed(past: Array, values: Array) -> Array:
    """The past one step later: without its oldest values, and with new ones."""
    return np.concatenate((past[:, :, 1:], values[:, :, None]), 2)


def taken(past: Array, age: Array) -> Array:
    """Array of `age` steps ago; the age has the shape (W, A), whole numbers."""
    index = past.shape[2] - 1 - age.astype(int)
    index = index.reshape(index.shape + (1,) * (past.ndim - 2))
    return np.take_along_axis(past, index, 2).squeeze(2)


def square_root(array: Array) -> Array:
    """Square root; 0 of a number below 0, which rounding may leave."""
    return np.sqrt(np.maximum(array, 0.0))


def remainder(index: Array, count: float) -> Array:
    """What is left of whole numbers, floats, when they are divided by one."""
    return index - count * np.floor(index / count)


def total(values: Array) -> Array:
    """Sum over the last axis, from its first number to its last: the same bits alone, in a batch
    and compiled, which NumPy's sums do not have.
    """
    result = values[..., 0]
    for index in range(1, values.shape[-1]):
        result = result + values[..., index]
    return result


def length(vectors: Array) -> Array:
    """Sizes of vectors, shape (..., k)."""
    return square_root(total(vectors * vectors))


def looked_up(table: np.ndarray, index: Array) -> Array:
    """Rows of a constant table, (rows, ...), at whole numbers, floats; the last ones beyond it."""
    index = clip(index, 0.0, len(table) - 1.0)
    if is_traced(index):
        return index.rows_of(table)
    return table[index.astype(int)]


def interpolated(table: np.ndarray, index: Array) -> Array:
    """Numbers of a constant table, (rows,), between whole numbers on straight lines."""
    before = np.floor(index)
    low = looked_up(table, before)
    return low + (looked_up(table, before + 1.0) - low) * (index - before)


# ---- of masks; code that is compiled has no truth values yet


def is_traced(array: Array) -> bool:
    """Whether this code is being compiled: then it runs once, for worlds whose numbers come later.

    The only function of `sim` outside `compile` that tells such an array from NumPy's.
    """
    return isinstance(array, TracedArray)


def some(mask: Array) -> bool:
    """Whether a mask has a drone, None being all: what follows is for its drones alone.

    Compiled code does what follows; that it is for none costs the time alone.
    """
    if mask is None or is_traced(mask):
        return True
    return bool(np.count_nonzero(mask))  # faster than NumPy's any


def found(mask: Array) -> bool:
    """Whether a mask has a drone of which Python is told: in compiled code its caller looks."""
    return not is_traced(mask) and some(mask)


def stack(parts: Sequence[Array]) -> Array:
    """Arrays along a new last axis; a number among them counts for all drones."""
    for like in parts:
        if not isinstance(like, _NUMBERS):
            break
    else:
        return np.array(parts)  # an eighth of the time of NumPy's stack
    shape = (*like.shape, len(parts))
    array = np.empty_like(like, np.result_type(*parts), shape=shape)
    for index, part in enumerate(parts):  # a third of the time of NumPy's stack
        array[..., index] = part
    return array
