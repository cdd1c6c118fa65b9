"""Both state machines without sockets: every pair of state and datagram.

`test_link_times.py` has the timers, `test_link_world.py` joins the two by a bad network, and
`test_link_hostile.py` has the attackers.
"""

import zlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from rotorgram.udp import LinkConfig, binary, text
from rotorgram.udp.agent_link import AgentLink, Event
from rotorgram.udp.keys import Key
from rotorgram.udp.link import Address
from rotorgram.udp.messages import (
    Close,
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)
from rotorgram.udp.simulator_link import SimulatorLink, new_session

SESSION, OTHER, NONCE = 77, 78, 99
HERE, STRANGER = ("127.0.0.1", 8000), ("127.0.0.1", 9999)
CONFIG = LinkConfig(timeout=10, first_resend=0.2, min_resend=0.01, max_resend=1.0)
SECRET = bytes(range(32))
CAUSES = {"malformed", "forged", "foreign", "refused", "duplicate", "stale"}
SHARED = {Hello, Welcome, Refuse, Wait, Unknown}
"""Sealed with the shared key; all else with that of the session."""


def hello(**changes: object) -> Hello:
    fields: dict[str, object] = {
        "session": SESSION,
        "env_id": "a/B-v0",
        "num_drones": 1,
        "observation_low": np.array([-9], np.float32),
        "observation_high": np.array([9], np.float32),
        "action_low": np.array([-1], np.float32),
        "action_high": np.array([1], np.float32),
        "discrete_actions": 0,
        "control_period": 0.02,
        "model_hash": "0" * 32,
        "telemetry_names": (),
        "options": "",
    }
    return Hello(**{**fields, **changes})  # type: ignore[arg-type]


def state(sequence: int, session: int = SESSION, value: float = 0.0, size: int = 1) -> State:
    return State(
        session=session,
        sequence=sequence,
        observations=np.full((1, size), value, np.float32),
        rewards=np.zeros(1),
        terminated=np.zeros(1, bool),
        truncated=np.zeros(1, bool),
        telemetry=np.zeros((1, 0)),
    )


def command(sequence: int, session: int = SESSION, value: float = 0.0, size: int = 1) -> Command:
    return Command(
        session=session,
        sequence=sequence,
        actions=np.full((1, size), value, np.float32),
        resets=np.zeros(1, bool),
    )


def close(sequence: int, session: int = SESSION, reason: str = "bye") -> Close:
    return Close(session=session, sequence=sequence, reason=reason)


def unknown(sequence: int, session: int = SESSION) -> Unknown:
    return Unknown(session=session, sequence=sequence)


WELCOME = Welcome(session=SESSION, nonce=NONCE)
REFUSE = Refuse(session=SESSION, reason="busy")
WAIT = Wait(session=SESSION)
ENDED = "the agent has closed"


def simulator(*, key: Key | None = None, **changes: object) -> SimulatorLink:
    return SimulatorLink(hello(**changes), CONFIG, key=key, draw_session=lambda: OTHER)


def agent(refusal: str = "", *, places: int = 1, key: Key | None = None) -> AgentLink:
    return AgentLink(lambda _: refusal, (1, 0), places=places, key=key, draw_nonce=lambda: NONCE)


class Wire:
    """Makes the datagrams of one side as they travel: sealed or not."""

    def __init__(self, side: Any, sealed: bool) -> None:
        self.key = Key(SECRET, side) if sealed else None

    def __call__(self, message: Message, asked: bytes = b"") -> bytes:
        """As an answer to a State, if it is an Unknown."""
        datagram = binary.encode(message)
        if self.key is None:
            return datagram
        if type(message) in SHARED:
            return self.key.seal(datagram, asked if isinstance(message, Unknown) else b"")
        return self.key.for_session(message.session, NONCE).seal(datagram)


def dropped(link: SimulatorLink | AgentLink) -> dict[str, int]:
    return {cause: n for cause, n in link.statistics.counters.items() if cause in CAUSES and n}


# ---- the simulator's table


def to_hello(link: SimulatorLink, wire: Wire) -> None:
    link.connect(0.0)


def to_ready(link: SimulatorLink, wire: Wire) -> None:
    to_hello(link, wire)
    link.receive(wire(WELCOME), 0.0)


def to_waiting(link: SimulatorLink, wire: Wire) -> None:
    to_ready(link, wire)
    link.send_state(state(1), 0.0)


def to_ready_again(link: SimulatorLink, wire: Wire) -> None:
    to_waiting(link, wire)
    link.receive(wire(command(1)), 0.0)


