"""The relay that drops, duplicates, reorders, delays, truncates and corrupts datagrams."""

import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf, nan, sqrt
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from peers import ANY, ENV_ID, Running, running
from rotorgram.models.errors import InputError
from rotorgram.udp import LinkConfig, RemoteVectorEnv, Simulator
from rotorgram.udp.protocol.auth import write_key
from rotorgram.udp.transport import relay as relay_module
from rotorgram.udp.transport.relay import FaultConfig, Faults, Relay

COUNT = 20_000


def udp(bind: tuple[str, int] = ANY) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(bind)
    sock.settimeout(5)
    return sock


def client_of(relay: Relay) -> socket.socket:
    sock = udp()
    sock.connect(relay.address)
    return sock


@contextmanager
def through(config: FaultConfig) -> Iterator[tuple[socket.socket, socket.socket, Relay]]:
    """A client, a server and the running relay between them."""
    with (
        udp() as server,
        running(Relay(ANY, server.getsockname(), config)) as relay,
        client_of(relay) as client,
    ):
        yield client, server, relay


def wait_for(counters: Counter[str], name: str, count: int) -> None:
    until = time.monotonic() + 5
    while counters[name] < count:
        assert time.monotonic() < until, (name, counters)
        time.sleep(0.001)


def within(count: int, trials: int, probability: float) -> bool:
    """Whether a binomial count is within five standard deviations of its mean."""
    spread = sqrt(trials * probability * (1 - probability))
    return abs(count - trials * probability) <= 5 * spread


def flipped_bits(a: bytes, b: bytes) -> int:
    return (int.from_bytes(a, "big") ^ int.from_bytes(b, "big")).bit_count()


# Faults: no socket, no clock.


def test_without_faults_every_datagram_comes_out_once_at_once() -> None:
    stream = Faults(FaultConfig())
    for datagram in (b"", b"a", bytes(65_507)):
        assert stream.fate(datagram) == [(0.0, datagram)]
    assert stream.counters == {"received": 3, "forwarded": 3}


def test_fates_follow_from_the_seed_and_the_stream() -> None:
    def fates(seed: int, stream: str) -> list[object]:
        config = FaultConfig(
            drop=0.2, duplicate=0.2, reorder=0.2, truncate=0.2, corrupt=0.2, jitter=1, seed=seed
        )
        one = Faults(config, stream)
        return [one.fate(b"0123456789") for _ in range(100)]

    assert fates(0, "up/1") == fates(0, "up/1")
    others = [fates(0, "up/1"), fates(1, "up/1"), fates(0, "down/1"), fates(0, "up/2")]
    assert all(a != b for i, a in enumerate(others) for b in others[:i])


def test_fates_do_not_depend_on_earlier_datagrams() -> None:
    config = FaultConfig(drop=0.3, duplicate=0.3, truncate=0.3, corrupt=0.3, jitter=1)
    short, long = Faults(config), Faults(config)
    for _ in range(50):
        short.fate(b"")
        long.fate(bytes(1000))
    assert [short.fate(b"abc") for _ in range(50)] == [long.fate(b"abc") for _ in range(50)]


def test_probabilities_are_those_asked_for() -> None:
    stream = Faults(
        FaultConfig(drop=0.1, duplicate=0.2, reorder=0.3, truncate=0.05, corrupt=0.02, seed=3)
    )
    out = [stream.fate(bytes(100)) for _ in range(COUNT)]
    counters = stream.counters
    left = 0.9  # what is dropped, nothing else happens to
    assert counters["received"] == COUNT
    assert within(counters["dropped"], COUNT, 0.1)
    assert within(counters["duplicated"], COUNT, left * 0.2)
    assert within(counters["reordered"], COUNT, left * 0.3)
    assert within(counters["truncated"], COUNT, left * 0.05)
    # One of a hundred truncated ones has no bit left to flip.
    assert within(counters["corrupted"], COUNT, left * 0.02 * (1 - 0.05 / 100))
    # The counters tell what came out.
    assert sum(not copies for copies in out) == counters["dropped"]
    assert sum(len(copies) == 2 for copies in out) == counters["duplicated"]
    assert sum(map(len, out)) == counters["forwarded"]
    assert counters["forwarded"] == COUNT - counters["dropped"] + counters["duplicated"]
    assert sum(bool(copies) and len(copies[0][1]) < 100 for copies in out) == counters["truncated"]
    assert sum(bool(copies) and any(copies[0][1]) for copies in out) == counters["corrupted"]


