"""Simulates a journal again, and compares every bit."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...envs.loop import Loop
from ...envs.registry import is_known
from ...envs.spec import EnvSpec, component_names
from ...models.errors import InputError
from ..protocol.messages import Command, State
from .reader import Item, Session, count_of, printable, read_journal
from .writer import software

__all__ = ["Difference", "SessionVerdict", "Verification", "verify"]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first number of a State that differs."""

    sequence: int
    drone: int
    field: str
    """`reward`, `terminated`, `truncated`, or the array and its component: `telemetry Y`."""
    recorded: str
    """A float in hexadecimal with all its bits, and in decimal."""
    replayed: str

    def __str__(self) -> str:
        return (
            f"State {self.sequence}, drone {self.drone}, {self.field}: "
            f"recorded {self.recorded}, replayed {self.replayed}"
        )


@dataclass(kw_only=True)
class SessionVerdict:
    """Result of repeating one session."""

    session: Session
    same: int = 0
    """States that are the same in every bit."""
    unchecked: int = 0
    """States before the first seed of a text session: its agent does not know how they began."""
    differing: int = 0
    """States that differ."""
    difference: Difference | None = None
    """The first of all."""
    problem: str = ""
    """Reason if it cannot be repeated, or not to its end."""
    notes: list[str] = field(default_factory=list)
    """Other things that have changed."""

    @property
    def identical(self) -> bool:
        """Whether nothing differs, as far as it can be compared."""
        return not (self.differing or self.problem)

    def lines(self) -> list[str]:
        """The verdict in words."""
        counts = f"{self.same} States the same in every bit"
        counts += f", {self.differing} not" if self.differing else ""
        counts += f", {self.unchecked} before the first seed not compared" if self.unchecked else ""
        lines = [f"{self.session}: {counts}"]
        lines += [f"  first difference: {self.difference}"] if self.difference else []
        lines += [f"  {self.problem}"] if self.problem else []
        return lines + [f"  note: {note}" for note in self.notes]


@dataclass(kw_only=True)
class Verification:
    """Result of repeating a journal."""

    path: Path
    complete: bool
    ending: str
    notes: list[str]
    """Versions that have changed."""
    sessions: list[SessionVerdict] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether States were compared, and every bit of every one is the same."""
        compared = sum(session.same for session in self.sessions)
        return compared > 0 and all(session.identical for session in self.sessions)

    def __str__(self) -> str:
        lines = [f"note: {note}" for note in self.notes]
        lines += [line for session in self.sessions for line in session.lines()]
        if not self.complete:
            lines.append(f"note: the file is {self.ending}")
        compared = sum(session.same + session.differing for session in self.sessions)
        if self.identical:
            read = "" if self.complete else " as far as it can be read"
            sessions = count_of(len(self.sessions), "session")
            lines.append(f"identical{read}: {compared} States in {sessions}")
        elif compared or any(session.problem for session in self.sessions):
            lines.append("not identical")
        else:
            lines.append("nothing to compare")
        return printable(lines)


def verify(path: Path | str, *, vehicle: Path | str | None = None) -> Verification:
    """Simulate every session of a journal again, and compare every bit of every State.

    Only an env that is registered here is simulated: nothing that the file names is imported.

    Args:
        path: The journal.
        vehicle: MJCF of the vehicle that was flown; None: the paper's.

    Raises:
        InputError: It is not a journal.
        OSError: It cannot be read.
    """
    recording = read_journal(path)
    repeats: dict[int, _Repeat] = {}
    verdicts: list[SessionVerdict] = []
    try:
        for item in recording:
            slot = item.session.slot
            if slot not in repeats or repeats[slot].verdict.session is not item.session:
                if slot in repeats:
                    repeats[slot].close()
                verdicts.append(SessionVerdict(session=item.session))
                repeats[slot] = _Repeat(verdicts[-1], vehicle)
            repeats[slot].take(item)
    finally:
        for repeat in repeats.values():
            repeat.close()
    return Verification(
        path=recording.path,
        complete=recording.complete,
        ending=recording.ending,
        notes=_other_versions(recording.about),
        sessions=verdicts,
    )


class _Repeat:
    """Simulates one session again."""

    def __init__(self, verdict: SessionVerdict, vehicle: Path | str | None) -> None:
        self.verdict = verdict
        self._vehicle = vehicle
        self._loop: Loop | None = None
        self._sequence: int | None = None
        self._command: Command | None = None
        self._known = False
        """Whether the simulated drones are where the recorded ones were."""

    def take(self, item: Item) -> None:
        if self.verdict.problem:
            return
        if isinstance(item.message, Command):
            self._command = item.message
        elif isinstance(item.message, State):
            try:
                self._repeat(item.message.sequence)
            except Exception as error:  # the env's: the recorded run ended with it too
                what = str(error) or type(error).__name__
                self.verdict.problem = f"State {item.message.sequence} cannot be repeated: {what}"
            else:
                self._compare(item.message)

    def close(self) -> None:
        if self._loop:
            self._loop.close()

    def _repeat(self, sequence: int) -> None:
        """Bring the drones to that State."""
        command, session = self._command, self.verdict.session
        if self._loop is None:
            self._loop = self._make()
            if session.seed is not None:
                self._reset(self._loop, session.seed)
                self._known = True
        elif command is None or not self._sequence == command.sequence == sequence - 1:
            number = command.sequence if command else "none"
            raise InputError(f"expected Command {sequence - 1} before it, got {number}")
        elif self._known or (command.seeds is not None and command.resets.all()):
            self._loop.advance(command.actions, command.resets, command.seeds, command.frozen)
            self._known = True
        self._sequence = sequence

    def _reset(self, loop: Loop, seed: int) -> None:
        """The simulator's own first reset: drone i takes seed + i, modulo 2^64."""
        count, actions = loop.num_envs, self.verdict.session.layout.actions
        seeds = np.array([(seed + i) % 2**64 for i in range(count)], np.uint64)
        loop.advance(np.zeros(actions.shape, actions.dtype), np.ones(count, bool), seeds)

    def _make(self) -> Loop:
        session = self.verdict.session
        spec = session.spec
        if not is_known(spec.env_id):
            raise InputError(
                f"expected a registered env id, got {spec.env_id!r}: "
                "--env MODULE:NAME names the module that registers it"
            )
        loop = Loop(spec.env_id, session.num_envs, vehicle=self._vehicle, options=spec.options)
        try:
            self._compare_specs(loop.spec)
        except BaseException:
            loop.close()
            raise
        return loop

    def _compare_specs(self, here: EnvSpec) -> None:
        """Raise `InputError` unless the arrays are those of the recorded spec."""
        recorded, notes = self.verdict.session.spec, self.verdict.notes
        for name in ("observation", "action", "telemetry", "control_period"):
            was, now = getattr(recorded, name), getattr(here, name)
            if was != now:
                raise InputError(f"expected an env of the {name} {was}, got one of {now}")
        if recorded.vehicle_hash.strip("0") and recorded.vehicle_hash != here.vehicle_hash:
            notes.append(
                f"the vehicle was {recorded.vehicle_hash}, and is {here.vehicle_hash} here"
            )

    def _compare(self, recorded: State) -> None:
        verdict, loop = self.verdict, self._loop
        if not self._known or loop is None:
            verdict.unchecked += 1
            return
        difference = _difference(recorded, loop)
        if difference is None:
            verdict.same += 1
            return
        verdict.differing += 1
        verdict.difference = verdict.difference or difference


