"""Motion of rigid bodies in free flight, as arithmetic on vectors.

Every component is a vector of its own, a number for each body, of any shape, or a number that
counts for all, and a number 0.0 costs nothing: a craft whose rotors are parallel and whose center
of mass is its origin needs a third of the operations of any craft. Vectors are NumPy's, or the
variables of a trace (`kernel.py`).

Frames: world, z up, and the body's. Position and velocity are those of the body's origin.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...models import matrices
from ...models.drawn import columns
from ...models.vehicle import Vehicle
from .. import elementary
from ..randomize import CENTER, LEAST_MASS
from ..rotations import product, transposed
from ..state import Array, parts_of

Vector = tuple[Array, Array, Array]
Push = tuple[Vector, Vector, Vector]
"""What acts on a body, constant over a physics step, besides gravity and the air: the force of the
rotors over the mass, body frame, m/s²; the angular acceleration by the torque about the center of
mass, body frame, rad/s²; the force at the body's origin over the mass, world frame, m/s²."""

_NOTHING = 1e-12  # of the largest number of its kind: what rounding leaves
_ZERO: Vector = (0.0, 0.0, 0.0)
_FURTHEST = (4 * math.pi) ** 2
_SINGLE, _DOUBLE = elementary.wave_series(8), elementary.wave_series(13)
"""Up to π / 2 the next terms are below the rounding of float32, and of float64."""
_BORTZ = (
    2.0742872904159143e-11,
    3.3571419266571038e-09,
    5.637370282876806e-07,
    0.00010564110705334667,
    0.03267274151216445,
)
"""Of Bortz's coefficient without its pole at a turn, powers 8, 6... of the angle:
2 (ζ(2 n) - 1) / (2 π)^(2 n), n = 5 to 1, with Riemann's ζ."""
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)
"""Of a cross product: (a × b)ᵢ = Σ _CROSS[i, j, k] aⱼ bₖ."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Motion(NamedTuple):
    """State of bodies, each component a vector, SI units."""

    position: Array
    """World frame, three."""
    quaternion: Array
    """From body to world, four."""
    velocity: Array
    """World frame, three."""
    rates: Array
    """Angular velocity, body frame, three."""


class Varying(NamedTuple):
    """What may differ between worlds: numbers for all of them, or vectors where it is drawn."""

    mass: Array
    """kg."""
    easier: Array
    """One over the factor of the inertia that all its parts have."""
    turn: Array
    """Inverse of the inertia without that factor, three rows."""
    gyroscopic: Array
    """Factors of `_euler`."""
    torques: Array
    """Of one newton of each rotor about the center of mass, N·m, three rows of R."""
    reaction: Array
    """Factor of the rotors' torque about their axes, or None."""
    shift: Vector
    """Of the center of mass, body frame, m."""
    center: Vector
    """The center of mass, body frame, m."""


