"""Controllers of drones of one world whose vehicles are not all alike."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..state import Array, WorldState

if TYPE_CHECKING:
    from . import Controller


class MixedController:
    """A `Controller` made of several: each flies its drones. Actions mean the same to all.

    Arrays are NumPy's, of shape (W, A, ...).
    """

    def __init__(self, controllers: Sequence[tuple["Controller", Sequence[int]]]) -> None:
        first: Any = controllers[0][0]
        self.low = first.low
        self.high = first.high
        self.components = first.components
        self.choices = first.choices
        self.every_step = getattr(first, "every_step", False)
        self.units = getattr(first, "units", "")
        self.frame = getattr(first, "frame", "")
        self.constants = getattr(first, "constants", {})
        self._controllers = controllers
        self._first = first

    def ranges(self) -> list[tuple[float, str]]:
        """As `Rates.ranges`, of a level that has them; all drones share them."""
        ranges: list[tuple[float, str]] = self._first.ranges()
        return ranges

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        thrusts = np.empty(state.thrust.shape)
        for controller, drones in self._controllers:
            thrusts[:, drones] = controller.thrust(action[:, drones], state.of(drones))
        return thrusts
