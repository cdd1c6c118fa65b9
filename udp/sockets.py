"""Sockets: opening them, with a clear sentence for what can be wrong, and waiting on them."""

import errno
import ipaddress
import logging
import os
import selectors
import socket
import sys
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any, Final

from .binary import MAX_DATAGRAM
from .link import Address
from .statistics import Statistics

__all__ = [
    "LARGE",
    "Port",
    "address_text",
    "is_loopback",
    "log_notices",
    "open_socket",
    "pause_between_parts",
    "receive",
    "resolve",
]

_log: Final = logging.getLogger("rotorgram.udp")
_ATTENTION: Final = 300e-6
"""How long a wait looks again and again before it sleeps, s."""
_STRANGERS_EVERY: Final = 0.01
"""While every place is taken, a datagram of a stranger is looked at so often, s."""
_BUFFER: Final = 1 << 22
"""Bytes of datagrams that a socket may hold until they are looked at."""
LARGE: Final = 16_384
"""Datagrams of more bytes are not sent many at once."""
_AT_ONCE: Final = 3
"""Datagrams of a message in parts that are sent without a pause: as many as fit into the smallest
buffer that systems give, and"""
_PAUSE: Final = 200e-6
"""how long they are given to be taken out, s."""
_LONGEST: Final = 3600.0
"""Longest wait in one go, s: the system counts milliseconds in an int, and longer ones wrap."""
_give_way: Final[Callable[[], None]] = getattr(os, "sched_yield", lambda: time.sleep(0))


def address_text(address: Address) -> str:
    """An address as it is written: host:port."""
    return f"{address[0]}:{address[1]}"


def is_loopback(address: Address) -> bool:
    """Whether a resolved address reaches this machine only."""
    return ipaddress.ip_address(address[0]).is_loopback


def resolve(address: Address, *, insecure: bool) -> Address:
    """The IPv4 address and port of a host name and port.

    Args:
        insecure: Allow any address; otherwise loopback ones only. Set where a key protects.

    Raises:
        ValueError: It is not an address, or not a loopback one and `insecure` is not set.
    """
    try:
        host, port = address
        valid = isinstance(host, str) and type(port) is int and 0 <= port <= 65535
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise ValueError(f"address: expected (host, port from 0 to 65535), got {address!r}")
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (socket.gaierror, UnicodeError):
        raise ValueError(f"host: expected a name or IPv4 address, got {host!r}") from None
    number = str(found[0][4][0])
    if not insecure and not is_loopback((number, port)):
        raise ValueError(
            f"{host} is not a loopback address: expected 127.0.0.1, or a key that both sides share "
            "(key_file, --key-file), or insecure=True (--insecure) where everybody who reaches "
            "this port may fly the drone"
        )
    return number, port


def open_socket(bind: Address, *, insecure: bool, peer: Address | None = None) -> socket.socket:
    """A UDP socket bound to an address, to be read with `receive`; port 0 takes a free one.

    With a resolved `peer` it is connected: the kernel drops what others send.

    Raises:
        ValueError: The address is not one of this machine's, or is not loopback and `insecure` is
            not set.
        OSError: The port is taken or may not be bound, or the peer cannot be reached from here.
    """
    address = resolve(bind, insecure=insecure)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    what = f"bind {address_text(bind)}"
    try:
        sock.bind(address)
        if peer is not None:
            what = f"send to {address_text(peer)} from {address_text(bind)}"
            sock.connect(peer)
    except OSError as error:
        sock.close()
        raise OSError(error.errno, f"cannot {what}: {_explain(error)}") from None
    _enlarge_buffer(sock)
    sock.setblocking(False)
    return sock


def _enlarge_buffer(sock: socket.socket) -> None:
    """Ask for room for the parts of a large message; the system gives what it allows."""
    with suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)


def _explain(error: OSError) -> str:
    sentences = {
        errno.EADDRINUSE: "the port is in use: choose another one, or end the program on it",
        errno.EADDRNOTAVAIL: "this machine has no such address",
        errno.EACCES: "ports below 1024 need more rights: choose a higher one",
        errno.EINVAL: "a loopback address reaches this machine only: bind another one",
    }
    return sentences.get(error.errno or 0, str(error.strerror))


def receive(sock: socket.socket, timeout: float) -> tuple[bytes, Address]:
    """The next datagram and where it came from.

    In lock-step the answer is mostly a few dozen microseconds away, and a processor that falls
    asleep meanwhile takes longer than that to wake up. So this looks again for a moment, giving
    way to whoever else wants the processor, before it sleeps.

    Raises:
        TimeoutError: Nothing came within `timeout`, s, or an hour: look at the clock.
        OSError: An earlier datagram came back, or the socket is closed.
    """
    # Not time.monotonic, which ticks every 16 ms on Windows.
    until = time.perf_counter() + min(timeout, _ATTENTION)
    while time.perf_counter() < until:
        try:
            return sock.recvfrom(MAX_DATAGRAM)
        except BlockingIOError:
            _give_way()
    try:
        sock.settimeout(min(max(timeout - _ATTENTION, _ATTENTION), _LONGEST))
        return sock.recvfrom(MAX_DATAGRAM)
    finally:
        sock.setblocking(False)


