"""Open-loop prediction of recorded flights: thousands of starts at once, by the backend `rigid`.

A window begins at a measured state. From there the measured rotor speeds, and nothing else, move
the vehicle; after each horizon its state is compared with the measured one.

A state has 13 numbers: position, quaternion (scalar first), velocity, in the world frame with z up,
and body rates, body frame; SI.
"""

import copy
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Self

import numpy as np
from flight_logs import FlightLog, Floats, Ints
from rotorgram.models.coefficients import Coefficients
from rotorgram.models.fields import immutable
from rotorgram.models.vehicle import Vehicle
from rotorgram.scenes import SceneConfig, Solids
from rotorgram.sim.backends.rigid import RigidWorld
from rotorgram.sim.effects import EffectOptions
from rotorgram.sim.rotations import between
from rotorgram.sim.scenery import Scenery
from rotorgram.sim.state import InitialState
from rotorgram.sim.world import PhysicsError

Numbers = Mapping[str, float]
"""Numbers of a vehicle by the names of `NAMES`, in the units of `models/coefficients.toml`."""

NAMES = (
    "rotors.thrust_coefficient", "rotors.reaction", "rotors.drag", "rotors.inflow", "rotors.lift",
    "body.inertia.x", "body.inertia.y", "body.inertia.z",
    "drag.linear.x", "drag.linear.y", "drag.linear.z",
    "drag.angular.x", "drag.angular.y", "drag.angular.z", "drag.moment.x", "drag.moment.y",
)  # fmt: skip
"""Numbers that move a vehicle and can be fitted."""
_ON_ROTORS = ("rotors.drag", "rotors.inflow", "rotors.lift")
_REPLACED = ("drag.angular", "drag.moment", "rotors.inflow", "rotors.lift")
_MORE_THRUST = 100.0  # times the vehicle's limit: predictions never reach it
_LOST = 1e6  # every number of a state after a prediction that diverged


def numbers_of(vehicle: Vehicle) -> dict[str, float]:
    """The numbers of a vehicle; those of effects that its file lacks are 0.

    Raises `InputError` if it has no thrust coefficient.
    """
    vehicle.coefficients.need("rotors.thrust_coefficient", "a prediction from rotor speeds")
    reactions = [np.linalg.norm(rotor.reaction) for rotor in vehicle.rotors]
    own: dict[str, Sequence[float]] = dict(vehicle.coefficients.numbers())
    own["body.inertia"] = np.diag(vehicle.inertia).tolist()
    own["rotors.reaction"] = [float(np.mean(reactions))]
    numbers = {}
    for name in NAMES:
        entry, axis = entry_of(name)
        values = own.get(entry, (0.0, 0.0, 0.0))
        numbers[name] = values["xyz".index(axis)]
    return numbers


def entry_of(name: str) -> tuple[str, str]:
    """Entry of a vehicle's file that has a number, and its axis in it: "drag.linear" and "x" for
    "drag.linear.x"; no axis, if the entry is one number.
    """
    entry, _, axis = name.rpartition(".")
    return (entry, axis) if axis in ("x", "y", "z") else (name, "")


def inertia_of(vehicle: Vehicle, numbers: Numbers) -> Floats:
    """The vehicle's inertia, kg·m², (3, 3), with the moments of the numbers."""
    inertia = np.array(vehicle.inertia)
    np.fill_diagonal(inertia, [numbers[f"body.inertia.{axis}"] for axis in "xyz"])
    return inertia


@immutable
class Windows:
    """M starts of flights, the rotor speeds from there on, and the measured motion.

    Starts and speeds may have a first axis more, of the P candidates that begin there.
    """

    period: float
    """Of the samples, s."""
    horizons: tuple[int, ...]
    """H numbers of steps, after which predictions are compared."""
    start: Floats
    """States, shape (M, 13)."""
    truth: Floats
    """Measured states at the horizons, shape (M, H, 13)."""
    speeds: Floats
    """Of the rotors at each step, rad/s, shape (M, steps, R)."""
    flight: Ints
    """Index of the flight of each start, shape (M,)."""
    index: Ints
    """Sample of the flight at which it starts, shape (M,)."""

    @classmethod
    def cut(
        cls, flights: Sequence[FlightLog], steps: int, stride: int, horizons: Sequence[int] = ()
    ) -> Self:
        """Starts at every `stride`-th sample after which the flight has `steps` more.

        The only horizon is the last step, unless others are given.
        """
        chosen = np.array(horizons or [steps])
        arrays = []
        for number, flight in enumerate(flights):
            first = np.arange(0, len(flight.states) - steps, stride)
            truth = flight.states[first[:, None] + chosen]
            speeds = flight.speeds[first[:, None] + np.arange(steps)]
            arrays.append((flight.states[first], truth, speeds, np.full_like(first, number), first))
        start, truth, speeds, numbers, index = map(np.concatenate, zip(*arrays, strict=True))
        return cls(
            period=flights[0].period,
            horizons=tuple(chosen.tolist()),
            start=start,
            truth=truth,
            speeds=speeds,
            flight=numbers,
            index=index,
        )


