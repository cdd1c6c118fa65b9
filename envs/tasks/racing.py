"""Races through gates in their order and direction: `rotorgram/Racing-v0`, along a track in the
air, and `rotorgram/Gates-v0`, through solid gates along a track of each episode.
"""

import json
import math
import tomllib
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, ClassVar

import numpy as np

from ...models.errors import InputError, one_line, shortened
from ...models.fields import Limits, immutable, read_table, set_fields
from ...scenes import SceneConfig
from ...scenes.generators import GATES_SIZE, OPENING
from ...sim import (
    Array,
    Draw,
    InitialState,
    clip,
    cos,
    length,
    parts_of,
    remainder,
    sin,
    square_root,
    stack,
    total,
)
from ..spec import Mark, Metric
from ..state import State
from .goal import (
    COURSE_RATE_WEIGHT,
    COURSE_TIME_COST,
    COURSE_WORST_STEP,
    FLIGHT_TIME,
    PASSING_REWARD,
    Distance,
    FramedOptions,
    GoalTask,
    Heading,
    Margin,
    Number,
    Point,
    Size,
    along,
    check_height,
    row_of,
)
from .measures import METRICS, begin_measures, measures_of, update_measures
from .task import Outcome, TaskOptions

TRACKS = Path(__file__).parent.parent / "tracks"
MAX_GATES = 64
_COUNT = 8  # solid gates
_RING = 40.0  # m: width of the ring of gates, and their highest, at the scale 1
_BEHIND = 4.0  # m: from the start to the first gate, at the scale 1
_WAY = "a track of ours, a TOML file of gates, or its content as JSON"

Laps = Annotated[int, Limits(1, 1000, whole=True)]
"""Of an option: rounds of all gates."""


@immutable
class Start:
    """Where a race starts."""

    position: Point
    heading: Heading
    """Direction of the nose about z, anticlockwise from x."""


@immutable
class Gate(Start):
    """A square opening that stands upright: its centre, and the direction in which it is passed."""

    size: Size
    """Width and height."""


@immutable
class _Track:
    """Content of a track's file."""

    gates: object
    start: object


