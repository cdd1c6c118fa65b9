"""Messages of the two sides.

Every array has the drone as its first axis; a single drone is N = 1. Quantities are the env's own:
this module knows nothing of drones but their number. Short messages check themselves. A `State` or
a `Command` means something only with the `Layout` of its Hello: the codec checks it against that.
"""

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...models.errors import InputError, shortened
from ...models.fields import immutable
from .layout import MAX_DRONES, Array

MAX_UINT64 = (1 << 64) - 1  # largest session, sequence number, nonce and seed
MAX_TEXT = 512  # longest reason, bytes of UTF-8
MAX_SPEC = 1 << 22  # longest spec, bytes of UTF-8

FLY = 0
RESET = 1
FREEZE = 2  # order to a drone: fly its action, reset instead of it, or do nothing

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def one_line(text: str, most: int = MAX_TEXT) -> str:
    """Any text made fit for a message: no control characters, at most `most` bytes, and never more
    than `MAX_TEXT`.
    """
    raw = _CONTROL.sub(" ", text).encode(errors="replace")
    return raw[: min(most, MAX_TEXT)].decode(errors="ignore")


def _check_text(name: str, text: str) -> None:
    size = len(text.encode())
    if size > MAX_TEXT:
        raise InputError(f"{name}: expected at most {MAX_TEXT} bytes of UTF-8, got {size}")
    if _CONTROL.search(text):
        raise InputError(f"{name}: expected no control characters, got {shortened(text)}")


class Extension(NamedTuple):
    """Something of a later version or of a user, in Hello or Welcome."""

    number: int
    """0 to 32,767."""
    value: bytes
    critical: bool = False
    """Whether a side that does not know it must not go on."""


@immutable
class Hello:
    """Simulator to agent, first: its env and its worlds."""

    session: int
    """Random 64-bit number, new at every start of a simulator and of its agent."""
    spec: str
    """The `EnvSpec` as JSON."""
    worlds: int = 1
    """Number of worlds W, each with every drone of the spec."""
    versions: tuple[int, int] = (3, 3)
    """Lowest and highest version of the protocol that the simulator speaks."""
    extensions: tuple[Extension, ...] = ()

    def __post_init__(self) -> None:
        worlds = self.worlds
        low, high = self.versions
        size = len(self.spec.encode())
        if not 1 <= worlds <= MAX_DRONES:
            raise InputError(f"worlds: expected 1 to {MAX_DRONES}, got {worlds}")
        if not 1 <= low <= high <= 255:
            raise InputError(f"versions: expected 1 <= lowest <= highest, got {self.versions}")
        if not 2 <= size <= MAX_SPEC:
            raise InputError(f"spec: expected 2 to {MAX_SPEC} bytes of UTF-8, got {size}")


@immutable
class Welcome:
    """Agent to simulator: the session is open."""

    session: int
    nonce: int
    """Random 64-bit number, new for every session: State 1 echoes it, the session's key has it."""
    version: int = 3
    """Version of all that follows."""
    seed: int | None = None
    """Seed for the simulator's own first reset, where the agent sets one: drone i takes seed + i
    (mod 2^64). Otherwise the session's number is the seed."""
    extensions: tuple[Extension, ...] = ()

    @property
    def first_seed(self) -> int:
        """Seed of the simulator's own first reset."""
        return self.session if self.seed is None else self.seed


@immutable
class Refuse:
    """Agent to simulator: the session is not opened."""

    session: int
    reason: str

    def __post_init__(self) -> None:
        _check_text("reason", self.reason)


@immutable
class Wait:
    """Agent to simulator: every slot is taken; go on saying Hello."""

    session: int


@immutable
class Unknown:
    """Agent to simulator: the session of this State is not known here; say Hello again."""

    session: int
    sequence: int
    """Number of that State."""


@immutable
class Alive:
    """Simulator to agent: the Command of this number came, and is still being computed. Agent to
    simulator, that has asked again: the State of this number came, and is not yet answered."""

    session: int
    sequence: int


@immutable
class Missing:
    """Either side: some fragments of a message have come, and these have not."""

    session: int
    sequence: int
    """Number of the message; 0 for a Hello."""
    kind: int
    """Type of the message in the binary codec: 1 Hello, 4 State, 5 Command."""
    count: int
    """Number of its fragments."""
    first: int
    """Number of the fragment that the first bit stands for."""
    bitmap: bytes
    """Bit i of byte j (bit 0 is the lowest) is set if fragment first + 8 j + i is missing."""

    def __post_init__(self) -> None:
        if self.kind not in (1, 4, 5):
            raise InputError(f"expected a Hello, State or Command, got type {self.kind}")
        size = len(self.bitmap)
        count = self.count
        if not size or self.first + 8 * (size - 1) >= count:
            raise InputError(f"expected a bitmap of {count} fragments, got {size} bytes")
        if (numbers := self.numbers()) and numbers[-1] >= count:
            raise InputError(f"expected fragments below {count}, got {numbers[-1]}")

    def numbers(self) -> list[int]:
        """Numbers of the fragments that are missing, in their order."""
        bits = np.unpackbits(np.frombuffer(self.bitmap, np.uint8), bitorder="little")
        numbers: list[int] = (np.flatnonzero(bits) + self.first).tolist()
        return numbers


@dataclass(kw_only=True, slots=True, eq=False)
class State:
    """Simulator to agent: observations of every drone after the step that `sequence` counts.

    Not to be changed, as all messages; to freeze it would triple the time to make one.
    """

    session: int
    sequence: int
    time: float
    """Simulated since the session began, s."""
    nonce: int = 0
    """That of the Welcome in State 1, 0 in all others."""
    observations: tuple[Array, ...]
    """Each array of the layout, shape (N, *shape)."""
    rewards: Array
    """float64, shape (N,)."""
    terminated: Array
    """bool, shape (N,)."""
    truncated: Array
    """bool, shape (N,)."""
    telemetry: tuple[Array, ...] = ()
    """Each array of the layout, float64, shape (N, *shape)."""


@dataclass(kw_only=True, slots=True, eq=False)
class Command:
    """Agent to simulator: next order of every drone. Answers the State of the same `sequence`.

    Not to be changed, as `State`.
    """

    session: int
    sequence: int
    actions: Array
    """Dtype of the layout, shape (N, *shape); int64, shape (N,), if discrete. Checked for every
    drone, and then ignored for those that do not fly."""
    orders: Array
    """uint8, shape (N,): `FLY`, `RESET` or `FREEZE`."""
    seeds: Array | None = None
    """uint64, shape (N,): seeds of the resets in this command; a drone that is not reset ignores
    its own. None leaves the generators as they are."""
    asks: Array | None = None
    """uint64, shape (N,): bit i asks for event i of the spec's `asks`, for a drone that flies. None
    asks for nothing."""

    @property
    def resets(self) -> Array:
        """bool, shape (N,): reset instead of flown."""
        return np.asarray(self.orders == RESET)

    @property
    def frozen(self) -> Array:
        """bool, shape (N,): neither reset nor flown."""
        return np.asarray(self.orders == FREEZE)


@immutable
class Close:
    """Either side: the exchange ends here."""

    session: int
    sequence: int
    """Number of the last State that the sender sent (simulator) or took (agent)."""
    reason: str

    def __post_init__(self) -> None:
        _check_text("reason", self.reason)


Message = Hello | Welcome | Refuse | Wait | Unknown | Alive | Missing | State | Command | Close