class RigidBody:
    """A vehicle's equations of motion, and MuJoCo's RK4 over its physics step.

    With the center of mass c, body frame; s the force on the body over its mass but gravity, body
    frame; R the attitude; τ the torque about c:

        origin'' = R (s - ω' × c - ω × (ω × c)) - g z,    I ω' = τ - ω × I ω.

    `linear_drag` acts at the origin. The stages of the classical Runge-Kutta method add up for
    rotation vectors, not for quaternions, so it integrates the former (Munthe-Kaas, BIT 38, 1998).

    Attributes:
        varying: As the last `vary` left it.
    """

    varying: Varying

    def __init__(self, vehicle: Vehicle) -> None:
        self._step = vehicle.timestep
        self._gravity = vehicle.gravity
        self._drag = vehicle.linear_drag
        self._least = (vehicle.mass, vehicle.center_of_mass.tolist())
        axes, reactions, places = (
            np.array([getattr(rotor, name) for rotor in vehicle.rotors]).T
            for name in ("axis", "reaction", "position")
        )
        levers = np.cross(places - vehicle.center_of_mass[:, None], axes, axis=0)
        size = abs(levers + reactions).max()
        self._axes = _sparse(axes)
        self._levers = _sparse(levers, size)
        self._reactions = _sparse(reactions, size)
        self._torques = _sparse(levers + reactions)
        self._of_inertia = _euler(vehicle.inertia)
        self.vary({})

    def vary(
        self,
        parameters: Mapping[str, Array],
        inertia: np.ndarray | None = None,
        craft: Array = None,
    ) -> None:
        """Take drawn parameters by their names, vectors.

        An inertia about the center of mass for each body, kg·m², (..., 3, 3), may replace the
        vehicle's; so may the numbers of drawn craft, as of `WorldState.craft`.
        """
        mass, center = self._least
        factor = parameters.get("mass", 1.0)
        turn, gyroscopic = self._of_inertia if inertia is None else _euler(inertia)
        whole = mass * factor
        if "load" in parameters:
            whole = np.maximum(whole + parameters["load"], LEAST_MASS * whole)
        shift: Vector = tuple(parameters.get(name, 0.0) for name in CENTER)
        torques = self._torques
        reaction = parameters.get("reaction")
        if craft is not None:
            turn, gyroscopic, torques, center = _of_craft(craft, reaction)
            reaction = None
        self.varying = Varying(
            mass=whole,
            easier=1.0 / factor / parameters.get("inertia", 1.0),
            turn=turn,
            gyroscopic=gyroscopic,
            torques=torques,
            reaction=reaction,
            shift=shift,
            center=tuple(a + b for a, b in zip(shift, center, strict=True)),
        )

    def fly(self, state: Array, thrust: Array, wrench: Array = None, steps: int = 1) -> list[Array]:
        """The 13 vectors of a state after physics steps, from those of `motion`.

        With R thrusts, N, and None, or a force and a torque as of `Effects.step`, six vectors.
        """
        push = self.push(thrust, wrench)
        now = motion(state)
        for _ in range(steps):
            now = self.advance(now, push)
        return [*now.position, *now.quaternion, *now.velocity, *now.rates]

    def push(self, thrust: Array, wrench: Array = None) -> Push:
        """Of thrusts, and a force and a torque, as of `fly`."""
        rotors = list(thrust)
        varying = self.varying
        force = forth(self._axes, rotors)
        if varying.reaction is None:
            torque = forth(varying.torques, rotors)
        else:
            both = zip(forth(self._levers, rotors), forth(self._reactions, rotors), strict=True)
            torque = tuple(added(a, (b, varying.reaction)) for a, b in both)
        torque = _plus(torque, _cross(force, varying.shift))
        outer = _ZERO
        if wrench is not None:
            parts = list(wrench)
            outer = _scaled(parts[:3], 1.0 / varying.mass)
            torque = _plus(torque, parts[3:])
        return _scaled(force, 1.0 / varying.mass), self._turned(torque), outer

    def acceleration(self, now: Motion, push: Push) -> tuple[Vector, Vector]:
        """Of the body's origin, world frame, m/s², and angular, body frame, rad/s²."""
        _, quaternion, velocity, rates = now
        inner, turning, outer = push
        varying = self.varying
        center = varying.center
        off = _is_there(center)
        if self._drag:
            outer = _plus(outer, velocity, -self._drag)
        if off and _is_there(outer):
            # The force at the origin has the torque -c × F about the center of mass.
            inside = forth(transposed(matrices.rotation(quaternion)), outer)
            lever = _cross(_scaled(inside, varying.mass), center)
            turning = _plus(turning, self._turned(lever))
        turning = tuple(
            added(start, *((factors[i][j], rates[i], rates[j]) for i, j in _PAIRS))
            for start, factors in zip(turning, varying.gyroscopic, strict=True)
        )
        if off:
            inner = _plus(inner, _cross(center, turning))
            inner = _plus(inner, _cross(_cross(rates, center), rates))
        x, y, z = _plus(_to_world(quaternion, inner), outer)
        return (x, y, added(z, (-self._gravity,))), turning

    def advance(self, now: Motion, push: Push) -> Motion:
        """The motion after a physics step."""
        h = self._step
        position, quaternion, velocity, rates = now
        stages = [(*self.acceleration(now, push), rates)]
        for part in (0.5 * h, 0.5 * h, h):
            linear, angular, spin = stages[-1]
            turned, square = _rotated(quaternion, spin, part)
            turning = _plus(rates, angular, part)
            moved = _plus(velocity, linear, part) if self._drag else velocity
            now = Motion(None, turned, moved, turning)
            follows = _of_rotation_vector(spin, part, square, turning)
            stages.append((*self.acceleration(now, push), follows))
        (a, u, p), (b, v, q), (c, w, r), (d, x, s) = stages
        # The stages' velocities are V, V + h/2 a, V + h/2 b and V + h c.
        early = _plus(_plus(a, b), c)
        late = _plus(_plus(b, c), d)
        turns = _plus(_plus(u, x), _plus(v, w), 2.0)
        middle = _plus(q, r)
        spin = _plus(_plus(p, s), middle, 2.0)
        return Motion(
            _plus(_plus(position, velocity, h), early, h * h / 6),
            _normalized(_rotated(quaternion, spin, h / 6)[0]),
            _plus(velocity, _plus(early, late), h / 6),
            _plus(rates, turns, h / 6),
        )

    def _turned(self, torque: Vector) -> Vector:
        """Angular acceleration by a torque about the center of mass, N·m."""
        return _scaled(forth(self.varying.turn, torque), self.varying.easier)


