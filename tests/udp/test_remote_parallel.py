"""A swarm over UDP is the swarm in process, bit for bit, also under loss."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from dataset import RecordedEpisodes
from peers import ANY, simulate
from relay import FaultConfig, relaying
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.models import InputError
from rotorgram.udp import LinkConfig, RemoteVectorEnv, Simulator
from rotorgram.udp.journal.reader import Summary
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.remote_parallel import RemoteParallelEnv
from swarms import RISE

LOSSY = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.1, seed=3)


@contextmanager
def flying(
    num_envs: int, drones: int, faults: FaultConfig | None = None
) -> Iterator[tuple[str, int]]:
    """The address at which an agent finds a simulator that waits for it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(ANY)
        agent = taken.getsockname()
    with ExitStack() as stack:
        server = stack.enter_context(relaying(agent, faults)).address if faults else agent
        patient = LinkConfig(timeout=60)
        running = simulate(server, patient, env=RISE, num_envs=num_envs, drones=drones)
        yield agent
        running.join()


@pytest.mark.parametrize("faults", [None, LOSSY], ids=["clean", "30 % loss"])
def test_a_remote_parallel_env_is_that_in_process(faults: FaultConfig | None) -> None:
    dice = np.random.default_rng(2)
    local = LocalParallelEnv(RISE, 3)
    with flying(3, 3, faults) as address:
        remote = RemoteParallelEnv(address)
        assert remote.possible_agents == ["drone_0", "drone_1", "drone_2"]
        assert remote.observation_spaces == local.observation_spaces
        for seed in (1, 2):
            ours = local.reset(seed=seed)
            theirs = remote.reset(seed=seed)
            left = []
            while local.agents:
                assert remote.agents == local.agents
                for agent in local.agents:
                    assert theirs[0][agent].tobytes() == ours[0][agent].tobytes()
                    assert theirs[-1][agent].items() <= ours[-1][agent].items()
                actions = {  # the higher its number, the faster it climbs
                    agent: share * dice.uniform(0.95, 1.0, 1).astype(np.float32)
                    for agent, share in zip(remote.possible_agents, (0.1, 0.8, 1.0), strict=True)
                }
                ours = local.step(actions)
                theirs = remote.step(actions)
                assert theirs[1:4] == ours[1:4]
                left.append(len(local.agents))
            assert remote.agents == []
            assert len(set(left)) > 2  # they left one after the other
        remote.close()


def test_a_vector_env_of_worlds_is_that_in_process() -> None:
    dice = np.random.default_rng(3)
    local = LocalVectorEnv(RISE, 4, drones=2)
    with flying(4, 2, LOSSY) as address:
        remote = RemoteVectorEnv(address)
        assert remote.num_envs == 4
        ours = local.reset(seed=5)
        theirs = remote.reset(seed=5)
        ends = 0
        for _ in range(100):
            assert theirs[0].tobytes() == ours[0].tobytes()
            actions = dice.uniform(-0.4, 1, (4, 1)).astype(np.float32)
            ours = local.step(actions)
            theirs = remote.step(actions)
            for here, there in zip(ours[1:4], theirs[1:4], strict=True):
                assert here.tolist() == there.tolist()
            assert (remote.done == local.done).all()
            assert (remote.out == local.out).all()
            ends += int(local.done.any())
        assert ends > 2
        remote.close()


def test_several_worlds_are_no_parallel_env() -> None:
    with flying(4, 2) as address, pytest.raises(InputError, match="worlds: expected one, got 2"):
        RemoteParallelEnv(address)


def test_drones_that_do_not_fill_their_worlds_are_refused() -> None:
    with pytest.raises(InputError, match="drones: expected a divisor of num_envs = 3, got 2"):
        Simulator(RISE, bind=ANY, num_envs=3, drones=2)
    with pytest.raises(InputError, match="num_envs: expected a multiple of drones = 2, got 3"):
        LocalVectorEnv(RISE, 3, drones=2)


def test_a_journal_of_a_swarm(tmp_path: Path) -> None:
    journal = tmp_path / "swarm.mcap"
    flown = 0
    climb = np.array([[0.0], [0.0], [0.0], [1.0]], np.float32)  # the last one is out early
    with flying(4, 2) as address:
        remote = RemoteVectorEnv(address, autoreset_mode="Disabled", record=journal)
        remote.reset(seed=5)
        while not remote.done.all():
            flown += int((~remote.out).sum())
            remote.step(climb)
        remote.close()
    found = list(RecordedEpisodes([journal]))
    drones = sorted((one.drone, one.seed) for one in found)
    assert drones == [(0, 5), (1, 5), (2, 7), (3, 7)]
    (session,) = Summary(journal).sessions
    steps = sum(len(one) for one in found)
    assert steps == flown < 4 * (session.states - 2)  # none of drones that are out
    assert Verification(journal).identical
