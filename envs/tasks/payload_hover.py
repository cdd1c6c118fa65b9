"""`rotorgram/PayloadHover-v0`: hold a payload on a cable at a point, and damp its swing."""

import math
from typing import Annotated

from ...models.fields import Limits, immutable
from ...sim import Array, Draw, InitialState, atan2, length, stack
from ..config import EnvConfig
from ..spec import Metric
from ..state import State
from .goal import (
    MAX_SPEED,
    PAYLOAD_ERROR,
    WORST_RATES,
    WORST_SWING,
    Distance,
    GoalTask,
    Point,
    Share,
    Speed,
    Tilt,
    along,
    at,
    check_cube,
    check_height,
    nearness,
    swing_cost,
    with_payload,
)
from .task import Outcome, TaskOptions


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