def motion(state: Array) -> Motion:
    """The motion of a state, 13 vectors."""
    x = list(state)
    return Motion(x[:3], x[3:7], x[7:10], x[10:])


def _euler(inertia: np.ndarray) -> tuple[Array, Array]:
    """Of inertias (..., 3, 3): their inverse, and of -I⁻¹ (ω × I ω) the factors of two rates.

    Each axis has a matrix of these factors, of which the upper half counts.
    """
    turn = matrices.inverse(inertia)
    torques = matrices.product(_CROSS, inertia[..., None, :, :])
    turned = matrices.product(turn, torques.reshape(*inertia.shape[:-1], 9))
    terms = -turned.reshape(torques.shape)
    folded = np.triu(terms) + np.triu(terms.swapaxes(-1, -2), 1)
    size = abs(terms).max()
    return _sparse(turn), [_sparse(folded[..., axis, :, :], size) for axis in range(3)]


def _of_craft(craft: Array, reaction: Array) -> tuple[Array, Array, Array, Vector]:
    """Of drawn craft: `turn`, `gyroscopic`, `torques` with a factor of the reactions or None, and
    the center of mass, as of `Varying`.
    """
    numbers = {name: parts_of(part) for name, part in columns(craft).items()}
    x, y, z = numbers["inertia"]
    turn = [[1.0 / x, 0.0, 0.0], [0.0, 1.0 / y, 0.0], [0.0, 0.0, 1.0 / z]]
    gyroscopic = [[[0.0] * 3 for _ in range(3)] for _ in range(3)]
    gyroscopic[0][1][2] = (y - z) / x
    gyroscopic[1][0][2] = (z - x) / y
    gyroscopic[2][0][1] = (x - y) / z
    yaw = numbers["yaw"]
    if reaction is not None:
        yaw = [one * reaction for one in yaw]
    torques = [numbers["y"], [-one for one in numbers["x"]], yaw]
    return turn, gyroscopic, torques, (0.0, 0.0, *numbers["center"])


def _sparse(matrix: np.ndarray, size: float | None = None) -> list[list[Array]]:
    """A matrix of vectors, or of numbers that count for all bodies, (..., n, m), as lists.

    What is nothing beside its largest number, or `size`, is the number 0.0.
    """
    least = _NOTHING * (abs(matrix).max() if size is None else size)
    rows = np.moveaxis(matrix, (-2, -1), (0, 1))
    if matrix.ndim == 2:
        rows = rows.astype(object)  # Python's numbers, which take the dtype of arrays
    return [[one if (abs(one) > least).any() else 0.0 for one in row] for row in rows]


