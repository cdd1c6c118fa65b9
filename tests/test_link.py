"""Both state machines without sockets: every pair of state and datagram.

`test_link_cases.py` has what no table shows, `test_link_times.py` the timers, `test_link_world.py`
joins the two by a bad network, and `test_link_hostile.py` and `test_link_anything.py` have the
attackers.
"""

from typing import Any

import pytest
from links import (
    AGENT_EVENTS,
    AGENT_STATES,
    COMMAND_LINE,
    ENDED,
    HERE,
    LINE,
    NONCE,
    OTHER,
    REFUSE,
    SESSION,
    SHARED,
    SIMULATOR_EVENTS,
    SIMULATOR_STATES,
    WAIT,
    WELCOME,
    Wire,
    agent,
    close,
    command,
    drive,
    dropped,
    hello,
    simulator,
    state,
    state_of,
    unknown,
)
from rotorgram.udp import binary
from rotorgram.udp.agent_link import Event
from rotorgram.udp.messages import (
    Hello,
    Message,
    Refuse,
    Unknown,
    Wait,
    Welcome,
)

# ---- the simulator's table

SIMULATOR_TABLE: dict[tuple[str, str], tuple[str, list[Message], str]] = {
    # (state, event): (state after, sent, counter); "": it counts. All others: dropped as stale.
    ("hello", "Welcome"): ("ready", [], ""),
    ("hello", "Refuse"): ("closed", [], ""),
    ("hello", "Wait"): ("hello", [], ""),
    ("ready", "Close 0"): ("closed", [close(0, reason="")], ""),
    ("waiting", "Command 1"): ("ready", [], ""),
    ("waiting", "Command 1, two numbers"): ("waiting", [], "malformed"),
    ("waiting", "Unknown 1"): ("hello", [hello(session=OTHER)], ""),
    ("waiting", "Close 0"): ("closed", [close(1, reason="")], ""),
    ("waiting", "Close 1"): ("closed", [close(1, reason="")], ""),
    ("ready 1", "Close 0"): ("closed", [close(1, reason="")], ""),
    ("ready 1", "Close 1"): ("closed", [close(1, reason="")], ""),
    ("closing", "Close 0"): ("closed", [], ""),
    ("closing", "Close 1"): ("closed", [], ""),
}


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
@pytest.mark.parametrize("event", SIMULATOR_EVENTS)
@pytest.mark.parametrize("before", SIMULATOR_STATES)
def test_simulator_table(before: str, event: str, sealed: bool) -> None:
    ours, theirs = Wire("simulator", sealed), Wire("agent", sealed)
    link, message = simulator(key=ours.key), SIMULATOR_EVENTS[event]
    SIMULATOR_STATES[before](link, theirs)
    assert link.state == before.split()[0]
    assert not dropped(link)
    link.take_outgoing()
    after, sent, counter = SIMULATOR_TABLE.get((before, event), (link.state, [], "stale"))
    if "another" in event:
        counter = "foreign"
    if sealed and type(message) not in SHARED and ("another" in event or before == "hello"):
        counter = "forged"  # no such session here, so no key to tell what it is
    taken = link.receive(theirs(message, b"".join(link._outstanding)), 1.0)
    assert link.state == after
    assert dropped(link) == ({counter: 1} if counter else {})
    assert link.take_outgoing() == [ours(m) for m in sent]
    quiet = counter or isinstance(message, Wait | Unknown)
    assert type(taken) is (type(None) if quiet else type(message))


# ---- the agent's table

