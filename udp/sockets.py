"""Sockets: opening them, with a clear sentence for what can be wrong, and waiting on them."""

import errno
import ipaddress
import os
import socket
import time
from collections.abc import Callable
from typing import Final

from .binary import MAX_DATAGRAM
from .link import Address

__all__ = ["address_text", "open_socket", "receive", "resolve"]

_ATTENTION: Final = 300e-6
"""How long a wait looks again and again before it sleeps, s."""
_LONGEST: Final = 3600.0
"""Longest wait in one go, s: the system counts milliseconds in an int, and longer ones wrap."""
_give_way: Final[Callable[[], None]] = getattr(os, "sched_yield", lambda: time.sleep(0))


def address_text(address: Address) -> str:
    """An address as it is written: host:port."""
    return f"{address[0]}:{address[1]}"


def resolve(address: Address, *, insecure: bool) -> Address:
    """The IPv4 address and port of a host name and port.

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
    if not insecure and not ipaddress.ip_address(number).is_loopback:
        raise ValueError(
            f"{host} is not a loopback address: expected 127.0.0.1, or insecure=True "
            "(--insecure) where everybody who reaches this port may fly the drone"
        )
    return number, port


def open_socket(bind: Address, *, insecure: bool, peer: Address | None = None) -> socket.socket:
    """A UDP socket bound to an address, to be read with `receive`; port 0 takes a free one.

    With a resolved `peer` it is connected: the kernel drops what others send.

    Raises:
        ValueError: The address is not one of this machine's, or is not loopback and `insecure` is
            not set: datagrams are not authenticated.
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
    sock.setblocking(False)
    return sock


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