def test_delays_are_uniform_in_their_range() -> None:
    config = FaultConfig(delay=1.0, jitter=0.5, reorder=1, reorder_by=0.25, duplicate=1)
    stream = Faults(config)
    out = [stream.fate(b"a") for _ in range(COUNT)]
    # The mean of a uniform number of 0 to w is w / 2, its variance w² / 12.
    spread = 5 * sqrt((0.5**2 + 0.25**2) / 12 / COUNT)
    for copy in (0, 1):
        delays = [copies[copy][0] for copies in out]
        assert min(delays) >= 1.0
        assert max(delays) <= 1.75
        assert abs(sum(delays) / COUNT - (1.0 + 0.25 + 0.125)) < spread
    assert all(first != second for (first, _), (second, _) in out)


def test_only_a_second_copy_is_held_back_if_nothing_is_reordered() -> None:
    stream = Faults(FaultConfig(delay=1.0, duplicate=1, reorder_by=0.25))
    for _ in range(100):
        (first, _), (second, _) = stream.fate(b"a")
        assert first == 1.0
        assert 1.0 <= second <= 1.25


def test_truncation_leaves_every_shorter_length() -> None:
    stream = Faults(FaultConfig(truncate=1))
    out = [stream.fate(b"0123456789")[0][1] for _ in range(COUNT)]
    assert all(b"0123456789".startswith(datagram) for datagram in out)
    lengths = Counter(map(len, out))
    assert sorted(lengths) == list(range(10))
    assert all(within(count, COUNT, 0.1) for count in lengths.values())
    assert stream.fate(b"") == [(0.0, b"")]
    assert stream.counters["truncated"] == COUNT


def test_corruption_flips_one_to_four_bits_anywhere() -> None:
    datagram = random.Random(1).randbytes(1000)
    stream = Faults(FaultConfig(corrupt=1))
    out = [stream.fate(datagram)[0][1] for _ in range(COUNT // 4)]
    assert {len(corrupted) for corrupted in out} == {1000}
    flips = Counter(flipped_bits(datagram, corrupted) for corrupted in out)
    assert sorted(flips) == [1, 2, 3, 4]
    # Of two to four places among 8000, two are the same in less than 0.1 % of cases.
    assert all(within(count, len(out), 0.25) for count in flips.values())
    touched = {i for corrupted in out for i in range(1000) if corrupted[i] != datagram[i]}
    assert len(touched) > 990  # 12,500 flips leave each byte alone with probability e^-12.5


def test_a_corrupted_datagram_is_never_the_same() -> None:
    stream = Faults(FaultConfig(corrupt=1))
    assert all(stream.fate(b"a")[0][1] != b"a" for _ in range(2000))
    assert stream.fate(b"") == [(0.0, b"")]


@pytest.mark.parametrize("name", ["drop", "duplicate", "reorder", "truncate", "corrupt"])
@pytest.mark.parametrize("value", [-0.1, 1.1, nan, "1", None])
def test_wrong_probability(name: str, value: object) -> None:
    with pytest.raises(InputError) as caught:
        FaultConfig(**{name: value})  # type: ignore[arg-type]
    assert str(caught.value) == f"{name}: expected a probability from 0 to 1, got {value!r}"


@pytest.mark.parametrize("name", ["delay", "jitter", "reorder_by"])
@pytest.mark.parametrize("value", [-1, inf, nan, "1"])
def test_wrong_time(name: str, value: object) -> None:
    with pytest.raises(InputError) as caught:
        FaultConfig(**{name: value})  # type: ignore[arg-type]
    assert str(caught.value) == f"{name}: expected seconds from 0 to 3600, got {value!r}"


@pytest.mark.parametrize(
    ("mtu", "size", "packets"),
    [(1500, 1472, 1), (1500, 1473, 2), (1500, 2952, 2), (1500, 2953, 3), (1500, 65_507, 45),
     (576, 548, 1), (576, 549, 2), (576, 1200, 3), (0, 65_507, 1)],
)  # fmt: skip
def test_a_datagram_is_lost_with_one_of_its_fragments(mtu: int, size: int, packets: int) -> None:
    # Of 1,500 bytes 20 are the IP header; 8 more in the first packet are the UDP header.
    stream = Faults(FaultConfig(drop=0.03, mtu=mtu, seed=4))
    for _ in range(COUNT):
        stream.fate(bytes(size))
    assert within(stream.counters["dropped"], COUNT, 1 - 0.97**packets)


@pytest.mark.parametrize(("mtu", "largest"), [(1500, 1472), (576, 548)])
def test_a_black_hole_lets_small_datagrams_through(mtu: int, largest: int) -> None:
    stream = Faults(FaultConfig(mtu=mtu, black_hole=True))
    assert len(stream.fate(bytes(largest))) == 1
    assert stream.fate(bytes(largest + 1)) == []


@pytest.mark.parametrize("mtu", [-1, 67, 65_536, 1500.0, True])
def test_wrong_mtu(mtu: object) -> None:
    with pytest.raises(InputError) as caught:
        FaultConfig(mtu=mtu)  # type: ignore[arg-type]
    assert str(caught.value) == f"mtu: expected 0 or 68 to 65535 bytes, got {mtu!r}"


def test_a_black_hole_needs_an_mtu() -> None:
    with pytest.raises(InputError, match=r"^black_hole: expected an mtu with it, got none$"):
        FaultConfig(black_hole=True)


def test_wrong_seed() -> None:
    with pytest.raises(InputError, match=r"^seed: expected a whole number, got 0\.5$"):
        FaultConfig(seed=0.5)  # type: ignore[arg-type]


# Relay: real sockets.


def test_without_faults_the_relay_is_transparent() -> None:
    with through(FaultConfig()) as (client, server, relay):
        for datagram in (b"", b"a", random.Random(0).randbytes(9000), b"b"):
            client.send(datagram)
            got, address = server.recvfrom(65_535)
            assert got == datagram
            assert address not in (client.getsockname(), relay.address)
            server.sendto(datagram[::-1], address)
            assert client.recv(65_535) == datagram[::-1]
        burst = [bytes([i]) for i in range(100)]
        for datagram in burst:
            client.send(datagram)
        assert [server.recv(9) for _ in burst] == burst
        assert relay.counters == {"received": 108, "forwarded": 108}


def test_clients_are_kept_apart() -> None:
    with through(FaultConfig()) as (one, server, relay), client_of(relay) as two:
        addresses = []
        for client in (one, two, one, two):
            client.send(b"hello")
            addresses.append(server.recvfrom(9)[1])
        assert addresses[0] != addresses[1]
        assert addresses[:2] == addresses[2:]
        server.sendto(b"to two", addresses[1])
        server.sendto(b"to one", addresses[0])
        assert one.recv(9) == b"to one"
        assert two.recv(9) == b"to two"


def test_fates_do_not_depend_on_how_clients_interleave() -> None:
    def arrivals(order: list[int]) -> list[list[bytes]]:
        with through(FaultConfig(drop=0.5)) as (one, server, relay), client_of(relay) as two:
            clients = ((one, iter(range(32))), (two, iter(range(32))))
            for count, who in enumerate(order, 1):
                client, numbers = clients[who]
                client.send(bytes([who, next(numbers)]))
                wait_for(relay.counters, "received", count)
            wait_for(relay.counters, "forwarded", len(order) - relay.counters["dropped"])
            got = [server.recv(9) for _ in range(relay.counters["forwarded"])]
        return [[datagram for datagram in got if datagram[0] == who] for who in (0, 1)]

    first = arrivals([0, 1] * 32)
    assert first == arrivals([0] + [1] * 32 + [0] * 31)
    assert [one[1] for one in first[0]] != [two[1] for two in first[1]]
    assert all(within(len(stream), 32, 0.5) for stream in first)


def test_drop_of_1_forwards_nothing() -> None:
    with through(FaultConfig(drop=1)) as (client, server, relay):
        for _ in range(50):
            client.send(b"a")
        wait_for(relay.counters, "dropped", 50)
        server.settimeout(0.02)
        with pytest.raises(TimeoutError):
            server.recv(9)
        assert relay.counters == {"received": 50, "dropped": 50}


def test_a_duplicate_comes_twice() -> None:
    with through(FaultConfig(duplicate=1)) as (client, server, _):
        for datagram in (b"a", b"b"):
            client.send(datagram)
            assert [server.recv(9), server.recv(9)] == [datagram, datagram]


@pytest.mark.parametrize("delay", [0.0004, 0.03])
def test_delay_holds_for_as_long_both_ways(delay: float) -> None:
    with through(FaultConfig(delay=delay)) as (client, server, _):
        client.send(b"the first makes the socket")
        _, address = server.recvfrom(99)
        trips = []
        for _ in range(5):
            start = time.perf_counter()
            client.send(b"a")
            server.recv(9)
            server.sendto(b"b", address)
            client.recv(9)
            trips.append(time.perf_counter() - start)
        assert min(trips) >= 2 * delay
        assert min(trips) < 2 * delay + 0.02  # a busy machine is late, but not each time


def test_delayed_datagrams_keep_their_order() -> None:
    with through(FaultConfig(delay=0.005)) as (client, server, _):
        sent = [bytes([i]) for i in range(100)]
        for datagram in sent:
            client.send(datagram)
        assert [server.recv(9) for _ in sent] == sent


def test_reordered_datagrams_are_overtaken() -> None:
    with through(FaultConfig(reorder=0.3, reorder_by=0.02, seed=1)) as (client, server, relay):
        sent = [bytes([i]) for i in range(100)]
        for datagram in sent:
            client.send(datagram)
        got = [server.recv(9) for _ in sent]
        assert got != sent
        assert sorted(got) == sent
        late = relay.counters["reordered"]
        assert within(late, 100, 0.3)
        # Those that are not held back stay in order: taking out the late ones leaves them sorted.
        stream = Faults(relay.config, "up/1")
        held = {datagram for datagram in sent if stream.fate(datagram)[0][0] > 0}
        assert len(held) == late
        assert [d for d in got if d not in held] == [d for d in sent if d not in held]


def test_a_server_that_is_not_there_yet() -> None:
    with udp() as server:
        address = server.getsockname()
    with running(Relay(ANY, address)) as relay, client_of(relay) as client:
        client.send(b"lost")
        wait_for(relay.counters, "unreachable", 1)
        with udp(address) as server:
            client.send(b"found")
            assert server.recv(9) == b"found"


def test_a_client_that_has_gone() -> None:
    with through(FaultConfig()) as (client, server, relay), client_of(relay) as other:
        client.send(b"a")
        _, address = server.recvfrom(9)
        client.close()
        for _ in range(3):
            server.sendto(b"b", address)
        wait_for(relay.counters, "received", 4)
        other.send(b"c")
        assert server.recv(9) == b"c"


def test_idle_clients_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "_IDLE", 0.05)
    with through(FaultConfig()) as (client, server, _):
        client.send(b"a")
        _, before = server.recvfrom(9)
        time.sleep(0.15)
        server.sendto(b"nobody has this address", before)
        client.send(b"b")
        datagram, after = server.recvfrom(9)
        assert datagram == b"b"
        assert after != before
        server.sendto(b"c", after)
        assert client.recv(9) == b"c"


def test_the_longest_idle_client_goes_when_there_are_too_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(relay_module, "_MAX_CLIENTS", 2)
    with (
        through(FaultConfig()) as (one, server, relay),
        client_of(relay) as two,
        client_of(relay) as three,
    ):
        addresses = []
        for client in (one, two, one, three, one, two):
            client.send(b"a")
            addresses.append(server.recvfrom(9)[1])
        assert addresses[0] == addresses[2] == addresses[4]
        assert addresses[1] != addresses[5]


def test_what_is_held_back_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "_MAX_HELD", 10)
    with through(FaultConfig(delay=60)) as (client, _, relay):
        for _ in range(15):
            client.send(b"a")
        wait_for(relay.counters, "unsent", 5)
        assert relay.counters == {"received": 15, "forwarded": 15, "unsent": 5}