def to_closing(link: SimulatorLink, wire: Wire) -> None:
    to_waiting(link, wire)
    link.close("bye", 0.0)


def to_closed(link: SimulatorLink, wire: Wire) -> None:
    to_waiting(link, wire)
    link.receive(wire(close(1)), 0.0)


SIMULATOR_STATES: dict[str, Callable[[SimulatorLink, Wire], None]] = {
    "hello": to_hello,
    "ready": to_ready,
    "waiting": to_waiting,
    "ready 1": to_ready_again,
    "closing": to_closing,
    "closed": to_closed,
}
SIMULATOR_EVENTS: dict[str, Message] = {
    "Welcome": WELCOME,
    "Refuse": REFUSE,
    "Wait": WAIT,
    "Unknown 0": unknown(0),
    "Unknown 1": unknown(1),
    "Unknown 2": unknown(2),
    "Command 0": command(0),
    "Command 1": command(1),
    "Command 2": command(2),
    "Command 1, two numbers": command(1, size=2),
    "Close 0": close(0),
    "Close 1": close(1),
    "Close 2": close(2),
    "Hello": hello(),
    "State 1": state(1),
    "Welcome of another": Welcome(session=OTHER, nonce=NONCE),
    "Command 1 of another": command(1, session=OTHER),
    "Close 1 of another": close(1, session=OTHER),
    "Unknown 1 of another": unknown(1, session=OTHER),
}
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

AGENT_STATES: dict[str, list[Any]] = {
    "free": [],
    "welcomed": [hello()],
    "deciding": [hello(), state(1)],
    "expecting": [hello(), state(1), command(1)],
    "closing": [hello(), state(1), command(1), "close"],
    "ended": [hello(), state(1), close(1)],
    "silent": [hello(), state(1), command(1), "free"],
    "full": ["other"],
    "full, waits": ["other", hello()],
    "closed": ["close"],
    "welcomed, closed": [hello(), "close"],
    "refusing": ["refuse"],
    "welcomed, refusing": [hello(), "refuse"],
}
AGENT_EVENTS: dict[str, Message] = {
    "Hello": hello(),
    "new Hello": hello(session=OTHER),
    "State 0": state(0),
    "State 1": state(1),
    "State 1, two numbers": state(1, size=2),
    "State 2": state(2),
    "State 3": state(3),
    "new State 1": state(1, session=OTHER),
    "Close 0": close(0),
    "Close 1": close(1),
    "Close 2": close(2),
    "Close 3": close(3),
    "Close 1 of another": close(1, session=OTHER),
    "Command 1": command(1),
    "Command 1 of another": command(1, session=OTHER),
    "Welcome": WELCOME,
    "Wait of another": Wait(session=OTHER),
}
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


def drive(link: AgentLink, steps: Iterable[Any], wire: Wire, address: Address = HERE) -> None:
    """Bring an agent into a state by what a simulator at that address sends, and what it does."""
    for step in steps:
        if isinstance(step, Command):
            link.send_command(0, step, 0.0)
        elif step == "close":
            link.close("bye", 0.0)
        elif step == "free":
            link.free(0)
        elif step == "other":
            drive(link, [hello(session=5), state(1, session=5)], wire, STRANGER)
        elif step == "no text":
            link.takes_text = False
        elif step == "refuse":
            link._accept = lambda _: "busy"
        else:
            link.receive(wire(step), address, 0.0)


def state_of(link: AgentLink, address: Address = HERE) -> str:
    return next((s.state for s in link.places if s and s.peer == address), "free")


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

LINE, COMMAND_LINE = b"1,0.0,0,0,0.0", b"1,0.0"
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


# ---- what we may not do


def test_misuse_says_what_was_expected() -> None:
    link = simulator()
    with pytest.raises(ValueError, match="expected link state 'ready' and sequence 1, got 'hello'"):
        link.send_state(state(1), 0.0)
    link.connect(0.0)
    link.receive(binary.encode(WELCOME), 0.0)
    with pytest.raises(ValueError, match="sequence 1, got 'ready' and 2"):
        link.send_state(state(2), 0.0)
    server = agent()
    with pytest.raises(ValueError, match="'deciding' on State 0, got a free place"):
        server.send_command(0, command(0), 0.0)
    server.receive(binary.encode(hello()), HERE, 0.0)
    server.receive(binary.encode(state(1)), HERE, 0.0)
    with pytest.raises(ValueError, match=r"'deciding' on State 2, got \('deciding', 1\)"):
        server.send_command(0, command(2), 0.0)
    server.send_command(0, command(1), 0.0)
    with pytest.raises(ValueError, match=r"got \('expecting', 1\)"):
        server.send_command(0, command(1), 0.0)