@immutable
class RacingOptions(FramedOptions):
    """Options of `rotorgram/Racing-v0`."""

    track: str = "oval"
    """A track of ours (`oval`, `dive`), or a TOML file with its gates and its start. It is kept as
    JSON, so that it crosses the wire."""
    laps: Laps = 1
    """Rounds of all gates."""
    start_band: Distance = 0.5
    """Largest distance of the start from that of the track along each axis, m."""
    margin: Margin = 5.0
    """An episode terminates when the craft is further than this from the line between the gate that
    it has passed, or the start, and the next one, m."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        gates, start = read_track(self.track)
        content = {"gates": [asdict(gate) for gate in gates], "start": asdict(start)}
        set_fields(self, track=json.dumps(content, separators=(",", ":")))


class Racing(GoalTask):
    """Pass the gates of a track in their order and direction, as fast as possible.

    Gates are not solid: they are lines in the air, and a craft that misses one has to come back.

    ## Observation, `float32`, shape (22 + R,) or (23 + R,)

    Those of `GoalTask`, whose goal is the centre of the next gate; then x and y of the direction in
    which it is passed; the centre of the gate after it minus position; x and y of its direction;
    and half the size of the next gate. All are in the `frame`; in that of the body, directions of
    gates have three numbers.

    Numbers are clipped: positions at the size of the track, speeds at 100 m/s, rates at 100 rad/s.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover, -1 its least, 1 its
    largest.

    ## Reward

    By how much the craft came nearer to the centre of the gate in this step, 1/m, the progress of
    Song et al. 2021 (arXiv 2103.08624); 1 on the step that passes it; -0.04; -0.002 s/rad times the
    size of the body rates, up to 20 rad/s; and -8 on a step that terminates with gates left. The
    last three weights are those of `Waypoints`.

    A gate is passed in a step whose straight way goes through its opening in its direction; one
    gate in a step at most.

    ## Metrics

    `gates_left`, those that were not passed; `flight_time`, s, until now; and `lap_time`, s, of the
    last whole round, 0 before it.

    ## Start, termination, truncation

    At rest, the nose along the track, within 0.5 m of its start along each axis (`start_band`), at
    hover thrust.

    *Terminated*: the last gate is passed; further than 5 m from the line between the last gate and
    the next (`margin`), or contact. Any tilt is allowed. *Truncated*: after 1500 steps of 0.02 s.
    """

    Options: ClassVar[type[TaskOptions]] = RacingOptions
    worst_step = COURSE_WORST_STEP
    episode_length = 1500
    metrics: ClassVar[tuple[Metric, ...]] = (
        Metric(name="gates_left", unit="", settled=0.5, held=0.5, final=True),
        FLIGHT_TIME,
        Metric(name="lap_time", unit="s", final=True),
    )

    def setup(self) -> None:
        """See the class."""
        gates, self._start = read_track(self.options.track)
        room = self.vehicle.rest_height + self.options.start_band
        check_height("track: start", self._start.position[2], room)
        self.marks = tuple(
            Mark(shape="gate", size=gate.size, position=gate.position, heading=gate.heading)
            for gate in gates
        )
        turns = np.radians([gate.heading for gate in gates])
        centers = np.array([gate.position for gate in gates])
        halves = np.array([gate.size / 2 for gate in gates])
        self._gates = np.column_stack((centers, cos(turns), sin(turns), halves))
        corners = np.vstack((centers, self._start.position))
        reach = length(np.ptp(corners, axis=0)) + 2 * self.options.margin
        self.define_race(len(gates), reach, float(halves.max()))

    def define_race(self, count: int, reach: float, half: float) -> None:
        """Set `observation`, for gates of half a size and within a reach of each other, m."""
        self._count = count
        self._total = count * self.options.laps
        axes = "xyz" if self.body else "xy"
        numbers = along("direction of the gate", "1", 1.001, axes)
        numbers += along("gate after - position", "m", reach)
        numbers += along("direction of the gate after", "1", 1.001, axes)
        largest = half + 0.001
        numbers.append(Number("half size of the gate", "m", -largest, largest))
        self.define_observation(reach / 2, numbers)

    @property
    def track(self) -> Array:
        """Gates: their centers, x and y of their directions, half their sizes, (..., count, 6)."""
        return self._gates

    def begin(self, draw: Draw) -> InitialState:
        """At rest near the start, the nose along the track."""
        offset = self.offset(draw)
        position = np.array(self._start.position) + offset
        half = math.radians(self._start.heading) / 2
        zero = 0.0 * offset[..., 0]
        return self.start(position, stack((zero + cos(half), zero, zero, zero + sin(half))))

    def start(self, position: Array, turn: Array) -> InitialState:
        """A start at rest, m, and its quaternion, (W, A, 4), with the memory of a race."""
        memory = self.memory
        memory.position = position  # before the last step
        memory.behind = position  # where the way to the next gate began
        memory.passed = memory.passing = memory.progress = memory.off = 0.0
        memory.lap = memory.lap_began = 0.0
        return InitialState(position=position, quaternion=turn)

    def update_memory(self, state: State) -> None:
        """Whether the gate was passed, how much nearer it came, and the times of rounds."""
        memory = self.memory
        gate = self._gate(memory.passed)
        center = gate[..., :3]
        half = gate[..., 5]
        before = memory.position - center
        now = state.position - center
        behind = self._ahead(gate, before)
        ahead = self._ahead(gate, now)
        through = (behind < 0.0) & (ahead >= 0.0)
        share = (behind / np.where(through, behind - ahead, -1.0))[..., None]
        crossing = before + share * (now - before)
        x, y, z = parts_of(crossing)
        aside = y * gate[..., 3] - x * gate[..., 4]
        inside = (abs(aside) <= half) & (abs(z) <= half)
        left = memory.passed < self._total
        is_passed = through & inside & left
        passed = memory.passed + is_passed
        whole = is_passed & (remainder(passed, self._count) == 0.0)
        way = center - memory.behind
        come = state.position - memory.behind
        along = total(come * way) / (total(way * way) + 1e-12)
        memory.off = length(come - clip(along, 0.0, 1.0)[..., None] * way)
        memory.progress = length(before) - length(now)
        memory.passed = passed
        memory.passing = is_passed * 1.0
        memory.lap = np.where(whole, state.time - memory.lap_began, memory.lap)
        memory.lap_began = np.where(whole, state.time, memory.lap_began)
        memory.position = state.position
        memory.behind = np.where(is_passed[..., None], center, memory.behind)

    def _ahead(self, gate: Array, way: Array) -> Array:
        """How far a way from the centre of a gate leads in its direction, m, (W, A)."""
        return way[..., 0] * gate[..., 3] + way[..., 1] * gate[..., 4]

    def further(self, state: State) -> tuple[Array, ...]:
        """The direction of the next gate, the gate after it, and the size of the next."""
        gate = self._gate(self.memory.passed)
        after = self._gate(self.memory.passed + 1.0)
        way = after[..., :3] - state.position
        vectors = [gate[..., 3:5], way, after[..., 3:5]]
        if self.body:
            level = 0.0 * way[..., :1]
            vectors = [
                self.framed(state, np.concat((vector, level), axis=-1)[..., :3])
                for vector in vectors
            ]
        return *vectors, gate[..., 5:]

    def outcome(self, state: State) -> Outcome:
        """Progress to the next gate; the end at the last one, or off the track."""
        memory = self.memory
        left = self._total - memory.passed
        crashed = (memory.off > self.options.margin) | state.touching
        terms = {
            "progress": memory.progress,
            "passing": PASSING_REWARD * memory.passing,
            "time": -COURSE_TIME_COST,
        }
        metrics = {"gates_left": left, "flight_time": state.time, "lap_time": memory.lap}
        return self.judged(state, terms, crashed, metrics, left < 0.5, COURSE_RATE_WEIGHT)

    def goal(self, state: State) -> Array:
        """The centre of the next gate."""
        return self._gate(self.memory.passed)[..., :3]

    def _gate(self, passed: Array) -> Array:
        """The next gate after `passed` gates, shape (..., 6); after the last gate, the last."""
        number = np.minimum(passed, self._total - 1.0)
        return row_of(self.track, remainder(number, self._count))


@immutable
class GatesOptions(FramedOptions):
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

    Those of `Racing-v0`.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor.

    ## Reward

    That of `Racing-v0`.

    ## Metrics

    Those of `Racing-v0` and of `Forest-v0`; success: all gates are passed.

    ## Start, termination, truncation

    At rest before the first gate, the nose towards it, within 0.1 m along each axis (`start_band`).

    *Terminated*: the last gate is passed; further than 3 m from the line between the last gate and
    the next (`margin`), or contact. Any tilt is allowed. *Truncated*: after 1500 steps of 0.02 s.
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


def read_track(given: str) -> tuple[list[Gate], Start]:
    """Gates of a track, and its start. Raises `InputError`."""
    try:
        if given.lstrip().startswith("{"):
            content = json.loads(given)
        else:
            ours = TRACKS / f"{given}.toml"
            path = ours if ours.is_file() and ours.parent == TRACKS else Path(given)
            content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        names = ", ".join(sorted(path.stem for path in TRACKS.glob("*.toml")))
        reason = one_line(getattr(error, "strerror", None) or error)
        raise InputError(
            f"track: expected {_WAY} ({names}), got {shortened(given)}: {reason:.120}"
        ) from None
    track = read_table(_Track, content, "track")
    rows = track.gates
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_GATES:
        raise InputError(f"track: expected 1 to {MAX_GATES} gates, got {shortened(rows)}")
    gates = [read_table(Gate, row, f"track: gate {i}") for i, row in enumerate(rows, start=1)]
    return gates, read_table(Start, track.start, "track: start")
