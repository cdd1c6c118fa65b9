"""`rotorgram/Formation-v0`: drones take their places in a formation."""

from dataclasses import dataclass
from typing import Final, Literal

from ...sim import Array, Draw, InitialState
from ..spec import Metric
from .swarm import Swarm, SwarmOptions, grid, line, ring

Formed = Literal["ring", "line", "grid"]
_PLACES: Final = {"ring": ring, "line": line, "grid": grid}


@dataclass(frozen=True, kw_only=True)
class FormationOptions(SwarmOptions):
    """Options of `rotorgram/Formation-v0`."""

    formation: Formed = "ring"
    """`ring`; `line`, along y; or `grid`, nearly a square. All are level."""


class Formation(Swarm):
    """Each drone flies from a start by lot to its own place in a formation, and holds it.

    ## Observation, `float32`, shape (15 + R + 7 k,), k = 7 (`neighbours`)

    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0-2 | own place minus position | m | world |
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

    (s - d) / (s + d) for the distance d to the own place, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it; -0.02 s/rad times the size of the body
    rates, up to 20 rad/s; with less than a diameter between the drone's sphere and another, down to
    -0.5 where they touch and -1 where their centres meet; and -240 on the step that terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, in the cells of a grid by lot, moved by up to 0.2 of the
    distance between cells along each axis.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its place than any start. Its rotors stand still, and the others fly on. *Truncated*: after 500
    steps of 0.02 s.
    """

    Options = FormationOptions
    metrics = (
        Metric(name="position_error", unit="m", settled=0.1, held=0.1, symbol="e"),
        Metric(name="clearance", unit="m", goal="high"),
    )

    def setup(self) -> None:
        """See the class."""
        self.prepare_slots(_PLACES[self.options.formation](self.count))

    def begin(self, mask: Array, draw: Draw) -> InitialState:
        """At rest, level, in the cells of a grid by lot."""
        return InitialState(position=self.cells(draw))