def mean_speeds(speeds: Floats, step: int) -> Floats:
    """Rotor speeds between a sample and the next, the mean of both, of speeds (M, steps, R).

    After the last sample that a prediction may know, those of that one.
    """
    following = min(step + 1, speeds.shape[1] - 1)
    return 0.5 * (speeds[:, step] + speeds[:, following])


def predict(vehicle: Vehicle, candidates: Sequence[Numbers], windows: Windows) -> Floats:
    """States at the horizons, (P, M, H, 13), of the vehicle with each of P candidates' numbers.

    All fly at once, much faster than one after the other. A physics step is the period of the
    samples.
    """
    count = len(candidates)
    share, steps, rotors = windows.speeds.shape[-3:]
    starts = count * share
    speeds = np.broadcast_to(windows.speeds, (count, share, steps, rotors))
    speeds = speeds.reshape(starts, steps, rotors)
    start = np.broadcast_to(windows.start, (count, share, 13)).reshape(starts, 1, 13)
    numbers = {name: np.repeat([one[name] for one in candidates], share) for name in NAMES}
    each = {name: values[:, None] for name, values in numbers.items()}
    world = _world(vehicle, numbers, windows.period)
    inertias = np.stack([inertia_of(vehicle, one) for one in candidates])
    own = numbers_of(vehicle)["rotors.reaction"] or 1.0
    world.vary(
        inertia=np.repeat(inertias, share, axis=0)[:, None],
        reaction=each["rotors.reaction"] / own,
    )
    air = world.effects.air
    air.linear = tuple(each[f"drag.linear.{axis}"] for axis in "xyz")
    air.angular = tuple(each[f"drag.angular.{axis}"] for axis in "xyz")
    air.moment = tuple(each[f"drag.moment.{axis}"] for axis in "xy")
    air.slope = np.sqrt(each["rotors.thrust_coefficient"])[..., None]
    air.drag = each["rotors.drag"][..., None]
    air.inflow = each["rotors.inflow"][..., None]
    air.lift = each["rotors.lift"][..., None]
    position, quaternion, velocity, rates = np.split(start, (3, 7, 10), axis=-1)
    initial = InitialState(
        position=position, quaternion=quaternion, velocity=velocity, body_rates=rates
    )
    world.reset(np.ones((starts, 1), bool), initial)
    states = np.full((starts, len(windows.horizons), 13), _LOST)
    coefficient = each["rotors.thrust_coefficient"]
    state = world.state
    with suppress(PhysicsError):  # of numbers far off, which a fit tries
        for step in range(steps):
            thrust = coefficient * mean_speeds(speeds, step) ** 2
            world.step(thrust[:, None], 1)
            if step + 1 in windows.horizons:
                motion = (state.position, state.quaternion, state.velocity, state.body_rates)
                horizon = windows.horizons.index(step + 1)
                states[:, horizon] = np.concatenate(motion, axis=-1)[:, 0]
    return states.reshape(count, share, -1, 13)


def _world(vehicle: Vehicle, numbers: Mapping[str, Floats], period: float) -> RigidWorld:
    """A world for each number, of a vehicle without limits of thrust; the air acts on it."""
    model = copy.copy(vehicle.model)
    model.opt.timestep = period
    model.actuator_ctrlrange *= _MORE_THRUST
    high = _MORE_THRUST * vehicle.thrust_high
    coefficients = Coefficients(vehicle.coefficients)
    coefficients |= dict.fromkeys(_REPLACED)  # the numbers take their place
    coefficients |= {"drag.linear": (0.0, 0.0, 0.0), "rotors.drag": 0.0}
    free = replace(vehicle, model=model, thrust_high=high, coefficients=coefficients)
    has_rotor_drag = any(numbers[name].any() for name in _ON_ROTORS)
    effects = EffectOptions(body_drag=True, rotor_drag=has_rotor_drag)
    count = len(numbers["rotors.drag"])
    nothing = Scenery(SceneConfig(), Solids.none(), count)
    return RigidWorld(free, count, effects=effects, scenery=nothing, dtype="float64")


def differences(predicted: Floats, truth: Floats) -> Floats:
    """Predicted less measured, of states (..., 13): shape (..., 4, 3).

    Position, rotation vector, velocity and body rates.
    """
    turn = between(truth[..., 3:7], predicted[..., 3:7])
    turn = turn * np.where(turn[..., :1] < 0, -1.0, 1.0)
    size = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(size, turn[..., :1])
    share = np.divide(angle, size, out=np.full_like(size, 2.0), where=size > 1e-12)
    rest = predicted - truth
    parts = (rest[..., :3], turn[..., 1:] * share, rest[..., 7:10], rest[..., 10:])
    return np.stack(parts, axis=-2)
