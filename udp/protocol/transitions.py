"""States of both sides, and the messages that each state sends and receives.

One table for each side says what a message does, sent or received; other messages cannot be
sent, and are dropped when they come. A text simulator begins at READY, for it says no Hello.
"""

from enum import Enum
from typing import Final

from . import messages as m


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

SIMULATOR: Final[dict[tuple[SimulatorState, Way, type[m.Message]], SimulatorState]] = {
    (_S.IDLE, _SENT, m.Hello): _S.HELLO,
    (_S.HELLO, _RECEIVED, m.Missing): _S.HELLO,
    (_S.HELLO, _RECEIVED, m.Wait): _S.HELLO,
    (_S.HELLO, _RECEIVED, m.Welcome): _S.READY,
    (_S.HELLO, _RECEIVED, m.Refuse): _S.CLOSED,
    (_S.READY, _SENT, m.Alive): _S.READY,
    (_S.READY, _SENT, m.State): _S.WAITING,
    (_S.READY, _SENT, m.Close): _S.CLOSING,
    (_S.READY, _RECEIVED, m.Close): _S.CLOSED,
    (_S.WAITING, _SENT, m.Missing): _S.WAITING,
    (_S.WAITING, _RECEIVED, m.Missing): _S.WAITING,
    (_S.WAITING, _RECEIVED, m.Alive): _S.WAITING,
    (_S.WAITING, _RECEIVED, m.Command): _S.READY,
    (_S.WAITING, _RECEIVED, m.Unknown): _S.IDLE,
    (_S.WAITING, _RECEIVED, m.Close): _S.CLOSED,
    (_S.WAITING, _SENT, m.Close): _S.CLOSING,
    (_S.CLOSING, _RECEIVED, m.Close): _S.CLOSED,
    (_S.IDLE, _UNSAID, m.Close): _S.CLOSED,
    (_S.HELLO, _UNSAID, m.Close): _S.CLOSED,
    (_S.CLOSING, _UNSAID, m.Close): _S.CLOSED,
    (_S.CLOSED, _UNSAID, m.Close): _S.CLOSED,
}

AGENT: Final[dict[tuple[AgentState, Way, type[m.Message]], AgentState]] = {
    (_A.NEW, _SENT, m.Refuse): _A.CLOSED,
    (_A.NEW, _SENT, m.Wait): _A.QUEUED,
    (_A.NEW, _SENT, m.Welcome): _A.WELCOMED,
    (_A.NEW, _RECEIVED, m.State): _A.DECIDING,  # by text
    (_A.QUEUED, _SENT, m.Wait): _A.QUEUED,
    (_A.QUEUED, _SENT, m.Welcome): _A.WELCOMED,
    (_A.QUEUED, _SENT, m.Refuse): _A.CLOSED,
    (_A.WELCOMED, _SENT, m.Welcome): _A.WELCOMED,
    (_A.WELCOMED, _SENT, m.Missing): _A.WELCOMED,
    (_A.WELCOMED, _RECEIVED, m.State): _A.DECIDING,
    (_A.WELCOMED, _RECEIVED, m.Close): _A.CLOSED,
    (_A.WELCOMED, _SENT, m.Unknown): _A.CLOSED,
    (_A.WELCOMED, _SENT, m.Close): _A.CLOSED,
    (_A.DECIDING, _SENT, m.Alive): _A.DECIDING,
    (_A.DECIDING, _SENT, m.Command): _A.EXPECTING,
    (_A.DECIDING, _SENT, m.Close): _A.CLOSING,
    (_A.DECIDING, _RECEIVED, m.Close): _A.CLOSED,
    (_A.EXPECTING, _RECEIVED, m.Alive): _A.EXPECTING,
    (_A.EXPECTING, _RECEIVED, m.Missing): _A.EXPECTING,
    (_A.EXPECTING, _SENT, m.Missing): _A.EXPECTING,
    (_A.EXPECTING, _RECEIVED, m.State): _A.DECIDING,
    (_A.EXPECTING, _RECEIVED, m.Close): _A.CLOSED,
    (_A.EXPECTING, _SENT, m.Close): _A.CLOSING,
    (_A.CLOSING, _RECEIVED, m.Close): _A.CLOSED,
    (_A.DECIDING, _UNSAID, m.Close): _A.CLOSED,
    (_A.EXPECTING, _UNSAID, m.Close): _A.CLOSED,
    (_A.CLOSING, _UNSAID, m.Close): _A.CLOSED,
    (_A.CLOSED, _UNSAID, m.Close): _A.CLOSED,
}
