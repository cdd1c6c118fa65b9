"""Force and torque of the air: drag of the body, drag, inflow and lift of rotors, ground effect."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ...models.errors import expect
from ..state import Array, WorldState, clip, component, constant, each, stack
from .options import EffectOptions
from .rotors import total

if TYPE_CHECKING:
    from ...models.vehicle import Vehicle

LEAST_HEIGHT: Final = 0.5
"""Height of a rotor over the ground, in radii, below which the ground effect grows no further. The
measurements in Cheeseman and Bennett (ARC R&M 3021, 1955) end there."""

Vector = tuple[Array, Array, Array]


class AirEffects:
    """The air around W worlds; the ground effect needs level ground at z = 0.

    Forces, in body axes, with v the velocity of a point through the air:

    * body, at the center of mass: -(linear + quadratic |v|) v, axis by axis;
    * each rotor, with speed Ω = sqrt(thrust / k), v_a its velocity along its axis and v_p in its
      plane: -drag Ω v_p, and along its axis -inflow Ω v_a + lift |v_p|² (as RotorPy, arXiv
      2306.04485, equations 4 to 6, models them);
    * each rotor at height z over the ground, with radius R: thrust / (1 - (R / 4z)²) in place of
      its thrust (Cheeseman and Bennett, ARC R&M 3021, 1955).
    """

    def __init__(self, vehicle: "Vehicle", options: EffectOptions, xp: Any) -> None:
        self._xp, self._options, self._step = xp, options, vehicle.timestep
        told, rotors = vehicle.coefficients, vehicle.rotors
        self._center = vehicle.center_of_mass.tolist()
        self._place = tuple(np.array([r.position for r in rotors]).T)
        self._axis = tuple(np.array([r.axis for r in rotors]).T)
        if options.body_drag:
            drag = told.drag
            given = drag.linear is not None or drag.quadratic is not None
            expected = "drag.linear or drag.quadratic in the vehicle's file, which body_drag needs"
            expect(given, "vehicle", expected, "none")
            none = (0.0, 0.0, 0.0)
            self._linear, self._quadratic = drag.linear or none, drag.quadratic or none
            self._check_stiffness(vehicle, max(self._linear))
        if options.rotor_drag:
            (self._coefficient,) = told.need("rotors.thrust_coefficient", "rotor_drag")
            three = (told.rotors.drag, told.rotors.inflow, told.rotors.lift)
            some = any(value is not None for value in three)
            expected = "rotors.drag, inflow or lift in the vehicle's file, which rotor_drag needs"
            expect(some, "vehicle", expected, "none")
            self._drag, self._inflow, self._lift = (value or 0.0 for value in three)
            speeds = np.sqrt(np.maximum(vehicle.thrust_high, 0.0) / self._coefficient)
            self._check_stiffness(vehicle, max(self._drag, self._inflow) * float(speeds.sum()))
        if options.ground_effect:
            (self._radius,) = told.need("rotors.radius", "ground_effect")
        self._factors: dict[str, Array] = {}
        self._before: tuple[Array, Array] | None = None

    def _check_stiffness(self, vehicle: "Vehicle", drag: float) -> None:
        """Refuse drag that the extrapolation over a physics step cannot follow."""
        most = 0.5 * vehicle.mass / vehicle.timestep
        expected = f"at most {most:.4g} N s/m of drag, half its mass over the physics step"
        expect(drag <= most, "vehicle", expected, f"{drag:.4g}")

    def begin(self, mask: Array, state: WorldState, factors: dict[str, Array]) -> None:
        """Begin at the motion of a state; factors (W, A) by parameter."""
        self._factors = factors
        now = (state.velocity + 0.0, state.body_rates + 0.0)
        if self._before is not None:
            where, chosen = self._xp.where, mask[..., None]
            now = tuple(where(chosen, a, b) for a, b in zip(now, self._before, strict=True))
        self._before = now

    def step(
        self, state: WorldState, thrust: Array, wind: Array | None, mask: Array | None
    ) -> tuple[Array, Array]:
        """Mean force, world frame, N, and torque about the body's origin, body frame, N·m.

        Both (W, A, 3); thrust (W, A, R), N; wind: velocity of the air, world frame, m/s.
        """
        xp, options = self._xp, self._options
        assert self._before is not None
        # The middle of the step: half of the last step's change further.
        velocity = 1.5 * state.velocity - 0.5 * self._before[0]
        rates = 1.5 * state.body_rates - 0.5 * self._before[1]
        if mask is None:
            self._before = (state.velocity + 0.0, state.body_rates + 0.0)
        else:
            chosen, old = mask[..., None], self._before
            self._before = (
                xp.where(chosen, state.velocity, old[0]),
                xp.where(chosen, state.body_rates, old[1]),
            )
        turn = _turned(state.quaternion, rates, 0.5 * self._step, xp)
        through = velocity if wind is None else velocity - wind
        v = _to_body(turn, _parts(through))
        w = _parts(rates)
        force: Vector = (0.0 * v[0],) * 3
        torque = force
        if options.body_drag:
            c = self._center
            u = tuple(a + b for a, b in zip(v, _cross(w, c), strict=True))
            size = xp.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
            factor = self._factors.get("body_drag", 1.0)
            drag = [
                -factor * (linear + quadratic * size) * x
                for linear, quadratic, x in zip(self._linear, self._quadratic, u, strict=True)
            ]
            force, torque = _add(force, drag), _add(torque, _cross(c, drag))
        if options.rotor_drag or options.ground_effect:
            push = self._rotors(state, turn, thrust, v, w)
            place = tuple(constant(x, thrust) for x in self._place)
            force = _add(force, [total(x) for x in push])
            torque = _add(torque, [total(x) for x in _cross(place, push)])
        return stack(_to_world(turn, force)), stack(torque)

    def _rotors(
        self, state: WorldState, turn: Any, thrust: Array, v: Vector, w: Vector
    ) -> list[Array]:
        """Force of each rotor besides its thrust, body axes: three of shape (W, A, R)."""
        xp, factors = self._xp, self._factors
        place = [constant(x, thrust) for x in self._place]
        axis = [constant(x, thrust) for x in self._axis]
        push = [0.0 * thrust] * 3
        if self._options.rotor_drag:
            turning = _cross([each(rate) for rate in w], place)
            hub = [each(x) + y for x, y in zip(v, turning, strict=True)]
            along = hub[0] * axis[0] + hub[1] * axis[1] + hub[2] * axis[2]
            plane = [x - along * n for x, n in zip(hub, axis, strict=True)]
            speed = xp.sqrt(clip(thrust, 0.0, np.inf) / self._coefficient)
            if "rotor_drag" in factors:
                speed = speed * each(factors["rotor_drag"])
            sideways = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
            up = self._lift * sideways - self._inflow * speed * along
            push = [up * n - self._drag * speed * x for n, x in zip(axis, plane, strict=True)]
        if self._options.ground_effect:
            x, y, z = (each(cosine) for cosine in turn[6:])  # of each body axis: its part upwards
            height = each(component(state.position, 2)) + x * place[0] + y * place[1]
            height = height + z * place[2]
            ratio = self._radius / (4 * clip(height, LEAST_HEIGHT * self._radius, np.inf))
            more = thrust * (1 / (1 - ratio * ratio) - 1)
            push = [x + more * n for x, n in zip(push, axis, strict=True)]
        return push


def _parts(vectors: Array) -> Vector:
    return component(vectors, 0), component(vectors, 1), component(vectors, 2)


def _add(a: Any, b: Any) -> Any:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _cross(a: Any, b: Any) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _turned(quaternion: Array, rates: Array, time: float, xp: Any) -> tuple[Array, ...]:
    """Rotation matrix, row by row, after such a time of turning at these body rates."""
    w, x, y, z = (component(quaternion, i) for i in range(4))
    a, b, c = (0.5 * time * rate for rate in _parts(rates))
    w, x, y, z = (
        w - a * x - b * y - c * z,
        x + a * w + c * y - b * z,
        y + b * w + a * z - c * x,
        z + c * w + b * x - a * y,
    )
    s = 2 / (w * w + x * x + y * y + z * z)
    return (
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip


def _to_world(m: tuple[Array, ...], v: Any) -> Vector:
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


def _to_body(m: tuple[Array, ...], v: Any) -> Vector:
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )
