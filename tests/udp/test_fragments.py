"""Messages larger than a datagram: only what is missing is sent again."""

import random
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from links import Pair, agent, hello, layout, lossy, outgoing, send_command, simulator, state
from peers import TABLES
from relay import FaultConfig, Faults
from rotorgram.models.errors import InputError
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.client import largest_datagram
from rotorgram.udp.protocol.errors import DecodeError
from rotorgram.udp.protocol.fragments import (
    FAR,
    NEAR,
    Assembler,
    Transfer,
    asks,
    is_fragment,
)
from rotorgram.udp.protocol.messages import Missing

AWAY = ("10.0.0.1", 8000)
QUAD = ((3,), (3,), (4,), (3,), (1,))
"""Telemetry of `Elevation-v0`."""


def message(size: int) -> bytes:
    of = layout(1, size)
    return binary.encode(state(3, of=of, value=1.0), of)


def test_what_fits_is_not_cut() -> None:
    transfer = Transfer(message(10), FAR)
    assert transfer.start() == [message(10)] == transfer.probe()


@settings(max_examples=60)
@given(
    st.integers(1, 4000), st.integers(256, 1500), st.integers(0, 2**32), st.sampled_from([0, 0.4])
)
def test_any_message_comes_through(size: int, largest: int, seed: int, loss: float) -> None:
    data = message(size)
    dice = random.Random(seed)
    transfer = Transfer(data, largest)
    assembler = Assembler(len(data))
    out = transfer.start()
    for _ in range(100):
        arriving = []
        for datagram in out:
            assert len(datagram) <= largest
            for _ in range(2):
                if dice.random() >= loss:
                    arriving.append(datagram)
        dice.shuffle(arriving)
        for datagram in arriving:
            if not is_fragment(datagram):
                assert datagram == data
                return
            binary.check(datagram)
            whole = assembler.take(datagram)
            if whole is not None:
                assert whole == data
                return
        asked = any(map(asks, arriving))
        missing = assembler.missing() if asked else None
        out = transfer.resend(missing) if missing else transfer.probe()
    pytest.fail("never whole")


def test_only_what_is_missing_is_sent_again() -> None:
    data = message(5000)
    transfer = Transfer(data, FAR)
    assembler = Assembler(len(data))
    first = transfer.start()
    assert len(first) == transfer.count == 18
    for number, datagram in enumerate(first):
        if number not in (3, 7, 11):
            assert assembler.take(datagram) is None
    missing = assembler.missing()
    assert missing is not None
    assert missing.numbers() == [3, 7, 11]
    decoded = binary.decode(binary.encode(missing))
    assert decoded == missing
    again = transfer.resend(missing)
    assert [asks(datagram) for datagram in again] == [False, False, True]
    assert [assembler.take(datagram) for datagram in again] == [None, None, data]


