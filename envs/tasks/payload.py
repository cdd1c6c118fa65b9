"""A payload on a cable: one craft holds it at a point and damps its swing (`PayloadHover-v0`), or
drones carry it together (`Cable-v0`).
"""

import math
from dataclasses import replace
from typing import Annotated

import numpy as np

from ...models import InputError
from ...models.fields import Limits, immutable
from ...models.matrices import cross, right_inverse
from ...sim import Array, Draw, InitialState, atan2, cos, length, parts_of, sin, stack, total
from ..config import EnvConfig
from ..spec import Metric
from ..state import State
from .goal import (
    MAX_SPEED,
    WORST_RATES,
    Distance,
    GoalTask,
    Point,
    Speed,
    Tilt,
    along,
    at,
    check_cube,
    check_height,
    nearness,
)
from .swarm import Swarm, SwarmOptions, angles, approach, on_circle, ring, shared
from .task import Outcome, TaskOptions

SWING_WEIGHT = 0.1  # Cost of a payload that moves at 1 m/s relative to the craft
WORST_SWING = -0.4  # Of a payload at 4 m/s or faster

PAYLOAD_ERROR = Metric(name="payload_error", unit="m", settled=0.1, held=0.1, symbol="e")

Share = Annotated[float, Limits(0.001, 10.0)]
"""Of an option: mass of a payload over that of a vehicle."""


def with_payload(config: EnvConfig, mass: float, cable: float) -> EnvConfig:
    """The config with a payload that the task's options describe. Raises `InputError`."""
    given = [name for name in ("payload", "cable") if name in config.effects.to_options()]
    if given:
        raise InputError(
            "effects: expected a payload that the options of the task describe, "
            f"got {' and '.join(given)}"
        )
    return replace(config, effects=replace(config.effects, payload=mass, cable=cable))


def swing_cost(state: State) -> Array:
    """Reward for the speed of a payload relative to the craft, (W, A)."""
    speed = length(state.payload_velocity - state.velocity)
    return np.maximum(-SWING_WEIGHT * speed, WORST_SWING)


@immutable
class PayloadHoverOptions(TaskOptions):
    """Options of `rotorgram/PayloadHover-v0`."""

    goal: Point = (0.0, 0.0, 4.0)
    """Point at which to hold the payload: x, y, z in MuJoCo's world frame (z up), m."""
    payload_share: Share = 0.1
    """Mass of the payload over that of the vehicle."""
    cable: Annotated[float, Limits(0.05, 100.0, "m")] = 1.0
    """Length of the cable, m."""
    start_band: Distance = 1.0
    """Largest distance of the payload from the goal along each axis at the start, m."""
    start_speed: Speed = 1.0
    """Largest horizontal speed at the start along each axis, m/s, of craft and payload alike."""
    start_tilt: Tilt = 15.0
    """Largest tilt at the start, degrees, about a horizontal axis drawn uniformly."""
    flight_band: Distance = 3.0
    """An episode terminates when the payload is further than this from its goal, m."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        check_cube(self.flight_band, self.start_band)


class PayloadHover(GoalTask):
    """Hold a payload on a cable at a point, and damp its swing.

    The payload is the effect of that name, a ball on a tendon that is slack below its length. The
    task switches it on; its options `payload_share` and `cable` take the place of the effect's.

    ## Observation, `float32`, shape (21 + R,)

    Those of `GoalTask`, whose goal is above the payload's by the cable; then position and velocity
    of the payload minus those of the craft.

    Numbers are clipped: positions at twice the flight band or the cable, speeds at 100 m/s, rates
    at 100 rad/s. The payload's are exact, with sensors too: nothing measures them.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover without the payload,
    -1 its least, 1 its largest.

    ## Reward

    (s - d) / (s + d) for the distance d of the payload to its goal with s = 0.5 m; -0.1 s/m times
    the speed of the payload relative to the craft, up to 4 m/s; -0.02 s/rad times the size of the
    body rates, up to 20 rad/s; and -180 on the step that terminates.

    ## Start, termination, truncation

    The payload hangs straight down, within 1 m of the goal along each axis (`start_band`). Both
    move alike, by up to 1 m/s along x and y (`start_speed`): as soon as the craft brakes, the
    payload swings. The craft is tilted by up to 15° (`start_tilt`), at the thrust that carries
    both.

    *Terminated*: the payload further than 3 m from its goal (`flight_band`), a tilt above 90°, or
    contact of either. *Truncated*: after 250 steps of 0.02 s.
    """

    Options = PayloadHoverOptions
    worst_step = -1.0 + WORST_SWING + WORST_RATES
    metrics = (PAYLOAD_ERROR, Metric(name="swing", unit="deg", settled=5.0))

    def setup(self) -> None:
        """See the class."""
        from ...models.vehicle import payload_radius

        options = self.options
        radius = payload_radius(options.payload_share * self.vehicle.mass)
        check_height("goal", options.goal[2], radius + options.start_band)
        hung = along("payload - position", "m", 2 * options.cable)
        moving = along("payload velocity - velocity", "m/s", MAX_SPEED)
        self.define_observation(options.flight_band, hung + moving)

    def adjust(self, config: EnvConfig) -> EnvConfig:
        """The payload on its cable."""
        mass = self.options.payload_share * self.vehicle.mass
        return with_payload(config, mass, self.options.cable)

    def begin(self, draw: Draw) -> InitialState:
        """The payload near its goal, hanging still below a craft that moves and tilts."""
        options = self.options
        fastest = options.start_speed
        offset = self.offset(draw)
        tilted = self.tilted(draw)
        along = draw.uniform(-fastest, fastest)
        across = draw.uniform(-fastest, fastest)
        return InitialState(
            position=self._above(along) + offset,
            quaternion=tilted,
            velocity=stack((along, across, 0.0)),
            thrust=(1.0 + options.payload_share) * self.vehicle.hover_thrust,
        )

    def _above(self, like: Array) -> Array:
        """Above the payload's goal by the cable, (W, A, 3), m."""
        x, y, z = self.options.goal
        return at((x, y, z + self.options.cable), like)

    def place(self, state: State) -> Array:
        """Where the craft holds the payload at its goal."""
        return self._above(state.position[..., 0])

    def further(self, state: State) -> tuple[Array, Array]:
        """Position and velocity of the payload relative to the craft."""
        return state.payload - state.position, state.payload_velocity - state.velocity

    def outcome(self, state: State) -> Outcome:
        """Nearness of the payload, its swing; the end at contact, a flip-over, or too far away."""
        distance = length(self.goal(state) - state.payload)
        hung = state.position - state.payload
        swing = atan2(length(hung[..., :2]), hung[..., 2]) * (180 / math.pi)
        crashed = self.crashed(state, distance > self.options.flight_band)
        terms = {"payload": nearness(distance), "swing": swing_cost(state)}
        metrics = {"payload_error": distance, "swing": swing}
        return self.judged(state, terms, crashed, metrics)


