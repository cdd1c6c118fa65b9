"""Both state machines, with a clock of their own: who says what, when, and what changes nothing."""

from dataclasses import replace
from math import inf

import pytest
from links import (
    CONFIG,
    HERE,
    NONCE,
    ONE,
    OTHER,
    SECRET,
    SESSION,
    STRANGER,
    WELCOME,
    Fleet,
    Pair,
    Wire,
    agent,
    close,
    command,
    dropped,
    hello,
    layout,
    lossy,
    outgoing,
    send_command,
    send_state,
    simulator,
    state,
)
from rotorgram.models.errors import InputError
from rotorgram.udp import LinkConfig
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.client import Client, RoundTrips
from rotorgram.udp.protocol.fragments import Transfer
from rotorgram.udp.protocol.messages import (
    Alive,
    Close,
    Command,
    Extension,
    Message,
    Missing,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)
from rotorgram.udp.protocol.server import Server
from rotorgram.udp.protocol.transitions import AGENT, SIMULATOR, AgentState, SimulatorState

LONG = "{" + " " * 200 + "}"
"""A Hello so long that its refusal is not cut."""
BOTH = pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])


def plain(datagram: bytes) -> Message:
    data = datagram[24:] if datagram[:2] == b"\xa7S" else datagram
    return binary.decode(data, ONE)


def to(link: Client, where: SimulatorState, wire: Wire) -> Client:
    """A simulator in a state."""
    if where == "idle":
        return link
    link.connect(0.0)
    if where != "hello":
        link.receive(wire(WELCOME), 0.0)
        if where != "ready":
            send_state(link, 0.0, 0.0)
            if where == "closing":
                link.close("bye", 0.0)
            if where == "closed":
                link.receive(wire(close(1)), 0.0)
    outgoing(link)
    return link


def agent_at(where: AgentState, wire: Wire, sealed: bool = False) -> Server:
    """An agent with a simulator in that state."""
    server = agent(sealed=sealed)
    server.receive(wire(hello()), HERE, 0.0)
    if where != "welcomed":
        assert server.receive(wire(state(1)), HERE, 0.0)
        if where in ("expecting", "closed"):
            send_command(server, 0, 0.0, 0.0)
        if where == "closing":
            server.close("bye", 0.0)
        if where == "closed":
            server.receive(wire(close(1)), HERE, 0.0)
    outgoing(server)
    return server


# ---- the tables


@BOTH
@pytest.mark.parametrize("where", [s for s in SIMULATOR if s != "idle"])
def test_a_simulator_takes_what_its_table_says(where: SimulatorState, sealed: bool) -> None:
    wire = Wire("agent", sealed)
    number = 1 if where in ("waiting", "closing") else 0
    messages: list[Message] = [
        WELCOME,
        Wait(session=SESSION),
        Refuse(session=SESSION, reason="busy"),
        command(number),
        close(number),
        hello(),
        state(number + 1),
        Alive(session=SESSION, sequence=number),
        Unknown(session=SESSION, sequence=number),
    ]
    for message in messages:
        link = to(simulator(sealed=sealed), where, wire)
        asked = link._asking if isinstance(message, Unknown) else b""
        taken = link.receive(wire(message, asked), 0.0)
        then = SIMULATOR[where].get(("received", type(message)))
        if then == "idle":  # it says Hello at once
            assert link.state == "hello"
            assert link.hello.session == OTHER
        else:
            assert link.state == (then or where)
        moves = isinstance(message, Welcome | Refuse | Command | Close)
        assert (taken is not None) == (then is not None and moves), message
        assert bool(dropped(link)) == (then is None)


