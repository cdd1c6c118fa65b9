"""States of both sides, and the messages that each state sends and receives: `transitions.toml`.

One table for each side says what a message does, sent or received.
"""

from typing import Literal, TypeVar

from ...models.files import read_own_toml
from . import messages
from .messages import Message

Way = Literal["sent", "received", "unsaid"]
"""Which way a message goes, seen from this side. `unsaid`: this side gives up, or another takes the
slot, and nothing is sent."""
SimulatorState = Literal["idle", "hello", "ready", "waiting", "closing", "closed"]
AgentState = Literal["new", "welcomed", "deciding", "expecting", "closing", "closed"]
"""State of an agent, for each simulator."""
Move = tuple[Way, type[Message]]
S = TypeVar("S")


def _read(side: str) -> dict[S, dict[Move, S]]:
    table: dict[S, dict[Move, S]] = {}
    for state, ways in read_own_toml(__file__, "transitions")[side].items():
        table[state] = {}
        for way, following in ways.items():
            for name, after in following.items():
                table[state][way, getattr(messages, name)] = after
    return table


SIMULATOR: dict[SimulatorState, dict[Move, SimulatorState]] = _read("simulator")
AGENT: dict[AgentState, dict[Move, AgentState]] = _read("agent")
