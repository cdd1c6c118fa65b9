"""Simulates a journal again, and compares every bit."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...envs.config import EnvConfig
from ...envs.registry import task_type
from ...envs.spec import component_names
from ...models import Backend
from ...models.errors import InputError, printable, shortened
from ..protocol.layout import Array
from ..protocol.messages import Command, State
from ..transport.simulator import COMMAND_AGE
from ..transport.stepped import Steppable, make_stepped
from .reader import Item, Recording, Session, count_of

_SAME = ("vehicle_hash", "agents", "observation", "action", "telemetry", "control_period")
"""Fields of the spec that have to be those of the recorded one."""


class Difference(NamedTuple):
    """The first number of a State that differs."""

    sequence: int
    drone: int
    field: str
    """`reward`, `terminated`, `truncated`, or the array and its component: `telemetry z`."""
    recorded: str
    """With as many digits as tell it from every other number."""
    replayed: str

    def __str__(self) -> str:
        where = f"State {self.sequence}, drone {self.drone}, {self.field}"
        return f"{where}: recorded {self.recorded}, replayed {self.replayed}"


@dataclass(kw_only=True)
class SessionVerdict:
    """Simulates one session again, and counts what is the same."""

    session: Session
    flown: dict[str, object]
    """Vehicle and backend, by the names of `EnvConfig.from_keywords`."""
    same: int = 0
    """States that are the same in every bit."""
    differing: int = 0
    """States that differ."""
    difference: Difference | None = None
    """The first of all."""
    problem: str = ""
    """Reason if it cannot be repeated, or not to its end."""

    _loop: Steppable | None = None

    @property
    def identical(self) -> bool:
        """Whether nothing differs, as far as it can be compared."""
        return not (self.differing or self.problem)

    def lines(self) -> list[str]:
        """The verdict in words."""
        differing = f", {self.differing} not" if self.differing else ""
        lines = [f"{self.session}: {self.same} States the same in every bit{differing}"]
        if self.difference:
            lines.append(f"  first difference: {self.difference}")
        if self.problem:
            lines.append(f"  {self.problem}")
        return lines

    def take(self, item: Item) -> None:
        """Repeat a message."""
        state = item.message
        if self.problem or not isinstance(state, State):
            return
        try:
            loop = self._repeat(state, item.command)
        except Exception as error:  # the env's: the recorded run ended with it too
            what = str(error) or type(error).__name__
            self.problem = f"State {state.sequence} cannot be repeated: {what}"
            return
        difference = _difference(state, loop)
        if difference:
            self.difference = self.difference or difference
            self.differing += 1
        else:
            self.same += 1

    def close(self) -> None:
        """Release the drones."""
        if self._loop:
            self._loop.close()
            self._loop = None

    def _repeat(self, state: State, command: Command | None) -> Steppable:
        """Bring the drones to that State."""
        if self._loop is None:
            self._loop = self._make()
        if command is None:
            number = state.sequence - 1
            raise InputError(f"expected Command {number} before it, got none of that number")
        resets = command.resets
        self._loop.advance(command.actions, resets, command.seeds, command.frozen, command.asks)
        return self._loop

    def _make(self) -> Steppable:
        """The drones. Raises `InputError` unless their arrays are those of the recorded spec."""
        spec = self.session.spec
        task_type(spec.env_id)  # raises for one that is not known here: no file names a module
        if COMMAND_AGE in spec.telemetry:
            raise InputError("expected a flight in lock-step, got one of sim --free-running")
        keywords = {**self.flown, **spec.options}
        config = EnvConfig.from_keywords(spec.env_id, drones=len(spec.agents), **keywords)
        loop = make_stepped(config, self.session.num_envs, {})
        for name in _SAME:
            was = getattr(spec, name)
            now = getattr(loop.spec, name)
            if was != now:
                loop.close()
                hint = " (--vehicle names its file)" if name == "vehicle_hash" else ""
                raise InputError(
                    f"expected an env of the {name} {shortened(was)}, got {shortened(now)}{hint}"
                )
        return loop


class Verification(Recording):
    """Every session of a journal simulated again, and every bit of every State compared.

    Only an env that is registered here is simulated: nothing that the file names is imported.

    Args:
        path: The journal.
        vehicle: File or name of the vehicle that was flown; None: the paper's.
        backend: What stepped the drones; None: what the journal says, else the task's.

    Attributes:
        sessions: The verdict on each.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        vehicle: Path | str | None = None,
        backend: Backend | None = None,
    ) -> None:
        super().__init__(path)
        stepped_by = backend or self.about.get("backend")
        flown: dict[str, object] = {"vehicle": vehicle, "backend": stepped_by}
        self.sessions: list[SessionVerdict] = []
        flying: dict[int, SessionVerdict] = {}  # the last of each slot
        try:
            for item in self:
                slot = item.session.slot
                if item.begins:
                    if slot in flying:
                        flying[slot].close()
                    flying[slot] = SessionVerdict(session=item.session, flown=flown)
                    self.sessions.append(flying[slot])
                flying[slot].take(item)
        finally:
            for verdict in self.sessions:
                verdict.close()

    @property
    def same(self) -> int:
        """States that are the same in every bit, in all sessions."""
        return sum(session.same for session in self.sessions)

    @property
    def identical(self) -> bool:
        """Whether States were compared, and every bit of every one is the same."""
        return self.same > 0 and all(session.identical for session in self.sessions)

    def __str__(self) -> str:
        lines = [line for session in self.sessions for line in session.lines()]
        if not self.complete:
            lines.append(f"note: the file is {self.ending}")
        if self.identical:
            sessions = count_of(len(self.sessions), "session")
            lines.append(f"identical: {self.same} States in {sessions}")
        elif all(session.identical for session in self.sessions):
            lines.append("nothing to compare")
        else:
            lines.append("not identical")
        return printable("\n".join(lines))


def _difference(recorded: State, loop: Steppable) -> Difference | None:
    """The first number that differs in any bit; None if none does."""
    for names, was, now in _arrays(recorded, loop):
        if was.tobytes() == now.tobytes():
            continue
        for at, old in enumerate(was.flat):
            new = now.flat[at]
            if old.tobytes() != new.tobytes():
                drone, component = divmod(at, len(names))
                name = names[component]
                return Difference(recorded.sequence, drone, name, str(old), str(new))
    return None


def _arrays(recorded: State, loop: Steppable) -> Iterator[tuple[list[str], Array, Array]]:
    """Names of the numbers of one drone, the recorded array and the replayed one."""
    yield ["reward"], recorded.rewards, loop.rewards
    yield ["terminated"], recorded.terminated, loop.terminated
    yield ["truncated"], recorded.truncated, loop.truncated
    for what, specs, arrays, here in (
        ("telemetry", loop.spec.telemetry, recorded.telemetry, loop.telemetry),
        ("observation", loop.spec.observation, recorded.observations, loop.observations),
    ):
        for spec, was in zip(specs, arrays, strict=True):
            names = [f"{what} {name}" for name in component_names(spec)]
            yield names, was, np.ascontiguousarray(here[spec.name], was.dtype)
