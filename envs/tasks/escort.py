"""`rotorgram/Escort-v0`: drones fly around a target that moves."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ...models.fields import Limits
from ...sim import Array, Draw, InitialState, stack
from ..spec import Metric
from ..state import State
from .goal import FURTHEST, MAX_SPEED, Speed, along
from .swarm import Swarm, SwarmOptions, ring


@dataclass(frozen=True, kw_only=True)
class EscortOptions(SwarmOptions):
    """Options of `rotorgram/Escort-v0`."""

    target_speed: Speed = 1.0
    """Largest speed of the target, m/s."""
    target_path: Annotated[float, Limits(0.01, FURTHEST, "m")] = 5.0
    """Furthest distance of the target from the center along x and y, m."""


class Escort(Swarm):
    """Each drone keeps its place on a ring about a target that moves on a smooth path.

    With amplitude a (`target_path`) and largest speed v (`target_speed`) the target is at
    a (sin(ω t + α), sin(c ω t + β)) from the center, level, with ω = v / (a sqrt(1 + c²)). The
    ratio c, from 0.5 to 2, and the phases are drawn for each episode.

    ## Observation, `float32`, shape (18 + R + 7 k,), k = 7 (`neighbours`)

    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0-2 | own place minus position | m | world |
    | 3-5 | velocity | m/s | world |
    | 6-8 | direction of body x, the nose | 1 | world |
    | 9-11 | direction of body z, the thrust | 1 | world |
    | 12-14 | body rates | rad/s | body |
    | 15... | thrust of each rotor over its hover thrust, minus 1 | 1 | |
    | 15 + R... | velocity of the target | m/s | world |
    | then, of each neighbour, the nearest first: 3 | its position minus the own | m | world |
    | 3 | its velocity minus the own | m/s | world |
    | 1 | 1; 0, as the six before, where no further drone is heard | 1 | |

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward

    (s - d) / (s + d) for the distance d to the own place, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it, relative to it; -0.02 s/rad times the
    size of the body rates, up to 20 rad/s; with less than a diameter between the drone's sphere and
    another, down to -0.5 where they touch and -1 where their centres meet; and -240 on the step
    that terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, in the cells of a grid about the target by lot, moved by up to
    0.2 of the distance between cells along each axis.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its place than any start. Its rotors stand still, and the others fly on. *Truncated*: after 500
    steps of 0.02 s.
    """

    Options = EscortOptions
    metrics = (
        Metric(name="position_error", unit="m", settled=0.3, held=0.3, symbol="e"),
        Metric(name="clearance", unit="m", goal="high"),
    )

    def setup(self) -> None:
        """See the class."""
        velocity = along("target velocity", "m/s", MAX_SPEED)
        self.prepare_slots(ring(self.count), velocity)

    def begin(self, mask: Array, draw: Draw) -> InitialState:
        """At rest, level, in the cells of a grid about the target, by lot."""
        ratio = draw.uniform(0.5, 2.0)
        alpha = draw.uniform(-math.pi, math.pi)
        beta = draw.uniform(-math.pi, math.pi)
        if self.count > 1:  # one for all
            ratio, alpha, beta = (x[:, :1] + 0.0 * x for x in (ratio, alpha, beta))
        memory = self.memory
        memory.ratio = ratio
        memory.alpha = alpha
        memory.beta = beta
        memory.time = 0.0
        position = self.cells(draw) + self.target()[0]
        return InitialState(position=position)

    def target(self) -> tuple[Array, Array]:
        """Position from the center and velocity of the target: world frame, m, m/s, (W, A, 3)."""
        memory = self.memory
        a = self.options.target_path
        slow = self.options.target_speed / (a * np.sqrt(1.0 + memory.ratio * memory.ratio))
        fast = memory.ratio * slow
        first = slow * memory.time + memory.alpha
        second = fast * memory.time + memory.beta
        zero = 0.0 * first
        place = stack((a * np.sin(first), a * np.sin(second), zero))
        velocity = stack((a * slow * np.cos(first), a * fast * np.cos(second), zero))
        return place, velocity

    def update_memory(self, state: State) -> None:
        """Move the target."""
        self.memory.time = self.memory.time + self.control_period

    def further(self, state: State) -> list[Array]:
        """The velocity of the target, and the neighbours."""
        return [self.target()[1], *super().further(state)]

    def goal_velocity(self) -> Array:
        """That of the target."""
        return self.target()[1]

    def goal(self, state: State) -> Array:
        """The place of each drone about the target."""
        return super().goal(state) + self.target()[0]
