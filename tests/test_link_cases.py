"""Both state machines without sockets: misuse, counts, codecs, versions, keys and strangers."""

import zlib

import numpy as np
import pytest
from links import (
    AGENT_EVENTS,
    AGENT_STATES,
    CONFIG,
    HERE,
    LINE,
    NONCE,
    REFUSE,
    SECRET,
    SESSION,
    SIMULATOR_EVENTS,
    SIMULATOR_STATES,
    STRANGER,
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
    to_ready,
    to_waiting,
)
from rotorgram.udp import LinkConfig, binary, text
from rotorgram.udp.agent_link import AgentLink
from rotorgram.udp.keys import Key
from rotorgram.udp.messages import (
    Close,
    Command,
    Hello,
    Message,
    Refuse,
)
from rotorgram.udp.simulator_link import SimulatorLink, new_session

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
