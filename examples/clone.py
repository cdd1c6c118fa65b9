"""Behaviour cloning: a network learns to answer as the pilot of recorded flights did.

    rotorgram teleop --env rotorgram/Hover-v0 --action velocity --record flight.mcap
    python examples/clone.py flight.mcap [--vehicle crazyflie2] [--epochs 200]

The pilot may be a hand, or any agent of `rotorgram evaluate --record`. The clone then flies
episodes that no journal of an evaluation has.
"""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro
from rotorgram.agents.policies import Observation, flat
from rotorgram.envs.spec import EnvSpec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.trajectories import Flights, fly_episodes
from torch import nn
from tyro.conf import Positional


class Clone:
    """The policy: it answers with what the pilot would do, as far as the network knows."""

    def __init__(self, network: nn.Module, spec: EnvSpec) -> None:
        self._network = network
        self._spec = spec

    def reset(self) -> None:
        """It has no memory."""

    def act(self, observation: Observation) -> np.ndarray:
        """An action within the bounds [-1, 1] of every level."""
        seen = torch.as_tensor(flat(observation, self._spec))
        with torch.no_grad():
            return self._network(seen).clamp(-1.0, 1.0).numpy()


def learned(flights: Flights, epochs: int) -> nn.Module:
    """A network that gives the actions of the flights for their observations."""
    spec = flights[0].spec
    rows = [flat({n: o[:-1] for n, o in f.observations.items()}, spec, len(f)) for f in flights]
    seen = torch.as_tensor(np.concatenate(rows))
    done = torch.as_tensor(np.concatenate([flight.actions for flight in flights]))
    sizes = seen.shape[1], done.shape[1]
    network = nn.Sequential(
        nn.Linear(sizes[0], 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, sizes[1])
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(epochs):
        for batch in torch.randperm(len(seen)).split(256):
            loss = (network(seen[batch]) - done[batch]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    print(f"{len(flights)} flights, {len(seen):,} steps: mean squared error {loss.item():.2e}")
    return network


def main(
    journal: Positional[Path], vehicle: str | None = None, epochs: int = 200, seed: int = 0
) -> None:
    """Learn from the flights of a journal, and fly.

    Args:
        journal: MCAP file of --record.
        vehicle: What flew, as of the commands.
        epochs: Times that every step is learned.
        seed: Of the network.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    names = [array.name for array in recorded_trajectories(journal)[0].spec.observation]
    flights = recorded_trajectories(journal, observations=names)
    config = flights[0].config
    assert config is not None
    network = learned(flights, epochs)
    if vehicle:
        config = replace(config, vehicle=(vehicle,))
    with closing(LocalVectorEnv(config, 10, autoreset_mode="Disabled")) as env:
        flown = fly_episodes(env, Clone(network, env.env_spec), 10, "tuning")
    for who, those in (("pilot", flights), ("clone", flown)):
        last = [flight.headline[-1] for flight in those]
        crashed = sum(flight.terminated for flight in those)
        print(f"{who}: last {flights[0].spec.headline.name} {np.mean(last):.3f}, {crashed} crashed")


if __name__ == "__main__":
    tyro.cli(main)
