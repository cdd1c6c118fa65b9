"""A task for several drones, for tests."""

from typing import Final

import numpy as np
from rotorgram.envs import ArraySpec, Metric, Outcome, Task, register
from rotorgram.sim import InitialState

RISE: Final = "swarm/Rise-v0"


class Rise(Task):
    """Drones in a row, 5 m apart. One that is 0.5 m above or below its start is out."""

    max_drones = 64
    action = "offset"
    episode_length = 30
    metrics = (Metric(name="risen", unit="m"),)

    def setup(self):
        self.observation = (ArraySpec(name="observation", shape=(3,), low=-100.0, high=100.0),)

    def begin(self, draw):
        row = 5.0 * np.arange(self.shape[1]) + draw.uniform(-0.1, 0.1)
        return InitialState(position=np.stack((row, 0.0 * row, 10.0 + 0.0 * row), axis=-1))

    def observe(self, state):
        return {"observation": state.position}

    def outcome(self, state):
        risen = state.position[..., 2] - 10.0
        return Outcome(
            reward={"alive": 1.0 + 0.0 * risen},
            terminated=abs(risen) > 0.5,
            metrics={"risen": risen},
        )


register(RISE, Rise)
