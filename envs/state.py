"""The state that a task sees."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sim.state import FAR, Array, ByName, WorldState


@dataclass(kw_only=True, slots=True)
class State(WorldState):
    """The state of the drones at the end of a step. Its arrays are read-only and safe to keep."""

    action: NDArray[np.float64]
    """The agent's last action, within float32, shape (W, A, k); neutral at a start."""
    steps: Array
    """Control steps of each episode, whole numbers, shape (W, A)."""
    time: Array
    """Time since the start of each episode, s, shape (W, A)."""
    known_clearance: Array = FAR
    """`clearance`; None where solids are hidden, as meshes are."""
    distance: Callable[[Array], Array]
    """From points, world frame, m, (W, n, 3), to the nearest solid but level ground of each world,
    m, (W, n): as `clearance`, without the sphere."""
    parameters: ByName = field(default_factory=dict)
    """What is drawn for the episode and what events have changed, by name, shape (W, A)."""
    neighbours: NDArray[np.float64] | None = None
    """What each drone has heard of its neighbours, see `stages/radio.py`: shape (W, A, k, 7)."""

    @property
    def clearance(self) -> Array:
        """Distance from a sphere about each body's origin, of `Vehicle.radius`, to the nearest
        solid but level ground, m, shape (W, A): below 0 within one, at most `FAR`. Raises
        `InputError` where solids are hidden.
        """
        if self.known_clearance is None:
            self.distance(self.position)  # raises
        return self.known_clearance


def kept_state(state: WorldState, **others: Any) -> State:
    """A copy of a world's state, with the other fields of `State`."""
    values = {}
    for name in WorldState.__slots__:
        value = getattr(state, name)
        if value is not None:
            values[name] = read_only(value)
    return State(**values, **others)


def read_only(values: Array) -> Array:
    """A copy that cannot be written."""
    copied = values.copy()
    copied.setflags(write=False)
    return copied
