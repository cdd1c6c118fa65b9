"""Flights through a network that loses datagrams, and the relay that is such a network."""

from math import sqrt
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from peers import ANY, ENV_ID, simulate
from relay import FaultConfig, Faults, relaying, udp_socket
from rotorgram.udp import LinkConfig, RemoteVectorEnv
from rotorgram.udp.protocol.auth import write_key

COUNT = 20_000


def within(count: int, trials: int, probability: float) -> bool:
    """Whether a binomial count is within five standard deviations of its mean."""
    spread = sqrt(trials * probability * (1 - probability))
    return abs(count - trials * probability) <= 5 * spread


def test_fates_follow_from_the_seed_and_the_stream() -> None:
    def fates(seed: int, stream: str) -> list[object]:
        faults = {"drop": 0.2, "duplicate": 0.2, "reorder": 0.2, "truncate": 0.2, "corrupt": 0.2}
        found = Faults(FaultConfig(**faults, seed=seed), stream)
        return [found.fate(b"0123456789") for _ in range(100)]

    assert fates(0, "up/1") == fates(0, "up/1")
    assert fates(0, "up/1") != fates(1, "up/1")
    assert fates(0, "up/1") != fates(0, "down/1")


def test_probabilities_are_those_asked_for() -> None:
    stream = Faults(
        FaultConfig(drop=0.1, duplicate=0.2, reorder=0.3, truncate=0.05, corrupt=0.02, seed=3)
    )
    out = [stream.fate(bytes(100)) for _ in range(COUNT)]
    counters = stream.counters
    left = 0.9  # nothing else happens to a datagram that is dropped
    assert counters["received"] == COUNT
    assert within(counters["dropped"], COUNT, 0.1)
    assert within(counters["duplicated"], COUNT, left * 0.2)
    assert within(counters["reordered"], COUNT, left * 0.3)
    assert within(counters["truncated"], COUNT, left * 0.05)
    # One of a hundred truncated datagrams has no bit left to flip.
    assert within(counters["corrupted"], COUNT, left * 0.02 * (1 - 0.05 / 100))
    assert sum(map(len, out)) == counters["forwarded"]
    assert sum(bool(copies) and any(copies[0][1]) for copies in out) == counters["corrupted"]


def test_the_relay_keeps_clients_apart_and_forwards_both_ways() -> None:
    with (
        udp_socket() as server,
        relaying(server.getsockname()) as relay,
        udp_socket(peer=relay.address) as one,
        udp_socket(peer=relay.address) as two,
    ):
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


@pytest.mark.parametrize("mtu", [1500, 576])
def test_many_drones_fly_through_a_path_that_drops_fragments(
    mtu: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """64 drones have States of 12 kB: several packets, and every datagram has to fit into one."""
    key = tmp_path / "key"
    write_key(key)
    faults = FaultConfig(drop=0.02, largest=mtu - 28, seed=5)
    # Less the headers of IP and UDP, and the seal.
    monkeypatch.setattr("rotorgram.udp.protocol.client.NEAR", mtu - 28 - 24)
    remote = RemoteVectorEnv(ANY, num_envs=64, key_file=key, connect=False)
    with relaying(remote.address, faults) as relay:
        simulator = simulate(relay, num_envs=64, key_file=key, config=LinkConfig(timeout=20))
        local = gym.make_vec(ENV_ID, num_envs=64)
        assert remote.reset(seed=1)[0].tobytes() == local.reset(seed=1)[0].tobytes()
        actions = np.random.default_rng(0).uniform(-1, 1, (20, 64, 1)).astype(np.float32)
        for action in actions:
            for ours, theirs in zip(remote.step(action)[:4], local.step(action)[:4], strict=True):
                assert ours.tobytes() == theirs.tobytes()
        remote.close()
        simulator.join()
    assert relay.counters["dropped"] > 0
