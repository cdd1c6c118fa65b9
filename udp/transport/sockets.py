"""Sockets: open them, with a clear sentence for each error, and wait on them.

A process that was asleep computes two to three times slower for a while: its core was asleep too.
So a wait in a lock-step first looks again and again for as long as a step takes, and sleeps only
then. Looking costs others the processor, so it ends where it does not pay: each wait in which
nothing came, or in which another process had the core, lets more of the next waits sleep at once.
`studies/waiting.py` measures both ways, beside processes that want the same cores.
"""

import errno
import ipaddress
import select
import selectors
import socket
import sys
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from math import ceil

from ...models import InputError
from ..protocol.client import Address, address_text

LONGEST_WAIT = 0.1
"""Longest wait in one go, s: flags that other threads and signals set are looked at as often."""
PAUSE = 1.0
"""If a wait takes longer than it should by this time, s, this process was stopped meanwhile."""

_LOOK = 200e-6  # look of a wait before it sleeps, s: a step of one drone takes less
_LOST = 60e-6  # time between two looks if another process had the core, s; else 2e-6
_MAX_ASLEEP = 64  # waits at most that sleep at once before one looks again
_STRANGERS_EVERY = 0.01  # time between two looks at strangers while no slot is free, s
_BUFFER = 1 << 22  # bytes of datagrams that a socket may hold until they are looked at
_MAX_DATAGRAM = 65507  # largest payload of a UDP datagram over IPv4, bytes
WAY_OUT = (
    "a key that both sides share (key_file, --key-file), or insecure=True (--insecure) where "
    "everybody who reaches this port may fly the drone"
)
EVENTS_WAY_OUT = "a key that both sides share (key_file, --key-file), where agents ask for events"
TEXT_WAY_OUT = (
    "the binary codec and a key, or insecure=True (--insecure) where everybody who reaches this "
    "port may fly the drone: text cannot be sealed"
)
_SENTENCES = {
    errno.EADDRINUSE: "the port is in use: choose another one, or end the program on it",
    errno.EADDRNOTAVAIL: "this machine has no such address",
    errno.EACCES: "ports below 1024 need more rights: choose a higher one",
    errno.EINVAL: "a loopback address reaches this machine only: bind another one",
}


def resolve(address: Address, *, insecure: bool, way_out: str = WAY_OUT) -> Address:
    """The IPv4 address and port of a host name and port.

    Args:
        insecure: Allow any address; otherwise loopback ones only. Set where a key protects.
        way_out: What allows any address, in words.

    Raises:
        InputError: It is not an address, or not a loopback one and `insecure` is not set.
    """
    match address:
        case (str(host), int(port)) if type(port) is int and 0 <= port <= 65535:
            pass
        case _:
            raise InputError(f"address: expected (host, port from 0 to 65535), got {address!r}")
    try:
        found = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)
    except (socket.gaierror, UnicodeError):
        raise InputError(f"host: expected a name or IPv4 address, got {host!r}") from None
    number = str(found[0][4][0])
    if not (insecure or ipaddress.ip_address(number).is_loopback):
        raise InputError(f"{host} is not a loopback address: expected 127.0.0.1, or {way_out}")
    return number, port