def test_stop_ends_an_idle_relay_at_once() -> None:
    with udp() as server, Relay(ANY, server.getsockname(), FaultConfig(delay=60)) as relay:
        thread = threading.Thread(target=relay.run)
        thread.start()
        with client_of(relay) as client:
            client.send(b"held for a minute")
            wait_for(relay.counters, "received", 1)
        start = time.perf_counter()
        relay.stop()
        thread.join(5)
        assert time.perf_counter() - start < 0.2  # promised are 50 ms, of a machine that is free
        relay.run()  # one that was stopped does not start again


def test_close_waits_for_the_thread() -> None:
    with udp() as server:
        relay = Relay(ANY, server.getsockname())
        thread = threading.Thread(target=relay.run)
        thread.start()
        relay.close()
        relay.close()
        thread.join(5)
        assert not thread.is_alive()


def test_an_idle_relay_does_not_spin() -> None:
    with udp() as server, running(Relay(ANY, server.getsockname())):
        start = time.process_time()
        time.sleep(0.2)
        assert time.process_time() - start < 0.05


def test_wrong_addresses() -> None:
    with pytest.raises(InputError, match=r"^server: expected the port of the agent, 1 to 65535"):
        Relay(ANY, ANY)
    with pytest.raises(InputError, match=r"^listen: expected another address than the server's"):
        Relay(("127.0.0.1", 8001), ("127.0.0.1", 8001))
    with pytest.raises(InputError, match="is not a loopback address"):
        Relay(ANY, ("192.0.2.1", 8001))
    with pytest.raises(InputError, match="is not a loopback address"):
        Relay(("0.0.0.0", 0), ("127.0.0.1", 8001))
    with udp() as taken, pytest.raises(OSError, match="the port is in use"):
        Relay(taken.getsockname(), ("127.0.0.1", 8001))


