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


class _Enum(Enum):
    __hash__ = object.__hash__  # of Enum's own, a lookup in a table takes four times as long


class Way(_Enum):
    """Which way a message goes, seen from this side."""

    SENT = "sent"
    RECEIVED = "received"
    UNSAID = "unsaid"  # this side gives up, or another takes the slot: nothing is sent


class SimulatorState(_Enum):
    """Of a simulator."""

    IDLE = "idle"  # nothing was said yet, or the agent does not know the session any more
    HELLO = "hello"  # waits for a Welcome
    READY = "ready"  # has a Welcome or a Command: computes, then sends a State
    WAITING = "waiting"  # for the Command of the State sent last
    CLOSING = "closing"  # waits for the answer to its Close
    CLOSED = "closed"


class AgentState(_Enum):
    """Of an agent, for each simulator."""

    NEW = "new"  # its Hello has come, or the first line of text
    QUEUED = "queued"  # every slot is taken: it waits for one
    WELCOMED = "welcomed"  # may take a slot: its State 1 is expected
    DECIDING = "deciding"  # has a slot; its State waits for a Command
    EXPECTING = "expecting"  # has a slot; its next State is expected
    CLOSING = "closing"  # the answer to a Close is expected
    CLOSED = "closed"


_S = SimulatorState
_A = AgentState
_SENT = Way.SENT
_RECEIVED = Way.RECEIVED
_UNSAID = Way.UNSAID

SIMULATOR: Final[dict[SimulatorState, dict[tuple[Way, type[Message]], SimulatorState]]] = {
    _S.IDLE: {(_SENT, Hello): _S.HELLO, (_UNSAID, Close): _S.CLOSED},
    _S.HELLO: {
        (_RECEIVED, Missing): _S.HELLO,
        (_RECEIVED, Wait): _S.HELLO,
        (_RECEIVED, Welcome): _S.READY,
        (_RECEIVED, Refuse): _S.CLOSED,
        (_UNSAID, Close): _S.CLOSED,
    },
    _S.READY: {
        (_SENT, Alive): _S.READY,
        (_SENT, State): _S.WAITING,
        (_SENT, Close): _S.CLOSING,
        (_RECEIVED, Close): _S.CLOSED,
    },
    _S.WAITING: {
        (_SENT, Hello): _S.HELLO,  # a new session, of several agents
        (_SENT, Missing): _S.WAITING,
        (_RECEIVED, Missing): _S.WAITING,
        (_RECEIVED, Alive): _S.WAITING,
        (_RECEIVED, Command): _S.READY,
        (_RECEIVED, Unknown): _S.IDLE,
        (_RECEIVED, Close): _S.CLOSED,
        (_SENT, Close): _S.CLOSING,
    },
    _S.CLOSING: {(_RECEIVED, Close): _S.CLOSED, (_UNSAID, Close): _S.CLOSED},
    _S.CLOSED: {(_UNSAID, Close): _S.CLOSED},
}

AGENT: Final[dict[AgentState, dict[tuple[Way, type[Message]], AgentState]]] = {
    _A.NEW: {
        (_SENT, Refuse): _A.CLOSED,
        (_SENT, Wait): _A.QUEUED,
        (_SENT, Welcome): _A.WELCOMED,
        (_RECEIVED, State): _A.DECIDING,  # by text
    },
    _A.QUEUED: {
        (_SENT, Wait): _A.QUEUED,
        (_SENT, Welcome): _A.WELCOMED,
        (_SENT, Refuse): _A.CLOSED,
    },
    _A.WELCOMED: {
        (_SENT, Welcome): _A.WELCOMED,
        (_SENT, Missing): _A.WELCOMED,
        (_RECEIVED, State): _A.DECIDING,
        (_RECEIVED, Close): _A.CLOSED,
        (_SENT, Unknown): _A.CLOSED,
        (_SENT, Close): _A.CLOSED,
    },
    _A.DECIDING: {
        (_SENT, Alive): _A.DECIDING,
        (_SENT, Command): _A.EXPECTING,
        (_SENT, Close): _A.CLOSING,
        (_RECEIVED, Close): _A.CLOSED,
        (_UNSAID, Close): _A.CLOSED,
    },
    _A.EXPECTING: {
        (_RECEIVED, Alive): _A.EXPECTING,
        (_RECEIVED, Missing): _A.EXPECTING,
        (_SENT, Missing): _A.EXPECTING,
        (_RECEIVED, State): _A.DECIDING,
        (_RECEIVED, Close): _A.CLOSED,
        (_SENT, Close): _A.CLOSING,
        (_UNSAID, Close): _A.CLOSED,
    },
    _A.CLOSING: {(_RECEIVED, Close): _A.CLOSED, (_UNSAID, Close): _A.CLOSED},
    _A.CLOSED: {(_UNSAID, Close): _A.CLOSED},
}
