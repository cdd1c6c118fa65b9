"""A loop as machine code: its step is a function from a snapshot to the next one.

The list of stages runs once on variables, region by region: a loop of one world gets a snapshot of
variables and runs a region, and its next snapshot says what the region computes. So nothing that a
step depends on can be forgotten that a snapshot has.
"""

import ctypes
from collections.abc import Callable, Collection, Sequence
from math import prod
from typing import Any

import numpy as np

from ..models.errors import InputError
from ..sim import World
from ..sim.compile import Program, Untraceable, lift
from ..sim.compile.layout import Layout, Memory, fields_of
from ..sim.compile.llvm import Region, compiled, widest
from ..sim.snapshots import Arrays, Snapshot, joined, part_of
from ..sim.state import ByName
from ..sim.world import Call
from .autoreset import Array, Content, Seeds, Told
from .derivative import Before, Derivative, variables
from .loop import Loop
from .stages.record import Mask, Record
from .telemetry import telemetry_of

LANES = 64  # Worlds of a block: their numbers fit into the nearest cache
MOST = 65_000  # Operations of a step but those of functions: more take too long to compile
_FIRST, _CONTROL, _PUSH, _BEGIN, _LAST = "first", "control", "push", "begin", "last"
"""Code before the physics of a step, between two of its calls, for episodes that begin, and after.
A step whose physics is array code is the last alone."""
_PHYSICS = "physics/"
_MASKS = ("flown", "begun", "active")
_ENDS = ("terminated", "truncated", "done", "out", "waiting")
_SEEN = "seen/"
_TOLD = "told/"
_TERM = "told/reward_"
_KEYS = "Flight/random/keys"
_EPISODE = "Flight/random/episode"
_SEEDS = "Flight/scenery/seeds"

Named = dict[str, Any]
Step = Sequence[Callable[[Record], None]]


