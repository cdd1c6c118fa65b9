"""The levels rates, attitude, velocity and position: each loop built on the one below.

Attitude control after T. Lee, M. Leok, N. H. McClamroch, "Control of Complex Maneuvers for a
Quadrotor UAV using Geometric Methods on SE(3)", arXiv 1003.2005, 2010: with the attitude R, the
body rates Ω, their wanted values R_d and Ω_d, and the inertia J,

    f = (m a_d + m g e₃) · R e₃
    M = -k_R e_R - k_Ω e_Ω + Ω × J Ω,   e_Ω = Ω - Rᵀ R_d Ω_d,

with k_R = kᵣ kₐ J and k_Ω = kᵣ J: a rate loop follows Rᵀ R_d Ω_d - kₐ e_R. R_d comes from R by the
shortest turn of the thrust axis to the wanted one. Of that turn, by an angle θ, e_R has the size
2 sin(θ / 2), after T. Lee, "Exponential stability of an attitude tracking control system on SO(3)
for large-angle rotational maneuvers", Systems & Control Letters 61, 2012; the sin θ of 2010
vanishes upside down. Wanted angular accelerations are left out.

Array code with any leading axes.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from ... import models
from ...models.matrices import dot, times
from ..effects import EffectOptions
from ..elementary import cos, polynomial, sin
from ..rotations import Parts, Rows, axes_of
from ..state import Array, WorldState, clip, interpolated, parts_of, square_root, stack
from .gains import Gains

Numbers = tuple[float, ...]
_ASIDE = 1e-3  # Upside down every way to turn is as short: it is about x
_TINY = 1e-12  # Added to squares under a root, whose slope at 0 is infinite
_STEPS = 1024  # of the table that inverts a thrust curve: right to 1e-6
_HALVINGS = 53


class AroundHover:
    """Thrusts as numbers in [-1, 1]: 0 is the thrust at hover, -1 the least, 1 the largest.

    Args:
        low, hover, high: These thrusts, N, numbers or of each rotor, (R,).
    """

    def __init__(self, low: Array, hover: Array, high: Array) -> None:
        self._hover = hover
        self._up = high - hover
        self._down = hover - low

    def thrust(self, share: Array) -> Array:
        """N, of numbers; one beyond a bound counts as the bound."""
        above = clip(share, 0.0, 1.0)
        below = clip(share, -1.0, 0.0)
        return self._hover + self._up * above + self._down * below

    def share(self, thrust: Array) -> Array:
        """The numbers of thrusts, N."""
        over = thrust - self._hover
        return over / np.where(over > 0.0, self._up, self._down)


class Mixing:
    """What levels share whose loops mix thrusts: a vehicle's numbers, and rotors that are driven.

    An action has four numbers, which `sizes` scales.
    """

    every_step = True
    choices = 0
    low: Numbers = (-1.0,) * 4
    high: Numbers = (1.0,) * 4
    components: tuple[str, ...]
    units: tuple[str, ...]
    frame = "body"

    def __init__(self, vehicle: "models.Vehicle", gains: Gains, effects: EffectOptions) -> None:
        self.gains = gains
        self._sizes = self.sizes(gains)
        self.constants: dict[str, float | Numbers] = {"action_scale": self._sizes}
        self._mass = vehicle.mass
        self._gravity = vehicle.gravity
        self._inertia = vehicle.inertia.tolist()
        self._low = vehicle.thrust_low.tolist()
        self._high = vehicle.thrust_high.tolist()
        self._throttle: np.ndarray | None = None
        if effects.thrust_curve:
            (curve,) = vehicle.coefficients.need("rotors.curve", "thrust_curve")
            self._throttle = _throttle(curve)

    def sizes(self, gains: Gains) -> Numbers:
        """Values of actions of 1."""
        raise NotImplementedError

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        raise NotImplementedError

    def _driven(
        self, wanted: list[Array], state: WorldState, lead: Array, most: Sequence[Array]
    ) -> Array:
        """Commands, at most so many newtons, that make rotors with a lag and a thrust curve give
        these thrusts.
        """
        if not isinstance(lead, float) or lead != 1.0:
            now = parts_of(state.thrust)
            wanted = [old + lead * (new - old) for old, new in zip(now, wanted, strict=True)]
        commands = list(map(clip, wanted, self._low, most))
        table = self._throttle
        if table is not None:
            both = zip(commands, self._high, strict=True)
            commands = [
                high * interpolated(table, _STEPS * square_root(part / high)) for part, high in both
            ]
        return stack(commands)

    def _scaled(self, action: Array) -> list[Array]:
        pairs = zip(parts_of(action), self._sizes, strict=True)
        return [size * clip(part, -1.0, 1.0) for part, size in pairs]


class Rates(Mixing):
    """Collective thrust and body rates.

    The rate loop: torque = J kᵣ (wanted rates - rates) + rates × J rates. The mixing: torques of
    roll and pitch come first, scaled down alike where they span more than the rotors' range; then
    the collective thrust moves as little as makes room for them; yaw gets the room that is left.
    """

    components: tuple[str, ...] = ("collective thrust", "roll rate", "pitch rate", "yaw rate")
    units: tuple[str, ...] = ("1", "rad/s", "rad/s", "rad/s")

    def __init__(self, vehicle: "models.Vehicle", gains: Gains, effects: EffectOptions) -> None:
        super().__init__(vehicle, gains, effects)
        hover = vehicle.mass * vehicle.gravity
        self.collective = AroundHover(gains.lowest, hover, gains.highest)

    def sizes(self, gains: Gains) -> Numbers:
        """Values of actions of 1; that of a collective thrust is 1, which is its limit."""
        return (1.0, *gains.most_rate)

    def thrust(self, action: Array, state: WorldState) -> Array:
        """As `Controller.thrust`."""
        collective, rates = self.demands(action, state)
        return self.turn(collective, rates, state)

    def demands(self, action: Array, state: WorldState) -> tuple[Array, Parts]:
        """Collective thrust, N, and body rates, rad/s, that an action asks for."""
        share, *rates = self._scaled(action)
        return self.collective.thrust(share), rates

    def turn(self, collective: Array, rates: Parts, state: WorldState) -> Array:
        """Thrusts, N, shape (..., R), for a collective thrust, N, and body rates, rad/s."""
        p, q, r = parts_of(state.body_rates)
        about_x, about_y, about_z = self.gains.rate
        wanted = about_x * (rates[0] - p), about_y * (rates[1] - q), about_z * (rates[2] - r)
        roll, pitch, yaw = times(self._inertia, wanted)
        u, v, w = times(self._inertia, (p, q, r))
        torque = roll + (q * w - r * v), pitch + (r * u - p * w), yaw + (p * v - q * u)
        gains = self.gains
        thrusts = mixed(gains, collective, torque)
        return self._driven(thrusts, state, gains.lead, self._high)


class Attitude(Rates):
    """Collective thrust, roll, pitch and yaw rate.

    Roll and pitch are those of the order yaw, pitch, roll (z, y, x), from the present heading: the
    wanted thrust axis is (cos roll sin pitch, -sin roll, cos roll cos pitch) in the world frame
    turned by the heading. The yaw rate is that about the vertical.
    """

    components = ("collective thrust", "roll", "pitch", "yaw rate")
    units = ("1", "rad", "rad", "rad/s")
    frame = "world turned by the heading"

    def sizes(self, gains: Gains) -> Numbers:
        return 1.0, gains.most_tilt, gains.most_tilt, gains.most_rate[2]

    def demands(self, action: Array, state: WorldState) -> tuple[Array, Parts]:
        """As `Rates.demands`."""
        axes = axes_of(state.quaternion)
        collective, axis, yaw_rate = self.aimed(action, axes, state)
        return collective, self.rates_to(axis, yaw_rate, axes)

    def aimed(self, action: Array, axes: Rows, state: WorldState) -> tuple[Array, Parts, Array]:
        """Collective thrust, N, thrust axis, a unit vector of the world, and yaw rate about the
        vertical, rad/s, that an action asks for. `axes` are the body's in the world frame.
        """
        share, roll, pitch, yaw_rate = self._scaled(action)
        cosine = cos(roll)
        x, y = turned(axes[0], cosine * sin(pitch), -sin(roll))
        return self.collective.thrust(share), (x, y, cosine * cos(pitch)), yaw_rate

    def rates_to(self, axis: Parts, yaw_rate: Array, axes: Rows) -> Parts:
        """Body rates, rad/s, that turn the thrust axis to another, with a yaw rate."""
        x, y, z = times(axes, axis)
        aside = _ASIDE * (z < 0.0)
        # Of the turn by θ about (-y, x, 0) / sin θ: over cos(θ / 2), which is sqrt((1 + z) / 2).
        size = self.gains.attitude / square_root(0.5 * (1.0 + z) + 0.25 * (aside * aside))
        return size * (aside - y), size * x, yaw_rate * axes[2][2]


class Velocity(Attitude):
    """Velocity in the world frame turned by the heading, and yaw rate.

    Wanted acceleration = kᵥ (wanted velocity - velocity), within `Gains.most_acceleration`, upwards
    within `most_lift`, which a craft needs that is heavier than its file says. With gravity it
    gives the thrust axis, and along the present one the collective thrust.
    """

    components = ("velocity x", "velocity y", "velocity z", "yaw rate")
    units = ("m/s", "m/s", "m/s", "rad/s")

    def sizes(self, gains: Gains) -> Numbers:
        level, up = gains.most_velocity
        return level, level, up, gains.most_rate[2]

    def aimed(self, action: Array, axes: Rows, state: WorldState) -> tuple[Array, Parts, Array]:
        """As `Attitude.aimed`."""
        velocity, yaw_rate = self.moved(action, axes)
        collective, axis = self.aim(velocity, axes, state)
        return collective, axis, yaw_rate

    def moved(self, action: Array, axes: Rows) -> tuple[Parts, Array]:
        """Velocity in the world frame, m/s, and yaw rate, rad/s, that an action asks for."""
        x, y, z, yaw_rate = self._scaled(action)
        return (*turned(axes[0], x, y), z), yaw_rate

    def aim(self, velocity: Parts, axes: Rows, state: WorldState) -> tuple[Array, Parts]:
        """Collective thrust, N, and thrust axis for a velocity in the world frame, m/s."""
        gains = self.gains
        gravity = self._gravity
        level, up = gains.most_acceleration
        u, v, w = parts_of(state.velocity)
        k = gains.velocity
        x = k * (velocity[0] - u)
        y = k * (velocity[1] - v)
        z = gravity + clip(k * (velocity[2] - w), -up, gains.most_lift)
        # Sideways no more than what the largest tilt gives at this lift.
        share = clip(level / gravity * z / _length(x, y), 0.0, 1.0)
        x = share * x
        y = share * y
        size = square_root(x * x + y * y + z * z)
        collective = self._mass * dot((x, y, z), axes[2])
        return collective, (x / size, y / size, z / size)


class Position(Velocity):
    """A point at an offset from the craft, in the world frame turned by the heading; a heading.

    Wanted velocity = kₚ offset, no faster than what half the largest acceleration stops within the
    offset, and within `Gains.most_velocity`; wanted yaw rate = gain · offset of the heading.
    """

    components = ("offset x", "offset y", "offset z", "offset of the heading")
    units = ("m", "m", "m", "rad")

    def __init__(self, vehicle: "models.Vehicle", gains: Gains, effects: EffectOptions) -> None:
        super().__init__(vehicle, gains, effects)
        self.constants["position_gain"] = gains.position

    def sizes(self, gains: Gains) -> Numbers:
        level, up = gains.most_offset
        return level, level, up, math.pi

    def moved(self, action: Array, axes: Rows) -> tuple[Parts, Array]:
        """As `Velocity.moved`."""
        x, y, z, heading = self._scaled(action)
        gains = self.gains
        level, up = gains.most_acceleration
        fast, climb = gains.most_velocity
        along = self._gain(_length(x, y), level, fast)
        x, y = turned(axes[0], along * x, along * y)
        z = self._gain(_length(z), up, climb) * z
        most = gains.most_rate[2]
        return (x, y, z), clip(gains.heading * heading, -most, most)

    def _gain(self, distance: Array, acceleration: float, speed: float) -> Array:
        """Velocity over offset, 1/s."""
        braked = square_root(0.5 * acceleration / distance)
        return clip(reduce(np.minimum, [braked, speed / distance]), 0.0, self.gains.position)


def mixed(craft: Any, collective: Array, torque: Parts) -> list[Array]:
    """Thrust of each rotor, N, for a collective thrust, N, and a torque, N·m.

    Of the craft it needs `lowest`, `highest`, `mix` and `share`, as `Gains` has them: numbers, or
    arrays where craft differ.
    """
    roll, pitch, yaw = torque
    low = craft.lowest
    high = craft.highest
    added = [a * roll + b * pitch for a, b, _ in craft.mix]
    lower = reduce(np.minimum, added)
    upper = reduce(np.maximum, added)
    scale = clip((high - low) / clip(upper - lower, 1e-9 * high, math.inf), 0.0, 1.0)
    least = low - scale * lower
    most = high - scale * upper
    middle = reduce(np.minimum, [reduce(np.maximum, [collective + 0.0 * least, least]), most])
    parts = [middle + scale * part for part in added]
    yaws = [(part, c) for part, (*_, c) in zip(parts, craft.mix, strict=True) if _turns(c)]
    ends = [((low - part) / c, (high - part) / c) for part, c in yaws]
    # Where there is no room, the upper end holds.
    yaw = reduce(np.maximum, [yaw, *(np.minimum(*both) for both in ends)])
    yaw = reduce(np.minimum, [yaw, *(np.maximum(*both) for both in ends)])
    rotors = zip(craft.share, parts, craft.mix, strict=True)
    return [share * (part + c * yaw) for share, part, (*_, c) in rotors]


def _turns(yaw: Array) -> bool:
    """Whether a rotor takes part in yaw."""
    return not isinstance(yaw, float) or yaw != 0.0


def _throttle(curve: Numbers) -> np.ndarray:
    """Throttles of a thrust curve, over even steps of the square root of the thrust: its slope
    there is finite for curves of u² too.
    """
    root = np.arange(_STEPS + 1) / _STEPS
    low = np.zeros_like(root)
    high = np.ones_like(root)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        is_below = polynomial(middle, (0.0, *curve[::-1])) < root * root
        low = np.where(is_below, middle, low)
        high = np.where(is_below, high, middle)
    return low


def turned(nose: Parts, x: Array, y: Array) -> tuple[Array, Array]:
    """A horizontal vector of the frame turned by the heading, in the world frame.

    The heading is the direction of the nose on the ground; 0 where the nose is vertical.
    """
    length = _length(nose[0], nose[1])
    c = nose[0] / length
    s = nose[1] / length
    return c * x - s * y, s * x + c * y


def tilt_of(axis: Parts, nose: Parts) -> tuple[Array, Array]:
    """Roll and pitch, rad, of a thrust axis, a unit vector of the world, as of `Attitude`."""
    x, y, z = axis
    ahead, left = turned((nose[0], -nose[1]), x, y)
    return -np.arcsin(clip(left, -1.0, 1.0)), np.arctan2(ahead, z)


def _length(x: Array, y: Array = 0.0) -> Array:
    return square_root(x * x + y * y + _TINY)
