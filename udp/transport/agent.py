"""The agent's port, and the simulators that have a slot at it."""

import os
import time
import weakref
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import gymnasium as gym

from ...envs import registry
from ...envs.config import EnvConfig
from ...envs.spec import EnvSpec, canonical_id, json_values, options_difference
from ...models.errors import InputError, shortened
from ...models.fields import check_fields
from ..layouts import layout_of
from ..protocol import text
from ..protocol.auth import Key, read_key
from ..protocol.client import Address, Seconds, address_text
from ..protocol.errors import PeerClosed, PeerSilent
from ..protocol.layout import Array, Layout
from ..protocol.messages import Close, Hello, State
from ..protocol.server import Server
from ..protocol.session import Event
from ..protocol.statistics import warn
from .sockets import LONGEST_WAIT, PAUSE, Port

if TYPE_CHECKING:
    from ..journal import Journal

Order = tuple[Array, Array, Array | None, Array | None]
"""Actions, orders, seeds and requests of the drones of one simulator: see `messages.Command`."""


class AgentSettings(TypedDict, total=False):
    """Settings of an env over UDP: see `RemoteEnv`."""

    env_id: str | None
    options: Mapping[str, object] | None
    vehicle_hash: str | None
    connect_timeout: float
    timeout: float
    key_file: Path | str | None
    insecure: bool
    record: Path | str | None


