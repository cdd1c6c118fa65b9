"""States of both sides, and the messages that each state sends and receives.

One table for each side says what a message does, sent or received; other messages cannot be
sent, and are dropped when they come. A text simulator begins at `ready`, for it says no Hello.
"""

from typing import Final, Literal

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

Way = Literal["sent", "received", "unsaid"]
"""Which way a message goes, seen from this side. `unsaid`: this side gives up, or another takes the
slot, and nothing is sent."""

SimulatorState = Literal["idle", "hello", "ready", "waiting", "closing", "closed"]
"""State of a simulator.

* `idle`: nothing was said yet, or the agent does not know the session any more.
* `hello`: it waits for a Welcome.
* `ready`: it has a Welcome or a Command; it computes, then sends a State.
* `waiting`: for the Command of the State sent last.
* `closing`: it waits for the answer to its Close.
"""

AgentState = Literal["new", "queued", "welcomed", "deciding", "expecting", "closing", "closed"]
"""State of an agent, for each simulator.

* `new`: its Hello has come, or the first line of text.
* `queued`: every slot is taken; it waits for one.
* `welcomed`: it may take a slot; its State 1 is expected.
* `deciding`: it has a slot; its State waits for a Command.
* `expecting`: it has a slot; its next State is expected.
* `closing`: the answer to a Close is expected.
"""

SIMULATOR: Final[dict[SimulatorState, dict[tuple[Way, type[Message]], SimulatorState]]] = {
    "idle": {("sent", Hello): "hello", ("unsaid", Close): "closed"},
    "hello": {
        ("received", Missing): "hello",
        ("received", Wait): "hello",
        ("received", Welcome): "ready",
        ("received", Refuse): "closed",
        ("unsaid", Close): "closed",
    },
    "ready": {
        ("sent", Alive): "ready",
        ("sent", State): "waiting",
        ("sent", Close): "closing",
        ("received", Close): "closed",
    },
    "waiting": {
        ("sent", Hello): "hello",  # a new session, of several agents
        ("sent", Missing): "waiting",
        ("received", Missing): "waiting",
        ("received", Alive): "waiting",
        ("received", Command): "ready",
        ("received", Unknown): "idle",
        ("received", Close): "closed",
        ("sent", Close): "closing",
    },
    "closing": {("received", Close): "closed", ("unsaid", Close): "closed"},
    "closed": {("unsaid", Close): "closed"},
}

AGENT: Final[dict[AgentState, dict[tuple[Way, type[Message]], AgentState]]] = {
    "new": {
        ("sent", Refuse): "closed",
        ("sent", Wait): "queued",
        ("sent", Welcome): "welcomed",
        ("received", State): "deciding",  # by text
    },
    "queued": {
        ("sent", Wait): "queued",
        ("sent", Welcome): "welcomed",
        ("sent", Refuse): "closed",
    },
    "welcomed": {
        ("sent", Welcome): "welcomed",
        ("sent", Missing): "welcomed",
        ("received", State): "deciding",
        ("received", Close): "closed",
        ("sent", Unknown): "closed",
        ("sent", Close): "closed",
    },
    "deciding": {
        ("sent", Alive): "deciding",
        ("sent", Command): "expecting",
        ("sent", Close): "closing",
        ("received", Close): "closed",
        ("unsaid", Close): "closed",
    },
    "expecting": {
        ("received", Alive): "expecting",
        ("received", Missing): "expecting",
        ("sent", Missing): "expecting",
        ("received", State): "deciding",
        ("received", Close): "closed",
        ("sent", Close): "closing",
        ("unsaid", Close): "closed",
    },
    "closing": {("received", Close): "closed", ("unsaid", Close): "closed"},
    "closed": {("unsaid", Close): "closed"},
}
