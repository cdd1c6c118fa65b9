"""Proximal Policy Optimisation: Schulman et al. 2017, arXiv 1707.06347, Equations 7 and 9."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from ..models.fields import Limits, PositiveInt
from .a2c import A2C, A2CConfig
from .networks import Floats
from .optimizers import clip_norm
from .rollouts import Rollout

_TERMS = ("gain", "entropy", "value_loss", "approx_kl", "clip_fraction")


@dataclass(frozen=True, kw_only=True)
class PPOConfig(A2CConfig):
    """Proximal Policy Optimisation (Schulman et al. 2017). Defaults: where it says so, the paper's.

    Serves our PPO and Stable-Baselines3's.
    """

    learning_rate: float = 0.0003
    """Of Adam (Schulman et al., table 3)."""
    critic_learning_rate: Annotated[float | None, Limits(0.0, 1e30, above=True)] = None
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
    max_grad_norm: Annotated[float, Limits(0.0, above=True)] = 0.5
    """The gradient, as one vector, is scaled down to this length."""


class PPO(A2C):
    """Many small steps on the same rollout, while the policy stays near the one that flew it.

    Each epoch draws the transitions in another order and cuts them into minibatches. Each of these
    is one step of Adam on the loss of Equation 9, with the clipped objective of Equation 7.
    """

    config: PPOConfig
    epsilon = 1e-5  # as in Stable-Baselines3 and in Schulman's code

    @property
    def rates(self) -> Floats:
        """Learning rate of every weight in the next update, float32."""
        rates = np.full_like(self.weights.values, self.rate)
        critic_rate = self.config.critic_learning_rate
        if critic_rate is not None:
            critic = self.weights.part("critic.").values.size
            rates[-critic:] *= critic_rate / self.config.learning_rate
        return rates

    def update(self, rollout: Rollout) -> None:
        """Learn from a rollout: by `epochs` times `minibatches` steps of Adam."""
        config = self.config
        columns = self._columns(rollout)
        rates = self.rates
        count = len(rollout)
        cuts = np.linspace(0, count, min(config.minibatches, count) + 1).astype(int).tolist()
        terms: list[tuple[float, ...]] = []
        for _ in range(config.epochs):
            order = self._rng.permutation(count)
            shuffled = [column[order] for column in columns]
            for first, last in pairwise(cuts):
                terms.append(self.minibatch(*(column[first:last] for column in shuffled)))
                clip_norm(self.weights.slopes, config.max_grad_norm)
                self.optimizer.step(rates)
        self.terms |= dict(zip(_TERMS, np.mean(terms, axis=0).tolist(), strict=True))
        last_epoch = terms[1 - len(cuts) :]
        self.terms["approx_kl"] = np.mean([one[3] for one in last_epoch])

    def minibatch(
        self,
        observations: Floats,
        actions: Floats,
        before: Floats,
        advantage: Floats,
        targets: Floats,
        seen: Floats | None = None,
    ) -> tuple[float, ...]:
        """Set the gradients of the loss of B transitions; its terms, by the names of `terms`.

        A central critic has `seen` more than the observations.

        Log-probabilities `before`, shape (B,), are those of the policy that flew, as `advantage`,
        and `targets` of V(s). The objective is the mean of min(r A, clip(r, 1 - c, 1 + c) A) for
        the ratio r of the probabilities. Its derivative by log P is r A, or 0 where it is clipped.
        """
        config = self.config
        count = len(before)
        if config.normalize and count > 1:
            advantage = advantage - advantage.mean()
            advantage /= np.sqrt(advantage.dot(advantage) / (count - 1)) + 1e-8
        log_probability, entropy = self._actor.score(observations, actions)
        change = log_probability - before
        ratio = np.exp(change)
        gains = ratio * advantage
        bounded = np.minimum(np.maximum(ratio, 1 - config.clip), 1 + config.clip) * advantage
        self._actor.backward(gains * (gains <= bounded) / -count, -config.ent_coef)
        inputs = observations if seen is None else seen
        errors = self._critic.forward(inputs)[:, 0] - targets
        self._critic.backward((2 * config.vf_coef / count * errors)[:, np.newaxis])
        clipped = np.count_nonzero(np.abs(ratio - 1) > config.clip) / count
        distance = float((ratio - 1 - change).mean())  # of KL, as SB3 estimates it
        gain = float(np.minimum(gains, bounded).mean())
        return gain, entropy, float(errors.dot(errors)) / count, distance, clipped

    def _columns(self, rollout: Rollout) -> tuple[Floats, ...]:
        """Arguments of `minibatch` for all transitions of a rollout."""
        observations = rollout.rows(rollout.observations)
        actions = rollout.rows(rollout.actions)
        estimates, judged, seen = self.advantages(rollout)
        advantage, values = (
            rollout.rows(array).astype(np.float32) for array in (estimates, judged)
        )
        targets = values + advantage
        before, _ = self._actor.score(observations, actions)
        self.terms = {"values": values, "targets": targets}
        more = (rollout.rows(seen),) if self.central else ()
        return observations, actions, before, advantage, targets, *more
