"""Controllers whose actions are thrusts: of all rotors alike, or of each."""

from typing import Final

from ... import models
from ..state import Array, WorldState, clip, component, stack


class CollectiveThrust:
    """One number for all rotors: they push alike, in proportion to their thrusts at hover.

    Args:
        vehicle: What it controls.
        newtons: Thrust per unit of action, mean over the rotors.
        increment: Add to the present thrust; otherwise to that of a hover.
        discrete: Three choices, decrease, hold and increase, in place of a number in [-1, 1].
    """

    def __init__(
        self, vehicle: "models.Vehicle", newtons: float, *, increment: bool, discrete: bool = False
    ) -> None:
        self.low: tuple[float, ...] = (-1.0,)
        self.high: tuple[float, ...] = (1.0,)
        self.components: tuple[str, ...] = (
            ("decrease", "hold", "increase") if discrete else ("collective",)
        )
        self.choices = 3 if discrete else 0
        self.newtons = newtons
        hover = vehicle.hover_thrust
        low = vehicle.thrust_low
        high = vehicle.thrust_high
        alike = all((values == values[0]).all() for values in (hover, low, high))
        # Rotors that are alike need one number for all of them.
        self._alike = alike
        self._increment = increment
        self._hover, self._per_action, self._low, self._high = (
            values.item(0) if alike else values
            for values in (hover, newtons * (hover / hover.mean()), low, high)
        )

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        share = component(action, 0)
        share = share - 1.0 if self.choices else clip(share, -1.0, 1.0)
        if self._alike:
            present = component(state.command, 0) if self._increment else self._hover
            thrust = clip(present + self._per_action * share, self._low, self._high)
            return thrust if isinstance(thrust, float) else stack((thrust,))
        present = state.command if self._increment else self._hover
        return clip(present + self._per_action * stack((share,)), self._low, self._high)


class RotorThrust:
    """One number for each rotor: 0 is its thrust at hover, -1 its least and 1 its largest."""

    def __init__(self, vehicle: "models.Vehicle") -> None:
        self.low = (-1.0,) * vehicle.num_rotors
        self.high = (1.0,) * vehicle.num_rotors
        self.components = tuple(f"F{i + 1}" for i in range(vehicle.num_rotors))
        self.choices = 0
        self._hover: Final = vehicle.hover_thrust
        self._up: Final = vehicle.thrust_high - vehicle.hover_thrust
        self._down: Final = vehicle.hover_thrust - vehicle.thrust_low

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        above = clip(action, 0.0, 1.0)
        below = clip(action, -1.0, 0.0)
        return self._hover + self._up * above + self._down * below
