"""The agent's port: strangers cannot fill a simulator's buffer, nor take the port."""

import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
from rotorgram.udp.transport import sockets
from rotorgram.udp.transport.sockets import Port, open_socket

ANY = ("127.0.0.1", 0)


@pytest.fixture
def port() -> Iterator[Port]:
    port = Port(ANY, insecure=False)
    yield port
    port.close()


@pytest.fixture
def others() -> Iterator[list[socket.socket]]:
    socks = [open_socket(ANY, insecure=False) for _ in range(3)]
    yield socks
    for sock in socks:
        sock.close()


def test_each_simulator_and_everybody_else(port: Port, others: list[socket.socket]) -> None:
    one, two, _ = others
    port.keep([one.getsockname(), two.getsockname()])
    for sock in others:
        sock.sendto(b"%d" % sock.getsockname()[1], port.address)
    seen = set()
    for _ in others:
        datagram, address = port.receive(1.0, strangers=True)
        assert int(datagram) == address[1]
        seen.add(address)
    assert seen == {sock.getsockname() for sock in others}
    port.send(b"back", one.getsockname())
    one.settimeout(1)
    assert one.recvfrom(100) == (b"back", port.address)
    with pytest.raises(TimeoutError):
        port.receive(0.01, strangers=True)


@pytest.mark.skipif(sys.platform != "linux", reason="one socket for all elsewhere")
@pytest.mark.parametrize("simulators", [1, 2])
def test_a_flood_leaves_the_simulators_their_buffer(
    port: Port, others: list[socket.socket], simulators: int
) -> None:
    *known, stranger = others
    port.keep([sock.getsockname() for sock in known[:simulators]])
    for _ in range(20_000):  # far more than a buffer holds
        stranger.sendto(bytes(500), port.address)
    for sock in known[:simulators]:
        sock.sendto(b"state", port.address)
    got = []
    for _ in range(10):
        with suppress(TimeoutError):
            got.append(port.receive(0.1, strangers=False)[0])
    assert got.count(b"state") == simulators
    assert got.count(bytes(500)) <= 10


def test_a_simulator_that_has_left_is_a_stranger_again(
    port: Port, others: list[socket.socket]
) -> None:
    one = others[0]
    for _ in range(3):
        port.keep([one.getsockname()])
        one.sendto(b"own", port.address)
        assert port.receive(1.0, strangers=False)[0] == b"own"
        port.keep([])
        one.sendto(b"any", port.address)
        assert port.receive(1.0, strangers=True)[0] == b"any"


def test_the_port_is_nobody_elses(port: Port, others: list[socket.socket]) -> None:
    for peers in ([], [others[0].getsockname()]):
        port.keep(peers)
        with pytest.raises(OSError, match="the port is in use"):
            open_socket(port.address, insecure=False)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with pytest.raises(OSError, match="in use"):
                thief.bind(port.address)


@pytest.mark.skipif(sys.platform != "linux", reason="one socket for all elsewhere")
def test_the_port_cannot_be_taken_while_a_simulator_joins(
    port: Port, others: list[socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:  # fault 30
    """A thief tries in the very moment; another user has no other way than SO_REUSEADDR."""
    tried = []
    bind = socket.socket.bind

    class Socket(sockets.Socket):
        def bind(self, address: object) -> None:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
                thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                with pytest.raises(OSError, match="in use"):
                    bind(thief, address)
                tried.append(address)
            super().bind(address)

    monkeypatch.setattr("rotorgram.udp.transport.sockets.Socket", Socket)
    port.keep([others[0].getsockname()])
    assert tried == [port.address]


class Quiet(sockets.Socket):
    """Nothing ever comes; it has a clock of its own, and counts how often one looks."""

    looks = 0
    now = 0.0
    pace = 2e-6

    def recvfrom(self, *_: object) -> Any:
        self.looks += 1
        raise BlockingIOError

    def monotonic(self) -> float:
        self.now += self.pace
        return self.now

    def waits(self, count: int) -> list[int]:
        """How often each of so many waits looks before it sleeps."""
        looks = []
        for _ in range(count):
            before = self.looks
            with pytest.raises(TimeoutError):
                self.receive(0.05)
            looks.append(self.looks - before - 1)
        return looks


def test_waits_look_for_a_moment_and_seldom_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fault 17: looking costs the processor."""
    slept: list[float] = []
    poll = SimpleNamespace(poll=lambda milliseconds: slept.append(milliseconds / 1000))
    with Quiet() as sock:
        sock._poll = poll
        monkeypatch.setattr(sockets, "time", sock)
        looks = sock.waits(200)
        assert [wait for wait, count in enumerate(looks) if count] == [0, 5, 22, 87, 152]
        assert 50 < max(looks) <= 101
        assert slept == [0.05] * 200
    with Quiet() as sock:
        sock._poll = poll
        monkeypatch.setattr(sockets, "time", sock)
        sock.pace = 100e-6  # others have the core in between
        assert sock.waits(1) == [1]
        sock.pace = 2e-6
        assert sock.waits(64) == [0] * 64
        assert sock.waits(1)[0] > 50
