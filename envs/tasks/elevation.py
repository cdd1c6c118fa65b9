"""`rotorgram/Elevation-v0`: hold an elevation, the paper's task."""

import math
from typing import Annotated, Literal

import numpy as np

from ...models.errors import InputError, shortened
from ...models.fields import Limits, NumberOrPair, immutable
from ...sim import Array, CollectiveThrust, Draw, InitialState, clip, stack
from ..spec import Metric
from ..state import State
from .goal import AIR, Number, NumberOrRange, NumbersTask, check_band, ends_of, nearness
from .task import Outcome, TaskOptions

TERMINATION_REWARD = -20.0
"""Added to the reward of the step that terminates an episode (crash, flip-over, out of band)."""
MAX_TILT_COSINE = 0.5  # Cosine of the tilt (60°) past which the craft counts as flipped over
FURTHEST = 1e6
"""Highest target and widest flight band, m: far inside what MuJoCo and float32 can hold."""

ActionType = Literal["continuous", "discrete"]
Observed = Literal["full", "error"]


@immutable
class ElevationOptions(TaskOptions):
    """Options of `rotorgram/Elevation-v0`."""

    target: Annotated[NumberOrRange, NumberOrPair(unit="m")] = 5.0
    """Target elevation Y, m: a number, or (low, high) to draw one uniformly for each episode."""
    start_band: Annotated[float, Limits(0.0, FURTHEST, "m")] = 1.0
    """An episode starts at rest, hovering, up to this far above or below the target, m."""
    flight_band: Annotated[float, Limits(0.0, FURTHEST, "m")] = 3.0
    """An episode terminates when the craft is further than this from the target, m."""
    action_type: ActionType = "continuous"
    """`continuous`: one number in [-1, 1]. `discrete`: 0 decrease, 1 hold, 2 increase."""
    observation: Observed = "full"
    """`full`: E, its rate and the thrust. `error`: E alone, as the paper feeds its network."""
    thrust_scale: Annotated[float | None, Limits(0.0, FURTHEST, "N", above=True)] = None
    """Thrust per unit of action for each rotor, N. None: 5 % (increment) or 20 % (offset) of the
    rotors' largest thrust, which is 5 N and 20 N for the paper's vehicle."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        check_band(self.flight_band, "start_band", self.start_band)


class Elevation(NumbersTask):
    """Hold a craft at a target elevation by changing the thrust of all rotors alike.

    The task of "Drone Elevation Control Based on Python-Unity Integrated Framework for
    Reinforcement Learning Applications" (Drones 2023, 7, 225), section 2.2 and figure 5. Where the
    paper gives no number, the number here is ours; `docs/task.md` lists which. Numbers below are
    those of the paper's vehicle and the default options.

    ## Observation, `float32`

    Elevation error E = Y - Y', desired minus measured (world, up); its rate, minus the climb rate;
    and the thrust relative to hover, F / 49 N - 1.

    `observation="error"` keeps index 0 alone, as in the paper. The bounds follow from vehicle and
    options and cannot be left; with effects, or with a vehicle that is drawn, numbers are clipped.

    ## Action

    | `action_type` | space | meaning |
    |---|---|---|
    | `continuous` | `Box(-1, 1, (1,), float32)` | a |
    | `discrete` | `Discrete(3)` | 0: a = -1, 1: a = 0, 2: a = +1 |

    | `action` | thrust F of every rotor, N, clipped to 0 ... 100 |
    |---|---|
    | `increment` | F <- F + 5 a (`thrust_scale` changes the 5) |
    | `offset` | F <- 49 + 20 a (`thrust_scale` changes the 20) |

    ## Reward

    (s - |E|) / (s + |E|) with s = 0.5 m: 1 at the target, 0 at half a metre, negative beyond; and
    -20 on the step that terminates.

    ## Start, termination, truncation

    The craft starts level, at rest and at hover thrust, its elevation uniform in target ± 1 m
    (`start_band`); with `target=(low, high)` the target is drawn first, uniformly.

    *Terminated*: |E| above 3 m (`flight_band`) or a tilt above 60° at the end of a step, or contact
    during it (looked for every 0.02 s).
    *Truncated*: after 250 steps (`episode_length`) of 0.02 s (`control_period`), unless the same
    step terminated.
    """

    Options = ElevationOptions
    actions = ("increment", "offset")
    action = "increment"
    metrics = (
        Metric(name="elevation_error", unit="m", settled=0.05, held=0.1, symbol="E", signed=True),
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        vehicle = self.vehicle
        room = vehicle.rest_height + AIR
        least = room + options.start_band
        low, high = ends_of(options.target)
        if low < least or high > FURTHEST:
            reasons = f"(start_band = {options.start_band:g} m, and {room:g} m of room)"
            raise InputError(
                f"target: expected {least:g} m {reasons} to {FURTHEST:g} m, "
                f"got {shortened(options.target)}"
            )
        most = float(vehicle.thrust_high.max())
        usual = self.controller
        assert isinstance(usual, CollectiveThrust)
        scale = options.thrust_scale or usual.newtons
        if scale > most:
            raise InputError(
                f"thrust_scale: expected at most {most:g} N, the largest thrust of a rotor, "
                f"got {scale:g}"
            )
        self.controller = CollectiveThrust(
            vehicle,
            scale,
            increment=self.action == "increment",
            discrete=options.action_type == "discrete",
        )
        self._hover = float(vehicle.hover_thrust[0])
        self.define_numbers(self._numbers(), "world, up")

    def begin(self, draw: Draw) -> InitialState:
        """Level, at rest, near the target."""
        band = self.options.start_band
        target = draw.uniform(*ends_of(self.options.target))
        start = draw.uniform(-band, band) + target
        self.memory.target = target
        return InitialState(position=stack((0.0, 0.0, start)))

    def observe(self, state: State) -> dict[str, Array]:
        """E, its rate and the thrust; or E alone."""
        error = self.memory.target - state.position[..., 2]
        numbers = [error]
        if self.options.observation == "full":
            rate = 0.0 - state.velocity[..., 2]
            numbers += [rate, state.thrust[..., 0] / self._hover - 1.0]
        # Only effects, or a vehicle that was drawn, could leave the bounds.
        return {"observation": clip(stack(numbers), *self._bounds)}

    def outcome(self, state: State) -> Outcome:
        """Nearness to the target; the end at a crash, a flip-over, or outside the band."""
        error = self.memory.target - state.position[..., 2]
        distance = abs(error)
        outside = distance > self.options.flight_band
        terminated = outside | state.touching | (state.tilt_cosine < MAX_TILT_COSINE)
        termination = terminated * TERMINATION_REWARD + 0.0  # no negative zeros
        return Outcome(
            reward={"elevation": nearness(distance), "termination": termination},
            terminated=terminated,
            metrics={"elevation_error": error},
        )

    def goal(self, state: State) -> Array:
        """Above the start, at the target elevation."""
        return stack((0.0, 0.0, self.memory.target))

    @property
    def rate_bound(self) -> float:
        """Speed that no flight can exceed before its episode ends, m/s.

        Thrust and gravity accelerate by a or less; drag only brakes. The band is checked at the end
        of a control period T. So the craft may turn back outside it within one period, fly through
        it, and fly on for one period: sqrt((a T / 2)² + 2 a · 2 flight_band) + a T.
        """
        a = self.vehicle.max_acceleration
        period = self.control_period
        out = math.sqrt(4 * a * self.options.flight_band)
        change = a * period / 2
        return math.sqrt(change * change + out * out) + a * period

    @property
    def error_bound(self) -> float:
        """Largest |E| of an observation, m: the band and one control period of flight."""
        return float(self.options.flight_band + self.rate_bound * self.control_period)

    def _numbers(self) -> list[Number]:
        """Of the observation, with their bounds."""
        error = above(self.error_bound)
        rate = above(self.rate_bound)
        least = -above(1 - self.vehicle.thrust_low[0] / self._hover)
        most = above(self.vehicle.thrust_high[0] / self._hover - 1)
        numbers = [
            Number("elevation error", "m", -error, error),
            Number("rate of the error", "m/s", -rate, rate),
            Number("thrust over hover", "1", least, most),
        ]
        return numbers if self.options.observation == "full" else numbers[:1]


def above(bound: float) -> float:
    """The next float32 above a bound, which rounding may move inwards by half a unit."""
    return float(np.nextafter(np.float32(bound), np.float32(np.inf)))
