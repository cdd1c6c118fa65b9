"""`rotorgram/Gates-v0`: a race through gates that are solid, along a track of each episode."""

from types import MappingProxyType
from typing import Annotated

from ...models import InputError
from ...models.fields import Limits, immutable
from ...scenes import SceneConfig
from ...scenes.generators import GATES_SIZE, OPENING
from ...sim import Array, Draw, InitialState, square_root, stack
from ..state import State
from .goal import Distance, Margin
from .measures import METRICS, begin_measures, measures_of, update_measures
from .racing import Laps, Racing
from .task import Outcome, TaskOptions

_COUNT = 8
_RING = 40.0  # m: width of the ring of gates, and their highest, at the scale 1
_BEHIND = 4.0  # m: from the start to the first gate, at the scale 1


@immutable
class GatesOptions(TaskOptions):
    """Options of `rotorgram/Gates-v0`."""

    opening: Annotated[float, Limits(1.0, 20.0, "m")] = 1.5
    """Width of a gate inside, m; the track grows with it."""
    laps: Laps = 1
    """Rounds of all gates."""
    start_band: Distance = 0.1
    """Largest distance of the start from the line through the first gate along each axis, m."""
    margin: Margin = 3.0
    """As of `rotorgram/Racing-v0`, m."""


class Gates(Racing):
    """Pass solid gates in their order and direction, as fast as possible.

    The track is that of the scene `gates`: a ring of eight gates whose places, heights and
    directions are drawn from a seed, another one in each episode. A touch ends the episode.

    ## Observation, `float32`, shape (22 + R,) or (23 + R,)

    With the actions `rotors` and `rates` all numbers of `Racing-v0` in the body frame: one setting
    serves every heading. The direction of world z takes the place of nose and thrust axis, and the
    directions of gates have three numbers. With other actions, those of `Racing-v0`.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor.

    ## Reward

    That of `Racing-v0`.

    ## Metrics

    Those of `Racing-v0` and of `Forest-v0`; success: all gates are passed.

    ## Start, termination, truncation

    At rest before the first gate, the nose towards it, within 0.1 m along each axis (`start_band`).

    *Terminated*: the last gate is passed; further than 3 m from the line between the last gate and
    the next (`margin`), a tilt above 90°, or contact. *Truncated*: after 1500 steps of 0.02 s.
    """

    Options = GatesOptions
    metrics = (*Racing.metrics, *METRICS[:-1])  # the time of flight is of both
    defaults = MappingProxyType({"vehicle": ("hummingbird",)})

    @classmethod
    def scene(cls, options: GatesOptions) -> SceneConfig:
        """A new track in each episode."""
        side = GATES_SIZE * options.opening / OPENING
        return SceneConfig(name="gates", layouts="new", options={"size": (side, side)})

    def setup(self) -> None:
        """See the class."""
        scene = self.config.scene
        if scene.name != "gates":
            raise InputError(f"scene: expected gates with {self.config.env_id}, got {scene}")
        scale = scene.values.scale
        half = scale * OPENING / 2
        if half <= self.vehicle.radius:
            raise InputError(
                f"opening: expected gates wider than the craft, {2 * self.vehicle.radius:.3g} m, "
                f"got {2 * half:g} m"
            )
        self.body = self.action in ("rotors", "rates")
        reach = 2 * scale * _RING + 2 * self.options.margin
        self.define_race(_COUNT, reach, half)

    @property
    def track(self) -> Array:
        """That of the episode's layout, (W, A, 8, 6)."""
        return self.memory.track

    def begin(self, draw: Draw) -> InitialState:
        """At rest before the first gate, the nose towards it."""
        offset = self.offset(draw)
        track = draw.openings + 0.0 * offset[..., None, :1]
        self.memory.track = track
        begin_measures(self)
        c, s = track[..., 0, 3], track[..., 0, 4]
        behind = _BEHIND * self.config.scene.values.scale
        position = track[..., 0, :3] - behind * stack((c, s, 0.0)) + offset
        w = square_root((1.0 + c) / 2)  # the first gate faces left of the ring: c > -0.5
        return self.start(position, stack((w, 0.0 * c, 0.0 * c, s / (2 * w))))

    def update_memory(self, state: State) -> None:
        """That of `Racing`, and measure the step."""
        super().update_memory(state)
        update_measures(self, state)

    def outcome(self, state: State) -> Outcome:
        """That of `Racing`, with the measures."""
        outcome = super().outcome(state)
        is_done = outcome.metrics["gates_left"] < 0.5
        outcome.metrics.update(measures_of(self, state, is_done))
        return outcome
