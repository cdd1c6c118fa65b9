"""States of both sides, and the messages that each state sends and receives.

One table for each side says what a message does, sent or received; other messages cannot be
sent, and are dropped when they come. A text simulator begins at READY, for it says no Hello.
"""

from enum import Enum
from typing import Final

from .messages import (
    Alive,
    Close,
    Command,
    Hello,
    Message,
    Missing,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)

__all__ = ["AGENT", "SIMULATOR", "AgentState", "SimulatorState", "Way"]


class Way(Enum):
    """Which way a message goes, seen from this side."""

    __hash__ = object.__hash__  # of Enum's own, a lookup in a table takes four times as long

    SENT = "sent"
    RECEIVED = "received"


class SimulatorState(Enum):
    """Of a simulator."""

    __hash__ = object.__hash__

    IDLE = "idle"
    """Nothing was said yet, or the agent does not know the session any more."""
    HELLO = "hello"
    """Waits for a Welcome."""
    READY = "ready"
    """Has a Welcome or a Command: computes, then sends a State."""
    WAITING = "waiting"
    """Waits for the Command of the State sent last."""
    CLOSING = "closing"
    """Waits for the answer to its Close."""
    CLOSED = "closed"


class AgentState(Enum):
    """Of an agent, for each simulator."""

    __hash__ = object.__hash__

    NEW = "new"
    """Its Hello has come, or the first line of text."""
    QUEUED = "queued"
    """Every slot is taken: it waits for one."""
    WELCOMED = "welcomed"
    """May take a slot: its State 1 is expected."""
    DECIDING = "deciding"
    """Has a slot; its State waits for a Command."""
    EXPECTING = "expecting"
    """Has a slot; its next State is expected."""
    CLOSING = "closing"
    """The answer to a Close is expected."""
    CLOSED = "closed"


_S, _A, _SENT, _RECEIVED = SimulatorState, AgentState, Way.SENT, Way.RECEIVED

SIMULATOR: Final[dict[tuple[SimulatorState, Way, type[Message]], SimulatorState]] = {
    (_S.IDLE, _SENT, Hello): _S.HELLO,
    (_S.HELLO, _RECEIVED, Missing): _S.HELLO,
    (_S.HELLO, _RECEIVED, Wait): _S.HELLO,
    (_S.HELLO, _RECEIVED, Welcome): _S.READY,
    (_S.HELLO, _RECEIVED, Refuse): _S.CLOSED,
    (_S.READY, _SENT, Alive): _S.READY,
    (_S.READY, _SENT, State): _S.WAITING,
    (_S.READY, _SENT, Close): _S.CLOSING,
    (_S.READY, _RECEIVED, Close): _S.CLOSED,
    (_S.WAITING, _SENT, Missing): _S.WAITING,
    (_S.WAITING, _RECEIVED, Missing): _S.WAITING,
    (_S.WAITING, _RECEIVED, Alive): _S.WAITING,
    (_S.WAITING, _RECEIVED, Command): _S.READY,
    (_S.WAITING, _RECEIVED, Unknown): _S.IDLE,
    (_S.WAITING, _RECEIVED, Close): _S.CLOSED,
    (_S.WAITING, _SENT, Close): _S.CLOSING,
    (_S.CLOSING, _RECEIVED, Close): _S.CLOSED,
}
"""A simulator closes without a word at IDLE and HELLO, and at CLOSING after a while."""

AGENT: Final[dict[tuple[AgentState, Way, type[Message]], AgentState]] = {
    (_A.NEW, _SENT, Refuse): _A.CLOSED,
    (_A.NEW, _SENT, Wait): _A.QUEUED,
    (_A.NEW, _SENT, Welcome): _A.WELCOMED,
    (_A.NEW, _RECEIVED, State): _A.DECIDING,  # by text
    (_A.QUEUED, _SENT, Wait): _A.QUEUED,
    (_A.QUEUED, _SENT, Welcome): _A.WELCOMED,
    (_A.QUEUED, _SENT, Refuse): _A.CLOSED,
    (_A.WELCOMED, _SENT, Welcome): _A.WELCOMED,
    (_A.WELCOMED, _SENT, Missing): _A.WELCOMED,
    (_A.WELCOMED, _RECEIVED, State): _A.DECIDING,
    (_A.WELCOMED, _SENT, Unknown): _A.CLOSED,
    (_A.WELCOMED, _SENT, Close): _A.CLOSED,
    (_A.DECIDING, _SENT, Alive): _A.DECIDING,
    (_A.DECIDING, _SENT, Command): _A.EXPECTING,
    (_A.DECIDING, _SENT, Close): _A.CLOSING,
    (_A.DECIDING, _RECEIVED, Close): _A.CLOSED,
    (_A.EXPECTING, _RECEIVED, Alive): _A.EXPECTING,
    (_A.EXPECTING, _RECEIVED, Missing): _A.EXPECTING,
    (_A.EXPECTING, _SENT, Missing): _A.EXPECTING,
    (_A.EXPECTING, _RECEIVED, State): _A.DECIDING,
    (_A.EXPECTING, _RECEIVED, Close): _A.CLOSED,
    (_A.EXPECTING, _SENT, Close): _A.CLOSING,
    (_A.CLOSING, _RECEIVED, Close): _A.CLOSED,
}
"""A slot is freed without a word when its simulator is silent, or another takes it over."""