@BOTH
@pytest.mark.parametrize("where", [s for s in AGENT if s != "new"])
def test_an_agent_takes_what_its_table_says(where: AgentState, sealed: bool) -> None:
    wire = Wire("simulator", sealed)
    seated = where not in ("welcomed", "closed")
    due = 2 if seated else 1
    for message in (
        state(due),
        close(1),
        command(1),
        WELCOME,
        Alive(session=SESSION, sequence=1),
        Missing(session=SESSION, sequence=1, kind=5, count=2, first=0, bitmap=b"\1"),
    ):
        server = agent_at(where, wire, sealed)
        event = server.receive(wire(message), HERE, 0.0)
        then = AGENT[where].get(("received", type(message)))
        session = server.slots[0]
        if where == "closed" or (where == "welcomed" and then != "deciding"):
            assert session is None
            assert event is None
        elif then == "closed":
            assert session is None
            assert event is not None
        else:
            assert session is not None
            assert session.state == (then or where)
            assert (event is not None) == (then is not None and isinstance(message, State))


def test_only_what_the_table_says_can_be_sent() -> None:
    wire = Wire("agent", False)
    for where in SIMULATOR:
        link = to(simulator(), where, wire)
        if ("sent", State) in SIMULATOR[where]:
            send_state(link, 0.0, 0.0)
        else:
            with pytest.raises(KeyError):
                send_state(link, 0.0, 0.0)
    for there in ("expecting", "closing"):
        server = agent_at(there, Wire("simulator", False))
        with pytest.raises(KeyError):
            send_command(server, 0, 0.0, 0.0)


# ---- lock-step


