"""`rotorgram/Hover-v0`: hold a position and a heading with independent rotors."""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ...models.errors import expect
from ...sim import Array, Draw, Pose, WorldState, clip, component, constant, stack
from ..spec import ArraySpec, Metric
from .task import Outcome, Task, TaskOptions, check_number, finite

ERROR_SCALE: Final = 0.5  # Distance at which the reward for nearness crosses zero, m
HEADING_WEIGHT: Final = 0.2  # Cost of a heading half a turn off
RATE_WEIGHT: Final = 0.02  # Cost of a body rate of 1 rad/s
TERMINATION_REWARD: Final = -20.0  # Added to the reward of the step that terminates an episode
LEAST_TILT_COSINE: Final = 0.0
"""Cosine of the tilt (90°) past which the craft counts as flipped over."""
AIR: Final = 0.6  # Least room under a craft that starts, m
FURTHEST: Final = 1e4  # Furthest goal, m
MOST_SPEED: Final = 100.0  # Speed past which an observation is clipped, m/s
MOST_RATE: Final = 100.0  # Body rate past which an observation is clipped, rad/s


@dataclass(frozen=True, kw_only=True)
class HoverOptions(TaskOptions):
    """Options of `rotorgram/Hover-v0`."""

    goal: tuple[float, float, float] = (0.0, 0.0, 5.0)
    """Position to hold: x, y, z in MuJoCo's world frame (z up), m."""
    heading: float = 0.0
    """Direction of the nose to hold, degrees about z, anticlockwise from x."""
    start_band: float = 1.0
    """Largest distance of the start from the goal along each axis, m."""
    start_tilt: float = 30.0
    """Largest tilt at the start, degrees, about a horizontal axis drawn uniformly."""
    start_heading: float = 30.0
    """Largest error of the heading at the start, degrees."""
    flight_band: float = 3.0
    """An episode terminates when the craft is further than this from its goal, m."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        goal: Any = self.goal
        values = [finite(x) for x in goal] if isinstance(goal, tuple | list) else []
        right = len(values) == 3 and all(x is not None and abs(x) <= FURTHEST for x in values)
        expect(right, "goal", "three numbers (x, y, z) in m", f"{goal!r}")
        object.__setattr__(self, "goal", tuple(values))
        check_number(self, "heading", -360.0, 360.0, "degrees")
        check_number(self, "start_band", 0.0, FURTHEST, "m")
        check_number(self, "start_tilt", 0.0, 80.0, "degrees")
        check_number(self, "start_heading", 0.0, 180.0, "degrees")
        check_number(self, "flight_band", 0.0, FURTHEST, "m")
        least = self.start_band * math.sqrt(3)
        expected = f"more than sqrt(3) · start_band = {least:.4g} m"
        expect(self.flight_band > least, "flight_band", expected, f"{self.flight_band!r}")


class Hover(Task):
    """Hold a position and a heading, each rotor on its own, from tilted starts.

    ## Observation, `float32`, shape (15 + R,)

    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0-2 | goal minus position | m | world, turned by the wanted heading |
    | 3-5 | velocity | m/s | the same |
    | 6-8 | direction of body x, the nose | 1 | the same |
    | 9-11 | direction of body z, the thrust | 1 | the same |
    | 12-14 | body rates | rad/s | body |
    | 15... | thrust of each rotor over its hover thrust, minus 1 | 1 | |

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.

    ## Action, `Box(-1, 1, (R,), float32)`

    Thrust of each rotor: 0 is hover, -1 its least, 1 its largest.

    ## Reward

    (s - d) / (s + d) for the distance d to the goal with s = 0.5 m; -0.2 |heading error| / 180°;
    -0.02 s/rad times the size of the body rates; and -20 on the step that terminates.

    ## Start, termination, truncation

    At rest, within 1 m of the goal along each axis (`start_band`), tilted by up to 30°
    (`start_tilt`), the heading off by up to 30° (`start_heading`), at hover thrust.

    *Terminated*: further than 3 m from the goal (`flight_band`), a tilt above 90°, or contact.
    *Truncated*: after 250 steps of 0.02 s.
    """

    Options = HoverOptions
    metrics = (
        Metric(name="position_error", unit="m", settled=0.1, held=0.1, symbol="e"),
        Metric(name="heading_error", unit="deg", settled=5.0, signed=True),
    )

    def setup(self) -> None:
        """See the class."""
        options, vehicle = self.options, self.vehicle
        least = vehicle.rest_height + AIR + options.start_band
        expected = f"a height of at least {least:g} m above the ground"
        expect(options.goal[2] >= least, "goal", expected, f"{options.goal[2]:g}")
        self._wanted = math.radians(options.heading)
        self._hover_thrust = vehicle.hover_thrust
        vectors = (
            ("goal - position", "m", 2 * options.flight_band),
            ("velocity", "m/s", MOST_SPEED),
            ("nose", "1", 1.001),
            ("thrust axis", "1", 1.001),
            ("body rate", "rad/s", MOST_RATE),
        )
        rotors = vehicle.num_rotors
        weakest, strongest = (
            limit / vehicle.hover_thrust - 1 for limit in (vehicle.thrust_low, vehicle.thrust_high)
        )
        bounds = [bound for *_, bound in vectors for _ in "xyz"]
        low = (*(-bound for bound in bounds), *(weakest - 0.001).tolist())
        high = (*bounds, *(strongest + 0.001).tolist())
        self.observation = (
            ArraySpec(
                name="observation",
                shape=(15 + rotors,),
                low=low,
                high=high,
                unit=(*(unit for _, unit, _ in vectors for _ in "xyz"), *["1"] * rotors),
                frame="world turned by the wanted heading; body rates: body",
                components=(
                    *(f"{vector} {axis}" for vector, *_ in vectors for axis in "xyz"),
                    *(f"thrust {i + 1} over hover" for i in range(rotors)),
                ),
            ),
        )
        self._bounds = tuple(np.array(bound) for bound in (low, high))

    def begin(self, mask: Array, draw: Draw) -> Pose:
        """At rest near the goal, tilted and turned."""
        xp, options = self.xp, self.options
        offset = draw.uniform(-options.start_band, options.start_band, (3,))
        tilt = draw.uniform(0.0, math.radians(options.start_tilt)) / 2
        azimuth = draw.uniform(-math.pi, math.pi)
        off = math.radians(options.start_heading)
        heading = (self._wanted + draw.uniform(-off, off)) / 2
        # First tilted about a horizontal axis, then turned about the vertical.
        w, x, y = xp.cos(tilt), xp.sin(tilt) * xp.cos(azimuth), xp.sin(tilt) * xp.sin(azimuth)
        c, s = xp.cos(heading), xp.sin(heading)
        quaternion = stack((c * w, c * x - s * y, c * y + s * x, s * w))
        goal = stack([0.0 * tilt + value for value in options.goal])
        return Pose(position=goal + offset, quaternion=quaternion)

    def observe(self, state: WorldState) -> dict[str, Array]:
        """See the table of the class."""
        xp = self.xp
        nose, up = _axes(xp, state.quaternion)
        turned = [self._turned(v) for v in (self.goal(state) - state.position, state.velocity)]
        thrust = state.thrust / constant(self._hover_thrust, state.thrust) - 1.0
        parts = (*turned, self._turned(nose), self._turned(up), state.body_rates, thrust)
        low, high = (constant(bound, state.thrust) for bound in self._bounds)
        return {"observation": clip(xp.concat(parts, axis=-1), low, high)}

    def outcome(self, state: WorldState) -> Outcome:
        """Nearness to goal and heading; the end at a crash, a flip-over, or outside the band."""
        xp = self.xp
        offset = self.goal(state) - state.position
        distance = xp.sqrt(xp.sum(offset * offset, axis=-1))
        nose, _ = _axes(xp, state.quaternion)
        off = xp.atan2(component(nose, 1), component(nose, 0)) - self._wanted
        heading = xp.atan2(xp.sin(off), xp.cos(off)) * (180 / math.pi)
        rates = xp.sqrt(xp.sum(state.body_rates * state.body_rates, axis=-1))
        outside = distance > self.options.flight_band
        terminated = outside | state.touching[()] | (state.tilt_cosine < LEAST_TILT_COSINE)
        return Outcome(
            reward={
                "position": (ERROR_SCALE - distance) / (ERROR_SCALE + distance),
                "heading": -HEADING_WEIGHT / 180 * abs(heading),
                "rates": -RATE_WEIGHT * rates,
                "termination": terminated * TERMINATION_REWARD + 0.0,
            },
            terminated=terminated,
            metrics={"position_error": distance, "heading_error": heading},
        )

    def goal(self, state: WorldState) -> Array:
        """The same for every drone."""
        zero = 0.0 * component(state.position, 0)
        return stack([zero + value for value in self.options.goal])

    def _turned(self, vectors: Array) -> Array:
        """World vectors in the world frame turned by the wanted heading, shape (..., 3)."""
        if self._wanted == 0.0:
            return vectors
        c, s = math.cos(self._wanted), math.sin(self._wanted)
        x, y = vectors[..., 0], vectors[..., 1]
        return stack((c * x + s * y, c * y - s * x, vectors[..., 2]))


def _axes(xp: Any, quaternion: Array) -> tuple[Array, Array]:
    """Directions of body x and body z in the world frame, shape (..., 3) each."""
    w, x, y, z = (component(quaternion, i) for i in range(4))
    nose = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    up = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return stack(nose), stack(up)
