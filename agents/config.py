"""Hyperparameters that all algorithms have."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from ..models.fields import Limits, PositiveInt, check_fields, immutable

Positive = Annotated[float, Limits(0.0, 1e30, above=True)]
"""A number above 0 that float32 holds."""
Share = Annotated[float, Limits(0.0, 1.0)]
Sizes = Annotated[tuple[int, ...], Limits(1, whole=True, count=0)]
"""At least one, each at least 1."""
LOG_STD = Limits(-4.0, 1.0)
"""Of the logarithm of a standard deviation."""


@immutable
class Config:
    """Base of the hyperparameters of every algorithm. Raises `InputError` for a wrong one."""

    network: str = "mlp"
    """`mlp`, or `cnn` with convolutions over images and rings: see `networks.NETWORKS`."""
    reach: Positive | None = None
    """Of an observed length d, m, a network sees d / (1 + |d| / reach), or with a reach below 1 m
    d / (reach + |d|); null: all of it."""
    filters: Sizes = (4, 8, 16)
    """Filters of each convolution of a `cnn`."""
    memory: Annotated[int, Limits(0, 4096, whole=True)] = 0
    """Units of a GRU before the hidden layers, which remembers an episode; 0: none."""
    hidden: Sizes = (16,)
    """Units of each hidden layer of each network (paper: one of 16)."""
    activation: Literal["relu", "tanh"] = "relu"
    """Of the hidden units (paper: relu)."""
    learning_rate: Positive = 0.001
    """Of Adam (paper)."""
    anneal: bool = False
    """Lower the learning rate linearly to zero over the run."""
    gamma: Share = 0.99
    """Discount. The paper names none."""
    reward_scale: Positive = 1.0
    """Factor of the rewards that it learns from; returns are shown without it."""
    reward_clip: Positive | None = None
    """Largest size of a reward that it learns from, after `reward_scale`; null: any."""
    anneal_clip: bool = False
    """Raise `reward_clip` over the run: to twice as much at its half, to ten times at 9/10."""
    log_std: Annotated[float, LOG_STD] = -0.5
    """Initial logarithm of the policy's standard deviation, in units of the action."""
    squashed: bool = False
    """Bound continuous actions by tanh, after the noise. Cut at their bounds, actions have another
    mean with noise than without it."""

    draws: ClassVar[bool] = True
    """Whether the policy's weights have a standard deviation."""
    remembers: ClassVar[bool] = True
    """Whether the algorithm trains a memory."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.anneal_clip and self.reward_clip is None:
            raise InputError("anneal_clip: expected a reward_clip with it, got null")
        if self.memory and not self.remembers:
            own = type(self).__name__
            raise InputError(f"memory: expected 0 with {own}, got {self.memory}; ppo trains one")

    def scaled(self, rewards: NDArray[np.float64], left: float = 1.0) -> NDArray[np.float64]:
        """The rewards that it learns from, with this share of the run left."""
        scaled = self.reward_scale * rewards
        most = self.reward_clip
        if most is None:
            return scaled
        if self.anneal_clip:
            most /= left
        return np.clip(scaled, -most, most)

    def least_steps(self, drones: int, episode_length: int) -> int:
        """Env steps that a training needs for one update, with all drones together."""
        return 1


@immutable
class RolloutConfig(Config):
    """Hyperparameters of an algorithm with rollouts of a fixed size."""

    steps_per_update: PositiveInt = 1
    """Env steps between updates (paper: one), of all drones together."""

    def rollout_size(self, drones: int) -> int:
        """Env steps of a rollout: `steps_per_update`, rounded up to whole steps of all drones."""
        return -(-self.steps_per_update // drones) * drones

    def least_steps(self, drones: int, episode_length: int) -> int:
        return self.rollout_size(drones)


@immutable
class SACConfig(RolloutConfig):
    """Stable-Baselines3's Soft Actor-Critic (Haarnoja et al. 2018, arXiv 1812.05905).

    Defaults: its Table 1.
    """

    draws = False
    remembers = False
    squashed: bool = True
    """As in the paper."""
    hidden: tuple[int, ...] = (256, 256)
    """Units of each hidden layer of each network."""
    learning_rate: float = 0.0003
    """Of Adam: actor, critics and temperature."""
    gradient_steps: PositiveInt = 1
    """Updates after each `steps_per_update` env steps."""
    batch_size: PositiveInt = 256
    """Transitions of an update, drawn from the buffer."""
    buffer_size: PositiveInt = 1_000_000
    """Transitions that are kept."""
    learning_starts: PositiveInt = 1_000
    """Transitions of uniform actions before the first update. Table 1 has none."""
    tau: Annotated[float, Limits(0.0, 1.0, above=True)] = 0.005
    """Share of the critics that their targets take over in each update."""
    alpha: Positive = 1.0
    """Temperature at the beginning. Table 1 has none."""
