"""Proximal Policy Optimisation: Schulman et al. 2017, arXiv 1707.06347, Equations 7 and 9."""

from typing import Annotated

import numpy as np

from ..models.fields import Limits, PositiveInt, immutable
from .a2c import A2C, A2CConfig
from .config import Positive
from .episodes import Mask
from .layers import Floats, views
from .optimizers import clip_norm
from .rollouts import Rollout


@immutable
class PPOConfig(A2CConfig):
    """Proximal Policy Optimisation (Schulman et al. 2017). Defaults: where it says so, the paper's.

    Serves our PPO and Stable-Baselines3's.
    """

    learning_rate: float = 0.0003
    """Of Adam (Schulman et al., table 3)."""
    critic_learning_rate: Positive | None = None
    """Of the critic's weights; null: the same."""
    steps_per_update: int = 2048
    """Env steps of a rollout, of all drones together (table 3)."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation (table 3)."""
    normalize: bool = True
    """Shift and scale the advantages of a minibatch to mean 0 and standard deviation 1."""
    epochs: PositiveInt = 10
    """Passes over a rollout (table 3)."""
    minibatches: PositiveInt = 32
    """Parts of a rollout, each for one step of Adam (table 3: of 64 transitions)."""
    clip: Annotated[float, Limits(0.0, above=True)] = 0.2
    """Change of an action's probability that the objective rewards (table 3)."""
    max_grad_norm: Positive = 0.5
    """The gradient, as one vector, is scaled down to this length."""
    target_kl: Positive | None = None
    """An update ends at a minibatch whose divergence is above 1.5 times it, nats, as in SB3. Null:
    never."""


class PPO(A2C):
    """Many small steps on the same rollout, while the policy stays near the one that flew it.

    Each epoch draws the transitions in another order and cuts them into minibatches. Each of these
    is one step of Adam on the loss of Equation 9, with the clipped objective of Equation 7.
    """

    config: PPOConfig
    epsilon = 1e-5  # as in Stable-Baselines3 and in Schulman's code

    @property
    def scales(self) -> Floats | None:
        """Factor of the learning rate of every weight; None: 1."""
        critic_rate = self.config.critic_learning_rate
        if critic_rate is None:
            return None
        scales = np.ones_like(self.weights.values)
        for array in views(scales, self._shapes).values():
            array[1] = critic_rate / self.config.learning_rate
        return scales

    def update(self, rollout: Rollout) -> None:
        """Learn from a rollout: by `epochs` times `minibatches` steps of Adam."""
        config = self.config
        sequences = self.sequences(rollout)
        columns = self.columns(rollout)
        scales = self.scales
        axis = 0
        choices = np.arange(len(rollout))
        if sequences:  # whole drones
            axis = 1
            choices = np.flatnonzero(rollout.kept.any(axis=0))
        minibatches = min(config.minibatches, len(choices))
        draws = (
            chosen
            for _ in range(config.epochs)
            for chosen in np.array_split(self._rng.permutation(choices), minibatches)
        )
        self._changes: list[Floats] = []
        terms = []
        for chosen in draws:
            some = [column.take(chosen, axis=axis) for column in columns]
            part = sequences.take(chosen) if sequences else None
            terms.append(self.minibatch(*some, sequences=part))
            if config.target_kl and divergence(self._changes[-1]) > 1.5 * config.target_kl:
                break
            clip_norm(self.weights.slopes, config.max_grad_norm)
            self.optimizer.step(self.rate, scales)
        means = np.mean(terms, axis=0).tolist()
        self.terms |= dict(zip(("gain", "entropy", "value_loss"), means, strict=True))
        changes = np.concatenate(self._changes)
        self.terms["clip_fraction"] = np.mean(np.abs(np.expm1(changes)) > config.clip)
        self.terms["approx_kl"] = divergence(changes[-len(rollout) :])

    def columns(self, rollout: Rollout) -> list[Floats]:
        """As of A2C, and log-probabilities by the policy that flew."""
        columns = super().columns(rollout)
        flown = [rollout.outputs, rollout.actions]
        if not self.config.memory:
            flown = [rollout.rows(column) for column in flown]
        *lead, _ = flown[0].shape
        outputs, actions = (column.reshape(-1, column.shape[-1]).T for column in flown)
        before, _ = self._actor.head.score(outputs, actions)
        return [*columns, before.reshape(lead)]

    def objective(  # type: ignore[override]
        self, log_probability: Floats, advantage: Floats, before: Floats
    ) -> tuple[Floats, Floats]:
        """min(r A, clip(r, 1 - c, 1 + c) A) for the ratio r of the probabilities now and before.

        Its derivative by log P is r A, or 0 where it is clipped.
        """
        clip = self.config.clip
        change = log_probability - before
        self._changes.append(change)
        ratio = np.exp(change)
        gains = ratio * advantage
        np.minimum(np.maximum(ratio, 1 - clip, out=ratio), 1 + clip, out=ratio)
        ratio *= advantage
        return np.minimum(gains, ratio), gains * (gains <= ratio)


def divergence(changes: Floats) -> float:
    """Of KL, nats, as SB3 estimates it from changes of log-probabilities."""
    return float(np.mean(np.expm1(changes) - changes))


class MAPPO(PPO):
    """PPO with a central critic: Yu et al. 2022, arXiv 2103.01955. Drones share parameters.

    The critic sees all drones of a world, and is needed in training alone.

    To judge a drone it sees that drone's observation and then those of the others, from the next
    one on by their names; zeros for a drone that is out. The actor sees what its drone sees, as
    PPO's.

    As in the paper: shared parameters, a state of the agent's own for the critic, generalised
    advantages that are normalised, the clipped objective. Not as there: values are not normalised,
    a rollout has as many minibatches as PPO's (the paper advises one or two), the loss of the value
    is neither clipped nor Huber's, and a drone that is out has no transition, where the paper's
    death masking gives zeros to the agent that is judged.
    """

    central = True

    def seen(self, observations: Floats, flying: Mask) -> Floats:
        """Inputs of the critic, shape (T, N, A·n), as `A2C.seen`."""
        count = len(self.spec.agents)
        steps, rows, size = observations.shape
        worlds = observations.reshape(steps, -1, count, size)
        there = worlds * flying.reshape(steps, -1, count, 1)
        others = [np.roll(there, -next_one, axis=2) for next_one in range(1, count)]
        return np.concatenate([worlds, *others], axis=-1).reshape(steps, rows, -1)
