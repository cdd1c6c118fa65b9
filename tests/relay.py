"""A bad network on purpose: a seeded relay between simulators (clients) and an agent (server)."""

import random
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count
from typing import Any

Address = tuple[str, int]
ANY = ("127.0.0.1", 0)
_NAP = 0.04  # longest wait before the relay looks whether it was stopped, s


@dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """Probabilities of faults, drawn for each datagram in both directions."""

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    truncate: float = 0.0
    corrupt: float = 0.0
    reorder_by: float = 0.002
    """Longest time that a reordered datagram or a second copy is held, s."""
    largest: int = 65_535
    """Larger datagrams are lost, as behind a router that drops fragments, bytes."""
    seed: int = 0


@dataclass
class Faults:
    """Fates of the datagrams of one stream: one direction of one client."""

    config: FaultConfig
    stream: str = ""
    counters: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._random = random.Random(f"{self.config.seed}/{self.stream}").random

    def fate(self, datagram: bytes) -> list[tuple[float, bytes]]:
        """The copies that come out: delay, s, and bytes; empty if it is dropped."""
        config = self.config
        # The same number of draws for each datagram: fates do not depend on earlier datagrams.
        drop, duplicate, reorder, truncate, corrupt, hold, lag, *draws = [
            self._random() for _ in range(13)
        ]
        self.counters["received"] += 1
        if drop < config.drop or len(datagram) > config.largest:
            self.counters["dropped"] += 1
            return []
        if truncate < config.truncate and datagram:
            self.counters["truncated"] += 1
            datagram = datagram[: int(draws[0] * len(datagram))]
        if corrupt < config.corrupt and datagram:
            self.counters["corrupted"] += 1
            flipped = bytearray(datagram)
            for bit in {int(draw * 8 * len(datagram)) for draw in draws[2 : 3 + int(draws[1] * 4)]}:
                flipped[bit >> 3] ^= 1 << (bit & 7)
            datagram = bytes(flipped)
        late = reorder < config.reorder
        out = [(hold * config.reorder_by if late else 0.0, datagram)]
        self.counters["reordered"] += late
        if duplicate < config.duplicate:
            self.counters["duplicated"] += 1
            out.append((lag * config.reorder_by, datagram))
        self.counters["forwarded"] += len(out)
        return out


def udp_socket(bind: Address = ANY, peer: Address | None = None) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(bind)
    if peer:
        sock.connect(peer)
    sock.settimeout(5)
    return sock


class Relay:
    """Carries datagrams between the clients that send to `address` and a server, with faults.

    Each client has a socket of its own towards the server, as behind a NAT. Clients are numbered
    from 1 as they come; number and direction name a stream of faults.
    """

    def __init__(self, server: Address, config: FaultConfig) -> None:
        self.server = server
        self.config = config
        self.counters: Counter[str] = Counter()
        self._clients: dict[Address, Any] = {}  # its socket to the server, faults down and up
        self._held: list[tuple[float, int, bytes, Address, bool]] = []
        self._numbers = count()
        self._stopped = threading.Event()
        self._socket = udp_socket()
        self._selector = selectors.SelectSelector()  # epoll counts whole milliseconds
        self._selector.register(self._socket, selectors.EVENT_READ)
        self.address: Address = self._socket.getsockname()

    def run(self) -> None:
        """Carry datagrams until `stop` is called."""
        while not self._stopped.is_set():
            for key, _ in self._selector.select(self._send_due()):
                with suppress(OSError):  # an earlier datagram found nobody
                    self._take(key.data)

    def stop(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        self._selector.close()
        for sock in (self._socket, *(client[0] for client in self._clients.values())):
            sock.close()

    def _take(self, client: Address | None) -> None:
        """Read one datagram, from the server for a client, or (None) from some client."""
        upward = client is None
        if client is None:
            datagram, client = self._socket.recvfrom(65_535)
            if client not in self._clients:
                self._add(client)
        else:
            datagram = self._clients[client][0].recv(65_535)
        now = time.perf_counter()
        for delay, copy in self._clients[client][1 + upward].fate(datagram):
            heappush(self._held, (now + delay, next(self._numbers), copy, client, upward))

    def _add(self, client: Address) -> None:
        upstream = udp_socket(peer=self.server)
        number = len(self._clients) + 1
        down, up = (Faults(self.config, f"{d}/{number}", self.counters) for d in ("down", "up"))
        self._clients[client] = upstream, down, up
        self._selector.register(upstream, selectors.EVENT_READ, client)

    def _send_due(self) -> float:
        """Send what is due. Returns the time until more is due, s."""
        while self._held:
            left = self._held[0][0] - time.perf_counter()
            if left > 0:
                return min(left, _NAP)
            _, _, datagram, client, upward = heappop(self._held)
            with suppress(OSError):  # as good as lost
                if upward:
                    self._clients[client][0].send(datagram)
                else:
                    self._socket.sendto(datagram, client)
        return _NAP


@contextmanager
def relaying(server: Address, config: FaultConfig | None = None) -> Iterator[Relay]:
    """A relay to that server, running in a thread."""
    relay = Relay(server, config or FaultConfig())
    thread = threading.Thread(target=relay.run)
    thread.start()
    try:
        yield relay
    finally:
        relay.stop()
        thread.join(5)
        relay.close()
    assert not thread.is_alive()


if __name__ == "__main__":  # a relay for each server until standard input closes: see studies/
    import json
    import sys
    from contextlib import ExitStack

    servers, faults = json.loads(sys.argv[1])
    with ExitStack() as stack:
        relays = [
            stack.enter_context(relaying(tuple(server), FaultConfig(**{"seed": seed, **faults})))
            for seed, server in enumerate(servers)
        ]
        print(json.dumps([relay.address for relay in relays]), flush=True)
        sys.stdin.read()
        print(json.dumps([relay.counters for relay in relays]), flush=True)
