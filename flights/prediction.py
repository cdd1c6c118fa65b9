"""Open-loop prediction of recorded flights: thousands of starts at once, in NumPy.

A start is a measured state of a flight. From there the rotor speeds that were measured, and nothing
else, move a rigid body with the equations of `sim/effects/air.py`; after each horizon the result is
compared with what was measured. System identification fits the numbers of an `Airframe` to that.

Vectors have their component as the first axis and the start as the last, as (3, M): sums over
components are then sums of contiguous rows. World x, y, z with z up; body x forward, y left, z up;
quaternions scalar first; SI.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from ..models.vehicle import Vehicle

Floats = npt.NDArray[np.float64]

ENTRIES: Final[Mapping[str, tuple[str, int | tuple[int, int] | None]]] = {
    "rotors.thrust_coefficient": ("thrust_coefficient", None),
    "rotors.reaction": ("reaction", None),
    "rotors.drag": ("drag", None),
    "rotors.inflow": ("inflow", None),
    "rotors.lift": ("lift", None),
    **{f"body.inertia.{axis}": ("inertia", (i, i)) for i, axis in enumerate("xyz")},
    **{f"drag.linear.{axis}": ("linear", i) for i, axis in enumerate("xyz")},
    **{f"drag.angular.{axis}": ("angular", i) for i, axis in enumerate("xyz")},
    **{f"drag.moment.{axis}": ("moment", i) for i, axis in enumerate("xy")},
}
"""Numbers of an `Airframe` that can be fitted: its field, and where in it."""


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A recorded flight on a uniform grid of N times. Arrays have the time as their first axis."""

    name: str
    period: float
    """Between two samples, s."""
    position: Floats
    """Of the body's origin, world frame, m, shape (N, 3)."""
    quaternion: Floats
    """From body to world, shape (N, 4)."""
    velocity: Floats
    """Of the body's origin, world frame, m/s, shape (N, 3)."""
    body_rates: Floats
    """Body frame, rad/s, shape (N, 3)."""
    speeds: Floats
    """Of the rotors in the vehicle's order, rad/s, shape (N, R)."""


@dataclass(frozen=True, kw_only=True)
class Airframe:
    """Numbers of a vehicle that move it. Units as in `models/coefficients.py`."""

    mass: float
    gravity: float
    center: Floats
    """Of mass, body frame, m, shape (3,)."""
    inertia: Floats
    """About the center of mass, kg·m², shape (3, 3)."""
    place: Floats
    """Of the rotors, body frame, m, shape (3, R)."""
    axis: Floats
    """Of their thrusts, shape (3, R)."""
    turn: Floats
    """Sign of each reaction about the rotor's axis, shape (R,)."""
    thrust_coefficient: float
    reaction: float
    """N·m per N, at least 0."""
    drag: float
    inflow: float
    lift: float
    linear: Floats
    angular: Floats
    moment: Floats

    @classmethod
    def of(cls, vehicle: Vehicle) -> Self:
        """The numbers of a vehicle; those of effects that its file lacks are 0.

        Raises `InputError` if it has no thrust coefficient.
        """
        told = vehicle.coefficients
        (coefficient,) = told.need("rotors.thrust_coefficient", "a prediction from rotor speeds")
        rotors = vehicle.rotors
        axis = np.array([rotor.axis for rotor in rotors]).T
        reaction = (np.array([rotor.reaction for rotor in rotors]).T * axis).sum(axis=0)
        return cls(
            mass=vehicle.mass,
            gravity=vehicle.gravity,
            center=vehicle.center_of_mass.copy(),
            inertia=vehicle.inertia.copy(),
            place=np.array([rotor.position for rotor in rotors]).T,
            axis=axis,
            turn=np.sign(reaction),
            thrust_coefficient=coefficient,
            reaction=float(np.abs(reaction).mean()),
            drag=told.rotors.drag or 0.0,
            inflow=told.rotors.inflow or 0.0,
            lift=told.rotors.lift or 0.0,
            linear=np.array(told.drag.linear or (0.0, 0.0, 0.0)),
            angular=np.array(told.drag.angular or (0.0, 0.0, 0.0)),
            moment=np.array(told.drag.moment or (0.0, 0.0)),
        )

    def value(self, name: str) -> float:
        """The number of an entry."""
        field, where = ENTRIES[name]
        array = getattr(self, field)
        return float(array if where is None else array[where])

    def with_values(self, values: Mapping[str, float]) -> Self:
        """A copy with other numbers, by the names of `ENTRIES`."""
        changed: dict[str, Any] = {}
        for name, value in values.items():
            field, where = ENTRIES[name]
            if where is None:
                changed[field] = value
            else:
                changed.setdefault(field, getattr(self, field).copy())[where] = value
        return replace(self, **changed)