WELCOMED = [WELCOME]
NEW = [Welcome(session=OTHER, nonce=NONCE)]
UNREFUSED = {"Hello": ("", WELCOMED, ""), "new Hello": ("", NEW, "")}
NO_SESSION: dict[str, tuple[str, list[Message], str]] = {
    "State 0": ("", [unknown(0)], "foreign"),
    "State 1": ("", [unknown(1)], "foreign"),
    "State 1, two numbers": ("", [unknown(1)], "foreign"),
    "State 2": ("", [unknown(2)], "foreign"),
    "State 3": ("", [unknown(3)], "foreign"),
    "new State 1": ("", [unknown(1, session=OTHER)], "foreign"),
}
NOTHING = {event: ("", [], "foreign") for event in AGENT_EVENTS}
AGENT_TABLE: dict[str, dict[str, tuple[str, list[Message], str]]] = {
    # state: event: (state after, "" if it is the same; sent; counter, "" if it counts)
    "free": {**NOTHING, **NO_SESSION, **UNREFUSED},
    "welcomed": {
        **NOTHING,
        **NO_SESSION,
        "Hello": ("", WELCOMED, "duplicate"),
        "new Hello": ("", NEW, ""),
        "State 1": ("deciding", [], ""),
        "State 1, two numbers": ("", [], "malformed"),
    },
    "deciding": {
        "new Hello": ("", NEW, ""),
        "State 1": ("", [], "duplicate"),
        "State 1, two numbers": ("", [], "duplicate"),
        "State 3": ("", [unknown(3)], "foreign"),
        "new State 1": ("", [unknown(1, session=OTHER)], "foreign"),
        "Close 1": ("free", [close(1, reason="")], ""),
    },
    "expecting": {
        "new Hello": ("", NEW, ""),
        "State 1": ("", [command(1)], "duplicate"),
        "State 1, two numbers": ("", [command(1)], "duplicate"),
        "State 2": ("deciding", [], ""),
        "State 3": ("", [unknown(3)], "foreign"),  # it has gone on with another agent
        "new State 1": ("", [unknown(1, session=OTHER)], "foreign"),
        "Close 1": ("free", [close(1, reason="")], ""),
        "Close 2": ("free", [close(1, reason="")], ""),
    },
    "closing": {
        "State 3": ("", [], "foreign"),
        "new State 1": ("", [], "foreign"),
        "new Hello": ("", [Refuse(session=OTHER, reason=ENDED)], "refused"),
        "State 1": ("", [close(1)], "duplicate"),
        "State 1, two numbers": ("", [close(1)], "duplicate"),
        "Close 1": ("free", [], ""),
        "Close 2": ("free", [], ""),
    },
    "ended": {**NOTHING, **NO_SESSION, "Hello": ("", [], "stale"), "new Hello": ("", NEW, "")},
    "silent": {**NOTHING, **NO_SESSION, "Hello": ("", [], "stale"), "new Hello": ("", NEW, "")},
    "full": {
        **NOTHING,
        **NO_SESSION,
        "Hello": ("", [WAIT], ""),
        "new Hello": ("", [Wait(session=OTHER)], ""),
    },
    "full, waits": {
        **NOTHING,
        **NO_SESSION,
        "Hello": ("", [WAIT], ""),
        "new Hello": ("", [Wait(session=OTHER)], ""),
    },
    "closed": {
        **NOTHING,
        "Hello": ("", [Refuse(session=SESSION, reason=ENDED)], "refused"),
        "new Hello": ("", [Refuse(session=OTHER, reason=ENDED)], "refused"),
    },
    "welcomed, closed": {
        **NOTHING,
        "Hello": ("", [Refuse(session=SESSION, reason=ENDED)], "refused"),
        "new Hello": ("", [Refuse(session=OTHER, reason=ENDED)], "refused"),
        "State 1": ("", [close(1, reason=ENDED)], "refused"),
        "State 1, two numbers": ("", [], "malformed"),
    },
    "refusing": {
        **NOTHING,
        **NO_SESSION,
        "Hello": ("", [REFUSE], "refused"),
        "new Hello": ("", [Refuse(session=OTHER, reason="busy")], "refused"),
    },
    "welcomed, refusing": {
        **NOTHING,
        **NO_SESSION,
        "Hello": ("", WELCOMED, "duplicate"),
        "new Hello": ("", [Refuse(session=OTHER, reason="busy")], "refused"),
        "State 1": ("", [close(1, reason="busy")], "refused"),
        "State 1, two numbers": ("", [], "malformed"),
    },
}


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
@pytest.mark.parametrize("event", AGENT_EVENTS)
@pytest.mark.parametrize("before", AGENT_STATES)
def test_agent_table(before: str, event: str, sealed: bool) -> None:
    ours, theirs = Wire("agent", sealed), Wire("simulator", sealed)
    link, message = agent(key=ours.key), AGENT_EVENTS[event]
    drive(link, AGENT_STATES[before], theirs)
    begun = state_of(link)
    assert begun == before or begun == "free"
    assert not dropped(link)
    link.take_outgoing()
    default = ("", [], "foreign" if "another" in event else "stale")
    after, sent, counter = AGENT_TABLE[before].get(event, default)
    taken = link.receive(theirs(message), HERE, 1.0)
    assert state_of(link) == (after or begun)
    assert link.take_outgoing() == [(ours(m, theirs(message)), HERE) for m in sent]
    assert dropped(link) == ({counter: 1} if counter else {})
    if counter or isinstance(message, Hello):
        assert taken is None
    else:
        assert isinstance(taken, Event)
        assert (taken.place, type(taken.message)) == (0, type(message))
        assert taken.joined == (before == "welcomed")


