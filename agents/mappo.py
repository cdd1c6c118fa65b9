"""PPO with a central critic: Yu et al. 2022, arXiv 2103.01955, with parameters shared by drones."""

import numpy as np

from .episodes import Mask
from .layers import Floats
from .ppo import PPO


class MAPPO(PPO):
    """The critic sees all drones of a world, and is needed in training alone.

    To judge a drone it sees that drone's observation and then those of the others, from the next
    one on by their names; zeros for a drone that is out. The actor sees what its drone sees, as
    PPO's.
    """

    central = True

    def seen(self, observations: Floats, flying: Mask) -> Floats:
        """Inputs of the critic, shape (T, N, A·n), as `A2C.seen`."""
        own = super().seen(observations, flying)
        count = len(self.spec.agents)
        (steps, rows, size) = own.shape
        worlds = own.reshape(steps, -1, count, size)
        there = worlds * flying.reshape(steps, -1, count, 1)
        others = [np.roll(there, -next_one, axis=2) for next_one in range(1, count)]
        return np.concatenate([worlds, *others], axis=-1).reshape(steps, rows, -1)