def added(total: Array, *products: tuple[Array, ...]) -> Array:
    """The total and the products of some vectors and numbers, in the fewest operations."""
    for factors in products:
        share = math.prod(one for one in factors if isinstance(one, float))
        if share == 0.0:
            continue
        vectors = [one for one in factors if not isinstance(one, float)]
        if not vectors:
            total = total + share
            continue
        value = math.prod(vectors[1:], start=vectors[0])
        if share != 1.0:
            value = value * share
        is_nothing = isinstance(total, float) and total == 0.0
        total = value if is_nothing else total + value
    return total


def _is_there(vector: Array) -> bool:
    return any(not isinstance(x, float) or x != 0.0 for x in vector)


def _plus(a: Array, b: Array, share: float = 1.0) -> Vector:
    return tuple(added(x, (share, y)) for x, y in zip(a, b, strict=True))


def _scaled(vector: Array, share: Array) -> Vector:
    return tuple(added(0.0, (share, x)) for x in vector)


def _cross(a: Array, b: Array) -> Vector:
    p, q, r = a
    x, y, z = b
    return (
        added(0.0, (q, z), (-1.0, r, y)),
        added(0.0, (r, x), (-1.0, p, z)),
        added(0.0, (p, y), (-1.0, q, x)),
    )


def forth(matrix: Array, vector: Array) -> Vector:
    """Product of a matrix of three rows and a vector, or the thrusts of rotors."""
    return tuple(added(0.0, *zip(row, vector, strict=True)) for row in matrix)


def _to_world(quaternion: Array, vector: Vector) -> Vector:
    """A body vector in the world frame."""
    if _is_there(vector[:2]):
        return forth(matrices.rotation(quaternion), vector)
    w, x, y, z = quaternion
    up = vector[2]
    twice = up + up
    return (x * z + w * y) * twice, (y * z - w * x) * twice, up - (x * x + y * y) * twice


def _rotated(quaternion: Array, rates: Vector, time: float) -> tuple[Array, Array]:
    """A quaternion turned for a time at body rates, and the square of the angle.

    An eighth of the angle is doubled twice: right for angles up to 4 π.
    """
    x, y, z = rates
    square = (x * x + y * y + z * z) * (time * time)
    of_part = np.minimum(square, _FURTHEST) / 64
    series = _SINGLE if square.dtype == np.float32 else _DOUBLE
    cosine, sine = (elementary.polynomial(of_part, one) for one in series)
    for _ in range(2):  # the sine is that over the angle
        cosine, sine = 1.0 - 2.0 * of_part * (sine * sine), sine * cosine
        of_part = 4.0 * of_part
    share = sine * (0.5 * time)
    return product(quaternion, (cosine, x * share, y * share, z * share)), square


def _of_rotation_vector(spin: Vector, time: float, square: Array, rates: Vector) -> Vector:
    """Derivative of the rotation vector r = spin · time at body rates in the turned frame.

    rates + r × rates / 2 + k r × (r × rates), k = (1 - |r| / 2 · cot(|r| / 2)) / |r|² (Bortz,
    IEEE Trans. AES-7, 1971): the sum of 2 / ((2 π n)² - |r|²) over n > 0. Here up to |r| = π.
    """
    square = np.minimum(square, math.pi**2)
    series = elementary.polynomial(square, _BORTZ)
    series = (series + 2.0 / (4 * math.pi**2 - square)) * (time * time)
    once = _cross(spin, rates)
    twice = _cross(spin, once)
    return tuple(
        added(w, (0.5 * time, a), (series, b)) for w, a, b in zip(rates, once, twice, strict=True)
    )


def _normalized(quaternion: Array) -> Array:
    """A quaternion whose size is nearly 1: Newton's step towards 1."""
    w, x, y, z = quaternion
    share = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)
    return w * share, x * share, y * share, z * share
