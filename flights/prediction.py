"""Open-loop prediction of recorded flights: thousands of starts at once, with `sim`'s body.

A start is a measured state of a flight. From there the rotor speeds that were measured, and nothing
else, move the vehicle; after each horizon the result is compared with what was measured. System
identification fits numbers of the vehicle to that.

Vectors have their component as the first axis and the start as the last, as (3, M). World x, y, z
with z up; body x forward, y left, z up; quaternions scalar first; SI.
"""

import copy
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ..models.coefficients import Drag
from ..models.errors import InputError
from ..models.vehicle import Vehicle
from ..sim.backends import kernel
from ..sim.backends.body import RigidBody
from ..sim.effects import EffectOptions
from ..sim.effects.air import AirEffects
from ..sim.rotations import between
from ..sim.state import WorldState
from .flight_logs import FlightLog

Floats = NDArray[np.float64]
Numbers = Mapping[str, float]
"""Numbers of a vehicle by the names of `NAMES`, in the units of `models/coefficients.py`."""
States = tuple[Floats, Floats, Floats, Floats]
"""Position, quaternion, velocity and body rates, (3, M) or (4, M)."""

NAMES: Final = (
    "rotors.thrust_coefficient", "rotors.reaction", "rotors.drag", "rotors.inflow", "rotors.lift",
    "body.inertia.x", "body.inertia.y", "body.inertia.z",
    "drag.linear.x", "drag.linear.y", "drag.linear.z",
    "drag.angular.x", "drag.angular.y", "drag.angular.z", "drag.moment.x", "drag.moment.y",
)  # fmt: skip
"""Numbers that move a vehicle and can be fitted."""
_ON_ROTORS: Final = NAMES[2:5]
_AIR: Final = _ON_ROTORS + NAMES[8:]


def numbers_of(vehicle: Vehicle) -> dict[str, float]:
    """The numbers of a vehicle; those of effects that its file lacks are 0.

    Raises `InputError` if it has no thrust coefficient.
    """
    coefficients = vehicle.coefficients
    coefficients.need("rotors.thrust_coefficient", "a prediction from rotor speeds")
    reactions = [np.linalg.norm(rotor.reaction) for rotor in vehicle.rotors]
    numbers = dict.fromkeys(NAMES, 0.0)
    numbers["rotors.reaction"] = float(np.mean(reactions))
    for i, axis in enumerate("xyz"):
        numbers[f"body.inertia.{axis}"] = float(vehicle.inertia[i, i])
    for name, values in coefficients.numbers().items():
        if name in numbers:
            numbers[name] = values[0]
        for axis, value in zip("xyz", values, strict=False):
            if f"{name}.{axis}" in numbers:
                numbers[f"{name}.{axis}"] = value
    return numbers


def inertia_of(vehicle: Vehicle, numbers: Numbers) -> Floats:
    """The vehicle's inertia, kg·m², (3, 3), with the moments of the numbers."""
    inertia = np.array(vehicle.inertia)
    np.fill_diagonal(inertia, [numbers[f"body.inertia.{axis}"] for axis in "xyz"])
    return inertia


@dataclass(frozen=True, kw_only=True)
class Windows:
    """M starts of flights, the rotor speeds from there on, and the measured motion.

    `speeds` has shape (H, R, M) for H steps of `period`.
    """

    period: float
    horizons: tuple[int, ...]
    """Steps after which predictions are compared."""
    speeds: Floats
    start: States
    truth: Mapping[int, States]
    """The measured states by horizon."""
    flight: NDArray[np.int_]
    """Index of the flight of each start, shape (M,)."""
    index: NDArray[np.int_]
    """Sample of the flight at which it starts, shape (M,)."""

    @classmethod
    def cut(
        cls, flights: Sequence[FlightLog], steps: int, stride: int, horizons: Sequence[int] = ()
    ) -> Self:
        """Starts at every `stride`-th sample after which the flight has `steps` more."""
        starts = [np.arange(0, len(one.position) - steps, stride) for one in flights]

        def states(shift: int) -> States:
            def joined(name: str) -> Floats:
                pairs = zip(flights, starts, strict=True)
                parts = [getattr(one, name)[at + shift].T for one, at in pairs]
                return np.concatenate(parts, axis=-1)

            position = joined("position")
            quaternion = joined("quaternion")
            return position, quaternion, joined("velocity"), joined("body_rates")

        spans = [at[:, None] + np.arange(steps) for at in starts]
        speeds = np.concatenate([f.speeds[s] for f, s in zip(flights, spans, strict=True)])
        flight = [np.full(len(at), number) for number, at in enumerate(starts)]
        horizons = tuple(horizons) or (steps,)
        return cls(
            period=flights[0].period,
            horizons=horizons,
            speeds=np.ascontiguousarray(speeds.transpose(1, 2, 0)),
            start=states(0),
            truth={horizon: states(horizon) for horizon in horizons},
            flight=np.concatenate(flight),
            index=np.concatenate(starts),
        )


def mean_speeds(speeds: Floats, step: int) -> Floats:
    """Rotor speeds between a sample and the next, (R, M): the mean of both.

    After the last sample that a prediction may know, those of that one. `speeds`: (H, R, M).
    """
    after = speeds[min(step + 1, len(speeds) - 1)]
    between_both: Floats = 0.5 * (speeds[step] + after)
    return between_both


