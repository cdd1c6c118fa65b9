"""Simulates a journal again, and compares every bit."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from . import binary
from .fleet import Fleet
from .journal import software
from .messages import Command, Hello, State
from .recording import Flight, Item, Summary, count_of, read_journal, summarize

__all__ = [
    "Difference",
    "SessionVerdict",
    "Summary",
    "Verification",
    "read_journal",
    "summarize",
    "verify",
]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first number of a State that came out otherwise."""

    sequence: int
    drone: int
    field: str
    """`reward`, `telemetry Y`, `observation 0`, `terminated` or `truncated`."""
    recorded: str
    """A float with all its bits as hexadecimal, and as decimal."""
    replayed: str

    def __str__(self) -> str:
        return (
            f"State {self.sequence}, drone {self.drone}, {self.field}: "
            f"recorded {self.recorded}, replayed {self.replayed}"
        )


@dataclass(kw_only=True)
class SessionVerdict:
    """How the repetition of one session compares."""

    flight: Flight
    same: int = 0
    """States that are the same, every bit."""
    unchecked: int = 0
    """States before the first seed of a text session, whose agent cannot know how they began."""
    differing: int = 0
    """States that are not the same."""
    difference: Difference | None = None
    """The first of all."""
    problem: str = ""
    """Why it cannot be repeated, or not to its end."""
    notes: list[str] = field(default_factory=list)
    """What else is not as it was."""

    @property
    def identical(self) -> bool:
        """Whether nothing differs, as far as it can be compared."""
        return not (self.differing or self.problem)

    def __str__(self) -> str:
        counts = f"{self.same} States the same in every bit"
        counts += f", {self.differing} not" if self.differing else ""
        counts += f", {self.unchecked} before the first seed not compared" if self.unchecked else ""
        lines = [f"{self.flight}: {counts}"]
        lines += [f"  first difference: {self.difference}"] if self.difference else []
        lines += [f"  {self.problem}"] if self.problem else []
        return "\n".join(lines + [f"  note: {note}" for note in self.notes])


