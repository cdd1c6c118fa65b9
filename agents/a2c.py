"""Advantage Actor-Critic: the paper's Algorithm 2, Equation 3."""

import math
from functools import cached_property
from typing import Annotated

import numpy as np

from ..models.fields import Limits, immutable
from .config import RolloutConfig, Share
from .episodes import Mask
from .layers import Floats, Weights
from .learner import Learner
from .memory import Sequences
from .rollouts import Collector, Numbers, Rollout, advantages


@immutable
class A2CConfig(RolloutConfig):
    """Advantage Actor-Critic (paper, section 2.3, Algorithm 2). Defaults: the paper's setting.

    Serves our A2C and Stable-Baselines3's.
    """

    gae_lambda: Share = 0.0
    """Lambda of generalised advantage estimation; 0 is the paper's Equation 3."""
    normalize: bool = False
    """Shift and scale the advantages of an update to mean 0 and standard deviation 1."""
    vf_coef: Annotated[float, Limits(0.0)] = 0.5
    """Weight of the squared error of the value."""
    ent_coef: Annotated[float, Limits(0.0)] = 0.0
    """Weight of the policy's entropy."""


class A2C(Learner):
    """Two networks: the critic learns V(s), the actor follows the advantage.

    Algorithm 2 weighs the actor's gradient by Q in step 3; the text and Equation 3 by A, as here.
    The critic descends the squared error to r + gamma · V(s'), held still, which is step 5.
    """

    config: A2CConfig
    has_critic = True

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly a fixed number of steps, across episodes."""
        return collector.steps(min(self.config.steps_per_update, most))

    def gradient(self, rollout: Rollout) -> None:
        """Of minus the mean of A · log P, plus the weighted squared error of the value."""
        sequences = self.sequences(rollout)
        columns = self.columns(rollout)
        gain, entropy, value_loss = self.minibatch(*columns, sequences=sequences)
        self.terms |= {"gain": gain, "entropy": entropy, "value_loss": value_loss}

    def columns(self, rollout: Rollout) -> list[Floats]:
        """Arguments of `minibatch` for all transitions of a rollout. Begins the `terms`.

        Moves the critic's memory to the end of the rollout.
        """
        estimates, judged, seen = self.advantages(rollout)
        advantage = estimates.astype(np.float32)
        values = judged.astype(np.float32)
        targets = values + advantage
        self.terms = {"values": rollout.rows(values), "targets": rollout.rows(targets)}
        columns = [seen, rollout.actions, advantage, targets]
        if self.config.memory:
            return columns
        return [rollout.rows(column) for column in columns]

    def sequences(self, rollout: Rollout, which: int | slice = slice(2)) -> Sequences | None:
        """The rollout as what the memories of actor (0) and critic (1) read; None without these."""
        if not self.config.memory:
            return None
        states = np.stack((rollout.state, self._memory[1]))
        return Sequences(states[which], rollout.begins, rollout.kept)

    def minibatch(
        self, inputs: Floats, *others: Floats, sequences: Sequences | None = None
    ) -> tuple[float, float, float]:
        """Set the gradients of the loss of B transitions; its gain, entropy and value loss.

        Rows of `inputs` and (B, k) of actions, and shape (B,): advantages, targets of V(s), and
        what else `objective` takes. With a memory all of them have the shape (T, S, ...) of
        `sequences`, and only their kept rows count.
        """
        config = self.config
        kept: slice | Mask = slice(None)
        if sequences is not None:
            kept = sequences.kept.ravel()
            inputs = inputs.reshape(-1, *inputs.shape[2:])
            others = tuple(column[sequences.kept] for column in others)
        actions, advantage, targets, *before = others
        count = len(targets)
        if config.normalize and count > 1:
            advantage = advantage - advantage.sum() / count
            advantage /= math.sqrt(advantage.dot(advantage) / (count - 1)) + 1e-8
        found = self._both.forward(inputs.T, sequences)
        outputs = found[..., kept]
        log_probability, entropy = self._actor.head.score(outputs[0], actions.T)
        gains, weights = self.objective(log_probability, advantage, *before)
        errors = outputs[1, 0] - targets
        slopes = outputs  # the derivatives take the place of the outputs; others of them are 0
        slopes[0] = self._actor.head.back(weights * (-1 / count), -config.ent_coef)
        np.multiply(errors, 2 * config.vf_coef / count, out=slopes[1, 0])
        if sequences is not None:
            found[...] = 0.0
            found[..., kept] = slopes
        self._both.learn(found)
        by_weights = self.weights.slopes
        by_weights *= self._learned
        return float(gains.sum()) / count, entropy, float(errors.dot(errors)) / count

    def objective(self, log_probability: Floats, advantage: Floats) -> tuple[Floats, Floats]:
        """The gain of each transition, and its derivative by log P, all of shape (B,)."""
        return log_probability * advantage, advantage

    def advantages(self, rollout: Rollout) -> tuple[Numbers, Numbers, Floats]:
        """A_t and V(s_t) of every row, shape (T, N), and the inputs of the critic for them."""
        seen = self.seen(rollout.observations, rollout.kept)
        after = self.seen(rollout.next_observations, rollout.kept & ~rollout.terminated)
        own = self.sequences(rollout, 1)
        values = self._values(seen, own)
        following = np.roll(values, -1, axis=0)
        # The next row has the same observation, unless an episode ends between them.
        new = rollout.ends.copy()
        new[-1] = True
        memory = self._critic.memory
        if memory:
            states = memory.states
            self._memory[1] = np.where(rollout.ends[-1], 0.0, states[:, -1])
            once = np.zeros((1, int(new.sum())), bool)
            own = Sequences(states[:, new], once, once)
        following[new] = self._values(after[new], own)
        estimates = advantages(
            rollout.rewards,
            values,
            following,
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            gae_lambda=self.config.gae_lambda,
        )
        return estimates, values, seen

    def seen(self, observations: Floats, flying: Mask) -> Floats:
        """Inputs of the critic, shape (T, N, m), from observations (T, N, n): here the same.

        The first of them are the actor's. Of drones that are not `flying`, bool, shape (T, N),
        another drone may not learn.
        """
        return observations

    @cached_property
    def _learned(self) -> Floats:
        """1 for each weight that actor or critic has, 0 for those that both skip, shape (P,).

        In an update both see the inputs of the critic: weights of inputs that the actor does not
        have stay 0.
        """
        learned = Weights.zeros(self._shapes)
        for number, own in enumerate((self._actor.shapes, self._critic.shapes)):
            for array in learned.of_one(number, own).arrays.values():
                array[...] = 1.0
        return learned.values

    def _values(self, seen: Floats, sequences: Sequences | None) -> Numbers:
        """V(s), shape (...), of inputs of the critic, shape (..., m)."""
        *lead, size = seen.shape
        values = self._critic.forward(seen.reshape(-1, size).T, sequences)
        return values.reshape(lead).astype(np.float64)