@dataclass(frozen=True, kw_only=True)
class Windows:
    """M starts of flights, what the rotors did from there on, and what was measured.

    `speeds` has shape (H, R, M) for H steps of `period`; the others have one array (K, M) for a
    start, and for each horizon of `horizons`, in steps.
    """

    period: float
    horizons: tuple[int, ...]
    speeds: Floats
    start: tuple[Floats, Floats, Floats, Floats]
    """Position, quaternion, velocity and body rates."""
    truth: Mapping[int, tuple[Floats, Floats, Floats, Floats]]
    flight: npt.NDArray[np.int_]
    """Index of the flight of each start, shape (M,)."""
    index: npt.NDArray[np.int_]
    """Sample of the flight at which it starts, shape (M,)."""

    @classmethod
    def cut(
        cls, flights: Sequence[Flight], steps: int, stride: int, horizons: Sequence[int] = ()
    ) -> Self:
        """Starts at every `stride`-th sample after which the flight has `steps` more."""
        horizons = tuple(horizons) or (steps,)
        starts = [np.arange(0, len(one.position) - steps, stride) for one in flights]

        def taken(one: Flight, at: npt.NDArray[np.int_]) -> list[Floats]:
            arrays = (one.position, one.quaternion, one.velocity, one.body_rates)
            return [array[at].T for array in arrays]

        def joined(shift: int) -> Any:
            parts = [taken(one, at + shift) for one, at in zip(flights, starts, strict=True)]
            return tuple(np.concatenate(arrays, axis=-1) for arrays in zip(*parts, strict=True))

        spans = [at[:, None] + np.arange(steps) for at in starts]
        speeds = np.concatenate([f.speeds[s] for f, s in zip(flights, spans, strict=True)])
        return cls(
            period=flights[0].period,
            horizons=horizons,
            speeds=np.ascontiguousarray(speeds.transpose(1, 2, 0)),
            start=joined(0),
            truth={h: joined(h) for h in horizons},
            flight=np.concatenate([np.full(len(at), i) for i, at in enumerate(starts)]),
            index=np.concatenate(starts),
        )

    def inputs(self, step: int) -> Floats:
        """Rotor speeds between a sample and the next, (R, M): the mean of both.

        Past the last sample that a prediction may know, those of that one.
        """
        after = self.speeds[min(step + 1, len(self.speeds) - 1)]
        between: Floats = 0.5 * (self.speeds[step] + after)
        return between


def predict(
    airframes: Airframe | Sequence[Airframe], windows: Windows, speeds: Floats | None = None
) -> Iterator[tuple[int, tuple[Floats, ...]]]:
    """Each horizon, and position, quaternion, velocity and body rates there, (K, M) each.

    Of P airframes they are (K, P M), one after the other: much faster than one call for each.
    `speeds`, (H, R, P M), takes the place of those of the windows. The midpoint rule over each
    sample's period: of second order, as the effects of the simulator.
    """
    several = [airframes] if isinstance(airframes, Airframe) else list(airframes)
    numbers = _Numbers(several, windows.start[0].shape[-1])
    position, q, velocity, w = (np.tile(array, len(several)) for array in windows.start)
    h, center, count = windows.period, numbers.center, len(windows.speeds)
    down = np.array([0.0, 0.0, -several[0].gravity])[:, None]
    # The center of mass is what moves without regard to the turning.
    p = position + rotated(q, center + 0 * position)
    v = velocity + rotated(q, cross(w, center))
    for step in range(count):
        if speeds is None:
            inputs = np.tile(windows.inputs(step), len(several))
        else:
            inputs = 0.5 * (speeds[step] + speeds[min(step + 1, count - 1)])
        pull, turn = numbers.accelerations(inputs, rotated(conjugate(q), v), w)
        middle_q = product(q, from_rotation_vector(0.5 * h * w))
        middle_v = v + 0.5 * h * (rotated(q, pull) + down)
        middle_w = w + 0.5 * h * turn
        body_v = rotated(conjugate(middle_q), middle_v)
        pull, turn = numbers.accelerations(inputs, body_v, middle_w)
        p = p + h * middle_v
        v = v + h * (rotated(middle_q, pull) + down)
        q = product(q, from_rotation_vector(h * middle_w))
        w = w + h * turn
        if step + 1 in windows.horizons:
            shift, swing = rotated(q, center + 0 * p), rotated(q, cross(w, center))
            yield step + 1, (p - shift, q, v - swing, w)


