"""Both state machines without sockets: a lossy channel between them and a clock that is moved."""

import random
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from rotorgram.udp import LinkConfig, binary, text
from rotorgram.udp.link import CLOSE_COPIES, AgentLink, SimulatorLink
from rotorgram.udp.messages import Close, Command, Hello, Message, Refuse, State, Welcome

SESSION = 77
HERE, STRANGER = ("127.0.0.1", 8000), ("127.0.0.1", 9999)
CONFIG = LinkConfig(timeout=10, first_resend=0.2, min_resend=0.01, max_resend=1.0)


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


def simulator(config: LinkConfig = CONFIG, **changes: object) -> SimulatorLink:
    return SimulatorLink(hello(**changes), config)


def agent(refusal: str = "") -> AgentLink:
    return AgentLink(lambda hello: refusal, (1, 0))


# ---- the two joined


@dataclass
class World:
    """A physics that only counts, an agent that answers with how often it was asked."""

    fate: Callable[[int, bytes], list[float]]
    """Delays with which datagram number i arrives: [] is lost, two are a duplicate, s."""
    text_codec: bool = False
    steps: list[float] = field(default_factory=list)
    policy_calls: int = 0
    commands: dict[int, set[bytes]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.simulator = SimulatorLink(hello(), CONFIG, text_codec=self.text_codec)
        self.agent = agent()
        self.now = 1000.0
        self.number = 0
        self.flying: list[tuple[float, int, str, bytes]] = []

    def send(self) -> None:
        for datagram in self.simulator.take_outgoing():
            self.put("agent", datagram)
        for datagram, address in self.agent.take_outgoing():
            assert address == HERE
            message = decode_reply(datagram, self.text_codec)
            if isinstance(message, Command):
                self.commands.setdefault(message.sequence, set()).add(datagram)
            self.put("simulator", datagram)

    def put(self, to: str, datagram: bytes) -> None:
        self.number += 1
        for delay in self.fate(self.number, datagram):
            self.flying.append((self.now + delay, self.number, to, datagram))
        self.flying.sort()

    def run(self, steps: int) -> None:
        self.simulator.connect(self.now)
        if self.text_codec:
            self.simulator.send_state(state(1), self.now)
        while len(self.steps) < steps:
            self.send()
            timer = self.simulator.next_timer()
            assert timer is not None
            if self.flying and self.flying[0][0] <= timer:
                arrival, _, to, datagram = self.flying.pop(0)
                self.now = max(self.now, arrival)
                (self.to_agent if to == "agent" else self.to_simulator)(datagram)
            else:
                self.now = timer
                assert self.simulator.handle_timer(self.now), "the channel was too bad"

    def to_agent(self, datagram: bytes) -> None:
        if isinstance(self.agent.receive(datagram, HERE), State):
            self.policy_calls += 1
            value = 1 / self.policy_calls
            self.agent.send_command(command(self.agent.sequence, self.agent.session, value))

    def to_simulator(self, datagram: bytes) -> None:
        message = self.simulator.receive(datagram, self.now)
        if isinstance(message, Command):
            self.steps.append(message.actions.item())
        if isinstance(message, Command | Welcome):
            self.simulator.send_state(state(self.simulator.sequence + 1), self.now)


def decode_reply(datagram: bytes, text_codec: bool) -> Message:
    return text.decode_command(datagram, 1, 0) if text_codec else binary.decode(datagram)


def lossy(seed: int) -> Callable[[int, bytes], list[float]]:
    dice = random.Random(seed)

    def fate(number: int, datagram: bytes) -> list[float]:
        copies = dice.choices([0, 1, 2, 3], [0.3, 0.5, 0.15, 0.05])[0]
        return [dice.choice([0.001, 0.004, 0.3, 2.0]) for _ in range(copies)]

    return fate


@pytest.mark.parametrize("text_codec", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_each_command_is_stepped_once_whatever_the_channel(seed: int, text_codec: bool) -> None:
    world = World(lossy(seed), text_codec=text_codec)
    world.run(300)
    assert world.steps == [float(np.float32(1 / n)) for n in range(1, 301)]
    assert world.policy_calls in (300, 301)
    assert all(len(datagrams) == 1 for datagrams in world.commands.values())
    assert world.simulator.counters["resent"] > 50
    assert world.agent.counters["duplicate"] > 50


@pytest.mark.parametrize("lost", [{1}, {2}, {3}, {4}, {1, 2, 3}, {5, 6, 7, 8}, {2, 5, 9}])
def test_chosen_losses(lost: set[int]) -> None:
    world = World(lambda number, _: [] if number in lost else [0.001])
    world.run(5)
    assert world.steps == [float(np.float32(1 / n)) for n in range(1, 6)]
    assert world.simulator.counters["resent"] == len(lost)


def test_a_clean_channel_repeats_nothing() -> None:
    world = World(lambda number, datagram: [0.001])
    world.run(100)
    assert world.now == pytest.approx(1000.0 + 0.002 * 101)
    assert world.simulator.counters == {"sent": 102, "received": 101}
    assert world.agent.counters == {"sent": 101, "received": 101}


# ---- tables of (state, event) -> (state, output)


def encoded(*messages: Message) -> list[bytes]:
    return [binary.encode(message) for message in messages]


SIMULATOR_STATES = {
    "hello": (0, [lambda link: link.connect(0.0)]),
    "ready": (0, [lambda link: link.connect(0.0), lambda link: answer(link, WELCOME)]),
    "waiting": (
        1,
        [
            lambda link: link.connect(0.0),
            lambda link: answer(link, WELCOME),
            lambda link: link.send_state(state(1), 0.0),
        ],
    ),
    "closed": (0, [lambda link: link.connect(0.0), lambda link: link.close("bye")]),
}
WELCOME = Welcome(session=SESSION, seed=0)
REFUSE = Refuse(session=SESSION, reason="busy")


def answer(link: SimulatorLink, message: Message) -> object:
    return link.receive(binary.encode(message), 0.0)


def close(sequence: int, session: int = SESSION) -> Close:
    return Close(session=session, sequence=sequence, reason="bye")


SIMULATOR_TABLE = [
    # state, event, state after, counter ("": the message is taken)
    ("hello", WELCOME, "ready", ""),
    ("hello", REFUSE, "closed", ""),
    ("hello", close(0), "closed", ""),
    ("hello", command(0), "hello", "stale"),
    ("hello", command(1), "hello", "stale"),
    ("hello", hello(), "hello", "stale"),
    ("hello", Welcome(session=78), "hello", "foreign"),
    ("ready", WELCOME, "ready", "stale"),
    ("ready", REFUSE, "ready", "stale"),
    ("ready", command(1), "ready", "stale"),
    ("ready", close(0), "closed", ""),
    ("waiting", command(1), "ready", ""),
    ("waiting", command(0), "waiting", "stale"),
    ("waiting", command(2), "waiting", "stale"),
    ("waiting", command(1, session=78), "waiting", "foreign"),
    ("waiting", command(1, size=2), "waiting", "malformed"),
    ("waiting", WELCOME, "waiting", "stale"),
    ("waiting", REFUSE, "waiting", "stale"),
    ("waiting", state(1), "waiting", "stale"),
    ("waiting", close(1), "closed", ""),
    ("waiting", close(0), "closed", ""),
    ("waiting", close(2), "waiting", "stale"),
    ("waiting", close(1, session=78), "waiting", "foreign"),
    ("closed", WELCOME, "closed", "stale"),
    ("closed", command(0), "closed", "stale"),
    ("closed", close(0), "closed", "stale"),
]


@pytest.mark.parametrize(("before", "event", "after", "counter"), SIMULATOR_TABLE)
def test_simulator_table(before: str, event: Message, after: str, counter: str) -> None:
    link = simulator()
    sequence, steps = SIMULATOR_STATES[before]
    for step in steps:
        step(link)
    assert (link.state, link.sequence) == (before, sequence)
    link.take_outgoing()
    message = answer(link, event)
    assert link.state == after
    assert type(message) is (type(None) if counter else type(event))
    dropped = {"stale", "foreign", "malformed"} & set(link.counters)
    assert dropped == ({counter} if counter else set())
    assert link.take_outgoing() == []


AGENT_STATES = {
    "listening": [],
    "expecting": [hello()],
    "deciding": [hello(), state(1)],
    "answered": [hello(), state(1), command(1)],
    "closed": [hello(), state(1), close(1)],
}
AGENT_TABLE = [
    # state, event, state after, counter, answer
    ("listening", hello(), "expecting", "", [Welcome(session=SESSION)]),
    ("listening", state(1), "listening", "foreign", []),
    ("listening", close(0), "listening", "foreign", []),
    ("listening", command(1), "listening", "foreign", []),
    ("expecting", hello(), "expecting", "duplicate", [Welcome(session=SESSION)]),
    ("expecting", hello(session=5), "expecting", "refused",
     [Refuse(session=5, reason="the agent already flies the simulator at 127.0.0.1:8000")]),
    ("expecting", state(1), "deciding", "", []),
    ("expecting", state(2), "expecting", "stale", []),
    ("expecting", state(1, session=5), "expecting", "foreign", []),
    ("expecting", state(1, size=2), "expecting", "malformed", []),
    ("expecting", close(0), "closed", "", []),
    ("expecting", close(1), "closed", "", []),
    ("expecting", close(2), "expecting", "stale", []),
    ("deciding", state(1), "deciding", "duplicate", []),
    ("deciding", state(2), "deciding", "stale", []),
    ("deciding", hello(), "deciding", "stale", []),
    ("deciding", close(1), "closed", "", []),
    ("answered", state(1), "expecting", "duplicate", [command(1)]),
    ("answered", state(2), "deciding", "", []),
    ("answered", state(0), "expecting", "stale", []),
    ("answered", state(3), "expecting", "stale", []),
    ("answered", hello(), "expecting", "stale", []),
    ("answered", command(1), "expecting", "stale", []),
    ("closed", state(2), "closed", "stale", []),
    ("closed", close(1), "closed", "stale", []),
    ("closed", hello(session=5), "closed", "refused",
     [Refuse(session=5, reason="the agent already flies the simulator at 127.0.0.1:8000")]),
]  # fmt: skip


@pytest.mark.parametrize(("before", "event", "after", "counter", "answers"), AGENT_TABLE)
def test_agent_table(
    before: str, event: Message, after: str, counter: str, answers: list[Message]
) -> None:
    link = agent()
    for message in AGENT_STATES[before]:
        if isinstance(message, Command):
            link.send_command(message)
        else:
            link.receive(binary.encode(message), HERE)
    assert link.state == {"answered": "expecting"}.get(before, before)
    link.take_outgoing()
    message = link.receive(binary.encode(event), HERE)
    assert link.state == after
    assert type(message) is (type(None) if counter else type(event))
    dropped = {"stale", "foreign", "malformed", "duplicate", "refused"} & set(link.counters)
    assert dropped == ({counter} if counter else set())
    assert [datagram for datagram, _ in link.take_outgoing()] == encoded(*answers)


# ---- what we may not do


def test_misuse_says_what_was_expected() -> None:
    link = simulator()
    with pytest.raises(ValueError, match="expected link state 'ready' and sequence 1, got 'hello'"):
        link.send_state(state(1), 0.0)
    answer(link, WELCOME)
    with pytest.raises(ValueError, match="sequence 1, got 'ready' and 2"):
        link.send_state(state(2), 0.0)
    server = agent()
    with pytest.raises(ValueError, match="expected link state 'deciding' and sequence 0"):
        server.send_command(command(0))
    server.receive(binary.encode(hello()), HERE)
    server.receive(binary.encode(state(1)), HERE)
    with pytest.raises(ValueError, match="sequence 1, got 'deciding' and 2"):
        server.send_command(command(2))
    server.send_command(command(1))
    with pytest.raises(ValueError, match="got 'expecting' and 1"):
        server.send_command(command(1))


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["timeout", "first_resend", "min_resend", "max_resend"])
def test_times_are_positive_and_finite(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected seconds > 0, got"):
        LinkConfig(**{name: bad})
    with pytest.raises(ValueError, match="min_resend: expected at most max_resend"):
        LinkConfig(min_resend=2.0)


# ---- timers


def resend_times(link: SimulatorLink, now: float) -> list[float]:
    times = []
    while True:
        timer = link.next_timer()
        assert timer is not None
        if not link.handle_timer(timer):
            return [*times, timer - now]
        times.append(timer - now)


def test_resends_back_off_within_bounds_until_the_timeout() -> None:
    link = simulator()
    link.connect(50.0)
    first = link.take_outgoing()
    times = resend_times(link, 50.0)
    assert times[:3] == pytest.approx([0.2, 0.6, 1.4])
    assert np.diff(times[2:-1]) == pytest.approx(1.0)
    assert times[-1] == pytest.approx(10.0)
    outgoing = link.take_outgoing()
    assert link.sends == len(times)
    assert link.state == "closed"
    assert link.next_timer() is None
    goodbye = Close(session=SESSION, sequence=0, reason="no answer from the agent for 10 s")
    assert outgoing == encoded(goodbye) * CLOSE_COPIES  # instead of one more Hello
    assert first == encoded(hello())


def test_every_resend_is_byte_identical() -> None:
    link = simulator()
    link.connect(0.0)
    answer(link, WELCOME)
    link.take_outgoing()
    link.send_state(state(1, value=0.1), 0.0)
    for _ in range(5):
        timer = link.next_timer()
        assert timer is not None
        assert link.take_outgoing() == encoded(state(1, value=0.1))
        assert link.handle_timer(timer)


def test_the_wait_follows_the_round_trips() -> None:
    link = simulator()
    link.connect(0.0)
    now = 0.05  # the first round trip: mean 50 ms, variation 25 ms
    link.receive(binary.encode(WELCOME), now)
    for sequence in range(1, 200):
        link.send_state(state(sequence), now)
        if sequence == 1:
            assert link.next_timer() == pytest.approx(now + 0.05 + 4 * 0.025)
        now += 0.05
        link.receive(binary.encode(command(sequence)), now)
    link.send_state(state(200), now)
    assert link.next_timer() == pytest.approx(now + 0.05, abs=1e-3)
    now += 30.0  # the agent learnt: a long pause must not stretch the wait past its bound
    link.receive(binary.encode(command(200)), now)
    link.send_state(state(201), now)
    assert link.next_timer() == pytest.approx(now + 1.0)


def test_an_ambiguous_round_trip_is_not_measured() -> None:
    link = simulator()
    link.connect(0.0)
    assert link.handle_timer(0.2)
    link.receive(binary.encode(WELCOME), 0.2001)
    link.send_state(state(1), 1.0)
    assert link.next_timer() == pytest.approx(1.2)  # still the first wait


def test_fast_round_trips_keep_the_shortest_wait() -> None:
    link = simulator()
    link.connect(0.0)
    link.receive(binary.encode(WELCOME), 1e-6)
    link.send_state(state(1), 1.0)
    assert link.next_timer() == pytest.approx(1.01)


def test_the_timer_does_nothing_before_its_time() -> None:
    link = simulator()
    assert link.next_timer() is None
    link.connect(0.0)
    link.take_outgoing()
    assert link.handle_timer(0.1)
    assert link.take_outgoing() == []


# ---- strangers, other codecs, other versions


def test_a_stranger_with_the_right_session_is_foreign() -> None:
    link = agent()
    link.receive(binary.encode(hello()), HERE)
    for message in (state(1), close(0)):
        assert link.receive(binary.encode(message), STRANGER) is None
    assert link.counters["foreign"] == 2
    assert link.state == "expecting"
    assert isinstance(link.receive(binary.encode(state(1)), HERE), State)


def test_a_second_simulator_is_refused_with_a_sentence() -> None:
    link = agent()
    link.receive(binary.encode(hello()), HERE)
    link.take_outgoing()
    link.receive(binary.encode(hello(session=5)), STRANGER)
    link.receive(b"1,0.0,0,0,1.0", STRANGER)
    link.receive(b"nonsense", STRANGER)
    reason = "the agent already flies the simulator at 127.0.0.1:8000"
    assert link.take_outgoing() == [
        (binary.encode(Refuse(session=5, reason=reason)), STRANGER),
        (b"1,close", STRANGER),
    ]
    assert link.counters["refused"] == 2
    assert link.counters["malformed"] == 1


def test_a_refused_hello_leaves_the_agent_listening() -> None:
    link = agent("expected another one " + "x" * 600)
    assert link.receive(binary.encode(hello()), HERE) is None
    ((datagram, _),) = link.take_outgoing()
    refuse = binary.decode(datagram)
    assert isinstance(refuse, Refuse)
    assert len(refuse.reason) == 512
    assert link.state == "listening"
    assert link.last_error.startswith("refused from 127.0.0.1:8000: expected another one")


def test_a_hello_of_another_version_is_refused() -> None:
    raw = bytearray(binary.encode(hello()))
    raw[2] = 2
    raw[4:8] = zlib.crc32(raw[8:], zlib.crc32(raw[:4])).to_bytes(4, "little")
    link = agent()
    assert link.receive(bytes(raw), HERE) is None
    ((datagram, address),) = link.take_outgoing()
    assert address == HERE
    sentence = "protocol version: expected 1, got 2"
    assert binary.decode(datagram) == Refuse(session=SESSION, reason=sentence)
    assert sentence in link.last_error
    assert link.state == "listening"


def test_text_in_a_binary_session_and_binary_in_a_text_session() -> None:
    link = agent()
    link.receive(binary.encode(hello()), HERE)
    link.take_outgoing()
    assert link.receive(b"1,0.0,0,0,1.0", HERE) is None
    assert link.receive(b"0,close", HERE) is None
    assert link.state == "expecting"
    link = agent()
    assert isinstance(link.receive(b"1,0.0,0,0,1.0", HERE), State)
    for message in (hello(session=0), hello(), state(2, session=0), close(1, session=0)):
        assert link.receive(binary.encode(message), HERE) is None
    assert (link.state, link.sequence) == ("deciding", 1)
    assert link.counters["refused"] == 2
    assert link.counters["foreign"] == 2
    client = SimulatorLink(hello(), CONFIG, text_codec=True)
    client.send_state(state(1), 0.0)
    assert client.receive(binary.encode(command(1)), 0.0) is None
    assert client.counters["malformed"] == 1
    assert isinstance(client.receive(b"1,0.5", 0.0), Command)


def test_a_text_session_from_first_line_to_close() -> None:
    link = agent()
    first = link.receive(b"41,0.0,0,0,1.0\n", HERE)  # any first number
    assert isinstance(first, State)
    link.send_command(command(41, session=0, value=0.5))
    assert link.receive(b"41,0.0,0,0,1.0", HERE) is None
    assert link.take_outgoing() == [(b"41,0.5", HERE)] * 2
    assert isinstance(link.receive(b"42,close", HERE), Close)
    assert link.state == "closed"


def test_discrete_actions_are_whole_and_in_range() -> None:
    link = simulator(discrete_actions=3)
    link.connect(0.0)
    answer(link, WELCOME)
    link.send_state(state(1), 0.0)
    for value in (-1.0, 3.0, 0.5):
        assert answer(link, command(1, value=value)) is None
    assert link.counters["malformed"] == 3
    assert "expected whole actions 0 to 2" in link.last_error
    assert isinstance(answer(link, command(1, value=2.0)), Command)


@pytest.mark.parametrize("sent", [state(1), None])
def test_closing_tells_the_other_side_and_is_final(sent: State | None) -> None:
    link = simulator()
    link.connect(0.0)
    answer(link, WELCOME)
    if sent is not None:
        link.send_state(sent, 0.0)
    link.take_outgoing()
    link.close("line one\nline two")
    link.close("again")
    sequence = 1 if sent is not None else 0
    goodbye = Close(session=SESSION, sequence=sequence, reason="line one line two")
    assert link.take_outgoing() == encoded(goodbye) * CLOSE_COPIES
    server = agent()
    server.close("nobody was there")
    assert server.take_outgoing() == []
    server.receive(binary.encode(hello()), HERE)
    ((refusal, _),) = server.take_outgoing()
    assert binary.decode(refusal) == Refuse(session=SESSION, reason="the agent has closed")


def test_a_lost_close_of_the_agent_is_repeated_for_a_repeated_state() -> None:
    link = agent()
    link.receive(binary.encode(hello()), HERE)
    link.receive(binary.encode(state(1)), HERE)
    link.take_outgoing()
    link.close("done")
    goodbye = binary.encode(Close(session=SESSION, sequence=1, reason="done"))
    assert link.take_outgoing() == [(goodbye, HERE)] * CLOSE_COPIES
    link.receive(binary.encode(state(1)), HERE)
    assert link.take_outgoing() == [(goodbye, HERE)]


def test_junk_changes_nothing_but_counters() -> None:
    dice = random.Random(3)
    link, client = agent(), simulator()
    client.connect(0.0)
    link.receive(binary.encode(hello()), HERE)
    link.take_outgoing()
    client.take_outgoing()
    for size in (0, 1, 24, 100, 65507):
        for first in (b"", b"\xa7R\x01\x04", b"1,"):
            junk = (first + dice.randbytes(size))[:65507]
            assert link.receive(junk, HERE) is None
            assert link.receive(junk, STRANGER) is None
            assert client.receive(junk, 0.0) is None
    assert (link.state, client.state) == ("expecting", "hello")
    assert link.take_outgoing() == client.take_outgoing() == []
    assert link.counters["malformed"] == 30
    assert client.counters["malformed"] == 15


def test_the_last_error_is_one_line_whatever_was_dropped() -> None:
    whole = binary.encode(state(1, value=0.25, size=100))
    body = whole[8:].replace(np.float32(0.25).tobytes(), np.float32(np.nan).tobytes())
    crc = zlib.crc32(body, zlib.crc32(whole[:4]))
    link, client = agent(), simulator()
    for receive in (
        lambda datagram: link.receive(datagram, HERE),
        lambda datagram: client.receive(datagram, 0.0),
    ):
        assert receive(whole[:4] + crc.to_bytes(4, "little") + body) is None
    for error in (link.last_error, client.last_error):
        assert "observations: expected finite numbers, got [[nan nan" in error
        assert "\n" not in error
        assert len(error) <= 512