def test_other_cuts_of_a_message_begin_it_anew() -> None:  # fault 18
    data = message(5000)
    assembler = Assembler(len(data))
    for datagram in Transfer(data, FAR).start()[:9]:
        assert assembler.take(datagram) is None
    *others, last = Transfer(data, FAR // 2).start()
    assert [assembler.take(datagram) for datagram in others] == [None] * len(others)
    assert assembler.take(last) == data


def test_a_large_message_goes_in_bursts() -> None:
    transfer = Transfer(bytes(24) + bytes(1 << 22), FAR)
    burst = transfer.start()
    assert 190_000 < sum(map(len, burst)) <= 210_000
    assert [asks(d) for d in burst].index(True) == len(burst) - 1
    all_missing = Missing(session=0, sequence=0, kind=1, count=transfer.count, first=len(burst),
                          bitmap=b"\xff")  # fmt: skip
    assert len(transfer.resend(all_missing)) == len(burst)


def test_more_than_can_come_is_not_kept() -> None:
    data = message(1000)
    assembler = Assembler(600)
    first, second, *_ = Transfer(data, 600).start()
    assert assembler.take(first) is None
    with pytest.raises(DecodeError, match="at most 600 bytes"):
        assembler.take(second)


def test_fragments_of_another_message_inside() -> None:
    inner = binary.frame(132, 1, 1, bytes(8))
    pieces = [inner[:20], inner[20:]]
    assembler = Assembler(100)
    bodies = [bytes((i, 0, 2, 0, 0, 0, 0, 0)) + piece for i, piece in enumerate(pieces)]
    assert assembler.take(binary.frame(132, 1, 1, bodies[0])) is None
    with pytest.raises(DecodeError, match="header of its fragments"):
        assembler.take(binary.frame(132, 1, 1, bodies[1]))


def test_a_missing_bitmap_has_the_size_of_its_numbers() -> None:
    for first, bitmap in ((20, b"\1"), (0, b""), (0, bytes(4)), (16, b"\x10")):
        with pytest.raises(InputError, match=r"bitmap|below"):
            Missing(session=1, sequence=1, kind=4, count=20, first=first, bitmap=bitmap)
        body = struct.pack("<BxHH", 4, 20, first) + bitmap
        with pytest.raises(DecodeError, match=r"bitmap|below"):
            binary.decode(binary.frame(binary.MISSING, 1, 1, body))


# ---- fault 15: datagrams beyond one machine


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize(("drones", "loss", "least"), TABLES["steps a second"])
def test_steps_a_second_where_datagrams_are_lost(
    drones: int, loss: float, least: float, sealed: bool
) -> None:
    """1 ms each way, datagrams of 1,200 bytes; the physics and the agent take no time."""
    of = layout(drones, 3, QUAD)
    client = simulator(of=of, sealed=sealed, largest=FAR)
    pair = Pair(client, agent(of=of, sealed=sealed), lossy(loss), AWAY)
    pair.run(200)
    assert pair.steps == [float(i + 1) for i in range(200)]
    assert pair.seen[:200] == [float(i) for i in range(200)]
    assert 200 / pair.now >= least
    fragments = -(-of.state.size // 1168) + -(-of.commands[False, False].size // 1168)
    assert pair.sent / 200 <= fragments * (1 + 4 * loss) + 3


@pytest.mark.parametrize("drones", [1, 64])
def test_steps_a_second_through_the_network_of_the_soak(drones: int) -> None:
    """As studies/soak.py, were everything but the network to take no time."""
    of = layout(drones, 3, QUAD)
    config = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.2, corrupt=0.05, truncate=0.02)
    pair = Pair(simulator(of=of, largest=NEAR), agent(of=of), Faults(config).fate)
    pair.run(300)
    assert pair.steps == [float(i + 1) for i in range(300)]
    assert 300 / pair.now >= 80


def test_small_fragments_to_other_machines() -> None:
    assert largest_datagram(("127.0.0.1", 1)) == NEAR == 65_483
    assert largest_datagram(("10.0.0.1", 1)) == FAR == 1_200
    of = layout(1024)
    for host in ("127.0.0.1", "10.0.0.1"):
        server = agent(of=of)
        for said in (hello(), state(1, of=of)):
            server.receive(binary.encode(said, of), (host, 1), 0.0)
        outgoing(server)
        send_command(server, 0, 0.0, 0.0)
        sizes = [len(datagram) for datagram, _ in outgoing(server)]
        assert max(sizes) == sum(sizes) if host == "127.0.0.1" else max(sizes) <= FAR


def test_large_fragments_on_loopback() -> None:
    of = layout(1024, 3, QUAD)
    pair = Pair(simulator(of=of, largest=NEAR), agent(of=of), lossy(0))
    pair.run(20)
    assert pair.sent / 20 < 5


def test_a_long_hello_is_cut_too() -> None:  # fault 3
    bounds = np.arange(65_535).tolist()
    spec = '{"low":' + str(bounds) + "}"
    through = lossy(0.1)

    def fate(datagram: bytes) -> list[tuple[float, bytes]]:
        assert len(datagram) <= FAR
        return through(datagram)

    pair = Pair(simulator(said=hello(spec=spec), largest=FAR), agent(), fate, AWAY)
    pair.run(3)
    session = pair.server.slots[0]
    assert session is not None
    assert session.hello is not None
    assert session.hello.spec == spec
