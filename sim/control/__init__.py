"""Controllers: they turn actions into rotor thrusts. `docs/control.md` is their page.

A controller has no memory: what it needs of the past is in the state. An action has k numbers
within bounds, or is one of some choices.
"""

from collections.abc import Sequence
from typing import Protocol, cast

import numpy as np

from ... import models
from ...models.errors import InputError, shortened
from ..effects import NO_EFFECTS, EffectOptions
from ..state import Array, WorldState, clip, stack, total
from .cascade import AroundHover, Attitude, Mixing, Numbers, Position, Rates, Velocity
from .gains import Gains, shared_ranges
from .wrench import Wrench

_CASCADE: dict[str, type[Mixing]] = {
    "wrench": Wrench,
    "rates": Rates,
    "attitude": Attitude,
    "velocity": Velocity,
    "position": Position,
}
LEVELS = ("rotors", *_CASCADE, "increment", "offset")
"""What an action may set: the thrust of each rotor; accelerations, alike for every craft;
collective thrust and body rates; collective thrust, roll, pitch and yaw rate; velocity and yaw
rate; position and heading; a change of all thrusts; all thrusts."""
SHARES = {"increment": 0.05, "offset": 0.2}
"""Thrust of one unit of action over the rotors' largest thrust."""
_CONSTANTS = (
    "thrust_low", "thrust_hover", "thrust_high", "torque_x", "torque_y", "torque_z",
    "throttle_curve",
)  # fmt: skip


class Controller(Protocol):
    """Turns actions into thrusts.

    Optional attributes: `every_step`, true if `thrust` is called before each physics step and not
    once per action; `units` and `frame` of its numbers, as in an `ArraySpec`; `constants` of an
    `EnvSpec`.
    """

    low: Numbers
    """Lower bound of each number of an action, shape (k,)."""
    high: Numbers
    """Upper bounds, shape (k,)."""
    components: tuple[str, ...]
    """Name of each number, or of each choice."""
    choices: int
    """0: an action is k numbers. Otherwise it is one number, 0 to choices - 1."""

    def thrust(self, action: Array, state: WorldState) -> Array:
        """Thrust of each rotor until the next call, N, shape (W, A, R), or what broadcasts to it.

        Actions are float64, shape (W, A, k), finite; one beyond a bound counts as the bound.
        """


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
        self.low: Numbers = (-1.0,)
        self.high: Numbers = (1.0,)
        self.components: tuple[str, ...] = (
            ("decrease", "hold", "increase") if discrete else ("collective",)
        )
        self.choices = 3 if discrete else 0
        self.newtons = newtons
        self._increment = increment
        self._hover = hover = vehicle.hover_thrust
        self._per_action = newtons * (hover / (total(hover) / len(hover)))
        self._low = vehicle.thrust_low
        self._high = vehicle.thrust_high

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        share = action[..., :1]
        share = share - 1.0 if self.choices else clip(share, -1.0, 1.0)
        present = state.command if self._increment else self._hover
        return clip(present + self._per_action * share, self._low, self._high)

    def action(self, collective: Array, state: WorldState) -> Array:
        """Actions that ask for a collective thrust, N, shape (...)."""
        present = state.command if self._increment else self._hover
        share = (collective - total(present)) / total(self._per_action)
        if self.choices:
            return np.rint(clip(share, -1.0, 1.0)) + 1.0
        return stack([share])


class RotorThrust:
    """One number for each rotor: 0 is its thrust at hover, -1 its least and 1 its largest."""

    choices = 0

    def __init__(self, vehicle: "models.Vehicle") -> None:
        self.low = (-1.0,) * vehicle.num_rotors
        self.high = (1.0,) * vehicle.num_rotors
        self.components = tuple(f"F{i + 1}" for i in range(vehicle.num_rotors))
        low, high = vehicle.thrust_low, vehicle.thrust_high
        self._rotors = AroundHover(low, vehicle.hover_thrust, high)

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        return self._rotors.thrust(action)

    def action(self, thrust: Array) -> Array:
        """Actions that ask for thrusts, N, shape (..., R)."""
        return self._rotors.share(thrust)