def test_a_message_that_is_too_large_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binary, "MAX_WHOLE", 70_000)
    link = simulator()
    to_ready(link, Wire("agent", False))
    link.take_outgoing()
    with pytest.raises(ValueError, match="State: expected at most 70000 bytes"):
        link.send_state(state(1, size=20_000), 0.0)
    assert (link.state, link.sequence, link.take_outgoing()) == ("ready", 0, [])
    server = agent()
    drive(server, [hello(), state(1)], Wire("simulator", False))
    server.take_outgoing()
    with pytest.raises(ValueError, match="Command: expected at most 70000 bytes"):
        server.send_command(0, command(1, size=20_000), 0.0)
    assert (state_of(server), server.take_outgoing()) == ("deciding", [])


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["timeout", "first_resend", "min_resend", "max_resend"])
def test_times_are_positive_and_finite(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected seconds > 0, got"):
        LinkConfig(**{name: bad})
    with pytest.raises(ValueError, match="min_resend: expected at most max_resend"):
        LinkConfig(min_resend=2.0)


def test_text_cannot_be_sealed() -> None:
    with pytest.raises(ValueError, match="text codec: expected no key, got one"):
        SimulatorLink(hello(), CONFIG, text_codec=True, key=Key(SECRET, "simulator"))


def test_session_numbers_are_random_and_not_0() -> None:
    numbers = {new_session() for _ in range(1000)}
    assert len(numbers) == 1000
    assert all(0 < number < 2**64 for number in numbers)


# ---- what is measured and seen


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_what_comes_out_is_what_was_counted_as_sent_or_resent(sealed: bool) -> None:
    ours, theirs = Wire("agent", sealed), Wire("simulator", sealed)
    for before in AGENT_STATES:
        for event in AGENT_EVENTS.values():
            link = agent(key=ours.key)
            drive(link, AGENT_STATES[before], theirs)
            link.receive(theirs(event), HERE, 1.0)
            link.handle_timer(2.0)
            counters = link.statistics.counters
            assert counters["sent"] + counters["resent"] == len(link.take_outgoing())
    for before in SIMULATOR_STATES:
        for event in SIMULATOR_EVENTS.values():
            client = simulator(key=theirs.key)
            SIMULATOR_STATES[before](client, ours)
            client.receive(ours(event), 1.0)
            client.handle_timer(2.0)
            counters = client.statistics.counters
            assert counters["sent"] + counters["resent"] == len(client.take_outgoing())


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_taps_see_every_message_once_and_not_sealed(sealed: bool) -> None:
    ours, theirs = Wire("agent", sealed), Wire("simulator", sealed)
    seen: list[tuple[int, Message, bytes]] = []
    link = AgentLink(lambda _: "", (1, 0), places=2, key=ours.key, draw_nonce=lambda: NONCE,
                     tap=lambda *all_of_it: seen.append(all_of_it))  # fmt: skip
    drive(link, ["other"], theirs)
    for _ in range(3):
        for message in (hello(), WELCOME, state(1), state(2), state(0)):
            link.receive(theirs(message), HERE, 0.0)
    link.send_command(1, command(1), 0.0)
    for _ in range(3):
        for message in (state(1), state(2), close(2)):
            link.receive(theirs(message), HERE, 0.0)
    flight = [hello(), WELCOME, state(1), command(1), state(2), close(2), close(2, reason="")]
    assert [(p, d) for p, _, d in seen if p == 1] == [(1, binary.encode(m)) for m in flight]
    assert [type(m) for p, m, _ in seen if p == 1] == [type(m) for m in flight]


def test_the_agent_measures_from_its_command_to_the_next_state() -> None:
    link, wire = agent(), Wire("simulator", False)
    drive(link, [hello(), state(1)], wire)
    assert link.statistics.round_trips.count == 0
    link.send_command(0, command(1), 5.0)
    link.receive(wire(state(1)), HERE, 5.1)
    link.receive(wire(state(2)), HERE, 5.25)
    assert link.statistics.round_trips.count == 1
    assert link.statistics.round_trips.longest == pytest.approx(0.25)


# ---- other codecs, other versions, one with a key and one without


def of_version(datagram: bytes, version: int) -> bytes:
    raw = bytearray(datagram)
    raw[2] = version
    raw[4:8] = zlib.crc32(raw[8:], zlib.crc32(raw[:4])).to_bytes(4, "little")
    return bytes(raw)


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_a_hello_of_another_version_is_refused(sealed: bool) -> None:
    ours, theirs = Wire("agent", sealed), Wire("simulator", sealed)
    raw = of_version(binary.encode(hello()), 3)
    link = agent(key=ours.key)
    assert link.receive(theirs.key.seal(raw) if theirs.key else raw, HERE, 0.0) is None
    sentence = "protocol version: expected 2, got 3"
    assert link.take_outgoing() == [(ours(Refuse(session=SESSION, reason=sentence)), HERE)]
    assert sentence in link.statistics.last_error
    # Whatever else it says is dropped.
    raw = of_version(binary.encode(WAIT), 3)
    link.receive(theirs.key.seal(raw) if theirs.key else raw, HERE, 0.0)
    assert link.take_outgoing() == []


def test_a_refusal_of_another_version_is_read() -> None:
    link = simulator()
    link.connect(0.0)
    for message, version in [(WELCOME, 1), (REFUSE, 1)]:
        taken = link.receive(of_version(binary.encode(message), version), 0.0)
    assert taken == REFUSE
    assert link.state == "closed"


@pytest.mark.parametrize("who", ["agent", "simulator"])
def test_who_forgot_the_key_is_told(who: str) -> None:
    """The Refuse is unsealed, since the other one could not open it; who has a key drops it."""
    link = agent(key=Wire("agent", who == "simulator").key)
    client = simulator(key=Wire("simulator", who == "agent").key)
    client.connect(0.0)
    link.receive(client.take_outgoing()[0], HERE, 0.0)
    ((datagram, _),) = link.take_outgoing()
    refuse = binary.decode(datagram)
    assert isinstance(refuse, Refuse)
    assert "(--key-file)" in refuse.reason
    taken = client.receive(datagram, 0.0)
    if who == "simulator":
        assert (type(taken), client.state) == (Refuse, "closed")
    else:
        assert (taken, client.state) == (None, "hello")
        (notice,) = client.statistics.take_notices()
        assert "not sealed, a Refuse that says: key: this agent has none" in notice


def test_with_a_key_nothing_unsealed_is_taken() -> None:
    ours, theirs = Wire("agent", True), Wire("simulator", True)
    for before in AGENT_STATES:
        for event in AGENT_EVENTS.values():
            link = agent(key=ours.key)
            drive(link, AGENT_STATES[before], theirs)
            begun = state_of(link)
            link.take_outgoing()
            assert link.receive(binary.encode(event), HERE, 1.0) is None
            assert state_of(link) == begun
            assert dropped(link) == {"forged": 1}
            assert len(link.take_outgoing()) == isinstance(event, Hello)
    for before in SIMULATOR_STATES:
        for event in SIMULATOR_EVENTS.values():
            client = simulator(key=theirs.key)
            SIMULATOR_STATES[before](client, ours)
            begun = client.state
            client.take_outgoing()
            assert client.receive(binary.encode(event), 1.0) is None
            assert (client.state, client.take_outgoing()) == (begun, [])
            assert dropped(client) == {"forged": 1}


def test_text_in_a_binary_session_and_binary_in_a_text_session() -> None:
    link, wire = agent(), Wire("simulator", False)
    drive(link, [LINE], lambda line: line)  # type: ignore[arg-type]
    for message in (hello(session=0), state(2, session=0), close(1, session=0)):
        assert link.receive(wire(message), HERE, 0.0) is None
    assert state_of(link) == "deciding"
    # A binary simulator at the same address takes its place, at its State 1.
    link.receive(wire(hello()), HERE, 0.0)
    event = link.receive(wire(state(1)), HERE, 0.0)
    assert event is not None
    assert (event.place, event.joined) == (0, True)
    client = SimulatorLink(hello(), CONFIG, text_codec=True)
    client.send_state(state(1), 0.0)
    assert client.receive(binary.encode(command(1)), 0.0) is None
    assert dropped(client) == {"malformed": 1}
    assert isinstance(client.receive(b"1,0.5", 0.0), Command)


def test_a_text_session_from_first_line_to_close() -> None:
    link = agent()
    first = link.receive(b"41,0.0,0,0,1.0\n", HERE, 0.0)  # any first number
    assert first is not None
    assert (first.joined, first.message.sequence) == (True, 41)
    link.send_command(0, command(41, session=0, value=0.5), 0.0)
    assert link.receive(b"41,0.0,0,0,1.0", HERE, 0.0) is None
    assert link.take_outgoing() == [(b"41,0.5", HERE)] * 2
    last = link.receive(b"42,close", HERE, 0.0)
    assert last is not None
    assert isinstance(last.message, Close)
    assert link.take_outgoing() == [(b"41,close", HERE)]
    assert link.places == [None]


@pytest.mark.parametrize("answer", [b"1,close", b"0,close"])
def test_a_text_simulator_answers_a_close(answer: bytes) -> None:
    client = SimulatorLink(hello(), CONFIG, text_codec=True)
    client.connect(0.0)
    client.send_state(state(1), 0.0)
    assert client.take_outgoing() == [text.encode(state(1))]
    assert isinstance(client.receive(answer, 0.0), Close)
    assert (client.state, client.take_outgoing()) == ("closed", [b"1,close"])


def test_discrete_actions_are_whole_and_in_range() -> None:
    link, wire = simulator(discrete_actions=3), Wire("agent", False)
    to_waiting(link, wire)
    for value in (-1.0, 3.0, 0.5, 3.4e38):
        assert link.receive(wire(command(1, value=value)), 0.0) is None
    assert dropped(link) == {"malformed": 4}
    assert "expected whole actions 0 to 2" in link.statistics.last_error
    assert isinstance(link.receive(wire(command(1, value=2.0)), 0.0), Command)


def test_the_action_of_a_drone_that_is_reset_is_ignored() -> None:
    link, wire = simulator(discrete_actions=3), Wire("agent", False)
    to_waiting(link, wire)
    reset = Command(session=SESSION, sequence=1, actions=np.full((1, 1), 7.5, np.float32),
                    resets=np.ones(1, bool))  # fmt: skip
    assert isinstance(link.receive(wire(reset), 0.0), Command)


# ---- strangers


def test_a_stranger_with_the_right_session_changes_nothing_and_is_not_answered() -> None:
    link, wire = agent(places=2), Wire("simulator", False)
    drive(link, [hello(), state(1), command(1)], wire)
    link.take_outgoing()
    for message in (state(1), state(2), close(1), close(2)):
        assert link.receive(wire(message), STRANGER, 0.0) is None
    assert link.take_outgoing() == []
    assert dropped(link) == {"foreign": 4}
    assert state_of(link) == "expecting"
    assert link.receive(wire(state(2)), HERE, 0.0) is not None


def test_no_word_ends_a_session_that_waits_or_was_welcomed() -> None:
    """Else a stranger could ask for an Unknown now, and send it to the simulator later."""
    for places in ([], ["other"]):
        link, wire = agent(), Wire("simulator", False)
        drive(link, [*places, hello()], wire)
        link.take_outgoing()
        for sequence in range(3):
            link.receive(wire(state(sequence)), ("127.0.0.1", 7777), 0.0)
        assert link.take_outgoing() == []
        assert dropped(link) == {"foreign": 3}


def test_a_refused_hello_leaves_the_place_free() -> None:
    link = agent("expected another one " + "x" * 600)
    assert link.receive(binary.encode(hello()), HERE, 0.0) is None
    ((datagram, _),) = link.take_outgoing()
    refuse = binary.decode(datagram)
    assert isinstance(refuse, Refuse)
    assert refuse.reason.startswith("expected another one xxx")
    assert len(datagram) == len(binary.encode(hello()))  # no more than came
    assert link.places == [None]
    assert link.statistics.last_error.startswith(
        "refused from 127.0.0.1:8000: expected another one"
    )


def test_a_hello_that_no_longer_fits_at_its_first_state_is_closed() -> None:
    reasons = [""]
    link = AgentLink(lambda _: reasons[0], (1, 0), places=2)
    wire = Wire("simulator", False)
    drive(link, [hello()], wire)
    reasons[0] = "another one has come " + "x" * 600
    drive(link, [state(1)], wire)
    (_, _), (datagram, _) = link.take_outgoing()
    message = binary.decode(datagram)
    assert isinstance(message, Close)
    assert message.reason.startswith("another one")
    assert len(datagram) <= len(binary.encode(state(1)))
    assert dropped(link) == {"refused": 1}


def test_the_last_error_is_one_line_whatever_was_dropped() -> None:
    whole = binary.encode(state(1, value=0.25, size=100))
    body = whole[8:].replace(np.float32(0.25).tobytes(), np.float32(np.nan).tobytes())
    crc = zlib.crc32(body, zlib.crc32(whole[:4]))
    hostile = whole[:4] + crc.to_bytes(4, "little") + body
    link, client = agent(), simulator()
    assert link.receive(hostile, HERE, 0.0) is client.receive(hostile, 0.0) is None
    for error in (link.statistics.last_error, client.statistics.last_error):
        assert "observations: expected finite numbers, got nan at [0, 0]" in error
        assert "\n" not in error
        assert len(error.encode()) <= 512
