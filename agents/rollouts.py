"""Experience: a policy flies, every transition is kept; returns and advantages of them.

Time is the first axis, drones may be the second: arrays have the shape (T, ...) or (T, N, ...).
`terminated` and `truncated` mark the last transition of an episode. A value is carried over a
truncation and never over a termination; a recursion stops at either, and at the last row.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from .episodes import EpisodeRecorder, Mask
from .layers import Floats
from .policies import Array, NetworkPolicy

Numbers = NDArray[np.float64]


class Diverged(InputError):
    """Weights or actions are not finite. Checkpoints from before are whole."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"training diverged: {reason}; try a lower learning_rate")


@dataclass(frozen=True)
class Rollout:
    """T steps of N drones. `kept` marks real transitions; losses skip the rest.

    Recursions over time may run through the rest, for an episode ends before each.
    """

    state: Floats
    """Of the policy's memory before the first row, shape (H, N)."""
    observations: Floats
    """Shape (T, N, n)."""
    outputs: Floats
    """Of the policy's network as it flew: shape (T, N, k)."""
    actions: Floats
    """As drawn, not clipped: shape (T, N, k); (T, N, 1) if discrete."""
    rewards: Numbers
    """Shape (T, N)."""
    next_observations: Floats
    """As `observations`, after each step and before any reset."""
    terminated: Mask
    """Shape (T, N), as the following."""
    truncated: Mask
    kept: Mask

    def __len__(self) -> int:
        return int(self.kept.sum())

    @property
    def ends(self) -> Mask:
        """After which rows another episode begins, or may: bool, shape (T, N)."""
        return np.asarray(self.terminated | self.truncated | ~self.kept)

    @property
    def begins(self) -> Mask:
        """Before which rows an episode begins, of which a memory knows nothing: shape (T, N).

        The first row has the state that the rollout has kept.
        """
        begins = np.zeros_like(self.kept)
        begins[1:] = self.ends[:-1]
        return begins

    def rows(self, array: Array) -> Array:
        """The kept rows of an array of shape (T, N, ...): one for each transition."""
        if self.kept.all():
            return array.reshape(-1, *array.shape[2:])
        return np.asarray(array[self.kept])

    def without_steps(self, lost: Mask) -> "Rollout":
        """Without the steps that lost their simulator: their rewards and observations are made up.

        The episode stops one step earlier: a value is carried over that, as over a truncation.
        """
        if not lost.any():
            return self
        truncated = self.truncated.copy()
        truncated[:-1] |= lost[1:] & ~self.terminated[:-1]
        return replace(self, truncated=truncated, kept=self.kept & ~lost)

    def without_episodes(self, lost: Mask) -> "Rollout":
        """Without the episodes that end with such a step: their returns are unknown."""
        losses = discounted_sums(lost, ~self.ends)
        return replace(self, kept=self.kept & (losses == 0))