def test_insecure_allows_other_addresses() -> None:
    with (
        udp() as server,
        running(Relay(("0.0.0.0", 0), server.getsockname(), insecure=True)) as relay,
        udp() as client,
    ):
        client.sendto(b"a", ("127.0.0.1", relay.address[1]))
        assert server.recv(9) == b"a"


@pytest.mark.parametrize("mtu", [1500, 576])
def test_many_drones_fly_through_a_path_that_drops_fragments(mtu: int, tmp_path: Path) -> None:
    """64 drones have States of 12 kB: several packets, and every datagram has to fit into one."""
    key = tmp_path / "key"
    write_key(key)
    faults = FaultConfig(drop=0.02, mtu=mtu, black_hole=True, seed=5)
    largest = {"max_datagram": mtu - 28 - 24}  # less the headers of IP and UDP, and the seal
    remote = RemoteVectorEnv(ANY, num_envs=64, key_file=key, connect=False, **largest)
    with running(Relay(ANY, remote.address, faults)) as relay:
        config = LinkConfig(timeout=20, **largest)
        simulator = Running(
            Simulator(server=relay.address, bind=ANY, num_envs=64, key_file=key, config=config)
        )
        local = gym.make_vec(ENV_ID, num_envs=64)
        assert remote.reset(seed=1)[0].tobytes() == local.reset(seed=1)[0].tobytes()
        actions = np.random.default_rng(0).uniform(-1, 1, (20, 64, 1)).astype(np.float32)
        for action in actions:
            for ours, theirs in zip(remote.step(action)[:4], local.step(action)[:4], strict=True):
                assert ours.tobytes() == theirs.tobytes()
        remote.close()
        simulator.join()
    assert relay.counters["dropped"] > 0