class MixedController:
    """Controllers of drones of one world whose vehicles are not all alike: each flies its drones.

    Actions mean the same to all; the other attributes are those of the first. Arrays have the shape
    (W, A, ...).
    """

    def __init__(self, controllers: Sequence[tuple[Controller, Sequence[int]]]) -> None:
        self._controllers = controllers

    def __getattr__(self, name: str) -> object:
        if name == "_controllers":  # which a copy does not have yet
            raise AttributeError(name)
        return getattr(self._controllers[0][0], name)

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        thrusts = np.empty_like(state.thrust)
        for controller, drones in self._controllers:
            thrusts[:, drones] = controller.thrust(action[:, drones], state.of(drones))
        return thrusts


def make_controller(
    level: str, vehicle: "models.Vehicle", period: float, effects: EffectOptions = NO_EFFECTS
) -> Controller:
    """The controller of one of `LEVELS`.

    `period` is the time between two looks at the state, s: the physics step, or the control period
    where the state is an estimate. Loops know the rotors' lag and thrust curve where these effects
    are on. Raises `InputError` if the level is none of them, or the vehicle cannot be flown at it.
    """
    if level not in LEVELS:
        raise InputError(f"action: expected one of {', '.join(LEVELS)}, got {shortened(level)}")
    if hasattr(vehicle, "table") and level != "wrench":
        raise InputError(f"action: expected wrench with craft of {vehicle.name}, got {level}")
    members = getattr(vehicle, "members", (vehicle,))
    kinds = list(dict.fromkeys(members))
    controllers: list[Controller]
    if level in _CASCADE:
        gains = [Gains.of(kind, period, lag_of(kind, effects)) for kind in kinds]
        pairs = zip(kinds, shared_ranges(gains), strict=True)
        controllers = [_CASCADE[level](kind, own, effects) for kind, own in pairs]
    else:
        controllers = [_of_thrusts(level, kind) for kind in kinds]
    if len(members) == 1:
        return controllers[0]
    drones = [[i for i, own in enumerate(members) if own is kind] for kind in kinds]
    mixed = MixedController(list(zip(controllers, drones, strict=True)))
    return cast(Controller, mixed)


def rotor_constants(vehicle: "models.Vehicle", effects: EffectOptions) -> dict[str, Numbers]:
    """What an agent needs to know of the rotors, by name: `docs/protocol.md` has the units."""
    thrusts = (vehicle.thrust_low, vehicle.hover_thrust, vehicle.thrust_high)
    rows = [tuple(row.tolist()) for row in (*thrusts, *vehicle.allocation[1:])]
    return dict(zip(_CONSTANTS, (*rows, throttle_curve(vehicle, effects)), strict=True))


def throttle_curve(vehicle: "models.Vehicle", effects: EffectOptions) -> Numbers:
    """Coefficients c₀, c₁, ... of a command over the rotors' largest at a throttle of 0 to 1.

    The vehicle's curve, or else the square; where the effect has the curve, the throttle itself.
    """
    curve: Numbers = vehicle.coefficients["rotors.curve"] or (0.0, 0.0, 1.0)
    return (0.0, 1.0) if effects.thrust_curve else tuple(curve)


def lag_of(vehicle: "models.Vehicle", effects: EffectOptions) -> float:
    """Longest time constant of the rotors, s; 0 where they follow at once."""
    names = ("rotors.time_constant", "rotors.time_constant_down")
    times = [vehicle.coefficients[name] or 0.0 for name in names]
    return max(times) if effects.motor_lag else 0.0


def _of_thrusts(level: str, vehicle: "models.Vehicle") -> Controller:
    if level == "rotors":
        return RotorThrust(vehicle)
    newtons = SHARES[level] * float(vehicle.thrust_high.max())
    return CollectiveThrust(vehicle, newtons, increment=level == "increment")