def _difference(recorded: State, loop: Loop) -> Difference | None:
    """The first number of the first drone that differs in any bit; None if none does."""
    pairs = list(_arrays(recorded, loop))
    if all(was.tobytes() == now.tobytes() for _, was, now in pairs):
        return None
    return next(
        Difference(
            sequence=recorded.sequence,
            drone=drone,
            field=name,
            recorded=_digits(old),
            replayed=_digits(new),
        )
        for drone in range(loop.num_envs)
        for names, was, now in pairs
        for name, old, new in zip(names, was[drone].flat, now[drone].flat, strict=True)
        if old.tobytes() != new.tobytes()
    )


def _arrays(
    recorded: State, loop: Loop
) -> Iterator[tuple[tuple[str, ...], np.ndarray, np.ndarray]]:
    """Names of the numbers of one drone, the recorded array and the replayed one."""
    yield ("reward",), recorded.rewards, loop.rewards
    yield ("terminated",), recorded.terminated, loop.terminated
    yield ("truncated",), recorded.truncated, loop.truncated
    for what, specs, arrays, here in (
        ("telemetry", loop.spec.telemetry, recorded.telemetry, loop.telemetry),
        ("observation", loop.spec.observation, recorded.observations, loop.observations),
    ):
        for spec, was in zip(specs, arrays, strict=True):
            names = tuple(f"{what} {name}" for name in component_names(spec))
            yield names, was, np.ascontiguousarray(here[spec.name], was.dtype)


def _digits(number: Any) -> str:
    value = number.item()
    return f"{value.hex()} ({number!s})" if isinstance(value, float) else str(value)


def _other_versions(about: dict[str, str]) -> list[str]:
    """Versions that differ from those that wrote the journal, where it was the simulator's."""
    if about.get("side") != "simulator":
        return []
    return [
        f"recorded with {name} {about[key]}, repeated with {number}"
        for name, number in software().items()
        if name != "mcap" and (key := f"version of {name}") in about and about[key] != number
    ]