class _Numbers:
    """Those of airframes that differ in the numbers of `ENTRIES`, a column for each start."""

    def __init__(self, airframes: Sequence[Airframe], starts: int) -> None:
        first = airframes[0]
        self._mass, self.center = first.mass, first.center[:, None]
        self._axis, self._arm = first.axis, first.place - self.center
        self._lever = np.cross(self._arm.T, first.axis.T).T
        self._spin = first.turn * first.axis

        def columns(field: str) -> Floats:
            return np.repeat(np.stack([getattr(a, field) for a in airframes], -1), starts, -1)

        self._coefficient, self._reaction = columns("thrust_coefficient"), columns("reaction")
        self._linear, self._angular = columns("linear"), columns("angular")
        self._moment, self._inertia = columns("moment"), columns("inertia")
        inverse = np.stack([np.linalg.inv(one.inertia) for one in airframes], -1)
        self._inverse = np.repeat(inverse, starts, -1)
        self._drag, self._inflow, self._lift = (columns(f) for f in ("drag", "inflow", "lift"))
        self._in_air = any(np.any(x) for x in (self._drag, self._inflow, self._lift))

    def accelerations(self, speeds: Floats, v: Floats, w: Floats) -> tuple[Floats, Floats]:
        """Of the center of mass without gravity, body axes, and of the body rates, (3, N) each.

        `speeds` (R, N); `v`: velocity of the center of mass, body axes; `w`: body rates.
        """
        force = -self._linear * v
        torque = -self._angular * w
        torque[0] += self._moment[0] * v[1]
        torque[1] -= self._moment[1] * v[0]
        thrust = self._coefficient * speeds * speeds
        force += self._axis @ thrust
        torque += self._lever @ thrust + self._reaction * (self._spin @ thrust)
        if self._in_air:
            n, r = self._axis[:, :, None], self._arm[:, :, None]
            hub = v[:, None] + cross(w[:, None], r)  # (3, R, N)
            along = (hub * n).sum(axis=0)
            plane = hub - along * n
            up = self._lift * (plane * plane).sum(axis=0) - self._inflow * speeds * along
            push = up * n - self._drag * speeds * plane
            force += push.sum(axis=1)
            torque += cross(r, push).sum(axis=1)
        torque -= cross(w, np.einsum("ijn,jn->in", self._inertia, w))
        return force / self._mass, np.einsum("ijn,jn->in", self._inverse, torque)


def differences(predicted: Sequence[Floats], truth: Sequence[Floats]) -> tuple[Floats, ...]:
    """Predicted less measured: position, rotation vector, velocity and body rates, (3, M) each."""
    turn = product(conjugate(truth[1]), predicted[1])
    turn = turn * np.where(turn[0] < 0, -1.0, 1.0)
    size = np.sqrt((turn[1:] ** 2).sum(axis=0))
    angle = 2 * np.arctan2(size, turn[0])
    rotation = turn[1:] * np.divide(angle, size, out=np.full_like(size, 2.0), where=size > 1e-12)
    return (
        predicted[0] - truth[0],
        rotation,
        predicted[2] - truth[2],
        predicted[3] - truth[3],
    )


# ---- vectors (3, M) and quaternions (4, M)


def cross(a: Floats, b: Floats) -> Floats:
    """Cross product."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a[1] * b[2], a[2] * b[1], out=out[0])
    np.subtract(a[2] * b[0], a[0] * b[2], out=out[1])
    np.subtract(a[0] * b[1], a[1] * b[0], out=out[2])
    return out


def conjugate(q: Floats) -> Floats:
    """The opposite rotation."""
    return np.stack((q[0], -q[1], -q[2], -q[3]))


def product(a: Floats, b: Floats) -> Floats:
    """First b, then a."""
    return np.stack(
        (
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        )
    )


def rotated(q: Floats, v: Floats) -> Floats:
    """A vector turned by a quaternion."""
    t = 2 * cross(q[1:], v)
    turned: Floats = v + q[0] * t + cross(q[1:], t)
    return turned


def from_rotation_vector(r: Floats) -> Floats:
    """Quaternion of a rotation vector, rad."""
    angle = np.sqrt((r * r).sum(axis=0))
    return np.concatenate((np.cos(angle / 2)[None], 0.5 * np.sinc(angle / (2 * np.pi)) * r))
