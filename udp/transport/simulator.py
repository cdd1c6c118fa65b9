"""The simulator: a UDP client that steps envs by the Commands of one agent, or of several."""

import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import gymnasium as gym

from ...envs.config import DEFAULT_ENV, EnvConfig
from ...envs.spec import ArraySpec, EnvSpec
from ...models.errors import InputError, NotCopied
from ...models.fields import Choice, Limits, check
from ..layouts import layout_of
from ..protocol import binary
from ..protocol.auth import Key, read_key
from ..protocol.client import Address, Client, LinkConfig, largest_datagram, random_number
from ..protocol.errors import LinkError
from ..protocol.layout import Layout
from ..protocol.messages import Command, Hello
from ..protocol.party import (
    NO_RESET,
    AgentLink,
    OneAgent,
    Rules,
    SeveralAgents,
)
from ..protocol.running import FreeRun, FreeRunning
from .sockets import EVENTS_WAY_OUT, LONGEST_WAIT, PAUSE, TEXT_WAY_OUT, WAY_OUT, Port, resolve
from .stepped import GymEnv, Steppable, make_stepped

if TYPE_CHECKING:
    from ..journal import Journal

DEFAULT_AGENT = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR = ("127.0.0.1", 8000)
COMMAND_AGE = ArraySpec(
    name="command_age",
    shape=(),
    dtype="float64",
    unit="s",
)
"""In the telemetry of a simulator that keeps time: see `FreeRunning`."""
_ALIVE_EVERY = 0.5  # period of the message Alive while an agent waits for a State, s

Observer = Callable[[Command], None]
"""Called with the Command that moved the drones: see `Simulator.observers`."""


