"""A bad network on purpose: a seeded relay between simulators (clients) and an agent (server).

`Faults` decides the fate of a datagram, without a socket or a clock; `Relay` carries it out.
"""

import itertools
import random
import selectors
import socket
import threading
import time
from collections import Counter, OrderedDict
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final

from ...models.errors import expect
from ..protocol.client import Address
from .sockets import open_socket, resolve

_NAP: Final = 0.04  # longest wait before the relay looks whether it was stopped, s
_IDLE: Final = 600.0  # a client without a datagram in either direction for so long is forgotten, s
_MAX_CLIENTS: Final = 200  # each takes a file, and some systems lend only 256
_MAX_HELD: Final = 16_384  # most datagrams that are held back at one time; more are not sent
_LARGEST: Final = 65_535  # bytes that a packet can have
_IP_HEADER: Final = 20
_UDP_HEADER: Final = 8
_WAY_OUT: Final = (
    "insecure=True (--insecure) where everybody that reaches the relay may send through it"
)


@dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """Faults of a network: the same for both directions, drawn for each datagram."""

    drop: float = 0.0
    """Probability that a packet is lost, 0 to 1: a datagram, or each fragment of it (`mtu`)."""
    duplicate: float = 0.0
    """Probability that a datagram comes twice, 0 to 1: the second up to `reorder_by` later."""
    reorder: float = 0.0
    """Probability that it is held back, 0 to 1, so that later ones overtake it."""
    truncate: float = 0.0
    """Probability that its end is cut off, 0 to 1: 0 bytes to all but one are left."""
    corrupt: float = 0.0
    """Probability that one to four of its bits are flipped, 0 to 1."""
    delay: float = 0.0
    """Time that every datagram is held, s."""
    jitter: float = 0.0
    """Longest time that it is held in addition, s: uniform from 0."""
    reorder_by: float = 0.002
    """Longest time that a reordered one or a second copy is held in addition, s: uniform from 0."""
    mtu: int = 0
    """Largest IP packet of the path, bytes, 68 to 65,535; 0: no limit. A larger datagram travels in
    several packets and is lost if one of them is lost."""
    black_hole: bool = False
    """Whether a datagram larger than `mtu` is always lost, as behind a router that drops
    fragments."""
    seed: int = 0
    """The same seed gives each client's datagrams the same fates, by their order."""

    def __post_init__(self) -> None:
        seed, mtu = self.seed, self.mtu
        expect(type(seed) is int, "seed", "a whole number", f"{seed!r}")
        right = type(mtu) is int and (mtu == 0 or 68 <= mtu <= _LARGEST)
        expect(right, "mtu", f"0 or 68 to {_LARGEST} bytes", f"{mtu!r}")
        expect(mtu or not self.black_hole, "black_hole", "an mtu with it", "none")
        for names, most, expected in (
            ("drop duplicate reorder truncate corrupt", 1, "a probability from 0 to 1"),
            ("delay jitter reorder_by", 3600, "seconds from 0 to 3600"),
        ):
            for name in names.split():
                value = getattr(self, name)
                right = isinstance(value, int | float) and 0 <= value <= most
                expect(right, name, expected, f"{value!r}")


class Faults:
    """Decides the fates of the datagrams of one stream: one direction of one client.

    Its random numbers depend on its name and the seed only, so not on how streams interleave.
    `counters` holds `received`, `forwarded` (copies that come out: received − dropped +
    duplicated), `dropped`, `duplicated`, `reordered`, `truncated` and `corrupted`.
    """

    def __init__(
        self, config: FaultConfig, stream: str = "", counters: Counter[str] | None = None
    ) -> None:
        self.config = config
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._random = random.Random(f"{config.seed}/{stream}").random

    def fate(self, datagram: bytes) -> list[tuple[float, bytes]]:
        """The copies that come out of a datagram: delay, s, and bytes; empty if it is dropped.

        Both copies of a duplicated datagram hold the same bytes.
        """
        config, count = self.config, self.counters
        # As many numbers for each datagram, so that fates do not depend on what came before.
        drop, duplicate, reorder, truncate, corrupt, jitter, hold, lag, *places = [
            self._random() for _ in range(14)
        ]
        count["received"] += 1
        packets = _packets(len(datagram), config.mtu)
        if (config.black_hole and packets > 1) or drop < 1 - (1 - config.drop) ** packets:
            count["dropped"] += 1
            return []
        if truncate < config.truncate and datagram:
            count["truncated"] += 1
            datagram = datagram[: int(places[0] * len(datagram))]
        if corrupt < config.corrupt and datagram:
            count["corrupted"] += 1
            datagram = _flip(datagram, places[2 : 3 + int(places[1] * 4)])
        delay = config.delay + jitter * config.jitter
        out = [(delay, datagram)]
        if reorder < config.reorder:
            count["reordered"] += 1
            out = [(delay + hold * config.reorder_by, datagram)]
        if duplicate < config.duplicate:
            count["duplicated"] += 1
            out.append((delay + lag * config.reorder_by, datagram))
        count["forwarded"] += len(out)
        return out


