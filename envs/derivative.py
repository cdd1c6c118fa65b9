"""Derivatives of a compiled step: from those by its results to those by what it began with."""

from typing import Any, NamedTuple

import numpy as np

from ..sim.compile import Program, lift, read
from ..sim.compile.adjoint import adjoints
from ..sim.compile.layout import Fields, Layout, Memory, fields_of
from ..sim.compile.llvm import Region, compiled
from ..sim.scenery import Frozen
from ..sim.snapshots import part_of
from ..sim.state import Array, ByName
from .loop import Loop


class Before(NamedTuple):
    """What a derivative needs from before a step."""

    memory: Memory
    """The machine's."""
    scenery: Frozen
    """What stood there."""


class Derivative:
    """The adjoint of a step that all drones fly, as machine code.

    A loss depends on the rewards and observations of a flight. `back` takes its derivatives from
    the end of a step to its beginning: call it for each step, the last one first. The derivatives
    by the state stay here from call to call.

    What rays and pictures show is a constant, and so is whether a craft touches: the derivative of
    a distance along a ray, through the craft's own motion, has no bound at an edge. The distance to
    the nearest solid has one.

    Args:
        loop: A loop of one world whose episode has begun.
        state: Layout of its snapshots in a memory.
        width: Lanes of a vector.
        worlds: W.
    """

    def __init__(self, loop: Loop, state: Layout, width: int, worlds: int) -> None:
        program = Program()
        sent = loop.record.sent
        shared = fields_of({**loop.world.scenery.shared(), "sent": sent})
        before = variables(program, loop, {**state.fields, **shared})
        after = _flown(loop, before)
        ended = read(program, "ended", np.dtype(bool), (1,))
        arrays: ByName = {"ended": ended} | {name: before[name] for name in shared}
        outputs: list[Any] = []
        inputs: list[Any] = []
        places = []
        for name, array in after.items():
            if array.dtype.kind != "f":
                continue
            slope: Any = read(program, f"by/{name}", array.dtype, array.shape)
            arrays[f"by/{name}"] = slope
            if name not in ("reward", "observation"):
                slope = np.where(ended, 0.0, slope)
            values = lift(program, array, array.dtype)
            outputs += zip(values, slope.values.flat, strict=True)
        for name, array in before.items():
            if array.dtype.kind == "f":
                arrays[f"by/{name}"] = array
                inputs += array.values.flat
                places += [(f"by/{name}", row) for row in range(array.size)]
        found = adjoints(program, outputs, inputs)
        stores = [(*place, value) for place, value in zip(places, found, strict=True)]
        layout = Layout(fields_of(arrays), state.lanes)
        self._run = compiled([Region("", program, stores)], [state, layout], {}, width)
        self._memory = Memory(layout, worlds)

    def back(
        self,
        before: Before,
        sent: Array,
        by_reward: Array,
        by_observation: Array,
        ended: Array,
    ) -> Array:
        """Derivatives by the actions of a step, float32, shape (W A, k).

        Args:
            before: Of the machine's tape.
            sent: The actions, shape (W A, k).
            by_reward: Derivatives by the rewards, shape (W A,).
            by_observation: Those by what an actor observes after the step, flat, shape (W A, n).
            ended: Whether the state after the step leads to nothing more, bool, shape (W,). Then
                the derivatives by it do not count.
        """
        memory = self._memory
        for name, values in before.scenery.shared.items():
            memory.put(name, values)
        memory.put("sent", sent)
        memory.put("ended", ended)
        memory.put("by/reward", by_reward)
        memory.put("by/observation", by_observation)
        self._run(memory.blocks, before.memory.address, memory.address, None)
        return memory.get("by/sent").reshape(sent.shape)


def variables(program: Program, loop: Loop, fields: Fields) -> ByName:
    """Variables of a loop's state, its scenery and more; the loop has them from now on."""
    arrays: ByName = {
        name: read(program, name, dtype, (1, *shape)) for name, (dtype, shape) in fields.items()
    }
    world = loop.world
    world.outer = part_of(arrays, "physics")
    for name in world.scenery.shared():
        setattr(world.scenery, name, arrays[name])
    loop.put(arrays)
    return arrays


def _flown(loop: Loop, before: ByName) -> ByName:
    """State, rewards and flat observations after a step that all drones fly."""
    record = loop.record
    record.flown = record.begun = record.asked = None
    record.sent = before["sent"]
    record.rest()
    record.run(None, loop.pipeline.fly)
    record.run(None, loop.pipeline.observe)
    after: ByName = loop.state()
    after["reward"] = record.reward
    parts = []
    for array in loop.spec.for_actor().observation:
        nothing = np.zeros((*record.shape, array.size))
        values = record.observations.get(array.name, nothing)
        parts.append(values.reshape(*record.shape, -1).astype(np.float32))
    after["observation"] = np.concatenate(parts, axis=-1)
    return after
