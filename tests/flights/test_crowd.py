"""Flights of many drones at once: the ends that they keep are those of each flight alone."""

from typing import Any

import numpy as np
import pytest
from rotorgram.agents import CONTROLLERS, preset
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.envs import LocalVectorEnv
from rotorgram.flights.crowd import fly_crowd
from rotorgram.flights.trajectories import evaluation_seed, fly_episodes
from rotorgram.training.metrics import Headline, measure_episode

ENVS: dict[str, tuple[str, dict[str, Any]]] = {
    "geometric": ("rotorgram/Hover-v0", {"action": "position", "start_tilt": 80.0}),
    "pid": ("rotorgram/Elevation-v0", {}),
    "payload": ("rotorgram/PayloadHover-v0", {"action": "position", "backend": "mujoco"}),
    "waypoints": ("rotorgram/Waypoints-v0", {"action": "position"}),
}


def env_of(name: str, count: int = 6) -> LocalVectorEnv:
    env_id, options = ENVS[name]
    options = {"backend": "rigid", **options}
    return LocalVectorEnv(env_id, count, autoreset_mode="Disabled", **options)


def agree(env: LocalVectorEnv, policy: Any) -> None:
    seeds = [evaluation_seed(number) for number in range(6)]
    together = fly_crowd(env, policy, seeds)
    headline = Headline.of(env.env_spec)
    for number, flight in enumerate(fly_episodes(env, policy, 6)):
        alone = measure_episode(flight, headline)
        assert together["seed"][number] == seeds[number]
        assert together["length"][number] == alone["length"]
        assert together["terminated"][number] == alone["terminated"]
        assert together["return"][number] == pytest.approx(alone["return"], rel=1e-3, abs=0.05)
        assert together["last"][number] == pytest.approx(flight.headline[-1], rel=1e-3, abs=1e-4)
        steady = together["last" if headline.final else "steady"][number]
        assert steady == pytest.approx(alone["steady"], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("name", ENVS)
def test_a_controller_flies_many_as_it_flies_one(name: str) -> None:
    env = env_of(name)
    agree(env, CONTROLLERS["pid" if name == "pid" else "geometric"](env.env_spec))


@pytest.mark.parametrize("memory", [0, 3])
def test_a_network_flies_many_as_it_flies_one(memory: int) -> None:
    env = LocalVectorEnv("rotorgram/Hover-v0", 6, autoreset_mode="Disabled", backend="rigid")
    config = preset("ppo", "tuned", "rotorgram/Hover-v0", memory=memory, reach=2.0)
    policy = NetworkPolicy(env.env_spec, config)
    size = sum(int(np.prod(shape)) for shape in policy.shapes.values())
    drawn = np.random.default_rng(2).normal(0.0, 0.1, size)
    weights = {}
    for name, shape in policy.shapes.items():
        count = int(np.prod(shape))
        weights[name], drawn = drawn[:count].reshape(shape), drawn[count:]
    agree(env, NetworkPolicy.load(weights, env.env_spec, config))


def test_a_policy_of_one_drone_flies_as_copies() -> None:
    class Counts:
        def __init__(self) -> None:
            self.steps = 0

        def reset(self) -> None:
            self.steps = 0

        def act(self, observation: Any) -> Any:
            self.steps += 1
            return np.full(4, 0.002 * self.steps, np.float32)

    agree(env_of_rotors(), Counts())


def env_of_rotors() -> LocalVectorEnv:
    return LocalVectorEnv("rotorgram/Hover-v0", 6, autoreset_mode="Disabled", backend="rigid")


def test_cases_are_told() -> None:
    env = LocalVectorEnv(
        "rotorgram/Hover-v0", 64, autoreset_mode="Disabled", backend="rigid",
        action="position", randomize={"mass": "1 | 0.5"},
    )  # fmt: skip
    flown = fly_crowd(env, CONTROLLERS["geometric"](env.env_spec), range(64))
    assert set(flown["case"]) == {0, 1}
    lighter, nominal = (np.median(flown["steady"][flown["case"] == case]) for case in (1, 0))
    assert lighter > 10 * nominal