class Simulator(NotCopied):
    """Simulated drones that an agent flies over UDP, or several agents.

    Several agents fly one world. Each is an ordinary one (`RemoteEnv`, `RemoteParallelEnv`, …): its
    Hello names its own drones, its States have their rows. The world steps when all agents that fly
    have answered, so its numbers are those of the world in process with the same actions, bit for
    bit. The rules are those of `SeveralAgents`.

    Args:
        env: `EnvConfig`, id of a registered task, or one Gymnasium env itself: observations are a
            Box or a Dict of Box, actions a Box or `Discrete`.
        server: Address (host, port) of the agent.
        agents: Addresses of several agents in its place. They share the drones evenly in their
            order.
        num_envs: Drones in all; None: those of one world.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        config: Times of the exchange. `timeout`: longest wait for an agent that is to come, or to
            come back, s.
        key_file: As `AgentSettings`, and so are `insecure` and `record`.
        allow_events: Whether agents may ask for the events that the config offers: those on this
            machine, or with a key.
        patience: Longest wait for a Command of one of several agents, s.
        free_run: Keep time instead of lock-step, with one agent.
        keywords: As of `EnvConfig.from_keywords`, with an id: `drones` of each world, `vehicle` …

    Attributes:
        address: Address of this side.
        spec: Spec of the env.
        stepped: The loop or the envs.
        rules: What the world does with the messages of its agents.
        observers: Called after every step of the world, once the agents have its State.

    Raises:
        InputError: An option, an address, the key file or the env's spaces are not what they
            should be.
        OSError: The port is in use, or the record cannot be written.
    """

    _stopped = _ran = False
    _journal: "Journal | None" = None

    def __init__(
        self,
        env: str | EnvConfig | GymEnv = DEFAULT_ENV,
        *,
        server: Address = DEFAULT_AGENT,
        agents: Sequence[Address] | None = None,
        num_envs: int | None = None,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
        allow_events: bool = False,
        patience: float = 10.0,
        free_run: FreeRun | None = None,
        **keywords: object,
    ) -> None:
        check("codec", Choice(("binary", "text")), codec)
        check("patience", Limits(0, unit="s", above=True), patience)
        by_text = codec == "text"
        alone = by_text or record or num_envs
        if agents is not None and alone:
            raise InputError("agents: expected neither text, record nor num_envs with several")
        key = Key(read_key(key_file), "simulator") if key_file else None
        with ExitStack() as failing:  # closes what is open if a later step fails
            self.stepped = stepped = make_stepped(env, num_envs, keywords)
            failing.callback(stepped.close)
            self.spec = spec = _offered(stepped.spec, free_run, allow_events)
            insecure = key is not None or (insecure and not spec.asks)
            worlds = stepped.num_envs // len(spec.agents)
            layout = layout_of(spec, worlds)
            servers = [server] if agents is None else list(agents)
            times = config or LinkConfig()
            links = _links(
                spec, worlds, servers, times, insecure=insecure, by_text=by_text, key=key
            )
            self._by_address = {link.address: link for link in links}
            if len(self._by_address) < len(links):
                raise InputError(f"agents: expected a different address of each, got {servers}")
            self.observers: list[Observer] = []
            self._port = port = Port(bind, insecure=insecure, peers=tuple(self._by_address))
            failing.callback(port.close)
            self.address: Address = port.address
            if self.address in self._by_address:
                raise InputError(
                    f"server: expected the address of an agent, got that of this side, {bind}"
                )
            self.rules: Rules
            if free_run:
                self.rules = _free_running(stepped, layout, links, free_run)
            elif agents is None:
                self.rules = OneAgent(stepped, layout, spec.control_period, links)
            else:
                self.rules = SeveralAgents(stepped, layout, spec.control_period, links, patience)
            if record:
                self._record(record)
            failing.pop_all()

    @property
    def link(self) -> Client:
        """The exchange with the first agent."""
        return self.rules.links[0].client

    def run(self) -> str:
        """Fly until every agent has closed; the reason that the last one gave. Runs once.

        The agents are told at once when the run ends, also by an error of the env or by Ctrl-C.

        Raises:
            PeerSilent: Nothing came from an agent within the timeout, and no other is left.
            Refused: An agent turned this simulator away, with a reason.
            LinkError: An agent closed before a shared world began, or the only one went on after
                an episode's end without a reset.
            KeyboardInterrupt: Ctrl-C.
        """
        if self._ran:
            raise ValueError(f"run: expected one call for each {type(self).__name__}, got another")
        self._ran = True
        reason = "the simulator was stopped"
        finished = threading.Event()
        heart = threading.Thread(target=self._say_alive, args=(finished,), daemon=True)
        heart.start()
        try:
            return self._fly() or reason
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            finished.set()
            self._end(reason)

    def stop(self) -> None:
        """Make `run` tell the agents and return, after the step that is being computed.

        May be called from another thread and in a signal handler, any number of times.
        """
        self._stopped = True

    def close(self) -> None:
        """Close the socket, the envs and the record. Not while it runs: see `stop`."""
        self._port.close()
        self.stepped.close()
        if self._journal:
            self._journal.close()

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fly(self) -> str:
        """Fly until all agents have closed: the reason of the last one. Empty after `stop`."""
        rules = self.rules
        rules.start(time.monotonic())
        while not self._stopped:
            try:
                again = rules.step(time.monotonic())
            except gym.error.ResetNeeded as error:
                raise LinkError(f"{NO_RESET} ({error})") from None
            rules.answer(time.monotonic())
            self._flush()
            if cause := rules.cause:
                rules.cause = None
                for observe in self.observers:
                    observe(cause)
                if self._journal:
                    self._journal.write()
            if rules.reason is not None:
                return rules.reason
            if again:
                continue
            before = time.monotonic()
            left = min(rules.next_timer() - before, LONGEST_WAIT)
            if left <= 0:
                rules.handle_timers(before)
                continue
            try:
                datagram, address = self._port.receive(left)
            except OSError as error:
                if self._port.closed:
                    raise
                pause = time.monotonic() - before - left
                if pause > PAUSE:  # this process was stopped
                    rules.pardon(pause)
                if len(rules.links) == 1 and not isinstance(error, TimeoutError):
                    rules.links[0].trouble = _words(error, "receiving")
                continue
            if link := self._by_address.get(address):
                link.trouble = ""
                rules.receive(link, datagram, time.monotonic())
        return ""

    def _end(self, reason: str) -> None:
        """Send Close to the agents until they answer, or their time for that is over."""
        rules = self.rules
        rules.close(reason, time.monotonic())
        self._flush()
        while not self._port.closed:
            timer = min([link.client.next_timer() for link in rules.links])
            if timer == inf:
                break
            left = timer - time.monotonic()
            with suppress(OSError):  # nothing came, or an earlier datagram found nobody
                datagram, address = self._port.receive(max(left, 0.0))
                if link := self._by_address.get(address):
                    link.client.receive(datagram, time.monotonic())
            for each in rules.links:
                each.client.handle_timer(time.monotonic())
            self._flush()
        if self._journal:
            self._journal.close()

    def _flush(self) -> None:
        """Send what is due, before any wait."""
        for link in self.rules.links:
            client = link.client
            outgoing = client.outgoing
            client.outgoing = []
            for datagram in outgoing:
                try:
                    self._port.send(datagram, link.address)
                except OSError as error:  # a full buffer or no network: as good as lost
                    client.statistics.counters["unsent"] += 1
                    link.trouble = _words(error, "sending")

    def _say_alive(self, finished: threading.Event) -> None:
        """In a thread: tell agents that wait for a State that it will come."""
        while not finished.wait(_ALIVE_EVERY):
            for link in self.rules.links:
                for datagram in link.client.alive(time.monotonic()):
                    with suppress(OSError):  # as good as lost
                        self._port.send(datagram, link.address)

    def _record(self, path: Path | str) -> None:
        from ..journal import Journal

        link = self.link
        about = {"codec": "text" if link.by_text else "binary"}
        if config := getattr(self.stepped, "config", None):  # a `Loop` has one
            about |= {"config": json.dumps(config.to_dict()), "backend": config.backend.name}
        self._journal = Journal(path, side="simulator", about=about)
        link.tap = self._journal.tap
        if link.by_text:  # says no Hello
            link.tap(0, link.hello, binary.encode(link.hello))


