"""The level wrench: an acceleration along body z and three angular ones, alike for every craft.

What a policy says is then no share of what one craft can do: the vehicle's file turns it into
thrusts. Array code with any leading axes.
"""

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from ... import models
from ...models.drawn import columns
from ...models.matrices import inverse, times
from ..effects import EffectOptions
from ..state import Array, WorldState, clip, parts_of
from .cascade import Mixing, Numbers, mixed
from .gains import Gains, lead_of

SIZES = (20.0, 150.0, 150.0, 30.0)
"""Of actions of 1: acceleration beyond a hover's, m/s², and angular accelerations, rad/s²."""
LONGEST_LAG = 0.1  # s
_ACTIONS = ("lift", "roll acceleration", "pitch acceleration", "yaw acceleration")
SEEN = (*_ACTIONS, *(f"largest {name}" for name in _ACTIONS), "lag over 0.1 s")
"""What a policy sees of the rotors: the action that their thrusts stand for, how much of each the
craft can give from a hover, up to 1, and their lag."""


class Plant(NamedTuple):
    """A craft: numbers, or arrays where craft are drawn."""

    mass: Array
    """kg."""
    inertia: Any
    """Three rows, kg·m²."""
    turn: Any
    """Its inverse."""
    torques: Any
    """Of one newton of each rotor, N·m, three rows of R."""
    lowest: Array
    """As `Gains` has it; so are those that follow."""
    highest: Array
    mix: Any
    share: Any
    lead: Array
    most: Any
    """Of each rotor, N."""
    lag: Array
    """s."""


class Wrench(Mixing):
    """Acceleration along body z, and angular accelerations about the body's axes.

    Torque = J · angular acceleration; thrusts are mixed, and rotors driven, as those of `Rates`.
    """

    components: tuple[str, ...] = _ACTIONS
    units: tuple[str, ...] = ("m/s²", "rad/s²", "rad/s²", "rad/s²")

    def __init__(self, vehicle: "models.Vehicle", gains: Gains, effects: EffectOptions) -> None:
        super().__init__(vehicle, gains, effects)
        self.plant = Plant(
            mass=vehicle.mass,
            inertia=vehicle.inertia.tolist(),
            turn=inverse(vehicle.inertia).tolist(),
            torques=vehicle.allocation[1:].tolist(),
            lowest=gains.lowest,
            highest=gains.highest,
            mix=gains.mix,
            share=gains.share,
            lead=gains.lead,
            most=self._high,
            lag=gains.lag,
        )
        self._period = gains.period if effects.motor_lag else 0.0

    def sizes(self, gains: Gains) -> Numbers:
        """See `SIZES`."""
        return SIZES

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        lift, *turns = self._scaled(action)
        plant = self._plant_of(state)
        torque = times(plant.inertia, turns)
        thrusts = mixed(plant, plant.mass * (self._gravity + lift), torque)
        return self._driven(thrusts, state, plant.lead, plant.most)

    def seen(self, state: WorldState) -> list[Array]:
        """What `SEEN` names, each (W, A)."""
        return self.told(self._plant_of(state), parts_of(state.thrust))

    def told(self, plant: Plant, thrusts: Sequence[Array]) -> list[Array]:
        """What `SEEN` names, of a craft whose rotors give so many newtons each."""
        torque = [sum(a * b for a, b in zip(row, thrusts, strict=True)) for row in plant.torques]
        hover = plant.mass * self._gravity
        lift = (sum(thrusts) - hover) / plant.mass
        room = np.minimum(plant.highest - hover, hover - plant.lowest)
        most = [(plant.highest - hover) / plant.mass]
        for axis in range(3):
            pushes = [abs(row[axis]) for row in plant.mix]
            most.append(room / (plant.inertia[axis][axis] * reduce(np.maximum, pushes)))
        now = (lift, *times(plant.turn, torque))
        own = [clip(value / size, 0.0, 1.0) for value, size in zip(most, SIZES, strict=True)]
        zero = 0.0 * lift
        return [
            *(value / size for value, size in zip(now, SIZES, strict=True)),
            *(zero + value for value in own),
            zero + plant.lag / LONGEST_LAG,
        ]

    def _plant_of(self, state: WorldState) -> Plant:
        return self.plant if state.craft is None else _drawn_plant(state.craft, self._period)


def _drawn_plant(craft: Array, period: float) -> Plant:
    """Of drawn craft, as of `WorldState.craft`; rotors with a lag are driven so often, s."""
    numbers = {name: parts_of(part) for name, part in columns(craft).items()}
    x, y, z = numbers["inertia"]
    mix = numbers["mix"]
    (highest,) = numbers["highest"]
    return Plant(
        mass=1.0,
        inertia=((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)),
        turn=((1.0 / x, 0.0, 0.0), (0.0, 1.0 / y, 0.0), (0.0, 0.0, 1.0 / z)),
        torques=(numbers["y"], [-one for one in numbers["x"]], numbers["yaw"]),
        lowest=0.0,
        highest=highest,
        mix=[mix[i : i + 3] for i in range(0, len(mix), 3)],
        share=numbers["share"],
        lead=lead_of(numbers["lag"][0], period) if period else 1.0,
        most=[highest * share for share in numbers["share"]],
        lag=numbers["lag"][0] if period else 0.0,
    )