# ---- the agent's table by text

TEXT_STATES: dict[str, list[Any]] = {
    "free": [],
    "deciding": [LINE],
    "expecting": [LINE, command(1, session=0)],
    "closing": [LINE, "close"],
    "ended": [LINE, b"1,close"],
    "full": ["other"],
    "closed": ["close"],
    "binary": [hello(), state(1)],
    "no text": ["no text"],
}
TEXT_EVENTS = [LINE, b"0,0.0,0,0,0.0", b"2,0.0,0,0,0.0", b"3,0,0,0,0", b"0,close", b"1,close",
               b"2,close", b"1,0.0", b"x"]  # fmt: skip
JOINS = {line: ("deciding", [], "") for line in TEXT_EVENTS[:4]}
NO_ROOM = {line: ("", [line[:2] + b"close"], "refused") for line in TEXT_EVENTS[:4]}
STRANGE = {b"1,0.0": ("", [], "malformed"), b"x": ("", [], "malformed")}
FOREIGN = {line: ("", [], "foreign") for line in TEXT_EVENTS[4:7]}
TEXT_TABLE: dict[str, dict[bytes, tuple[str, list[bytes], str]]] = {
    "free": {**JOINS, **FOREIGN},
    "deciding": {LINE: ("", [], "duplicate"), b"1,close": ("free", [b"1,close"], "")},
    "expecting": {
        LINE: ("", [COMMAND_LINE], "duplicate"),
        b"2,0.0,0,0,0.0": ("deciding", [], ""),
        b"1,close": ("free", [b"1,close"], ""),
        b"2,close": ("free", [b"1,close"], ""),
    },
    "closing": {
        LINE: ("", [b"1,close"], "duplicate"),
        b"1,close": ("free", [], ""),
        b"2,close": ("free", [], ""),
    },
    "ended": {**JOINS, **FOREIGN},
    "full": {**NO_ROOM, **FOREIGN},
    "closed": {**NO_ROOM, **FOREIGN},
    "binary": {**NO_ROOM, **FOREIGN},
    "no text": {**NO_ROOM, **FOREIGN},
}


@pytest.mark.parametrize("event", TEXT_EVENTS)
@pytest.mark.parametrize("before", TEXT_STATES)
def test_agent_table_by_text(before: str, event: bytes) -> None:
    link = agent()
    drive(link, TEXT_STATES[before], lambda m: m if isinstance(m, bytes) else binary.encode(m))
    begun = state_of(link)
    link.take_outgoing()
    row = {**STRANGE, **TEXT_TABLE[before]}
    after, sent, counter = row.get(event, ("", [], "stale"))
    taken = link.receive(event, HERE, 1.0)
    assert state_of(link) == (after or begun)
    assert link.take_outgoing() == [(line, HERE) for line in sent]
    assert dropped(link) == ({counter: 1} if counter else {})
    assert (taken is None) == bool(counter)


@pytest.mark.parametrize("line", TEXT_EVENTS)
def test_an_agent_with_a_key_closes_text_states_and_answers_nothing_else(line: bytes) -> None:
    link = agent(key=Wire("agent", True).key)
    assert link.receive(line, HERE, 0.0) is None
    # An answer to a Close would be answered by another agent with a key, and so on for ever.
    answers = [(line[:2] + b"close", HERE)] if line in TEXT_EVENTS[:4] else []
    assert link.take_outgoing() == answers
    assert dropped(link) == {"forged": 1}