class Socket(socket.socket):
    """A UDP socket over IPv4 that never blocks, but in `receive`."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.setblocking(False)
        with suppress(OSError):  # room for the fragments of a large message, if the system has it
            self.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._poll = select.poll()
        self._poll.register(self.fileno(), select.POLLIN)
        self._asleep = 0  # of the next waits so many sleep at once
        self._row = 1  # and so many after the next wait in which nothing came

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        """The next datagram and where it came from.

        Raises:
            TimeoutError: Nothing came within `timeout`, s, or a millisecond more, or
                `LONGEST_WAIT`: look at the clock.
            OSError: An earlier datagram came back, or the socket is closed.
        """
        if self._asleep:
            self._asleep -= 1
        else:
            begin = now = time.monotonic()
            until = begin + min(timeout, _LOOK)
            while now < until:
                try:
                    came = self.recvfrom(_MAX_DATAGRAM)
                except BlockingIOError:
                    before = now
                    now = time.monotonic()
                    if now - before > _LOST:
                        self._row = _MAX_ASLEEP
                        break
                else:
                    self._row = max(1, self._row // 2)
                    return came
            self._asleep = self._row = min(4 * self._row, _MAX_ASLEEP)
        timeout = min(timeout, LONGEST_WAIT)
        self._poll.poll(ceil(1e3 * timeout))
        try:  # OSError if another thread has closed it
            return self.recvfrom(_MAX_DATAGRAM)
        except BlockingIOError:
            raise TimeoutError from None


def open_socket(bind: Address, *, insecure: bool, peer: Address | None = None) -> Socket:
    """A UDP socket bound to an address. Port 0 takes a free one.

    With a resolved `peer` it is connected: the kernel drops what others send.

    Raises:
        InputError: The address is not one of this machine's, or is not loopback and `insecure` is
            not set.
        OSError: The port is taken or may not be bound, or the peer cannot be reached from here.
    """
    address = resolve(bind, insecure=insecure)
    sock = Socket()
    what = f"bind {address_text(bind)}"
    try:
        sock.bind(address)
        if peer is not None:
            what = f"send to {address_text(peer)} from {address_text(bind)}"
            sock.connect(peer)
    except OSError as error:
        sock.close()
        why = _SENTENCES.get(error.errno or 0, error.strerror)
        raise OSError(error.errno, f"cannot {what}: {why}") from None
    return sock


class Port:
    """The agent's port: a socket for all senders and, if the system can, one for each simulator.

    Those are connected, so that the system sorts the datagrams, each socket has a buffer of its
    own, and no other sender can fill the one of a simulator. `address` is listened on. `peers`,
    resolved, are known from the start; if there is one, it has the only socket.

    Raises:
        InputError, OSError: As `open_socket`.
    """

    def __init__(self, address: Address, *, insecure: bool, peers: Sequence[Address] = ()) -> None:
        only = peers[0] if len(peers) == 1 else None
        self._everybody = open_socket(address, insecure=insecure, peer=only)
        self.address: Address = self._everybody.getsockname()
        self._only = only
        self._own: dict[Address, Socket] = {}
        self._simulators = selectors.DefaultSelector()
        self._all = selectors.DefaultSelector()
        self._selectors = self._simulators, self._all
        self._all.register(self._everybody, selectors.EVENT_READ)
        self._missing = False  # whether a simulator's datagrams come to the socket for all senders
        self._next_look = 0.0
        if only is None:
            self.keep(peers)

    def keep(self, peers: Collection[Address]) -> None:
        """Have a socket for each of these, and no others."""
        wanted = set(peers)
        for peer in self._own.keys() - wanted:
            sock = self._own.pop(peer)
            for selector in self._selectors:
                selector.unregister(sock)
            sock.close()
        if sys.platform == "linux":  # others sort the datagrams of one port by other rules
            for peer in wanted - self._own.keys():
                self._add(peer)
        self._missing = len(self._own) < len(wanted)

    def receive(self, timeout: float, *, strangers: bool = False) -> tuple[bytes, Address]:
        """The next datagram and where it came from.

        Args:
            timeout: Longest wait, s.
            strangers: Wait for datagrams of strangers too. Otherwise they are looked at only now
                and then.

        Raises:
            TimeoutError, OSError: As `Socket.receive`; a wait may end early.
        """
        if self._only:
            return self._everybody.receive(timeout)
        if strangers or self._missing or not self._own:
            return _receive_any(self._all, timeout)
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + _STRANGERS_EVERY
            try:
                return self._everybody.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                pass
        if len(self._own) > 1:
            return _receive_any(self._simulators, timeout)
        (only,) = self._own.values()
        return only.receive(timeout)

    def send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram. Raises `OSError`."""
        if self._only:
            self._everybody.send(datagram)
            return
        sock = self._own.get(address)
        if sock:
            try:
                sock.send(datagram)
                return
            except ConnectionError:  # an earlier datagram found nobody: this was not sent
                pass
        self._everybody.sendto(datagram, address)

    @property
    def closed(self) -> bool:
        """Whether it was, maybe by another thread."""
        return self._everybody.fileno() < 0

    def close(self) -> None:
        """Close every socket."""
        self.keep(())
        for each in (*self._selectors, self._everybody):
            each.close()

    def _add(self, peer: Address) -> None:
        try:
            sock = Socket()
        except OSError:  # too many open files
            return
        try:
            # Not SO_REUSEADDR, with which another user could take the port in this moment.
            for one in (self._everybody, sock):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            sock.bind(self.address)
            sock.connect(peer)
        except OSError:  # then its datagrams come to the socket for all senders
            sock.close()
            return
        finally:
            self._everybody.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)
        self._own[peer] = sock
        for selector in self._selectors:
            selector.register(sock, selectors.EVENT_READ)


def _receive_any(selector: selectors.BaseSelector, timeout: float) -> tuple[bytes, Address]:
    """As `Socket.receive`, from any of several sockets, without looking first."""
    for key, _ in selector.select(min(timeout, LONGEST_WAIT)):
        assert isinstance(key.fileobj, socket.socket)
        datagram, address = key.fileobj.recvfrom(_MAX_DATAGRAM)
        return datagram, address
    raise TimeoutError