def _packets(size: int, mtu: int) -> int:
    """Number of IP packets that carry a datagram of so many bytes."""
    whole = size + _UDP_HEADER  # fragments but the last carry a multiple of 8 bytes
    return 1 if not mtu or whole <= mtu - _IP_HEADER else -(-whole // ((mtu - _IP_HEADER) & ~7))


def _flip(datagram: bytes, places: list[float]) -> bytes:
    """Flip the bits at these places, 0 to 1 of the length; the same bit twice is flipped once."""
    flipped = bytearray(datagram)
    for bit in {int(place * 8 * len(datagram)) for place in places}:
        flipped[bit >> 3] ^= 1 << (bit & 7)
    return bytes(flipped)


@dataclass(eq=False, slots=True)
class _Client:
    address: Address
    upstream: socket.socket  # connected to the server, for this client alone
    faults: tuple[Faults, Faults]  # of what goes to the client, and of what goes to the server
    seen: float = 0.0


class Relay:
    """Carries datagrams between the clients that send to `address` and a server, with faults.

    Each client has a socket of its own towards the server, as behind a NAT, so that the server
    tells them apart. Clients are numbered from 1 as they come; number and direction name a stream.

    `counters` holds those of `Faults`, over all clients and both directions, and two more of lost
    datagrams: `unreachable` (ICMP errors: no program listens there) and `unsent` (the system
    did not send, because of a full buffer for example, or too much is held back).

    Args:
        listen: Address (host, port) that clients send to; port 0 takes a free port.
        server: Address of the agent.
        config: The faults; by default none.
        insecure: Allow addresses that are not loopback; the relay authenticates no datagram.

    Attributes:
        address: Address that clients send to.

    Raises:
        InputError: An address is wrong.
        OSError: The port is in use.
    """

    def __init__(
        self,
        listen: Address,
        server: Address,
        config: FaultConfig | None = None,
        *,
        insecure: bool = False,
    ) -> None:
        self.config = config or FaultConfig()
        self.counters: Counter[str] = Counter()
        self.server = resolve(server, insecure=insecure, way_out=_WAY_OUT)
        expect(self.server[1], "server", "the port of the agent, 1 to 65535", "0")
        differs = self.server != resolve(listen, insecure=insecure, way_out=_WAY_OUT)
        expect(differs, "listen", "another address than the server's", f"{listen}")
        self._any = ("0.0.0.0" if insecure else "127.0.0.1", 0)
        self._clients: OrderedDict[Address, _Client] = OrderedDict()
        self._last_number = 0
        self._held: list[tuple[float, int, bytes, _Client, bool]] = []
        self._held_numbers = itertools.count()
        self._stopped = threading.Event()
        self._running = threading.Lock()
        self._socket = open_socket(listen, insecure=insecure)
        # Not epoll, which counts whole milliseconds.
        self._selector = selectors.SelectSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self.address: Address = self._socket.getsockname()

    def run(self) -> None:
        """Carry datagrams until `stop` is called, by another thread or a signal handler.

        A relay runs once. Datagrams that are held back at its end are lost.
        """
        with self._running:
            while not self._stopped.is_set():
                self._forget()
                for key, _ in self._selector.select(self._send_due()):
                    self._take(key.data)

    def stop(self) -> None:
        """End `run`, now or when it is called, within 50 ms."""
        self._stopped.set()

    def close(self) -> None:
        """Stop, wait for `run` to end in its thread, and close the sockets."""
        self.stop()
        with self._running:
            self._selector.close()
            self._socket.close()
            for client in self._clients.values():
                client.upstream.close()

    def __enter__(self) -> "Relay":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, client: _Client | None) -> None:
        """Read one datagram, of a client's upstream socket or (None) of some client."""
        try:
            if client is not None:
                datagram, upward = client.upstream.recv(_LARGEST), False
            else:
                datagram, address = self._socket.recvfrom(_LARGEST)
                client, upward = self._clients.get(address) or self._new_client(address), True
        except BlockingIOError:  # its checksum was wrong
            return
        except OSError:  # ICMP says that an earlier one did not arrive
            self.counters["unreachable"] += 1
            return
        if client is None:  # no socket is left for it
            return
        now = client.seen = time.perf_counter()
        self._clients.move_to_end(client.address)
        for delay, copy in client.faults[upward].fate(datagram):
            if len(self._held) >= _MAX_HELD:
                self.counters["unsent"] += 1
                continue
            number = next(self._held_numbers)  # those of the same time leave as they came
            heappush(self._held, (now + delay, number, copy, client, upward))

    def _send_due(self) -> float:
        """Send what is due. Returns the time until more is due, s."""
        while self._held:
            left = self._held[0][0] - time.perf_counter()
            if left > 0:
                return min(left, _NAP)
            _, _, datagram, client, upward = heappop(self._held)
            try:
                if upward:
                    client.upstream.send(datagram)
                else:
                    self._socket.sendto(datagram, client.address)
            except ConnectionError:
                self.counters["unreachable"] += 1
            except OSError:  # a full buffer, a network that is down, a client forgotten meanwhile
                self.counters["unsent"] += 1
        return _NAP

    def _new_client(self, address: Address) -> _Client | None:
        try:
            upstream = open_socket(self._any, insecure=self._any[0] == "0.0.0.0", peer=self.server)
        except OSError:  # too many open files, or no way there
            self.counters["unsent"] += 1
            return None
        self._last_number += 1
        down = Faults(self.config, f"down/{self._last_number}", self.counters)
        up = Faults(self.config, f"up/{self._last_number}", self.counters)
        client = self._clients[address] = _Client(address, upstream, (down, up))
        self._selector.register(upstream, selectors.EVENT_READ, client)
        return client

    def _forget(self) -> None:
        """Forget clients that are idle for too long, and the longest idle if there are too many."""
        now = time.perf_counter()
        while self._clients:
            client = next(iter(self._clients.values()))
            if len(self._clients) <= _MAX_CLIENTS and now - client.seen <= _IDLE:
                return
            del self._clients[client.address]
            self._selector.unregister(client.upstream)
            client.upstream.close()