@dataclass(kw_only=True, eq=False)
class AgentConfig:
    """The settings, their defaults, and whether a simulator is what they require.

    A server holds this object: an `Agent` held by its server would never be garbage.
    """

    env_id: str | None = None
    options: Mapping[str, object] | None = None
    vehicle_hash: str | None = None
    connect_timeout: Seconds = 60.0
    timeout: Seconds = 30.0
    key_file: Path | str | None = None
    insecure: bool = False
    record: Path | str | None = None
    slots: int = 1
    """Simulators to fly at the same time."""
    drones: int | None = None
    """Drones of each simulator; None: as many as the first has."""
    spec: EnvSpec | None = None
    """Of the simulator that joined last; None before the first."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.env_id is not None:
            self.env_id = canonical_id(self.env_id)
            self._expected_options(self.env_id)

    def accept(self, hello: Hello) -> Layout | str:
        """The layout of a simulator, or the reason to refuse it."""
        try:
            spec = EnvSpec.from_json(hello.spec)
            drones = hello.worlds * len(spec.agents)
            return self._difference(spec, drones) or layout_of(spec, hello.worlds)
        except InputError as error:
            return str(error)

    def _difference(self, spec: EnvSpec, drones: int) -> str:
        env_id = canonical_id(spec.env_id)
        if self.env_id is not None and env_id != self.env_id:
            return f"expected a simulator of {self.env_id}, got one of {env_id}"
        if self.drones is not None and drones != self.drones:
            return f"drones: expected a simulator of {self.drones}, got one of {drones}"
        if self.vehicle_hash is not None and spec.vehicle_hash != self.vehicle_hash:
            return (
                f"expected a vehicle of hash {self.vehicle_hash}, "
                f"got {spec.vehicle} of {spec.vehicle_hash}"
            )
        if self.options is not None:
            expected = self._expected_options(env_id)
            got_options = dict(spec.options)
            if not registry.is_known(env_id):  # others have any value
                got_options = {n: v for n, v in got_options.items() if n in expected}
            if reason := options_difference(expected, got_options):
                return f"options: {reason}"
        return _spec_difference(self.spec, spec) if self.spec else ""

    def _expected_options(self, env_id: str) -> dict[str, object]:
        """The options that a simulator of this env must have, as JSON values.

        Raises `InputError` if they are none, or the env is known here and has no such options.
        """
        options = dict(self.options or {})
        if self.options is not None and registry.is_known(env_id):
            options = EnvConfig.from_keywords(env_id, **options).flat_options()
        return json_values(options)

    @cached_property
    def text_spec(self) -> EnvSpec | None:
        """Of a simulator that speaks text, for it tells none; None if text is not flown.

        It is the env with the paper's vehicle, made here: text is not flown where that cannot be.
        """
        env_id = self.env_id
        if env_id is None or not registry.is_known(env_id) or self.drones not in (None, 1):
            return None
        if self.record:  # a journal begins with a Hello
            return None
        try:
            spec = registry.env_spec(EnvConfig.from_keywords(env_id, **(self.options or {})))
            text.check_layout(layout_of(spec))
        except (InputError, ImportError):  # the latter without MuJoCo
            return None
        return spec

    @cached_property
    def text_layout(self) -> Layout | None:
        """Of the messages of such a simulator."""
        return layout_of(self.text_spec) if self.text_spec else None


class Agent:
    """Exchanges Commands for States with all simulators at the same time.

    Attributes:
        address: Address that this side listens on.
        config: What a simulator must be: once one has come, as that one.
        states: The last State of each slot.
        lost: For each slot the reason of a loss during the last exchange; "" if there was none.
    """

    def __init__(self, address: Address, config: AgentConfig) -> None:
        self.config = config
        key = Key(read_key(config.key_file), "agent") if config.key_file else None
        self.server = server = Server(
            config.accept,
            lambda: config.text_layout,
            slots=config.slots,
            key=key,
        )
        self.states: dict[int, State] = {}
        self.lost = [""] * config.slots
        self._deadlines = [0.0] * config.slots
        self._port = Port(address, insecure=config.insecure or key is not None)
        self.address = self._port.address
        self._journal: Journal | None = None
        if config.record:
            from .. import journal

            try:
                self._journal = journal.Journal(config.record, side="agent")
                server.outbox.tap = self._journal.tap
            except BaseException:
                self._port.close()
                raise
        # Runs once: in close(), with the garbage, or when the program ends.
        self.close = weakref.finalize(self, _leave, os.getpid(), server, self._port, self._journal)

    def connect(self) -> EnvSpec:
        """Wait until it is the agent's turn at every slot. Returns the spec of the simulators.

        Raises `PeerSilent` if a slot stayed free, or its simulator fell silent and no other came;
        `PeerClosed` if the last simulator ended the exchange.
        """
        if not self.close.alive:
            raise gym.error.ClosedEnvironmentError("expected an open env, got a closed one")
        self._gather(self._pending())
        self.lost = [""] * len(self.lost)
        assert self.config.spec is not None
        return self.config.spec

    def exchange(self, orders: Mapping[int, Order]) -> None:
        """Send each of these slots its Command, and wait for the States of all.

        A simulator that is lost meanwhile is replaced by another that comes; then `lost` says why
        and `states` has the first State of that one. Raises `InputError` if the first order is not
        of the layout, or not finite, and nothing was sent; otherwise as `connect`.
        """
        now = time.monotonic()
        for slot, (actions, what, seeds, asks) in orders.items():
            session = self.server.slots[slot]
            assert session is not None
            session.send_command(actions, what, seeds, now, asks)
        self.lost = [""] * len(self.lost)
        self._gather(self._pending() if None in self.server.slots else list(orders))

    # ---- the exchange

    def _gather(self, pending: list[int]) -> None:
        """Send what is due and answer what comes, until it is the agent's turn everywhere."""
        server = self.server
        config = self.config
        slots = server.slots
        _flush(server, self._port)  # before anything else: a simulator waits
        now = time.monotonic()
        deadlines = self._deadlines
        for slot in pending:
            deadlines[slot] = now + (config.timeout if slots[slot] else config.connect_timeout)
        if self._journal:
            self._journal.write()
        while pending:
            left = min(map(deadlines.__getitem__, pending)) - now
            if left <= 0:
                self._give_up(pending, now)
                now = time.monotonic()
                pending = self._pending()
                continue
            before = now
            datagram = None
            try:
                datagram, address = self._port.receive(left, strangers=None in slots)
            except (OSError, ValueError):  # nothing came, or an earlier one came back
                if not self.close.alive:  # another thread has closed the env
                    raise gym.error.ClosedEnvironmentError("the env was closed") from None
            now = time.monotonic()
            pause = now - before - min(left, LONGEST_WAIT)
            if pause > PAUSE:  # of this process: what the simulators sent meanwhile was not read
                for slot in range(len(slots)):
                    deadlines[slot] += pause
            if datagram is None:
                continue
            event = server.receive(datagram, address, now)
            if event and not event.joined and isinstance(event.message, State):
                self.states[event.slot] = event.message
                pending.remove(event.slot)
            elif event:
                self._handle(event, address)
                pending = self._pending()
            if pending:
                _flush(server, self._port)

    def _pending(self) -> list[int]:
        """Slots at which it is not the agent's turn."""
        sessions = enumerate(self.server.slots)
        return [slot for slot, one in sessions if one is None or one.state != "deciding"]

    def _handle(self, event: Event, address: Address) -> None:
        slot = event.slot
        message = event.message
        session = self.server.slots[slot]
        if isinstance(message, Close):
            reason = f"the simulator at {address_text(address)} closed: {message.reason}"
            if not any(self.server.slots):
                self.lost[slot] = reason
                self._keep_sockets()
                _flush(self.server, self._port)
                raise PeerClosed(reason)
            self._lose(slot, reason)
            return
        assert session is not None  # another simulator has this slot now
        config = self.config
        if session.hello:
            self.server.takes_text = False
            config.spec = EnvSpec.from_json(session.hello.spec)
        else:
            config.spec = config.text_spec
        config.drones = session.layout.drones
        self._keep_sockets()
        if slot in self.states and not self.lost[slot]:
            self._lose(slot, f"the simulator at {address_text(address)} was started anew")
        self.states[slot] = message

    def _give_up(self, pending: list[int], now: float) -> None:
        """Free the slots of silent simulators. Raises `PeerSilent` if no other took a free slot."""
        config = self.config
        here = address_text(self.address)
        for slot in pending:
            if now < self._deadlines[slot]:
                continue
            session = self.server.slots[slot]
            last = self.server.statistics.last_error
            dropped = f"; last datagram dropped: {last}" if last else ""
            if session is None:
                lost = self.lost[slot]
                nobody = f"{lost}; no other" if lost else "no simulator"
                raise PeerSilent(
                    f"{nobody} came to {here} for {config.connect_timeout:g} s{dropped}"
                )
            if now < session.heard_at + config.timeout:  # it computes
                self._deadlines[slot] = session.heard_at + config.timeout
                continue
            there = address_text(session.peer)
            self.server.free(slot)
            self._lose(
                slot,
                f"no datagram from the simulator at {there} for {config.timeout:g} s, "
                f"waiting at {here} for State {session.sequence + 1}{dropped}",
            )

    def _keep_sockets(self) -> None:
        self._port.keep([session.peer for session in self.server.slots if session])

    def _lose(self, slot: int, reason: str) -> None:
        self.lost[slot] = reason
        self._deadlines[slot] = time.monotonic() + self.config.connect_timeout
        self._keep_sockets()
        if self.server.slots[slot] is None:
            reason += f"; waiting for another at {address_text(self.address)}"
        warn(reason)


