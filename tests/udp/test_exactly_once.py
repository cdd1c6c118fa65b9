"""A third of all datagrams is lost, others come twice, late, cut or changed: the same flight.

Simulators run in processes of their own and speak through `Relay`. Each State and Command counts
once: every observation, reward, flag and telemetry value is that of the env without a wire.
"""

import json
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from math import sqrt
from pathlib import Path
from typing import Any

import pytest
from fleets import assert_parity, assert_same, sync
from peers import ANY, ENV_ID, launch
from relay import FaultConfig, Relay, relaying
from remotes import assert_parity as assert_remote_parity
from rotorgram.udp import RemoteEnv, RemoteVectorEnv
from rotorgram.udp.protocol.auth import write_key

BAD = FaultConfig(
    drop=0.3, duplicate=0.1, reorder=0.2, corrupt=0.05, truncate=0.02, reorder_by=0.0006, seed=1
)
OPTIONS = {"control_period": 0.01, "target": (4.0, 6.0)}
SIMULATE = """
    import json, sys
    from rotorgram.udp import LinkConfig, Simulator
    from rotorgram.udp.protocol.client import RoundTrips
    address, arguments, options = map(json.loads, sys.argv[1:])

    # Asks again after a millisecond, often too early: more steps in a second, and more repeats.
    RoundTrips.wait = lambda *_: 1e-3
    times = LinkConfig(timeout=20)
    with Simulator(server=tuple(address), bind=("127.0.0.1", 0), config=times, **arguments,
                   **options) as simulator:
        reason = simulator.run()
        link = simulator.link
        print(json.dumps([reason, link.sequence, link.statistics.counters]))
"""


@contextmanager
def simulating(address: tuple[str, int], **arguments: Any) -> Iterator[subprocess.Popen[str]]:
    words = (address, arguments, OPTIONS)
    process = launch(SIMULATE, *map(json.dumps, words))
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def its_end(process: subprocess.Popen[str]) -> tuple[int, Counter[str]]:
    """Number of the simulator's last State, and its counts."""
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    reason, states, counters = json.loads(out)
    assert reason == "the agent closed"
    return states, Counter(counters)


def assert_bad(relay: Relay, agent: Counter[str], simulator: Counter[str], messages: int) -> None:
    """The faults did happen, and both sides saw them.

    `messages`: States, and as many Commands. An agent also says Alive while others are waited for.
    """
    got = relay.counters
    config = relay.config
    total = got["received"]
    kept = 1 - config.drop
    for name, share in (
        ("dropped", config.drop),
        ("duplicated", kept * config.duplicate),
        ("reordered", kept * config.reorder),
        ("truncated", kept * config.truncate),
        ("corrupted", kept * config.corrupt),
    ):
        expected = total * share
        spread = 5 * sqrt(expected * (1 - share)) + 1
        assert abs(got[name] - expected) <= spread, (name, got)
    for counters in (agent, simulator):
        assert counters["resent"] > 0.1 * messages
        changed = counters["malformed"] + counters["forged"]
        assert (changed > 0.01 * counters["received"]) is (config.corrupt > 0)
    assert agent["duplicate"] > 0.1 * messages
    assert simulator["stale"] > 0.01 * messages


# ---- one drone


@pytest.mark.parametrize(("kind", "steps"), [("binary", 600), ("text", 300), ("key", 300)])
def test_one_drone(kind: str, steps: int, tmp_path: Path) -> None:
    faults = BAD
    settings: dict[str, Any] = {}
    arguments: dict[str, str] = {}
    if kind == "text":
        # A changed text is another text: against that there is UDP's own checksum, and no more.
        faults = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.2, reorder_by=0.001)
        settings = {"env_id": ENV_ID, "options": OPTIONS}
        arguments = {"codec": "text"}
    if kind == "key":
        write_key(tmp_path / "key")
        arguments = settings = {"key_file": str(tmp_path / "key")}
    with (
        RemoteEnv(ANY, connect=False, **settings) as remote,
        relaying(remote.address, faults) as relay,
        simulating(relay.address, **arguments) as process,
    ):
        states = assert_remote_parity(remote, steps, (1, 2**63), **OPTIONS)
        remote.close()
        last, counters = its_end(process)
    assert last == states
    assert_bad(relay, remote.statistics.counters, counters, states)
    assert remote.statistics.counters["sessions"] == 1
    forged = min(counters["forged"], remote.statistics.counters["forged"])
    assert (forged > 0) == (kind == "key")


# ---- many


@pytest.mark.parametrize(
    ("simulators", "drones", "steps"),
    [(1, 64, 250), pytest.param(3, 2, 200, marks=pytest.mark.quiet)],
)
def test_many_drones(simulators: int, drones: int, steps: int) -> None:
    count = simulators * drones
    seeds = list(range(1000, 1000 + count))
    remote = RemoteVectorEnv(ANY, num_simulators=simulators, num_envs=count, connect=False)
    with ExitStack() as stack:
        local = stack.enter_context(sync(count, **OPTIONS))
        relay = stack.enter_context(relaying(remote.address, BAD))
        processes = []
        for _ in range(simulators):
            flying = simulating(relay.address, num_envs=drones)
            processes.append(stack.enter_context(flying))
        assert_same(remote.reset(seed=seeds), local.reset(seed=seeds))
        assert assert_parity(remote, local, steps) > 0
        remote.close()
        ends = [its_end(process) for process in processes]
    assert [last for last, _ in ends] == [steps + 2] * simulators
    counters = sum((counters for _, counters in ends), Counter())
    messages = simulators * (steps + 2)
    assert_bad(relay, remote.statistics.counters, counters, messages)
    assert remote.statistics.counters["sessions"] == simulators