def predict(
    vehicle: Vehicle,
    candidates: Numbers | Sequence[Numbers],
    windows: Windows,
    speeds: Floats | None = None,
) -> Iterator[tuple[int, States]]:
    """Each horizon, and the states there, of the vehicle with other numbers.

    P candidates are flown at once, much faster than one after the other; arrays then have P M
    starts, those of the first candidate first. `speeds`, (H, R, P M), replaces those of the
    windows. A physics step is the period of the samples.
    """
    several = [candidates] if isinstance(candidates, Mapping) else list(candidates)
    starts = windows.start[0].shape[-1]
    numbers = {name: np.repeat([one[name] for one in several], starts) for name in NAMES}
    flown = _with_step(vehicle, windows.period)
    body = RigidBody(flown)
    own = numbers_of(vehicle)["rotors.reaction"]
    if own:
        body.vary({"reaction": numbers["rotors.reaction"] / own})
    inertias = np.stack([inertia_of(vehicle, one) for one in several])
    body.set_inertia(np.repeat(inertias, starts, axis=0))
    air = _Air(flown, numbers)
    fly = _flight(body, vehicle.num_rotors, pushed=air.acts)
    rows = np.ascontiguousarray(np.tile(np.concatenate(windows.start), len(several)))
    given = np.tile(windows.speeds, len(several)) if speeds is None else speeds
    given = np.ascontiguousarray(given)
    for step in range(len(windows.speeds)):
        thrust = numbers["rotors.thrust_coefficient"] * mean_speeds(given, step) ** 2
        rows = fly(rows, thrust, air.wrench(rows, thrust))
        if step + 1 in windows.horizons:
            yield step + 1, (rows[:3], rows[3:7], rows[7:10], rows[10:])


def _flight(
    body: RigidBody, rotors: int, *, pushed: bool
) -> Callable[[Floats, Floats, Floats | None], Floats]:
    """New rows (13, N) after a physics step; compiled where a C compiler can, else by NumPy."""

    def by_numpy(rows: Floats, thrust: Floats, wrench: Floats | None) -> Floats:
        return np.array(body.fly(rows, thrust, wrench))

    if kernel.compiler() is None:
        return by_numpy
    try:
        step = kernel.compiled(body, rotors, np.float64, wrench=pushed)
    except InputError as error:
        logging.getLogger(__name__).warning("predictions by NumPy: %s", error)
        return by_numpy
    varying = kernel.packed(body, np.float64)
    return lambda rows, thrust, wrench: step(rows, thrust, wrench, varying, 1)


def _with_step(vehicle: Vehicle, period: float) -> Vehicle:
    """The vehicle with another physics step, s."""
    model = copy.copy(vehicle.model)
    model.opt.timestep = period
    return replace(vehicle, model=model)


class _Air:
    """Force and torque of the air on N bodies with numbers of their own, each of shape (N,)."""

    def __init__(self, vehicle: Vehicle, numbers: Mapping[str, Floats]) -> None:
        self._effects: AirEffects | None = None
        quadratic = vehicle.coefficients.drag.quadratic
        if quadratic is None and not any(numbers[name].any() for name in _AIR):
            return
        on_rotors = any(numbers[name].any() for name in _ON_ROTORS)
        none = Drag(linear=(0.0, 0.0, 0.0), quadratic=quadratic)
        rotors = replace(vehicle.coefficients.rotors, drag=0.0)
        coefficients = replace(vehicle.coefficients, drag=none, rotors=rotors)
        still = replace(vehicle, coefficients=coefficients)  # the numbers take their place
        options = EffectOptions(body_drag=True, rotor_drag=on_rotors)
        self._effects = AirEffects(still, options)
        self._effects.vary({name: values[:, None] for name, values in numbers.items()})
        self._begun = False

    @property
    def acts(self) -> bool:
        """Whether there is air."""
        return self._effects is not None

    def wrench(self, rows: Floats, thrust: Floats) -> Floats | None:
        """Of states (13, N) and thrusts (R, N): force, world frame, and torque, body frame, (6, N).

        None where there is no air.
        """
        if self._effects is None:
            return None
        columns = rows.T[:, None]
        force = thrust.T[:, None]
        state = WorldState(
            position=columns[..., :3],
            quaternion=columns[..., 3:7],
            velocity=columns[..., 7:10],
            body_rates=columns[..., 10:],
            command=force,
            thrust=force,
            touching=np.False_,
        )
        if not self._begun:
            self._effects.begin(np.True_, state, {})
            self._begun = True
        push: Floats = self._effects.step(state, force, None, [0.0, 0.0, 0.0], None)
        return np.ascontiguousarray(push.reshape(-1, 6).T)


def differences(predicted: States, truth: States) -> States:
    """Predicted less measured: position, rotation vector, velocity and body rates, (3, M) each."""
    turn = between(truth[1].T, predicted[1].T).T
    turn = turn * np.where(turn[0] < 0, -1.0, 1.0)
    size = np.sqrt((turn[1:] ** 2).sum(axis=0))
    angle = 2 * np.arctan2(size, turn[0])
    share = np.divide(angle, size, out=np.full_like(size, 2.0), where=size > 1e-12)
    return (
        predicted[0] - truth[0],
        turn[1:] * share,
        predicted[2] - truth[2],
        predicted[3] - truth[3],
    )