def _spec_difference(ours: EnvSpec, theirs: EnvSpec) -> str:
    """Difference between a simulator and earlier ones, in a sentence; "" if there is none."""
    if ours.options != theirs.options:
        return f"options: {options_difference(ours.options, theirs.options)}"
    for field in fields(EnvSpec):
        name = field.name
        expected = getattr(ours, name)
        got = getattr(theirs, name)
        told = "" not in (expected, got)  # a digest is optional
        if told and expected != got and name not in ("vehicle", "marks"):
            return f"{name}: expected {shortened(expected)} as before, got {shortened(got)}"
    return ""


def _leave(pid: int, server: Server, port: Port, journal: "Journal | None") -> None:
    """Tell every simulator, until it has answered or will not."""
    if os.getpid() != pid:  # a fork of the process that owns the agent
        return
    server.close("the agent closed", time.monotonic())
    _flush(server, port)
    while (timer := server.next_timer()) < inf:
        left = max(timer - time.monotonic(), 0.0)
        with suppress(OSError):  # nothing came
            datagram, address = port.receive(left)
            server.receive(datagram, address, time.monotonic())
        server.handle_timer(time.monotonic())
        _flush(server, port)
    port.close()
    if journal:
        journal.close()


def _flush(server: Server, port: Port) -> None:
    outbox = server.outbox
    datagrams = outbox.datagrams
    outbox.datagrams = []
    for datagram, address in datagrams:
        try:
            port.send(datagram, address)
        except OSError:  # as good as lost: the simulator asks again, or the wait ends in time
            outbox.statistics.counters["unsent"] += 1
