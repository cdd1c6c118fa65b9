"""The record that all stages share, and what a stage is."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim import Draw, InitialState
from ...sim.snapshots import Arrays, Snapshot, joined
from ...sim.state import Array, ByName, WorldState, chosen
from ..memory import Memory
from ..state import State

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Look = Callable[[], WorldState]
"""Gives the state that a controller sees: the exact one, or the estimate."""


class Record:
    """Named arrays of W worlds of A drones, shape (W, A, ...).

    A region runs stages under a mask of shape (W, A). When it ends, kept names have their new
    values under the mask and the old ones elsewhere. No array is changed in place.

    Attributes:
        shape: (W, A).
        memory: Of the task.
        kept: Names of arrays that keep their values between steps.
        flown: Drones that fly in this step; None: all.
        begun: Drones that begin an episode in this step; None: none.
        sent: Actions of the agent, float32, (W, A, k).
        asked: Which events the agent asks for, (W, A, E); None: it may ask for none.
        action: The last action that was flown, (W, A, k).
        received: The action that arrives at the controller.
        thrust: Of each rotor, N, (W, A, R).
        draw: Draws the numbers of episodes that begin.
        start: Initial state of the drones that begin.
        state: At the end of the step.
        measured: The state, or the estimate that replaces it.
        observations: By name, (W, A, *shape).
        terms: Of the reward, by name, (W, A).
        metrics: By name, (W, A).
        ended: Whether the task ends the episode, (W, A).
        reward: float64, (W, A).
        terminated, truncated: (W, A).
        unfit: Drones with numbers that are not finite, (W, A).
        steps: Control steps of each episode, (W, A).
        episodes: Number of episodes that each drone has begun, (W, A).
        out: Drones whose own episode has ended, (W, A).
        done: Drones of worlds whose episodes have all ended, (W, A).
        waiting: Drones that must be reset before they fly, (W, A).
        actions_sent, past_observations, history: Of the last steps, the oldest first.
        fired: Control step after which each event happened, infinite before, (W, A, E).
        said, heard, age, keys, silent: Of the radio; see `Radio`.
    """

    sent: NDArray[np.float32]
    action: Floats
    received: Floats
    actions_sent: Floats
    thrust: Array
    draw: Draw
    start: InitialState
    state: State
    measured: State
    observations: ByName
    past_observations: ByName
    history: ByName
    terms: ByName
    metrics: ByName
    ended: Array
    fired: Floats
    said: Floats
    heard: Floats
    age: Floats
    keys: NDArray[np.uint32]
    silent: Mask

    def __init__(self, shape: tuple[int, ...], memory: Memory, kept: tuple[str, ...] = ()) -> None:
        self.shape = shape
        self.memory = memory
        self.kept = kept
        nobody = np.zeros(shape, bool)
        self.flown: Mask | None = None
        self.begun: Mask | None = None
        self.steps: NDArray[np.int64] = np.zeros(shape, np.int64)
        self.episodes = self.steps
        self.out = self.done = self.terminated = self.truncated = self.unfit = nobody
        self.waiting = ~nobody
        self.asked: Mask | None = None
        self.reward = np.zeros(shape)
        self._nothing = self.reward
        self._nobody = nobody

    def run(self, mask: Mask | None, stages: Sequence[Callable[["Record"], None]]) -> None:
        """Run a region for the drones of a mask, None for all. An error leaves all as it was."""
        arrays = vars(self)
        memory = vars(self.memory)
        before = arrays.copy()
        remembered = memory.copy()
        try:
            for stage in stages:
                stage(self)
        except BaseException:
            arrays.clear()
            arrays.update(before)
            memory.clear()
            memory.update(remembered)
            raise
        if mask is None:
            return
        for name in self.kept:
            if name in before and arrays[name] is not before[name]:
                arrays[name] = merged(mask, arrays[name], before[name])
        for name, old in remembered.items():
            if memory[name] is not old:
                memory[name] = chosen(mask, memory[name], old)

    def snapshot(self) -> Snapshot:
        """Copies of what is kept and of the memory, by name."""
        known = vars(self)
        kept = {name: known.get(name) for name in self.kept}
        return joined({"memory": vars(self.memory), "kept": kept})

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        known = vars(self)
        for name in self.kept:
            known.pop(name, None)
        vars(self.memory).clear()
        with self.memory.open("begin"):
            for key, array in arrays.items():
                part, name, *inner = key.split("/", 2)
                if part == "memory":
                    setattr(self.memory, name, array.copy())
                elif inner:
                    known.setdefault(name, {})[inner[0]] = array.copy()
                else:
                    known[name] = array.copy()
        if self.has_begun:
            known.setdefault("metrics", {})  # of a task that has none
        self.flown = self.begun = None

    @property
    def has_begun(self) -> bool:
        """Whether there was an episode."""
        return "action" in vars(self)

    @property
    def active(self) -> Mask | None:
        """Drones that flew and drones that begin; None: all."""
        active = self.flown
        if active is not None and self.begun is not None:
            active = active | self.begun
        return None if active is None or active.all() else active

    def begin_all(self, stages: Sequence[Callable[["Record"], None]]) -> None:
        """A first reset of some drones begins all, so that every array exists; then all wait."""
        begun = self.begun
        assert begun is not None
        self.begun = begun | True
        self.run(None, stages)
        self.begun = begun
        self.waiting = begun | True
        self.episodes = 0 * self.episodes

    def rest(self) -> None:
        """A drone that does not fly gets no reward and no end."""
        self.reward = self._nothing
        self.terminated = self.truncated = self.unfit = self._nobody

    def wait(self, flown: Mask | None) -> None:
        """Drones that flew into a bad state must be reset, and those that flew beside them."""
        self.waiting = self.waiting | (True if flown is None else flown)

    def end(self, drones: Mask) -> None:
        """End the episodes of some drones; a world is done when all of its drones are out."""
        self.out = self.out | drones
        done = self.out
        if done.shape[1] > 1:
            done = np.repeat(done.all(axis=1, keepdims=True), done.shape[1], axis=1)
        self.done = done
        self.waiting = self.waiting | done


class Stage:
    """One concern of the loop. What changes of it is in the record.

    Class attributes:
        arrays: Names of the record that keep their values between steps. Other names that a stage
            assigns live until the end of the step.
        keeps: Name of an attribute with arrays of its own that a later step depends on.
    """

    arrays: tuple[str, ...] = ()
    keeps = ""

    def begin(self, record: Record) -> None:
        """Set the arrays of drones that begin an episode, those of `record.begun`."""

    def step(self, record: Record) -> None:
        """Compute one control step.

        Stages from `Measure` on run for drones that fly and for drones that begin.
        """

    def snapshot(self) -> Arrays:
        """What a later step depends on besides the record."""
        arrays: Arrays = getattr(self, self.keeps).snapshot() if self.keeps else {}
        return arrays

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Put a snapshot back; the record has been restored, and so have stages before this."""
        if self.keeps:
            getattr(self, self.keeps).restore(arrays)


def merged(mask: Mask, new: Any, old: Any) -> Any:
    """Arrays, or mappings of arrays: the new for the drones of a mask, the old for the others."""
    if isinstance(new, Mapping):
        return {name: merged(mask, value, old[name]) for name, value in new.items()}
    return chosen(mask, new, old)