def _offered(spec: EnvSpec, free_run: FreeRun | None, allow_events: bool) -> EnvSpec:
    """The spec as agents get it."""
    age = (COMMAND_AGE,) if free_run else ()
    asks = spec.asks if allow_events else ()
    return replace(spec, asks=asks, telemetry=(*spec.telemetry, *age))


def _free_running(
    stepped: Steppable, layout: Layout, links: list[AgentLink], run: FreeRun
) -> FreeRunning:
    """The rules of a simulator that keeps time. Raises `InputError` for several agents, for text,
    and for drones that cannot be flown without an agent.
    """
    from ...envs.failsafe import Failsafe
    from ...envs.loop import Loop

    if len(links) > 1 or links[0].client.by_text:
        raise InputError("free_run: expected one agent and binary messages")
    failsafe = None
    if isinstance(stepped, Loop):
        stepped.prepare()  # before the clock runs
    if run.after != "hold":
        if not isinstance(stepped, Loop):
            raise InputError(f"after: expected hold with {stepped.spec.env_id}, got {run.after}")
        pilot = Failsafe(stepped.task, run.after)
        failsafe = lambda: pilot.actions(stepped.telemetry)  # noqa: E731
    return FreeRunning(stepped, layout, stepped.spec.control_period, links, run, failsafe)


def _links(
    spec: EnvSpec,
    worlds: int,
    servers: Sequence[Address],
    config: LinkConfig,
    *,
    insecure: bool,
    by_text: bool,
    key: Key | None,
) -> list[AgentLink]:
    """A client for each agent, with a session of its own. They share the drones evenly."""
    way_out = TEXT_WAY_OUT if by_text else WAY_OUT
    if spec.asks:
        if by_text:
            raise InputError("allow_events: expected the binary codec, got text")
        way_out = EVENTS_WAY_OUT
    if not servers:
        raise InputError("agents: expected one address or more, got none")
    drones = worlds * len(spec.agents)
    share, left = divmod(drones, len(servers))
    if left:
        raise InputError(
            f"agents: expected a divisor of {drones} drones, got {len(servers)} agents"
        )
    links = []
    for number, address in enumerate(servers):
        there = resolve(address, insecure=insecure, way_out=way_out)
        if not there[1]:
            raise InputError("server: expected the port of the agent, 1 to 65535, got 0")
        rows = slice(number * share, (number + 1) * share)
        own = replace(spec, agents=spec.agents[rows])
        client = Client(
            Hello(session=random_number(), spec=own.to_json(), worlds=worlds),
            layout_of(own, worlds),
            config,
            largest=largest_datagram(there),
            by_text=by_text,
            key=key,
        )
        links.append(AgentLink(there, client, rows))
    return links


def _words(error: OSError, what: str) -> str:
    if isinstance(error, ConnectionError):
        return "nothing listens on that port"
    return f"{what} failed: {error.strerror}"