class Port:
    """The agent's port: a socket for everybody and, where the system can, one for each simulator.

    Those are connected, so that the system sorts the datagrams, each socket has a buffer of its
    own, and nobody else can fill the one of a simulator, however fast he sends.

    Raises:
        ValueError, OSError: As `open_socket`.
    """

    def __init__(self, address: Address, *, insecure: bool) -> None:
        self._everybody = open_socket(address, insecure=insecure)
        self._own: dict[Address, socket.socket] = {}
        self._simulators = selectors.DefaultSelector()
        self._all = selectors.DefaultSelector()
        self._all.register(self._everybody, selectors.EVENT_READ)
        self._missing = False  # whether a simulator's datagrams come to the socket for everybody
        self._next_look = 0.0

    @property
    def address(self) -> Address:
        """Address that is listened on."""
        host, port = self._everybody.getsockname()
        return host, port

    def keep(self, peers: Collection[Address]) -> None:
        """Have a socket for each of these, and for nobody else."""
        for peer in self._own.keys() - set(peers):
            sock = self._own.pop(peer)
            for selector in (self._simulators, self._all):
                selector.unregister(sock)
            sock.close()
        if sys.platform == "linux":  # others sort the datagrams of one port by other rules
            for peer in set(peers) - self._own.keys():
                self._add(peer)
        self._missing = len(self._own) < len(set(peers))

    def receive(self, timeout: float, *, strangers: bool) -> tuple[bytes, Address]:
        """The next datagram and where it came from.

        Args:
            timeout: Longest wait, s.
            strangers: Whether one from anybody is as welcome as one of a simulator. Otherwise they
                are looked at only now and then.

        Raises:
            TimeoutError, OSError: As the function `receive`; a wait may end early.
        """
        if not self._own:
            return receive(self._everybody, timeout)
        if strangers or self._missing:
            return _receive_any(self._all, timeout)
        now = time.perf_counter()
        if now >= self._next_look:
            self._next_look = now + _STRANGERS_EVERY
            with suppress(BlockingIOError):
                return self._everybody.recvfrom(MAX_DATAGRAM)
        timeout = min(timeout, _STRANGERS_EVERY)
        if len(self._own) > 1:
            return _receive_any(self._simulators, timeout)
        (only,) = self._own.values()
        return receive(only, timeout)

    def send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram. Raises `OSError`."""
        self._everybody.sendto(datagram, address)

    def close(self) -> None:
        """Close every socket."""
        self.keep(())
        self._simulators.close()
        self._all.close()
        self._everybody.close()

    def _add(self, peer: Address) -> None:
        try:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        except OSError:  # too many open files
            return
        try:
            # Only for this moment: the port is nobody else's.
            for one in (self._everybody, sock):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(self._everybody.getsockname())
            sock.connect(peer)
        except OSError:  # then its datagrams come to the socket for everybody
            sock.close()
            return
        finally:
            self._everybody.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        _enlarge_buffer(sock)
        sock.setblocking(False)
        self._own[peer] = sock
        for selector in (self._simulators, self._all):
            selector.register(sock, selectors.EVENT_READ)


def _receive_any(selector: selectors.BaseSelector, timeout: float) -> tuple[bytes, Address]:
    """As `receive`, from any of several sockets."""
    until = time.perf_counter() + min(timeout, _ATTENTION)
    ready = selector.select(0)
    while not ready and time.perf_counter() < until:
        _give_way()
        ready = selector.select(0)
    ready = ready or selector.select(min(max(timeout - _ATTENTION, _ATTENTION), _LONGEST))
    for key, _ in ready:
        sock: Any = key.fileobj
        datagram, address = sock.recvfrom(MAX_DATAGRAM)
        return datagram, address
    raise TimeoutError


def pause_between_parts(number: int) -> None:
    """Wait a moment after every few datagrams that are sent in one go.

    Args:
        number: Of the datagram that is about to be sent, from 0.
    """
    if number and number % _AT_ONCE == 0:
        time.sleep(_PAUSE)


def log_notices(statistics: Statistics, now: float) -> None:
    """Write to the log `rotorgram.udp` what there is to say: warnings, and a report each minute."""
    for notice in statistics.take_notices():
        _log.warning("%s", notice)
    if statistics.report_due(now):
        _log.info("wire: %s", statistics)
