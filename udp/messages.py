"""What the two sides say to each other. Imports nothing but NumPy.

Every array has the drone as its first axis; a single drone is N = 1. Quantities are the env's own:
this module knows nothing of drones but their number. Messages check themselves: one that exists
has arrays that fit together and holds no NaN or infinity (bounds of spaces may be infinite).
"""

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

__all__ = [
    "MAX_DRONES",
    "MAX_SIZE",
    "MAX_TEXT",
    "MAX_UINT64",
    "Close",
    "Command",
    "Hello",
    "Message",
    "Refuse",
    "State",
    "Unknown",
    "Wait",
    "Welcome",
    "one_line",
]

MAX_DRONES: Final = 1 << 16
MAX_SIZE: Final = (1 << 16) - 1
"""Most observations, actions, telemetry values or discrete actions per drone."""
MAX_UINT64: Final = (1 << 64) - 1
"""Largest session, sequence number and seed."""
MAX_TEXT: Final = 512
"""Longest text field (env id, reason, telemetry names joined by commas), bytes of UTF-8."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_HASH: Final = re.compile(r"[0-9a-f]{32}")
_SMALL: Final = 64
"""Up to this many numbers Python's loop is faster than NumPy's call."""


def one_line(text: str) -> str:
    """Any text made fit for a message: no control characters, at most `MAX_TEXT` bytes."""
    raw = _CONTROL.sub(" ", text).encode(errors="replace")
    return raw[:MAX_TEXT].decode(errors="ignore")


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")


def _check_rows(name: str, array: np.ndarray) -> int:
    """Number of drones of an array of shape (N, anything)."""
    if array.ndim != 2 or not 1 <= array.shape[0] <= MAX_DRONES:
        raise ValueError(f"{name}: expected 1 to {MAX_DRONES} rows, got shape {array.shape}")
    return len(array)


def _check_finite(name: str, array: np.ndarray) -> None:
    if array.size <= _SMALL:
        finite = all(map(math.isfinite, array.ravel().tolist()))
    else:
        finite = bool(np.isfinite(array).all())
    if not finite:
        first = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f"{name}: expected finite numbers, got {array[*first]} at {first}")


def _check_text(name: str, text: str) -> None:
    size = len(text.encode())
    if size > MAX_TEXT:
        raise ValueError(f"{name}: expected at most {MAX_TEXT} bytes of UTF-8, got {size}")
    if _CONTROL.search(text):
        raise ValueError(f"{name}: expected no control characters, got {text!r}")


def _check_uint64(name: str, number: int) -> None:
    if not 0 <= number <= MAX_UINT64:
        raise ValueError(f"{name}: expected 0 to 2^64 - 1, got {number}")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Hello:
    """Simulator to agent, first: what it simulates."""

    session: int
    """Random 64-bit number, new at every start of a simulator and of its agent."""
    env_id: str
    num_drones: int
    observation_low: np.ndarray
    """float32, shape (n,)."""
    observation_high: np.ndarray
    """float32, shape (n,)."""
    action_low: np.ndarray
    """float32, shape (k,)."""
    action_high: np.ndarray
    """float32, shape (k,)."""
    discrete_actions: int
    """0: actions are continuous. Otherwise one action (k = 1) out of 0 ... discrete_actions - 1."""
    control_period: float
    """Time that one step simulates, s."""
    model_hash: str
    """32 lower-case hexadecimal digits; the same model, the same hash; zeros if it has none."""
    telemetry_names: tuple[str, ...]
    options: str
    """Options of the env as a JSON object; empty where the env tells none."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_drones <= MAX_DRONES:
            raise ValueError(f"num_drones: expected 1 to {MAX_DRONES}, got {self.num_drones}")
        self._check_bounds("observation", self.observation_low, self.observation_high)
        self._check_bounds("action", self.action_low, self.action_high)
        most = MAX_SIZE if self.action_low.size == 1 else 0
        if not 0 <= self.discrete_actions <= most:
            raise ValueError(f"discrete_actions: expected 0 to {most}, got {self.discrete_actions}")
        if not 1e-6 <= self.control_period <= 1e6:
            raise ValueError(f"control_period: expected 1e-6 to 1e6 s, got {self.control_period}")
        if not _HASH.fullmatch(self.model_hash):
            raise ValueError(f"model_hash: expected 32 hex digits, got {self.model_hash!r}")
        _check_text("env_id", self.env_id)
        _check_text("telemetry_names", ",".join(self.telemetry_names))
        _check_text("options", self.options)
        names = self.telemetry_names
        if len(set(names)) < len(names) or not all(name and "," not in name for name in names):
            raise ValueError(f"telemetry_names: expected names, each once, without commas: {names}")

    @staticmethod
    def _check_bounds(name: str, low: np.ndarray, high: np.ndarray) -> None:
        if low.ndim != 1 or not 1 <= low.size <= MAX_SIZE:
            raise ValueError(f"{name}_low: expected 1 to {MAX_SIZE} numbers, got {low.shape}")
        _check_shape(f"{name}_high", high, low.shape)
        # NaN compares as false; a bound may be infinite, but not on the wrong side.
        fits = (low <= high) & (low < np.inf) & (high > -np.inf)
        if not fits.all():
            first = int(fits.argmin())
            got = f"{low[first]} and {high[first]} at [{first}]"
            raise ValueError(f"{name}: expected low <= high, got {got}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Welcome:
    """Agent to simulator: the session is open."""

    session: int
    nonce: int = 0
    """Random 64-bit number, new for every session: the agent's part of the session's key."""
    seed: int | None = None
    """Seed for the simulator's own first reset, where the agent sets one: drone i takes seed + i
    (mod 2^64). Otherwise the session's number is the seed."""

    def __post_init__(self) -> None:
        _check_uint64("nonce", self.nonce)
        if self.seed is not None:
            _check_uint64("seed", self.seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class Refuse:
    """Agent to simulator: the session is not opened."""

    session: int
    reason: str

    def __post_init__(self) -> None:
        _check_text("reason", self.reason)


@dataclass(frozen=True, kw_only=True, slots=True)
class Wait:
    """Agent to simulator: every place is taken; go on saying Hello."""

    session: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Unknown:
    """Agent to simulator: the session of this State is not known here; say Hello again."""

    session: int
    sequence: int
    """Number of that State."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class State:
    """Simulator to agent: what every drone sees after the step that `sequence` counts."""

    session: int
    sequence: int
    observations: np.ndarray
    """float32, shape (N, n)."""
    rewards: np.ndarray
    """float64, shape (N,)."""
    terminated: np.ndarray
    """bool, shape (N,)."""
    truncated: np.ndarray
    """bool, shape (N,)."""
    telemetry: np.ndarray
    """float64, shape (N, m), in the order of `Hello.telemetry_names`."""

    def __post_init__(self) -> None:
        drones = _check_rows("observations", self.observations)
        _check_shape("rewards", self.rewards, (drones,))
        _check_shape("terminated", self.terminated, (drones,))
        _check_shape("truncated", self.truncated, (drones,))
        _check_shape("telemetry", self.telemetry, (drones, *self.telemetry.shape[1:2]))
        _check_finite("observations", self.observations)
        _check_finite("rewards", self.rewards)
        _check_finite("telemetry", self.telemetry)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Command:
    """Agent to simulator: what every drone does next. Answers the State of the same `sequence`."""

    session: int
    sequence: int
    actions: np.ndarray
    """float32, shape (N, k). Ignored for a drone that is reset."""
    resets: np.ndarray
    """bool, shape (N,): reset instead of step."""
    seeds: np.ndarray | None = None
    """uint64, shape (N,): seeds of the resets in this command; a drone that is not reset ignores
    its own. None leaves the generators as they are."""
    holds: np.ndarray | None = None
    """bool, shape (N,): neither reset nor step. None holds none."""

    def __post_init__(self) -> None:
        drones = _check_rows("actions", self.actions)
        _check_shape("resets", self.resets, (drones,))
        _check_finite("action", self.actions)
        if self.seeds is not None:
            _check_shape("seeds", self.seeds, (drones,))
        if self.holds is not None:
            _check_shape("holds", self.holds, (drones,))
            if (self.holds & self.resets).any():
                first = int((self.holds & self.resets).argmax())
                raise ValueError(f"holds: expected a reset or a hold, got both for drone {first}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Close:
    """Either side: the exchange ends here."""

    session: int
    sequence: int
    """Number of the last State that the sender sent (simulator) or took (agent)."""
    reason: str

    def __post_init__(self) -> None:
        _check_text("reason", self.reason)


Message = Hello | Welcome | Refuse | Wait | Unknown | State | Command | Close
