"""`rotorgram/Crossing-v0`: drones on a ring change to the opposite places without touching."""

import math

import numpy as np

from ...sim import Array, Draw, InitialState, stack
from ..spec import Metric
from ..state import State
from .swarm import JITTER, Swarm, SwarmOptions, ring


class Crossing(Swarm):
    """Each drone flies from its place on a ring to the opposite one: all meet in the middle.

    ## Observation, `float32`, shape (15 + R + 7 k,), k = 7 (`neighbours`)

    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0-2 | goal minus position | m | world |
    | 3-5 | velocity | m/s | world |
    | 6-8 | direction of body x, the nose | 1 | world |
    | 9-11 | direction of body z, the thrust | 1 | world |
    | 12-14 | body rates | rad/s | body |
    | 15... | thrust of each rotor over its hover thrust, minus 1 | 1 | |
    | then, of each neighbour, the nearest first: 3 | its position minus the own | m | world |
    | 3 | its velocity minus the own | m/s | world |
    | 1 | 1; 0, as the six before, where no further drone is heard | 1 | |

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward

    (s - d) / (s + d) for the distance d to the goal, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it; -0.02 s/rad times the size of the body
    rates, up to 20 rad/s; with less than a diameter between the drone's sphere and another, down to
    -0.5 where they touch and -1 where their centres meet; and -240 on the step that terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, on a level ring that is turned by lot, neighbours three
    diameters (`spacing`) apart, moved by up to 0.2 of that along each axis. The ring is no smaller
    than one of six drones.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its goal than any start. Its rotors stand still, and the others fly on. *Truncated*: after
    1000 steps of 0.02 s.
    """

    Options = SwarmOptions
    episode_length = 1000
    metrics = (
        Metric(name="position_error", unit="m", settled=0.1, held=0.1, symbol="e"),
        Metric(name="clearance", unit="m", goal="high"),
    )

    def setup(self) -> None:
        """See the class."""
        radius = max(float(np.linalg.norm(ring(self.count)[0])), 1.0)  # of six
        angle = 2 * math.pi * np.arange(self.count) / self.count
        self._angles = angle if self.shape else 0.0
        self._radius = radius * self.gap
        self.reach = 2 * self._radius + 2 * JITTER * self.gap
        self.prepare()

    def begin(self, mask: Array, draw: Draw) -> InitialState:
        """At rest, level, on the ring."""
        turn = draw.uniform(-math.pi, math.pi)
        jitter = draw.uniform(-JITTER, JITTER, (3,)) * self.gap
        if self.count > 1:
            turn = turn[:, :1]  # one for all
        self.memory.turn = turn + 0.0 * jitter[..., 0]
        position = self._opposite(turn + math.pi) + jitter
        return InitialState(position=position)

    def _opposite(self, turn: Array) -> Array:
        """Where drones fly to from a ring turned by an angle, rad: world frame, m, (W, A, 3)."""
        angle = turn + self._angles + math.pi
        x = self._radius * np.cos(angle)
        y = self._radius * np.sin(angle)
        cx, cy, cz = self.options.center
        return stack((x + cx, y + cy, 0.0 * x + cz))

    def goal(self, state: State) -> Array:
        """The place opposite to the start of each drone."""
        return self._opposite(self.memory.turn)