@dataclass(kw_only=True)
class Verification:
    """How the repetition of a journal compares."""

    path: Path
    complete: bool
    ending: str
    notes: list[str]
    """Versions that are not what they were."""
    sessions: list[SessionVerdict] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether States were compared, and every bit of every one is the same."""
        compared = sum(session.same for session in self.sessions)
        return compared > 0 and all(session.identical for session in self.sessions)

    def __str__(self) -> str:
        lines = [f"note: {note}" for note in self.notes] + list(map(str, self.sessions))
        if not self.complete:
            lines.append(f"note: the file is {self.ending}")
        compared = sum(session.same + session.differing for session in self.sessions)
        if self.identical:
            read = "" if self.complete else " as far as it can be read"
            sessions = count_of(len(self.sessions), "session")
            verdict = f"identical{read}: {compared} States in {sessions}"
        elif compared or any(session.problem for session in self.sessions):
            verdict = "not identical"
        else:
            verdict = "nothing to compare"
        return "\n".join([*lines, verdict])


def verify(path: Path | str) -> Verification:
    """Simulate every session of a journal again, and compare every bit of every State.

    Raises:
        ValueError: It is no journal.
        OSError: It cannot be read.
    """
    recording = read_journal(path)
    repeats: dict[int, _Repeat] = {}
    verdicts: list[SessionVerdict] = []
    try:
        for item in recording:
            place = item.flight.place
            if place not in repeats or repeats[place].verdict.flight is not item.flight:
                if place in repeats:
                    repeats[place].close()
                verdicts.append(SessionVerdict(flight=item.flight))
                repeats[place] = _Repeat(verdicts[-1], recording.about)
            repeats[place].take(item)
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

    def __init__(self, verdict: SessionVerdict, about: dict[str, str]) -> None:
        self.verdict = verdict
        self._about = about
        self._fleet: Fleet | None = None
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
            except Exception as error:  # of the env: what the simulator's run ended with as well
                what = str(error) or type(error).__name__
                self.verdict.problem = f"State {item.message.sequence} cannot be repeated: {what}"
            else:
                self._compare(item.message, item.datagram)

    def close(self) -> None:
        if self._fleet:
            self._fleet.close()

    def _repeat(self, sequence: int) -> None:
        """Bring the drones to that State."""
        command, seed = self._command, self.verdict.flight.seed
        if self._fleet is None:
            self._fleet = self._make()
            if seed is not None:
                self._fleet.reset(seed)
                self._known = True
        elif command is None or not self._sequence == command.sequence == sequence - 1:
            number = command.sequence if command else "none"
            raise ValueError(f"expected Command {sequence - 1} before it, got {number}")
        elif self._known or (command.seeds is not None and command.resets.all()):
            self._fleet.step(command.actions, command.resets, command.seeds, command.holds)
            self._known = True
        self._sequence = sequence

    def _make(self) -> Fleet:
        hello = self.verdict.flight.hello
        options = json.loads(hello.options or self._about.get("options") or "{}")
        fleet = Fleet(hello.env_id, hello.num_drones, options)
        try:
            here = fleet.hello
            if _sizes(here) != _sizes(hello):
                raise ValueError(
                    "expected (observations, actions, discrete actions, control period, telemetry) "
                    f"= {_sizes(hello)}, got an env of {_sizes(here)}"
                )
            known = hello.model_hash.strip("0") and here.model_hash != hello.model_hash
            if known:
                self.verdict.notes.append(
                    f"the model was {hello.model_hash}, and is {here.model_hash} here"
                )
        except BaseException:
            fleet.close()
            raise
        return fleet

    def _compare(self, recorded: State, datagram: bytes) -> None:
        verdict, fleet = self.verdict, self._fleet
        if not self._known or fleet is None:
            verdict.unchecked += 1
            return
        replayed = fleet.state(recorded.session, recorded.sequence)
        if binary.encode(replayed) == datagram:
            verdict.same += 1
            return
        verdict.differing += 1
        if verdict.difference is None:
            verdict.difference = _difference(recorded, replayed, fleet.hello.telemetry_names)


def _difference(recorded: State, replayed: State, names: tuple[str, ...]) -> Difference:
    """The first number of the first drone that differs in any bit."""
    sizes = [
        (*state.observations.shape, state.telemetry.shape[1]) for state in (recorded, replayed)
    ]
    if sizes[0] != sizes[1]:
        what = "drones, observations, telemetry"
        was, now = map(str, sizes)
        return Difference(
            sequence=recorded.sequence, drone=0, field=what, recorded=was, replayed=now
        )
    for drone in range(len(recorded.rewards)):
        pairs = zip(_numbers(recorded, drone, names), _numbers(replayed, drone, names), strict=True)
        for (name, old), (_, new) in pairs:
            if old.tobytes() != new.tobytes():
                return Difference(
                    sequence=recorded.sequence,
                    drone=drone,
                    field=name,
                    recorded=_digits(old),
                    replayed=_digits(new),
                )
    raise ValueError("expected States that differ, got equal ones")


def _numbers(state: State, drone: int, names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Every number of a drone, by name."""
    yield "reward", state.rewards[drone]
    for name, value in zip(names, state.telemetry[drone], strict=True):
        yield f"telemetry {name}", value
    for index, value in enumerate(state.observations[drone]):
        yield f"observation {index}", value
    yield "terminated", state.terminated[drone]
    yield "truncated", state.truncated[drone]


def _digits(number: Any) -> str:
    value = number.item()
    return f"{value.hex()} ({number!s})" if isinstance(value, float) else str(value)


def _sizes(hello: Hello) -> tuple[Any, ...]:
    return (
        hello.observation_low.size,
        hello.action_low.size,
        hello.discrete_actions,
        hello.control_period,
        hello.telemetry_names,
    )


def _other_versions(about: dict[str, str]) -> list[str]:
    """Versions that differ from those that wrote the journal, where it was the simulator's."""
    if about.get("side") != "simulator":
        return []
    return [
        f"recorded with {name} {about[key]}, repeated with {number}"
        for name, number in software().items()
        if name != "mcap" and (key := f"version of {name}") in about and about[key] != number
    ]
