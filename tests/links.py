"""What the tests of both state machines share: messages, links, and how to drive them."""

import zlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from rotorgram.udp import LinkConfig, binary
from rotorgram.udp.agent_link import AgentLink
from rotorgram.udp.keys import OVERHEAD, Key, is_sealed
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
from rotorgram.udp.simulator_link import SimulatorLink

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


# ---- a simulator in each of its states


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


# ---- an agent in each of its states

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
LINE, COMMAND_LINE = b"1,0.0,0,0,0.0", b"1,0.0"


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


# ---- what attackers need

ANYWHERE = ("10.6.6.6", 666)


def fixed(datagram: bytes) -> bytes:
    """With its checksum made right, behind whatever seal it has."""
    at = OVERHEAD if is_sealed(datagram) else 0
    head, body = datagram[: at + 4], datagram[at + 8 :]
    if len(datagram) < at + 24:
        return datagram
    return head + zlib.crc32(body, zlib.crc32(head[at:])).to_bytes(4, "little") + body


def of_agent(link: AgentLink) -> object:
    """All that a datagram may change, but for what is remembered of those who come."""
    return link.closed, [
        s and (s.peer, s.number, s.state, s.sequence, s.reply, s.asked_at) for s in link.places
    ]


def of_simulator(link: SimulatorLink) -> object:
    numbers = (link._sent_at, link._resend_at, link._deadline, link._smoothed, link._variation)
    return link.state, link.sequence, link.hello.session, link.sends, link._outstanding, numbers


def pair(sealed: bool, session: int = 77) -> tuple[SimulatorLink, AgentLink]:
    keys: list[Any] = [Key(SECRET, side) if sealed else None for side in ("simulator", "agent")]
    numbers = iter(range(1000, 2000))
    link = SimulatorLink(
        hello(session=session), LinkConfig(), key=keys[0], draw_session=lambda: next(numbers)
    )
    return link, new_agent(keys[1])


def new_agent(key: Key | None) -> AgentLink:
    return AgentLink(lambda _: "", (1, 0), key=key)


def only(outgoing: list[Any]) -> bytes:
    (first,) = outgoing
    return first if isinstance(first, bytes) else first[0]


def begin(link: SimulatorLink, agent: AgentLink) -> tuple[bytes, bytes]:
    """To State 1, which is not delivered; the Hello and the State."""
    if not link.sends:
        link.connect(0.0)
    greeting = only(link.take_outgoing())
    agent.receive(greeting, HERE, 0.0)
    link.receive(only(agent.take_outgoing()), 0.0)
    link.send_state(state(1, link.hello.session), 0.0)
    return greeting, only(link.take_outgoing())


def step(link: SimulatorLink, agent: AgentLink, datagram: bytes) -> bytes:
    """The Command for a State, and the next State."""
    event = agent.receive(datagram, HERE, 0.0)
    assert event is not None
    answer = command(event.message.sequence, event.message.session)
    agent.send_command(event.place, answer, 0.0)
    assert isinstance(link.receive(only(agent.take_outgoing()), 0.0), Command)
    link.send_state(state(link.sequence + 1, link.hello.session), 0.0)
    return only(link.take_outgoing())