@dataclass
class Collector:
    """Flies a policy, episode after episode, across calls; `rng` draws the actions."""

    log: EpisodeRecorder
    rng: np.random.Generator
    policy: NetworkPolicy

    def steps(self, count: int) -> Rollout:
        """Whole steps of all drones: the fewest for `count` transitions, without the lost steps.

        Running episodes go on in the next call. After an episode ends, that drone's next step
        begins the next episode and is no transition; if all have ended, no step is spent.
        """
        length = -(-count // self.log.num_envs)
        rollout, lost, _ = self._fly(length, None)
        return rollout.without_steps(lost)

    def episodes(self, count: int, most_steps: int) -> Rollout:
        """Whole episodes, the same number of each drone: at least `count`.

        A drone whose episode ends is frozen until all have ended. A round that `most_steps`
        cuts off is left out, but for a single drone's last fragment. Episodes with a lost simulator
        are left out, and a round of nothing else does not count.
        """
        log = self.log
        rounds = -(-count // log.num_envs)
        last = log.env_steps + most_steps
        flown = []
        while rounds and log.env_steps < last:
            rollout, lost, done = self._fly(None, last)
            rollout = rollout.without_episodes(lost)
            if not done and log.num_envs > 1:
                rollout = replace(rollout, kept=np.zeros_like(rollout.kept))
            flown.append(rollout)
            if len(rollout):
                rounds -= 1
        columns = zip(*(vars(part).values() for part in flown), strict=True)
        return Rollout(*map(np.concatenate, columns))

    def _fly(self, length: int | None, last: int | None) -> tuple[Rollout, Mask, bool]:
        """`length` steps of all drones; or an episode of each, if it ends by the env step `last`.

        Returns the rollout; the steps in which a simulator was lost, bool, shape (T, N); and
        whether all drones are at the end of an episode.
        """
        log = self.log
        env = log.env
        count = log.num_envs
        log.start()
        block = length or max(256 // count, 1)
        memory = self.policy.memory
        state = memory.state.copy() if memory else np.zeros((0, count), np.float32)
        rows: list[tuple[Array, ...]] = []
        observations = log.observations
        waiting = int(np.count_nonzero(log.done))
        while len(rows) != length and (last is None or log.env_steps < last):
            if not len(rows) % block:
                drawn = self.policy.head.noise(self.rng, block * count)
                noise = drawn.reshape(block, count, -1)
            outputs = self.policy.outputs(observations).copy()
            actions = self.policy.head.sample(outputs, noise[len(rows) % block])
            if not np.isfinite(actions).all():
                raise Diverged("actions are not finite")
            flying = ~log.out
            idle = log.done if waiting else None
            if last is None:
                log.fly(actions, idle, None)
            else:
                log.fly(actions, None, idle)
            after = log.observations
            ends = (env.terminated, env.truncated, flying, env.lost)
            rows.append((observations, outputs, actions, env.rewards, after, *ends))
            if memory:
                memory.forget(env.terminated | env.truncated | env.lost | ~flying)
            observations = after
            waiting = int(np.count_nonzero(log.done))  # of few drones faster than `any`
            if waiting == count:
                if last is not None:
                    break
                log.begin(log.done)
                observations = log.observations
                waiting = 0
        if waiting and (last is None or waiting == count):
            log.begin(log.done)
        *columns, lost = (np.array(column) for column in zip(*rows, strict=True))
        return Rollout(state, *columns), lost, waiting == count


def discounted_sums(values: Array, factors: Array) -> Numbers:
    """S_t = v_t + f_t · S_t+1, where S is 0 after the last row: float64, shape of `values`.

    A factor is 0 where a sum stops. The rows are combined in pairs, pairs of pairs and so on:
    log2(T) NumPy operations on all of them take the place of T operations on one.
    """
    sums = values.astype(np.float64)
    factors = factors.astype(np.float64)
    span = 1
    while span < len(sums):
        sums[:-span] += factors[:-span] * sums[span:]
        factors[:-span] *= factors[span:]
        factors[-span:] = 0.0
        span *= 2
    return sums


def advantages(
    rewards: Numbers,
    values: Numbers,
    next_values: Numbers,
    terminated: Mask,
    truncated: Mask,
    *,
    gamma: float,
    gae_lambda: float,
) -> Numbers:
    """Generalised advantage estimates, float64; with `gae_lambda` = 0 the paper's Equation 3.

    A_t = r_t + gamma · V(s_t+1) - V(s_t), where V after a termination is 0, and s_t+1 is the state
    that the step led to, before any reset. `gae_lambda` is the decay of the sum over later errors.
    Arrays have shape (T, N), as the result; the last two are bool.
    """
    errors: Numbers = rewards + gamma * np.where(terminated, 0.0, next_values) - values
    if gae_lambda == 0.0:
        return errors
    return discounted_sums(errors, gamma * gae_lambda * ~(terminated | truncated))


def step_of_episode(ends: Mask) -> NDArray[np.int64]:
    """Number of each step within its episode, where the first row begins at 0."""
    goes_on = np.roll(~ends, 1, axis=0)
    # The sum of ones backward in time: it counts the steps up to each.
    steps = discounted_sums(np.ones(ends.shape), goes_on[::-1])[::-1]
    return steps.astype(int) - 1