@immutable
class CableOptions(SwarmOptions):
    """Options of `rotorgram/Cable-v0`. `center` is the point for the payload."""

    payload_share: Share = 0.2
    """Mass of the payload over that of all vehicles together."""
    angle: Annotated[float, Limits(5.0, 60.0, "degrees")] = 30.0
    """Angle of the cables to the vertical at the start, degrees. Their length follows from it and
    from `spacing`."""
    start_band: Annotated[float, Limits(0.0, 100.0)] = 0.5
    """Largest distance of the payload from the goal along each axis at the start, over the distance
    between neighbouring drones."""


class Cable(Swarm):
    """Drones carry a payload, each on a cable from its body's origin, and hold it at a point.

    ## Observation, `float32`, shape (24 + R + 7 k,), k = 7 (`neighbours`)

    The place where the payload would hang still at the goal minus the own position, then as
    `GoalTask`; position and velocity of the payload minus the own; goal of the payload minus its
    position; then of each neighbour, the nearest first, position and velocity minus the own, and 1,
    or seven zeros where no further drone is heard.

    The payload's numbers are exact, with sensors too: nothing measures them.

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward, the same for all but for rates and room

    (s - d) / (s + d) for the distance d of the payload to the goal, where s is half the distance
    between neighbouring drones; 0.1 s/m times the speed of the payload towards it; -0.1 s/m times
    the speed of the payload relative to the drone, up to 4 m/s; -0.02 s/rad times the size of the
    body rates, up to 20 rad/s; with less than two diameters between the drone's sphere and another,
    -1 where they touch, -1.5 at worst; and -350 on the step that terminates.

    ## Start, termination, truncation

    At rest in equilibrium: the drones on a level ring that is turned by lot, neighbours three
    diameters (`spacing`) apart, each tilted and with the thrusts that carry its share of the
    payload on a cable 30° (`angle`) off the vertical. The payload is off the goal by up to half
    the distance between neighbours along each axis (`start_band`).

    *Terminated*, for all drones at once: contact of any, a tilt above 90°, the payload on the
    ground or 10 m (`margin`) further from the goal than any start. *Truncated*: after 500 steps of
    0.02 s.
    """

    Options = CableOptions
    worst_step = Swarm.worst_step + WORST_SWING
    metrics = (PAYLOAD_ERROR, *Swarm.metrics[1:])
    max_drones = 32

    def setup(self) -> None:
        """See the class."""
        from ...models.fleet import Fleet
        from ...models.vehicle import payload_radius

        options = self.options
        vehicle = self.vehicle
        count = self.count
        if isinstance(vehicle, Fleet):
            raise InputError(
                f"vehicle: expected one for all drones that carry a payload, got {vehicle.name}"
            )
        self._slant = math.radians(options.angle)
        self._ring = length(ring(count)[0]) * self.gap
        self._azimuths = angles(count)
        self._cable = self._ring / sin(self._slant)
        self._height = self._cable * cos(self._slant)
        self._load = options.payload_share * vehicle.mass * vehicle.gravity
        lift = vehicle.mass * vehicle.gravity + self._load
        self._inwards = self._load * sin(self._slant) / cos(self._slant)
        self._tilt = atan2(self._inwards, lift)
        self._allocated = right_inverse(vehicle.allocation)
        thrust = self.carrying(np.linspace(0.0, 2 * math.pi, 36))
        able = (vehicle.thrust_low <= thrust).all() and (thrust <= vehicle.thrust_high).all()
        if not able:
            raise InputError(
                f"payload_share: expected a load that the rotors of {vehicle.name} carry at an "
                f"angle of {options.angle:g}°, got {options.payload_share:g}"
            )
        self._radius = payload_radius(options.payload_share * vehicle.mass * count)
        away = options.start_band * self.gap
        check_height("center", options.center[2], self._radius + away)
        self.reach = away * math.sqrt(3)
        numbers = along("payload - position", "m", 2 * self._cable)
        numbers += along("payload velocity - velocity", "m/s", MAX_SPEED)
        numbers += along("payload goal - payload", "m", 2 * (self.reach + options.margin))
        self.prepare(numbers)

    def adjust(self, config: EnvConfig) -> EnvConfig:
        """The payload's share of each drone, on its cable."""
        return with_payload(config, self.options.payload_share * self.vehicle.mass, self._cable)

    def carrying(self, azimuth: Array) -> Array:
        """Thrusts that hold drones at such azimuths from the payload, N, (..., R): rad, (...).

        Each cable pulls at the body's origin, which may be off the center of mass: the rotors turn
        against that.
        """
        vehicle = self.vehicle
        load = self._load
        # The pull in the frame of a drone that is tilted outwards; its height and its way inwards.
        inwards = self._inwards
        c = cos(self._tilt)
        s = sin(self._tilt)
        along = s * load - c * inwards
        down = -s * inwards - c * load
        pull = stack((along * cos(azimuth), along * sin(azimuth), down))
        weight = vehicle.mass * vehicle.gravity
        lift = load + weight
        force = math.sqrt(inwards * inwards + lift * lift)
        even = force * (vehicle.hover_thrust / weight)
        torque = stack(cross(vehicle.center_of_mass.tolist(), parts_of(pull)))
        wanted = np.concatenate((force + 0.0 * azimuth[..., None], torque), axis=-1)
        missing = wanted - total(vehicle.allocation * even)
        return even + total(self._allocated * missing[..., None, :])

    def begin(self, draw: Draw) -> InitialState:
        """At rest in equilibrium, the payload off its goal."""
        away = self.options.start_band * self.gap
        self.memory.turn = turn = shared(draw.uniform(-math.pi, math.pi))
        ball = self.center + shared(draw.uniform(-away, away, (3,)))
        azimuth = turn + self._azimuths
        half = self._tilt / 2
        sine = sin(half)
        return InitialState(
            position=ball + self._around(turn),
            quaternion=stack((cos(half), -sine * sin(azimuth), sine * cos(azimuth), 0.0 * azimuth)),
            thrust=self.carrying(azimuth),
            payload=ball,
        )

    def _around(self, turn: Array) -> Array:
        """Places of the drones from the payload, on the ring turned by an angle, (W, A, 3), m."""
        return on_circle(turn + self._azimuths, self._ring, self._height)

    def goal(self, state: State) -> Array:
        """The place of each drone where the payload hangs still at its goal."""
        return self.center + self._around(self.memory.turn)

    def further(self, state: State) -> list[Array]:
        """The payload from the drone, its way to its goal, and the neighbours."""
        hung = state.payload - state.position
        moving = state.payload_velocity - state.velocity
        return [hung, moving, self._missing(state), *super().further(state)]

    def _missing(self, state: State) -> Array:
        """From the payload to its goal, world frame, m, (W, A, 3)."""
        return self.center - state.payload

    def ended(self, state: State) -> Array:
        """Whether the flight of all drones of a world is over, bool, (W, A)."""
        outside = length(self._missing(state)) > self.band
        down = state.payload[..., 2] < self._radius
        one = self.crashed(state, outside | down)
        return np.broadcast_to(one.any(axis=1, keepdims=True), one.shape)

    def outcome(self, state: State) -> Outcome:
        """Nearness, approach and swing of the payload, and room; see the class."""
        missing = self._missing(state)
        distance = length(missing)
        room = self.clearance(state)
        terms = {
            "payload": nearness(distance, self.gap / 2),
            "approach": approach(missing, state.payload_velocity),
            "swing": swing_cost(state),
            "room": self.proximity_penalty(room),
        }
        metrics = {"payload_error": distance, "clearance": room}
        return self.judged(state, terms, self.ended(state), metrics)
