"""Scenes whose layouts are new in each episode, and sensors with rays, over a wire that loses."""

import socket
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from peers import ANY, Running
from relay import FaultConfig, relaying
from rotorgram.envs import LocalVectorEnv
from rotorgram.udp import LinkConfig, RemoteVectorEnv, Simulator


@pytest.mark.parametrize(("name", "more"), [("Forest", {"privileged": True}), ("Dodge", {})])
def test_the_same_bits_with_a_loss_of_a_twentieth(name: str, more: dict[str, bool]) -> None:
    env_id = f"rotorgram/{name}-v0"
    options: dict[str, Any] = {"backend": "rigid", "episode_length": 25, **more}
    local = LocalVectorEnv(env_id, 6, **options)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(ANY)
        agent = taken.getsockname()
    with relaying(agent, FaultConfig(drop=0.05, duplicate=0.02, reorder=0.02, seed=8)) as relay:
        simulator = Simulator(
            env_id, server=relay.address, bind=ANY, num_envs=6, config=LinkConfig(timeout=60),
            **options,
        )  # fmt: skip
        running = Running(simulator)
        with closing(RemoteVectorEnv(agent)) as remote, closing(local):
            dice = np.random.default_rng(6)
            there, told = local.reset(seed=4)
            here, heard = remote.reset(seed=4)
            layouts = set()
            for _ in range(60):
                for part, values in there.items():
                    assert here[part].tobytes() == values.tobytes()
                assert heard["layout"].tobytes() == told["layout"].tobytes()
                layouts |= {*told["layout"].tolist()}
                actions = dice.uniform(-1, 1, local.action_space.shape).astype(np.float32)
                there, rewards, *_, told = local.step(actions)
                here, paid, *_, heard = remote.step(actions)
                assert paid.tobytes() == rewards.tobytes()
            assert len(layouts) >= 12
        running.join()