@BOTH
def test_a_repeat_is_the_same_bytes_and_gets_the_same_answer(
    sealed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    client = simulator(sealed=sealed)
    server = agent(sealed=sealed)
    Pair(client, server, lossy(0)).run(3)
    first = outgoing(client)
    assert client.handle_timer(client.next_timer() or 0.0)
    assert outgoing(client) == first
    event = server.receive(first[0], HERE, 1.0)
    assert event is not None
    send_command(server, 0, 9.0, 1.0)
    answer = outgoing(server)
    for _ in range(3):
        assert server.receive(first[0], HERE, 1.0) is None
        assert outgoing(server) == answer
    assert server.statistics.counters["duplicate"] == 3
    assert server.statistics.last_error == ""
    assert not caplog.messages  # every network does it


def test_no_resend_on_a_clean_wire_and_few_on_one_that_slows_down() -> None:  # fault 16
    delay = [1e-4]
    pair = Pair(simulator(), agent(), lambda datagram: [(delay[0], datagram)])
    pair.run(100)
    assert pair.client.statistics.counters["resent"] == 0
    delay[0] = 0.05
    pair.run(200)
    slow = pair.client.statistics.counters["resent"]
    assert slow < 60
    pair.run(300)
    assert pair.client.statistics.counters["resent"] < slow + 10


def test_waits_follow_the_round_trips() -> None:
    trips = RoundTrips()
    assert trips.wait(1) == 0.2
    for at in range(50):
        trips.sent(float(at), first=True)
        trips.answered(at + 0.02)
    assert trips.wait(1) == pytest.approx(0.025, abs=1e-3)
    assert trips.wait(8) == pytest.approx(0.025, abs=1e-3)
    assert trips.wait(9) == pytest.approx(0.05, abs=2e-3)
    assert trips.wait(40) == 1.0


@BOTH
@pytest.mark.parametrize(("simulators", "milliseconds"), [(3, 18), (8, 32)])
def test_the_losses_of_one_simulator_do_not_lengthen_the_waits_of_others(
    simulators: int, milliseconds: float, sealed: bool
) -> None:  # fault 16
    clients = [simulator(said=hello(session=n + 1), sealed=sealed) for n in range(simulators)]
    fleet = Fleet(clients, agent(slots=simulators, sealed=sealed), lossy(0.3, 1e-4))
    fleet.run(300)
    assert fleet.now / 300 < 1e-3 * milliseconds


def test_one_pause_does_not_make_later_resends_late() -> None:
    trips = RoundTrips()
    for at in range(50):
        trips.sent(float(at), first=True)
        trips.answered(at + (1.0 if at == 40 else 0.002))
    assert trips.wait(1) < 0.01


def test_only_answers_that_come_twice_in_a_row_lengthen_the_wait() -> None:
    trips = RoundTrips()
    trips.sent(0.0, first=True)
    trips.sent(0.0)
    trips.answered(0.1)
    longer = []
    for twice in (True, False, True, True, True, False, True):  # the one before came so
        trips.sent(1.0, first=True)
        before = trips.wait(1)
        if twice:
            trips.answered_again()
            trips.answered_again()
        longer.append(trips.wait(1) > before)
        trips.sent(2.0)
    assert longer == [False, False, False, True, True, False, False]


def test_an_agent_that_waits_for_others_is_not_silent() -> None:
    wire = Wire("agent", False)
    link = to(simulator(), "waiting", wire)
    number = link.sequence
    link.receive(wire(Alive(session=link.hello.session, sequence=number)), 9.0)
    assert link.handle_timer(18.0)
    assert link.state == "waiting"
    assert not link.handle_timer(19.0)


def test_a_missing_of_other_fragments_changes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    wire = Wire("agent", False)
    link = to(simulator(), "waiting", wire)
    for kind, count in ((4, 1), (4, 2), (5, 1)):
        missing = Missing(
            session=SESSION, sequence=1, kind=kind, count=count, first=0, bitmap=b"\1"
        )
        assert link.receive(wire(missing), 9.0) is None
    assert dropped(link) == {"stale": 3}
    assert link.statistics.last_error == ""
    assert not caplog.messages
    assert not outgoing(link)
    assert not link.handle_timer(10.0)


@pytest.mark.parametrize(("timeout", "longest"), [(20.0, 5.0), (120.0, 10.0)])
def test_an_agent_that_waits_for_long_is_asked_before_the_timeout(
    timeout: float, longest: float
) -> None:
    wire = Wire("agent", False)
    link = to(simulator(config=LinkConfig(timeout=timeout)), "waiting", wire)
    alive = wire(Alive(session=link.hello.session, sequence=link.sequence))
    now = 0.0
    asked = 0
    while now < 50_000.0:
        now, before = link.next_timer() or 0.0, now
        assert link.handle_timer(now)
        assert outgoing(link)
        assert now - before <= longest + 1e-6
        link.receive(alive, now)
        asked += 1
    assert asked < 50_000 / longest + 50


def test_silence_ends_a_simulator_and_a_pause_of_its_own_does_not() -> None:  # fault 25
    link = to(simulator(), "waiting", Wire("agent", False))
    link.deadline += 100.0
    assert link.handle_timer(50.0)
    assert not link.handle_timer(111.0)
    assert link.state == "closing"


def test_a_simulator_that_gives_up_tells_a_silent_agent() -> None:
    link = to(simulator(), "waiting", Wire("agent", False))
    outgoing(link)
    assert not link.handle_timer(100.0)
    (last,) = outgoing(link)
    assert plain(last) == close(1, reason="no answer from the agent for 10 s")


def test_a_simulator_that_was_never_welcomed_closes_without_a_word() -> None:  # fault 35
    link = simulator()
    link.connect(0.0)
    outgoing(link)
    link.close("over", 1.0)
    assert link.state == "closed"
    assert link.next_timer() == inf
    assert not outgoing(link)


def test_a_close_is_repeated_while_a_part_of_the_command_is_there() -> None:
    many = layout(1000)
    link = simulator(of=many, largest=1200)
    link.connect(0.0)
    link.receive(binary.encode(WELCOME), 0.0)
    send_state(link, 0.0, 0.0)
    parts = Transfer(binary.encode(command(1, of=many), many), 1200).start()
    link.receive(parts[0], 0.1)
    outgoing(link)
    link.close("over", 0.2)
    link.handle_timer(link.next_timer())
    assert [plain(one) for one in outgoing(link)] == [close(1, reason="over")] * 2


def test_a_simulator_that_has_been_welcomed_waits_for_no_slot() -> None:
    link = simulator()
    link.connect(0.0)
    link.receive(binary.encode(Wait(session=SESSION)), 0.1)
    assert link.is_queued
    link.receive(binary.encode(Welcome(session=SESSION, nonce=NONCE)), 0.2)
    assert not link.is_queued


def test_while_wait_comes_there_is_no_silence(caplog: pytest.LogCaptureFixture) -> None:
    link = simulator()
    wire = Wire("agent", False)
    link.connect(0.0)
    for now in range(0, 100, 9):
        assert link.receive(wire(Wait(session=SESSION)), float(now)) is None
        assert link.handle_timer(now + 8.0)
    assert caplog.messages == ["every slot of the agent is taken; waiting for a free one"]
    assert not link.handle_timer(200.0)


def test_wrong_numbers_of_the_config() -> None:
    nan = float("nan")
    for name, wrong in (
        ("timeout", 0), ("timeout", nan), ("drop", -0.1), ("drop", nan),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{name}: expected a .*, got {wrong}$"):
            LinkConfig(**{name: wrong})


# ---- slots


def test_a_source_that_never_reads_takes_no_slot() -> None:  # fault 11
    server = agent()
    sent = got = 0
    for message in (hello(), *(state(1, nonce=guess) for guess in range(20))):
        datagram = binary.encode(message, ONE)
        sent += len(datagram)
        server.receive(datagram, STRANGER, 0.0)
        got += sum(len(d) for d, _ in outgoing(server))
    assert server.slots == [None]
    assert got <= sent


@BOTH
def test_a_replayed_hello_does_not_keep_the_real_simulator_from_recovering(sealed: bool) -> None:
    """Fault 10: after an agent's restart its State is answered by Unknown, whoever said Hello."""
    wire = Wire("simulator", sealed)
    client = to(simulator(sealed=sealed), "waiting", Wire("agent", sealed))
    server = agent(sealed=sealed)  # started anew
    server.receive(wire(hello()), STRANGER, 0.0)
    outgoing(server)
    client.handle_timer(5.0)
    for datagram in outgoing(client):
        server.receive(datagram, HERE, 0.0)
    ((reply, address),) = outgoing(server)
    assert address == HERE
    assert client.receive(reply, 5.0) is None
    assert client.state == "hello"
    assert client.hello.session == OTHER


def test_a_session_of_another_address_is_not_ended_by_a_stranger() -> None:
    server = agent_at("expecting", Wire("simulator", False))
    for message in (state(2), close(1), state(7), hello()):
        server.receive(binary.encode(message, ONE), STRANGER, 0.0)
    assert outgoing(server) == []
    assert server.slots[0] is not None


@pytest.mark.parametrize("slots", [1, 2])
def test_one_session_number_from_two_addresses(slots: int) -> None:  # fault 18
    nonces = {HERE: NONCE, STRANGER: NONCE + 1}
    server = agent(slots=slots, draw_nonce=iter(nonces.values()).__next__)
    for address, nonce in nonces.items():
        server.receive(binary.encode(hello()), address, 0.0)
        ((reply, to_),) = outgoing(server)
        assert plain(reply) == Welcome(session=SESSION, nonce=nonce)
        assert to_ == address
    event = server.receive(binary.encode(state(1, nonce=NONCE + 1), ONE), STRANGER, 0.0)
    assert event is not None
    assert event.joined
    assert server.receive(binary.encode(state(1), ONE), HERE, 0.0) is None
    assert outgoing(server) == []


def test_an_old_hello_that_came_late_is_forgotten() -> None:
    """Its State 5 says that the simulator flew with another agent: it is to begin again."""
    server = agent_at("welcomed", Wire("simulator", False))
    server.receive(binary.encode(state(5), ONE), HERE, 0.0)
    ((reply, _),) = outgoing(server)
    assert plain(reply) == Unknown(session=SESSION, sequence=5)
    server.receive(binary.encode(state(1), ONE), HERE, 0.0)  # its opening is forgotten
    assert server.slots == [None]


def test_a_session_that_has_ended_is_not_taken_up() -> None:
    server = agent_at("closed", Wire("simulator", False))
    server.receive(binary.encode(hello()), HERE, 0.0)
    server.receive(binary.encode(state(1, nonce=NONCE + 1), ONE), HERE, 0.0)
    assert server.slots == [None]


@BOTH
def test_a_simulator_that_closes_before_its_first_state_is_answered(sealed: bool) -> None:
    wire = Wire("simulator", sealed)
    server = agent_at("welcomed", wire, sealed)
    server.receive(wire(close(0)), HERE, 0.0)
    ((reply, _),) = outgoing(server)
    link = to(simulator(sealed=sealed), "ready", Wire("agent", sealed))
    link.close("bye", 0.0)
    link.receive(reply, 0.0)
    assert link.state == "closed"
    assert not server.openings
    assert server.statistics.last_error == "refused from 127.0.0.1:8000: bye"


def test_a_state_0_is_not_answered() -> None:
    server = agent()
    server.receive(binary.encode(replace(state(1), sequence=0), ONE), HERE, 0.0)
    assert outgoing(server) == []
    assert dropped(server) == {"malformed": 1}


def test_the_longest_hello_comes_in_fragments() -> None:
    server = agent()
    extensions = (Extension(number=1, value=bytes(512)),) * 64
    longest = hello(spec="x" * (1 << 22), extensions=extensions)
    transfer = Transfer(binary.encode(longest), 65_483)
    fragments = transfer.start()
    answer = None
    while fragments:
        for fragment in fragments:
            server.receive(fragment, HERE, 0.0)
        ((data, _),) = outgoing(server)
        answer = plain(data)
        fragments = transfer.resend(answer) if isinstance(answer, Missing) else []
    assert isinstance(answer, Welcome)


def test_what_is_remembered_of_strangers_is_bounded() -> None:
    server = agent()
    long = hello(spec='{"x":"' + "y" * 5000 + '"}')
    for number in range(1, 3001):
        server.receive(binary.encode(hello(session=number)), ("127.0.0.1", number), 0.0)
        data = binary.frame(129, number, 0, b"\0\0\5\0\0\0\0\0" + binary.encode(long)[:1000])
        server.receive(data, ("127.0.0.2", number), 0.0)
    assert len(server.openings) <= 1024
    assert len(server._assembling) <= 16


def test_refusals_and_their_size() -> None:
    server = agent("x" * 500)
    datagram = binary.encode(hello())
    server.receive(datagram, HERE, 0.0)
    ((reply, _),) = outgoing(server)
    assert len(reply) <= len(datagram)
    assert isinstance(plain(reply), Refuse)


def test_versions_and_critical_extensions() -> None:  # fault 18
    critical = (Extension(number=9, value=b"", critical=True),)
    for message, words in (
        (hello(spec=LONG, versions=(1, 1)), "versions 1 to 1, the agent 3"),
        (hello(spec=LONG, extensions=critical), "no critical extension, got type 9"),
    ):
        server = agent()
        server.receive(binary.encode(message), HERE, 0.0)
        ((reply, _),) = outgoing(server)
        refuse = plain(reply)
        assert isinstance(refuse, Refuse)
        assert words in refuse.reason
    optional = (Extension(number=9, value=b"?"),)
    server.receive(binary.encode(hello(session=3, extensions=optional)), STRANGER, 0.0)
    ((reply, _),) = outgoing(server)
    assert isinstance(plain(reply), Welcome)
    link = to(simulator(), "hello", Wire("agent", False))
    for wrong in (
        Welcome(session=SESSION, nonce=1, version=4),
        Welcome(session=SESSION, nonce=1, extensions=critical),
    ):
        assert link.receive(binary.encode(wrong), 0.0) is None
    assert link.state == "hello"
    assert link.receive(binary.encode(WELCOME), 0.0) == WELCOME


def test_an_agent_drops_what_another_key_seals() -> None:
    server = agent(sealed=True)
    stranger = Client(hello(session=9), ONE, CONFIG, key=Key(bytes([7]) * 32, "simulator"))
    stranger.connect(0.0)
    server.receive(outgoing(stranger)[0], STRANGER, 0.0)
    assert outgoing(server) == []
    assert server.statistics.counters["forged"] == 1


# ---- liveness


@BOTH
def test_a_simulator_that_computes_says_that_it_lives(sealed: bool) -> None:  # fault 33
    client = simulator(sealed=sealed)
    server = agent(sealed=sealed)
    Pair(client, server, lossy(0)).run(3)
    (datagram,) = outgoing(client)
    server.receive(datagram, HERE, 1.0)
    assert client.alive(1.0) == [], "it waits"
    send_command(server, 0, 0.0, 1.0)
    ((datagram, _),) = outgoing(server)
    client.receive(datagram, 1.0)
    assert client.alive(1.2) == [], "the agent has waited for 0.2 s alone"
    (datagram,) = client.alive(1.3)
    assert server.receive(datagram, HERE, 50.0) is None
    session = server.slots[0]
    assert session is not None
    assert session.heard_at == 50.0


# ---- text


def by_text() -> Client:
    return simulator(by_text=True)


def test_text_flies() -> None:
    pair = Pair(by_text(), agent(), lossy(0.3))
    pair.client.connect(0.0)
    send_state(pair.client, 0.0, 0.0)
    pair.run(50)
    assert pair.steps == [float(i + 1) for i in range(50)]


def test_a_late_copy_of_a_text_state_takes_no_slot_again() -> None:  # fault 9
    server = agent()
    assert server.receive(b"1,0,0,0,1", HERE, 0.0)
    send_command(server, 0, 0.0, 0.0)
    assert server.receive(b"2,0,0,0,1", HERE, 0.0)
    assert server.receive(b"2,close", HERE, 0.0)
    assert server.receive(b"2,0,0,0,1", HERE, 0.1) is None
    assert server.slots == [None]
    assert server.statistics.counters["sessions"] == 1
    assert server.receive(b"1,0,0,0,1", HERE, 0.2)  # another simulator at that address
    server = agent()
    assert server.receive(b"1,0,0,0,1", HERE, 0.0)
    send_command(server, 0, 0.0, 0.0)
    assert server.receive(b"2,close", HERE, 0.0)  # its State 2 was overtaken
    assert server.receive(b"2,0,0,0,1", HERE, 0.1) is None
    assert server.receive(b"2,0,0,0,1", HERE, 3.0)  # not for ever


def test_text_is_told_why_it_may_not_fly() -> None:
    line = b"7,0,0,0,1"
    full = agent_at("deciding", Wire("simulator", False))
    keyed = agent(sealed=True)
    other = agent(text_layout=lambda: None)
    for server in (full, keyed, other):
        assert server.receive(line, STRANGER, 0.0) is None
        replies = outgoing(server)
        assert [reply for reply, _ in replies] == [b"7,close"]


def test_a_key_and_text_do_not_go_together() -> None:
    with pytest.raises(InputError, match="only binary"):
        simulator(by_text=True, sealed=True)
    with pytest.raises(InputError, match="one drone"):
        simulator(by_text=True, of=layout(2))


# ---- keys that only one side has


def test_recorded_messages_of_another_session_are_forged() -> None:
    old = Key(SECRET, "agent").for_session(SESSION, 1)
    link = to(simulator(sealed=True), "waiting", Wire("agent", True))
    assert link.receive(old.seal(binary.encode(command(1), ONE)), 0.0) is None
    assert dropped(link) == {"forged": 1}


def test_every_message_is_shown_once() -> None:
    here: list[bytes] = []
    there: list[bytes] = []
    client = simulator()
    server = agent()
    client.tap = lambda slot, message, data: here.append(data)
    server.outbox.tap = lambda slot, message, data: there.append(data)
    Pair(client, server, lossy(0.3)).run(30)
    assert len(here) > 60
    assert len(set(here)) == len(here)
    assert here[:60] == there[:60]


def test_a_simulator_loses_the_same_datagrams_on_purpose_in_each_run() -> None:
    def arrived() -> list[bool]:
        link = simulator(config=LinkConfig(timeout=1e6, drop=0.3))
        link.connect(0.0)
        sent = []
        for number in range(1000):
            sent.append(bool(outgoing(link)))
            link.handle_timer(link.next_timer())
            link.receive(b"", 1e4 + number)
        received = link.statistics.counters["received"]
        assert abs(received - 700) < 75  # five standard deviations
        lost = 2001 - sum(sent) - bool(outgoing(link)) - received
        assert link.statistics.counters["dropped"] == lost
        return sent

    assert abs(sum(arrived()) - 700) < 75
    assert arrived() == arrived()
