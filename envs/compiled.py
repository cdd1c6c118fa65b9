"""A loop whose steps are machine code."""

import traceback
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..models.errors import InputError, one_line
from ..sim import Array, PhysicsError
from ..sim.snapshots import Arrays, Snapshot
from ..sim.state import ByName, some
from ..sim.world import tell_once
from .autoreset import Seeds
from .config import EnvConfig
from .loop import Loop
from .stages.ends import refuse_unfit

if TYPE_CHECKING:
    from .machine import Machine

_STARTS = 16
_TRACER = ("numpy", "rotorgram.sim.compile")  # modules that are not to blame
_OURS = ("numpy", "rotorgram")


def make_loop(config: EnvConfig, num_worlds: int = 1) -> Loop:
    """The loop of a config: compiled where it can be."""
    if config.backend.compiled is not False:
        from ..sim.compile.llvm import trouble

        if not trouble():
            return CompiledLoop(config, num_worlds)
    return Loop(config, num_worlds)


class CompiledLoop(Loop):
    """A loop that a machine steps, with the same bits; what cannot be compiled NumPy runs.

    The state is in the machine, until somebody asks for the record, the world or the task.
    """

    _machine: "Machine | None" = None
    _inside: "Machine | None" = None  # while it has the state
    refusal = ""
    """Why it is not compiled, once that was tried."""

    def _step(self, seeds: Seeds | None, *, flies: bool) -> None:
        record = self._record
        begun = record.begun
        if begun is not None and not record.has_begun and not begun.all():
            self._settle()
            machine = None  # NumPy begins all, so that every array exists
        else:
            machine = self.machine()
        if machine is None:
            super()._step(seeds, flies=flies)
            return
        sent = record.sent if flies else None
        flew = record.flown
        try:
            if flies and self._world.scenery.moves:
                steps = machine.memory.get("record/kept/steps")
                fired = machine.memory.get("record/kept/fired") if self._throws else None
                self._move_solids(steps + (1 if flew is None else flew), fired)
            results, told = machine.step(sent, flew, begun, record.active, record.asked, seeds)
            if not record.has_begun:
                record.action = self.pipeline.actions.neutral()
            record.waiting = results["waiting"].reshape(record.shape)
            self._give(results)
            self._told = told
            if some(results["wrong"]):
                self._check()
        except BaseException as error:
            self._settle()  # the physics has gone on
            if isinstance(error, PhysicsError):
                self._undo(flew)
            raise
        self._measure()

    def prepare(self) -> None:
        """Compile."""
        self.machine()

    def machine(self) -> "Machine | None":
        """The machine, which has the state from now on; None where NumPy flies."""
        if self._machine is None and not self.refusal:
            self._machine = self._made()
        if self._machine is not None and self._inside is None:
            self._machine.restore(self.state())
            self._inside = self._machine
        return self._machine

    def _made(self) -> "Machine | None":
        from .machine import Machine

        config = self.config
        loop = Loop(replace(config, backend=replace(config.backend, compiled=False)))
        loop.measures = False
        try:
            _begin(loop)
            loop.advance(loop.pipeline.actions.neutral())
            return Machine(loop, self._world)
        except InputError as error:  # which NumPy will raise
            self.refusal = str(error)
        except Exception as error:  # of an own task, any
            self.refusal = f"{one_line(error)} ({place_of(error)})"
            tell_once(f"{config.env_id}: not compiled, NumPy flies it: {self.refusal}")
        return None

    def _settle(self) -> None:
        machine = self._inside
        self._inside = None
        if machine is not None and self._record.has_begun:
            super().put(machine.kept())
            self._world.take()

    def state(self) -> Snapshot:
        """As `Loop.state`."""
        if self._inside is not None and self._record.has_begun:
            return self._inside.state()
        return super().state()

    def put(self, state: Arrays) -> None:
        """As `Loop.put`."""
        self._inside = None
        super().put(state)

    def _give(self, results: np.ndarray) -> None:
        self.observations = {}
        self._results = results
        for number, array in enumerate(self.arrays):
            self.observations[array.name] = results[f"observation/{number}"]
        self.rewards = results["reward"]
        self.headline = results["headline"]
        self.terminated = results["terminated"]
        self.truncated = results["truncated"]
        self.done = results["done"]
        self.out = results["out"]

    def _moment(self) -> ByName:
        machine = self._inside
        return super()._moment() if machine is None else machine.moment(self._results)

    def _undo(self, flew: Array) -> None:
        """Do not count a step that broke; its drones wait for a reset."""
        record = self.record
        record.steps = record.steps - (1 if flew is None else flew)
        record.wait(flew)

    def _check(self) -> None:
        """Raise for bad states, and for numbers that are not finite."""
        flew = self._record.flown
        record = self.record
        self._world.refuse_bad(flew)
        refuse_unfit(record, self.config.env_id)
        self._refuse_stuck()


def _begin(loop: Loop) -> None:
    """Begin an episode. Raises `InputError` if many starts are refused."""
    everybody = np.ones(loop.num_envs, bool)
    for seed in range(_STARTS):
        try:
            loop.advance(None, everybody, seed)
        except InputError as error:
            refused = error
        else:
            return
    raise refused


def place_of(error: Exception) -> str:
    """The function and the line to blame: the last that is not of ours, or not of the tracer."""
    frames = [
        (frame.f_globals["__name__"], f"`{frame.f_code.co_name}`, line {line}")
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    for machinery in (_OURS, _TRACER):
        own = [place for module, place in frames if not module.startswith(machinery)]
        if own:
            break
    return own[-1]
