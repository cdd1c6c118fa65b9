"""The text codec: one drone, numbers separated by commas, at most 1024 bytes of ASCII.

The paper's peers turn arrays of numbers into bytes and back (section 2.1). There is no Hello:

    simulator:  sequence,reward,terminated,truncated,observation...,telemetry...
    agent:      sequence,action...    or    sequence,reset[,seed]
    either:     sequence,close

Numbers are written as float64 with the fewest digits that read back as the same bits; a float32
is written as the float64 of the same value.
"""

import re
from typing import Final

import numpy as np

from .errors import DecodeError
from .messages import MAX_UINT64, Close, Command, State

__all__ = ["MAX_LINE", "decode_command", "decode_state", "encode", "is_text"]

MAX_LINE: Final = 1024
_DIGITS: Final = frozenset(b"0123456789")
_F4: Final = np.dtype(np.float32)
_FLAGS: Final = {"0": False, "1": True}
_WHOLE: Final = re.compile(r"[0-9]{1,20}")
_NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def is_text(datagram: bytes) -> bool:
    """Whether a datagram can be a text message: every one begins with a digit."""
    return bool(datagram) and datagram[0] in _DIGITS


def encode(message: State | Command | Close) -> bytes:
    """One line, without its end. Raises `ValueError` if it is too long or not for one drone."""
    match message:
        case State():
            _expect_one_drone(message.observations)
            fields = _state_fields(message)
        case Command():
            _expect_one_drone(message.actions)
            fields = _command_fields(message)
        case Close():
            fields = ["close"]
    line = ",".join([str(message.sequence), *fields]).encode()
    if len(line) > MAX_LINE:
        raise ValueError(f"text line: expected at most {MAX_LINE} bytes, got {len(line)}")
    return line


def _expect_one_drone(rows: np.ndarray) -> None:
    if len(rows) != 1:
        raise ValueError(f"text codec: expected one drone, got {len(rows)}: use the binary codec")


def _state_fields(message: State) -> list[str]:
    flags = ["01"[message.terminated.item()], "01"[message.truncated.item()]]
    numbers = [*message.observations[0].tolist(), *message.telemetry[0].tolist()]
    return [repr(message.rewards.item()), *flags, *map(repr, numbers)]


def _command_fields(message: Command) -> list[str]:
    if message.resets.item():
        return ["reset"] if message.seeds is None else ["reset", str(message.seeds.item())]
    return [repr(action) for action in message.actions[0].tolist()]


def decode_state(datagram: bytes, observation_size: int, telemetry_size: int) -> State | Close:
    """A simulator's line, as of session 0. Raises `DecodeError` for anything else."""
    sequence, fields = _split(datagram)
    if fields == ["close"]:
        return Close(session=0, sequence=sequence, reason="the simulator closed")
    expected = 3 + observation_size + telemetry_size
    if len(fields) != expected:
        raise DecodeError(
            f"state: expected {expected + 1} fields (sequence, reward, terminated, truncated, "
            f"{observation_size} of observation, {telemetry_size} of telemetry), "
            f"got {len(fields) + 1}"
        )
    end = 3 + observation_size
    try:
        return State(
            session=0,
            sequence=sequence,
            rewards=np.array(_floats("reward", fields[:1])),
            terminated=np.array([_flag("terminated", fields[1])]),
            truncated=np.array([_flag("truncated", fields[2])]),
            observations=_float32("observation", fields[3:end]),
            telemetry=np.array([_floats("telemetry", fields[end:])]),
        )
    except ValueError as error:
        raise DecodeError(f"state: {error}") from None


def decode_command(datagram: bytes, action_size: int, session: int) -> Command | Close:
    """An agent's line, taken as one of `session`. Raises `DecodeError` for anything else."""
    sequence, fields = _split(datagram)
    if fields == ["close"]:
        return Close(session=session, sequence=sequence, reason="the agent closed")
    reset = fields[0] == "reset"
    expected = f"sequence,reset[,seed] or sequence and {action_size} of action"
    if len(fields) > 2 if reset else len(fields) != action_size:
        raise DecodeError(f"command: expected {expected}, got {datagram[:80]!r}")
    try:
        seed = [_whole("seed", fields[1])] if reset and len(fields) == 2 else None
        return Command(
            session=session,
            sequence=sequence,
            actions=np.zeros((1, action_size), _F4) if reset else _float32("action", fields),
            resets=np.array([reset]),
            seeds=None if seed is None else np.array(seed, np.uint64),
        )
    except ValueError as error:
        raise DecodeError(f"command: {error}") from None


def _split(datagram: bytes) -> tuple[int, list[str]]:
    if len(datagram) > MAX_LINE:
        raise DecodeError(f"text line: expected at most {MAX_LINE} bytes, got {len(datagram)}")
    try:
        line = datagram.decode("ascii").removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise DecodeError("text line: expected ASCII") from None
    sequence, _, rest = line.partition(",")
    if not rest:
        raise DecodeError(f"text line: expected sequence,field..., got {line[:80]!r}")
    try:
        return _whole("sequence", sequence), rest.split(",")
    except ValueError as error:
        raise DecodeError(f"text line: {error}") from None


def _whole(name: str, field: str) -> int:
    number = int(field) if _WHOLE.fullmatch(field) else -1
    if not 0 <= number <= MAX_UINT64:
        raise ValueError(f"{name}: expected a whole number below 2^64, got {field[:80]!r}")
    return number


def _flag(name: str, field: str) -> bool:
    if field not in _FLAGS:
        raise ValueError(f"{name}: expected 0 or 1, got {field[:80]!r}")
    return _FLAGS[field]


def _floats(name: str, fields: list[str]) -> list[float]:
    if not all(map(_NUMBER.fullmatch, fields)):
        raise ValueError(f"{name}: expected decimal numbers, got {','.join(fields)[:80]!r}")
    return [float(field) for field in fields]


def _float32(name: str, fields: list[str]) -> np.ndarray:
    """Numbers of one drone, float32, shape (1, len(fields)); infinite where they do not fit."""
    with np.errstate(over="ignore", under="ignore"):  # whatever the program has set
        return np.array([_floats(name, fields)]).astype(_F4)
