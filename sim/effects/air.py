"""Force and torque of the air: drag of the body, drag, inflow and lift of rotors, ground effect."""

import math

import numpy as np

from ... import models
from ...models import InputError
from ...models.matrices import cross, dot, rotation, times
from ..rotations import Parts, Rows, add, product, transposed
from ..snapshots import Kept
from ..state import (
    Array,
    ByName,
    WorldState,
    chosen,
    clip,
    parts_of,
    square_root,
    stack,
    total,
)  # fmt: skip
from .options import EffectOptions

LEAST_HEIGHT = 0.5
"""Height of a rotor over the ground, in radii, below which the ground effect grows no further: our
choice, since the formula has a pole at a quarter of a radius."""

_NOTHING = (0.0, 0.0, 0.0)


class AirEffects(Kept):
    """The air around W worlds; the ground effect needs level ground at z = 0.

    Forces, in body axes, with v the velocity of a point through the air:

    * body, at the center of mass: -(linear + quadratic |v|) v, axis by axis, and the torque
      -angular ω + moment × (v_y, -v_x), the latter about x and y;
    * each rotor, with speed Ω = sqrt(thrust / k), v_a its velocity along its axis and v_p in its
      plane: -drag Ω v_p, and along its axis -inflow Ω v_a + lift |v_p|² (rotor drag and
      translational lift of RotorPy, arXiv 2306.04485, whose moment of flapping is left out);
    * each rotor at height z over the ground, with radius R: thrust / (1 - (R / 4z)²) in place of
      its thrust (Cheeseman and Bennett, ARC R&M 3021, 1955).

    Coefficients may be set to those of each drone before the first episode.

    Attributes:
        acts: Whether an effect is on.
        linear, quadratic, angular: Of the body's drag, of each axis a number or (W, A).
        moment: The same of two axes. None of it, or of `angular`: there is none.
        drag, inflow, lift: Of rotors, numbers or (W, A, 1).
        slope: Square root of a rotor's thrust over its speed, a number or (W, A, 1).
    """

    arrays = ("_before",)
    _before: Array = None
    """The last motion."""

    def __init__(self, vehicle: "models.Vehicle", options: EffectOptions) -> None:
        self._options = options
        self.acts = options.body_drag or options.rotor_drag or options.ground_effect
        self._half = 0.5 * vehicle.timestep
        coefficients = vehicle.coefficients
        self._center: Parts = tuple(vehicle.center_of_mass.tolist())
        geometry = np.array([(*rotor.position, *rotor.axis) for rotor in vehicle.rotors])
        self._rotors = list(geometry.T)  # positions and axes: six of shape (R,)
        if options.body_drag:
            names = ("angular", "moment", "linear", "quadratic")
            drag = [coefficients[f"drag.{name}"] for name in names]
            if drag == [None] * 4:
                raise InputError(
                    "vehicle: expected drag.linear or drag.quadratic in the vehicle's file, which "
                    "body_drag needs, got none"
                )
            self.angular, self.moment, linear, quadratic = drag
            self.linear = linear or _NOTHING
            self.quadratic = quadratic or _NOTHING
            # Of a fall at its terminal velocity, sqrt(weight / quadratic), the slope of the drag.
            weight = vehicle.mass * vehicle.gravity
            slope = max(self.linear) + 2 * math.sqrt(max(self.quadratic) * weight)
            _check_stiffness(vehicle, slope, "drag of the body")
            turning = vehicle.mass / _least_moment(vehicle)
            slope = turning * max(self.angular or _NOTHING)
            _check_stiffness(vehicle, slope, "drag.angular, times mass over inertia,")
        if options.rotor_drag:
            (coefficient,) = coefficients.need("rotors.thrust_coefficient", "rotor_drag")
            self.slope = math.sqrt(coefficient)  # of the square root of a thrust over the speed
            three = [coefficients[f"rotors.{name}"] for name in ("drag", "inflow", "lift")]
            if three == [None] * 3:
                raise InputError(
                    "vehicle: expected rotors.drag, inflow or lift in the vehicle's file, which "
                    "rotor_drag needs, got none"
                )
            self.drag, self.inflow, self.lift = (value or 0.0 for value in three)
            speeds = np.sqrt(np.maximum(vehicle.thrust_high, 0.0)) / self.slope
            slope = max(self.drag, self.inflow) * float(speeds.sum())
            # Of a turn: about the least moment of inertia, at the longest arm.
            arm = float(((geometry[:, :3] - vehicle.center_of_mass) ** 2).sum(axis=1).max())
            turning = vehicle.mass * arm / _least_moment(vehicle)
            _check_stiffness(vehicle, slope * max(1.0, turning), "drag of the rotors")
        if options.ground_effect:
            (self._radius,) = coefficients.need("rotors.radius", "ground_effect")

    def begin(self, mask: Array, state: WorldState) -> None:
        """Begin at the motion of a state."""
        self._before = chosen(mask, _motion(state), self._before)

    def take(self, factors: ByName) -> None:
        """Take the factors of drawn parameters, (W, A), by name."""
        self._factors = factors

    def step(
        self,
        state: WorldState,
        thrust: Array,
        root: Array | None,
        wind: Parts,
        mask: Array | None,
    ) -> Array:
        """Mean force, world frame, N, and torque about the body's origin, body frame, N·m.

        Shape (W, A, 6); mean thrust (W, A, R), N, and mean of its square root, None where it does
        not change over the step; wind: the velocity of the air, world frame, m/s, three of shape
        (W, A) or numbers for all.
        """
        now = _motion(state)
        # The middle of the step: half of the last step's change further.
        ahead = parts_of(1.5 * now - 0.5 * self._before)
        self._before = chosen(mask, now, self._before)
        w = ahead[3:]
        turn = _turned(state.quaternion, w, self._half)
        through = (ahead[0] - wind[0], ahead[1] - wind[1], ahead[2] - wind[2])
        v = times(transposed(turn), through)
        force: Parts = _NOTHING
        torque: Parts = _NOTHING
        if self._options.body_drag:
            force, torque = self._body(v, w)
        if self._options.rotor_drag or self._options.ground_effect:
            height = state.position[..., 2] + self._half * ahead[2]
            around = [number[..., None] for number in (*v, *w, *turn[2], height)]
            push = self._push(thrust, root, around)
            force = add(force, list(map(total, push)))
            torque = add(torque, list(map(total, cross(self._rotors, push))))
        return stack((*times(turn, force), *torque))

    def _body(self, v: Parts, w: Parts) -> tuple[Parts, Parts]:
        """Drag of the body, body axes: force, and torque about the body's origin."""
        v = add(v, cross(w, self._center))
        speed = square_root(dot(v, v))
        factor = self._factors.get("body_drag", 1.0)
        both = zip(self.linear, self.quadratic, v, strict=True)
        x, y, z = (-factor * (linear + quadratic * speed) * u for linear, quadratic, u in both)
        torque = cross(self._center, (x, y, z))
        if self.angular is not None:
            pairs = zip(torque, self.angular, w, strict=True)
            roll, pitch, yaw = (t - factor * k * rate for t, k, rate in pairs)
            torque = roll, pitch, yaw
        if self.moment is not None:
            roll, pitch = (factor * k for k in self.moment)
            torque = torque[0] + roll * v[1], torque[1] - pitch * v[0], torque[2]
        return (x, y, z), torque

    def _push(self, thrust: Array, root: Array | None, around: list[Array]) -> Parts:
        """Forces of rotors besides their thrusts, body axes; thrust and root as of `step`.

        `around`: velocity, body rates, the upward component of each body axis, and the height of
        the body's origin.
        """
        place = self._rotors[:3]
        axis = self._rotors[3:]
        thrust = clip(thrust, 0.0, math.inf)
        up = 0.0
        push: Parts = _NOTHING
        if self._options.rotor_drag:
            x, y, z = add(around, cross(around[3:6], place))
            along = dot((x, y, z), axis)
            plane = (x - along * axis[0], y - along * axis[1], z - along * axis[2])
            root = square_root(thrust) if root is None else root
            speed = root / self.slope
            if "rotor_drag" in self._factors:
                speed = speed * self._factors["rotor_drag"][..., None]
            up = self.lift * dot(plane, plane) - self.inflow * speed * along
            drag = -self.drag * speed
            push = (drag * plane[0], drag * plane[1], drag * plane[2])
        if self._options.ground_effect:
            x, y, z, origin = around[6:]
            height = origin + dot((x, y, z), place)
            ratio = self._radius / (4 * clip(height, LEAST_HEIGHT * self._radius, math.inf))
            share = ratio * ratio
            up = up + thrust * (share / (1 - share))
        return push[0] + up * axis[0], push[1] + up * axis[1], push[2] + up * axis[2]


def _least_moment(vehicle: "models.Vehicle") -> float:
    """Least principal moment of inertia, kg·m²."""
    return float(np.linalg.eigvalsh(vehicle.inertia)[0])


def _check_stiffness(vehicle: "models.Vehicle", slope: float, what: str) -> None:
    """Refuse drag that the extrapolation over a physics step cannot follow."""
    most = 0.5 * vehicle.mass / vehicle.timestep
    if not slope <= most:
        raise InputError(
            f"vehicle: expected {what} of at most {most:.4g} N s/m, half its mass over the physics "
            f"step, got {slope:.4g}"
        )


def _motion(state: WorldState) -> Array:
    """Velocity and body rates, a copy, shape (W, A, 6)."""
    return np.concat((state.velocity, state.body_rates), axis=-1)


def _turned(quaternion: Array, rates: Parts, time: float) -> Rows:
    """Rotation matrix from body to world after such a time of turning at these body rates."""
    half = 0.5 * time
    spin = (1.0, half * rates[0], half * rates[1], half * rates[2])
    turned = product(parts_of(quaternion), spin)
    w, x, y, z = turned
    return rotation(turned, 2 / (w * w + x * x + y * y + z * z))
