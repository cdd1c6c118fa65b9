"""The PID holds the target, in both action modes, and says what it cannot fly."""

import numpy as np
import pytest
from rotorgram.agents.pid import PID
from rotorgram.envs import ElevationConfig
from rotorgram.envs.elevation import ElevationEnv
from rotorgram.experiments.evaluate import fly_episodes


@pytest.mark.parametrize("mode", ["increment", "offset"])
@pytest.mark.parametrize("drag", [0.0, 0.5])
def test_pid_holds_the_target(mode: str, drag: float) -> None:
    config = ElevationConfig(action_mode=mode, linear_drag=drag)
    flights = fly_episodes(ElevationEnv(action_mode=mode, linear_drag=drag), PID(config), 5)
    for flight in flights:
        assert not flight.terminated
        assert np.abs(flight.errors[-60:]).mean() < 0.02


def test_pid_says_what_it_needs() -> None:
    with pytest.raises(ValueError, match="observation='full'"):
        PID(ElevationConfig(observation="error"))
    with pytest.raises(ValueError, match="action_type='continuous'"):
        PID(ElevationConfig(action_type="discrete"))
