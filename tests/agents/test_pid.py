"""The PID holds the target, in both action modes and with any vehicle, or says what it needs."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from drones import ENV, infos_of
from rotorgram.agents import PID
from rotorgram.models.errors import InputError
from scripted import spec_of


@pytest.mark.parametrize("mode", ["increment", "offset"])
@pytest.mark.parametrize("drag", [0.0, 0.5])
def test_pid_holds_the_target(mode: str, drag: float) -> None:
    env: Any = gym.make(ENV, action=mode, effects={"linear_drag": drag})
    spec = env.get_wrapper_attr("env_spec")
    policy = PID(spec)
    for seed in range(3):
        errors = [abs(info["elevation_error"]) for info in infos_of(env, policy, seed)]
        assert np.mean(errors[-60:]) < 0.02


def test_pid_takes_the_vehicle_from_the_spec() -> None:
    """Hover at 12 N of 30 N, scale 20 % of 30 N: 1 m too low wants 9 m/s² · 12 N / 9.8 m/s²."""
    spec: Any = gym.make(ENV, action="offset").get_wrapper_attr("env_spec")
    arrays = {array.name: array for array in spec.telemetry}
    thrust = replace(arrays["thrust"], low=0.0, high=30.0)
    arrays["thrust"] = thrust
    telemetry = tuple(arrays.values())
    seen = replace(spec.observation[0], low=-9.0, high=(9.0, 9.0, 30 / 12 - 1))
    other = replace(spec, telemetry=telemetry, observation=(seen,))
    policy = PID(other)
    near = np.array([0.1, 0.0, 0.0], np.float32)
    action = policy.act(near)
    assert action == pytest.approx([0.9 * 12 / 9.8 / 6], rel=1e-6)
    far = np.array([9.0, 0.0, 0.0], np.float32)
    action = policy.act(far)
    assert action.tolist() == [1.0]


WRONG = [
    ({"observation": "error"}, "observation='full'"),
    ({"action_type": "discrete"}, "action_type='continuous'"),
]


@pytest.mark.parametrize(("options", "sentence"), WRONG)
def test_pid_says_what_it_needs(options: dict[str, str], sentence: str) -> None:
    env: Any = gym.make(ENV, **options)
    spec = env.get_wrapper_attr("env_spec")
    with pytest.raises(InputError, match=sentence):
        PID(spec)


def test_pid_flies_elevation_alone() -> None:
    spec = spec_of()
    with pytest.raises(InputError, match="expected the env rotorgram/Elevation-v0"):
        PID(spec)