class Machine:
    """The memory of W worlds, and the code that steps them.

    Args:
        loop: A loop of one world that flies by NumPy, whose episode has begun.
        world: W worlds, whose physics flies where it is no array code.

    Attributes:
        is_whole: Whether a step is code as a whole, and has a derivative.
        tape: Unless it is None, gets what a derivative needs from before each flown step.

    Raises:
        Untraceable: A stage cannot be compiled.
    """

    def __init__(self, loop: Loop, world: World) -> None:
        self._loop = loop
        self._world = world
        self._worlds = worlds = world.shape[0]
        self.is_whole = not world.is_apart
        ours = loop.world
        ours.outer = seen = ours.told()
        world.asked = ours.asked
        self.tape: list[Before] | None = None
        state = loop.state()
        record = loop.record
        width = min(widest(), max(2, 1 << (worlds - 1).bit_length()))
        lanes = width * min(LANES // width, -(-worlds // width))
        self._names = tuple(state)
        layout = Layout(fields_of(state), lanes)
        self._told = Layout(fields_of(self._telemetry()), lanes)
        given: Named = dict.fromkeys(_MASKS, record.out) | {"sent": record.sent}
        if record.asked is not None:
            given["asked"] = record.asked
        pushed = self._pushed()
        self._acts = tuple(pushed)
        given |= world.scenery.shared() | pushed
        given |= {_PHYSICS + name: array for name, array in seen.items()}
        self._outside = fields_of(given | self._seen())
        self._layouts = layout, self._told
        self._calls = [(_before(call), call) for call in loop.pipeline.flight.calls()]
        self._calls[0] = _FIRST, self._calls[0][1]
        steps = self._regions()
        size = sum(len(one.operations()) for regions in steps.values() for one in regions)
        if size > MOST:
            most = f"expected at most {MOST:,}"
            raise Untraceable(f"a step of {size:,} operations is not compiled: {most}")
        self._codes = {
            name: compiled(regions, self._layouts, self._outside, width)
            for name, regions in steps.items()
        }
        self._width = width
        self.memory = Memory(layout, worlds)
        self._plan(given)
        self._all_fly = False  # in the last step

    def _regions(self) -> dict[str, list[Region]]:
        """What is compiled, by name: a whole step, or what comes before and after physics."""
        loop = self._loop
        pipeline = loop.pipeline
        last = [
            self._traced("active", pipeline.observe),
            self._gives(lambda: self._seen() | self._telemetry()),
        ]
        if self.is_whole:
            first = [self._traced("", [Record.rest]), self._traced("flown", pipeline.fly)]
            return {_LAST: [*first, self._traced("begun", pipeline.begin), *last]}
        flight = pipeline.flight
        take = self._traced("", [Record.rest, flight.take])
        regions = {
            _FIRST: [self._traced("flown", pipeline.before), self._gives(self._pushed)],
            _BEGIN: [self._traced("begun", pipeline.set_out)],
            _LAST: [take, self._traced("begun", pipeline.sense), *last],
        }
        for code, call in self._calls:
            if code and code not in regions:
                stage = flight.control if call.commands else flight.push
                flown = self._traced("flown", [stage])
                regions[code] = [take, flown, self._gives(self._pushed)]
        return regions

    def _plan(self, given: Collection[str]) -> None:
        """Arrays that are given; where all that leaves lies in the bytes of a step, behind what is
        told; and the table of their addresses, which code reads.
        """
        kinds = {}
        starts = []
        end = self.memory.blocks * self._told.size
        for name, (dtype, (drones, *shape)) in self._outside.items():
            if name not in given:
                kinds[name] = (dtype, (self._worlds * drones, *shape))
                starts.append(end)
                size = self.memory.size * drones * prod(shape) * dtype.itemsize
                end += -(-size // 8) * 8
        fields: Any = {"names": [*kinds], "formats": [*kinds.values()], "offsets": starts}
        self._results = np.dtype(fields | {"itemsize": end})
        self._given = {
            name: np.zeros((self.memory.size, *shape), dtype)
            for name, (dtype, shape) in self._outside.items()
            if name in given
        }
        places = [array.ctypes.data for array in self._given.values()]
        self._places = np.array([*places, *starts])
        self._table = self._places.ctypes.data
        self._leaving = self._places[len(places) :]
        self._starts = self._leaving.copy()

    def step(
        self,
        sent: Array | None,
        flown: Mask | None,
        begun: Mask | None,
        active: Mask | None,
        asked: Mask | None,
        seeds: Seeds | None = None,
    ) -> tuple[Array, Told]:
        """Run all regions. Returns what leaves the loop, by name, (N, ...), and `Loop.told`.

        Actions (W, A, k), None if nobody flies; masks as of a `Record`; seeds of worlds, (W,).
        """
        if self.tape is not None and sent is not None:
            self.tape.append(Before(self.memory.copy(), self._world.scenery.frozen()))
        worlds = self._worlds
        given = self._given
        all_fly = flown is None and begun is None and active is None
        if not (all_fly and self._all_fly):
            given["flown"][:worlds] = True if flown is None else flown
            given["begun"][:worlds] = False if begun is None else begun
            given["active"][:worlds] = True if active is None else active
        self._all_fly = all_fly
        if sent is not None:
            given["sent"][:worlds] = sent
            if asked is not None:
                given["asked"][:worlds] = asked
        new: Any = np.empty(self._results.itemsize, np.uint8)
        # A third of the time of `ctypes.data`.
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(new))
        np.add(self._starts, self._address, out=self._leaving)
        if sent is not None and not self.is_whole:
            self._fly(flown)
        if begun is not None:
            self._seed(begun, seeds)
        for name, values in self._world.scenery.shared().items():
            given[name][:worlds] = values
        if not self.is_whole:
            if begun is not None:
                self._begin(begun)
            self._take(self._world.told())
        self._call(_LAST)
        return np.ndarray((), self._results, new), Told(self._read, new)

    def moment(self, results: Array) -> ByName:
        """As `Loop._moment` after a step."""
        seen = {"keys": self.memory.get(_KEYS), "episode": self.memory.get(_EPISODE)}
        for name in self._loop.sight():
            values = results[_SEEN + name]
            seen[name] = values.reshape(*self._world.shape, *values.shape[1:])
        return seen

    def _call(self, name: str) -> None:
        memory = self.memory
        self._codes[name](memory.blocks, memory.address, self._address, self._table)

    def _fly(self, flown: Mask | None) -> None:
        """Fly by physics that is no array code."""
        world = self._world
        worlds = self._worlds
        acts = {name: self._given[name][:worlds] for name in self._acts}
        for code, call in self._calls:
            if code:
                if code != _FIRST:
                    self._take(world.told(asked=False))
                self._call(code)
                vars(world).update(acts)
            world.fly(call, flown)

    def _begin(self, begun: Mask) -> None:
        """Begin with such physics. Raises `InputError` for a start that it refuses."""
        before = self.memory.copy()
        world = self._world
        try:
            self._call(_BEGIN)
            world.restore(part_of(self.kept(), "Flight"))
            world.place(begun)
        except InputError:
            self.memory = before
            world.restore(part_of(self.kept(), "Flight"))
            raise

    def _take(self, told: Named) -> None:
        """Give the code what physics says."""
        worlds = self._worlds
        for name, values in told.items():
            self._given[_PHYSICS + name][:worlds] = values

    def derivative(self) -> Derivative:
        """That of a step."""
        return Derivative(self._loop, self._layouts[0], self._width, self._worlds)

    def _seed(self, begun: Mask, seeds: Seeds | None) -> None:
        """As `Random.seed`, where there are seeds; and draw the layouts, which code does not."""
        world = self._world
        if seeds is None and not world.scenery.varies:
            return
        random = world.random
        random.keys = self.memory.get(_KEYS)
        random.episode = self.memory.get(_EPISODE)
        if seeds is not None:
            random.seed(begun, seeds)
            self.memory.put(_KEYS, random.keys)
            self.memory.put(_EPISODE, random.episode)
        world.scenery.begin(random, begun, ahead=1)
        if world.scenery.varies:
            self.memory.put(_SEEDS, world.scenery.seeds)

    def state(self) -> Snapshot:
        """As `Loop.state`."""
        return self.kept() | joined({"Flight/state": self._world.hidden()})

    def kept(self) -> Snapshot:
        """The part of `state` that is array code."""
        return {name: self.memory.get(name) for name in self._names}

    def restore(self, state: Arrays) -> None:
        """Put a state back; one from before an episode has a part of the arrays."""
        for name in self._names:
            values = state.get(name)
            if values is not None and values.ndim:
                self.memory.put(name, values)

    def _read(self, moments: Sequence[Array]) -> Content:
        """Telemetry and terms of the reward, float64, shape (K, N, n) and (K, N), of K steps."""
        telemetry = {}
        terms = {}
        drones = self._world.shape[1]
        size = self.memory.blocks * self._told.size
        content = np.concatenate([moment[:size] for moment in moments])
        for name in self._told.fields:
            view = self._told.view(name, content, len(moments) * self.memory.blocks)
            values = view.astype(np.float64, order="C")
            values = values.reshape(len(moments), self.memory.size * drones, -1)
            flat = values[:, : self._worlds * drones]
            if name.startswith(_TERM):
                terms[name.removeprefix(_TERM)] = flat[:, :, 0]
            else:
                telemetry[name.removeprefix(_TOLD)] = flat
        return telemetry, terms

    def _telemetry(self) -> Named:
        """What is told of the loop's step."""
        loop = self._loop
        told = {_TERM + name: term for name, term in loop.record.terms.items()}
        return told | {_TOLD + name: array for name, array in telemetry_of(loop).items()}

    def _seen(self) -> Named:
        """What leaves the loop."""
        record = self._loop.record
        headline = self._loop.headline_now().astype(np.float64)
        seen = {"reward": record.reward, "headline": headline}
        for number, array in enumerate(self._loop.arrays):  # their names are the task's
            seen[f"observation/{number}"] = record.observations[array.name].astype(array.dtype)
        if self._loop.instruments:
            seen |= {_SEEN + name: values for name, values in self._loop.sight().items()}
        seen |= {name: getattr(record, name) for name in _ENDS}
        return seen | {"wrong": record.unfit | self._loop.world.bad | self._loop.stuck()}

    def _pushed(self) -> Named:
        """What physics flies under that is no array code."""
        world = self._loop.world
        if not world.is_apart:
            return {}
        pushed = {"acting": world.acting, "wrench": world.wrench, "load": world.load}
        return {name: array for name, array in pushed.items() if array is not None}

    def _variables(self, program: Program) -> Named:
        """Variables of all arrays; those of the state become the loop's."""
        arrays = variables(program, self._loop, {**self._layouts[0].fields, **self._outside})
        for name in _MASKS:  # alike for the drones of a world
            first = arrays[name][:, :1]
            arrays[name] = np.repeat(first, self._world.shape[1], axis=1)
        return arrays

    def _traced(self, mask: str, stages: Step) -> Region:
        """What a region changes of a snapshot."""
        program = Program()
        before = self._variables(program)
        record = self._loop.record
        record.flown = before["flown"]
        record.begun = before["begun"]
        record.sent = before["sent"]
        record.asked = before.get("asked")
        record.run(before.get(mask), stages)
        return Region(mask, program, _stores(program, self._loop.state(), before))

    def _gives(self, named: Callable[[], Named]) -> Region:
        """A region that writes arrays."""
        program = Program()
        self._variables(program)
        fields = {**self._outside, **self._told.fields}
        stores = []
        for name, values in named().items():
            lifted = lift(program, values, fields[name][0])
            stores += [(name, row, value) for row, value in enumerate(lifted)]
        return Region("", program, stores)


def _before(call: Call) -> str:
    """The code before a call of the physics that is not the first, if there is any."""
    if call.commands:
        return _CONTROL
    return _PUSH if call.pushes else ""


def _stores(program: Program, after: Named, before: Named) -> Any:
    """Array, component and new value of what differs."""
    stores = []
    for name, values in after.items():
        old = before[name]
        new = lift(program, values, old.dtype)
        for row, (value, known) in enumerate(zip(new, old.values.reshape(-1), strict=True)):
            if value is not known:
                stores.append((name, row, value))
    return stores
