"""Analytic policy gradient: the derivative of the reward itself, through the backend `rigid`.

Backpropagation through time, as in Wiedemann et al., ICRA 2023, arXiv 2209.13052: no value
function. It needs torch and an env in this process: derivatives do not cross the wire.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..models.errors import expect, require
from .episodes import EpisodeLog
from .learner import Learner, OnUpdate, diverged
from .networks import clip_norm
from .presets import APGConfig

if TYPE_CHECKING:
    import torch
else:
    torch = require("torch", "train", "apg")

NEAR: Final = {"position": 0.3, "quaternion": 0.1}
"""Deviations of the states that count as near: m, and half the angle in rad (0.2 rad of tilt)."""


class APG(Learner):
    """The derivative of the return by every action, through controller, body, task and policy.

    An update flies `horizon` steps of every drone with the most likely actions. What was before
    them is held still, and nothing counts after them: so the derivatives by the last `tail` actions
    before the end, whose consequences are missing, move no weight. Those by all others do, in
    minibatches, each alike: an action's own discount begins with it.
    """

    config: APGConfig

    def __init__(self, log: EpisodeLog, config: APGConfig, seed: int) -> None:
        super().__init__(log, config, seed)
        self._loop: Any = getattr(log.env, "loop", None)
        backend = "rigid" if hasattr(getattr(self._loop, "world", None), "detach") else "another"
        expect(
            backend == "rigid", "apg", "an env in this process, on rigid with gradients", backend
        )
        sensed = "sensors" in log.spec.options
        expect(not sensed, "apg", "an env without sensors, which have no derivative", "some")
        torch.set_num_threads(1)  # such small tensors lose by a second thread
        actions = log.actions
        expect(not actions.discrete, "apg", "continuous actions", "choices")
        self._map = [
            torch.from_numpy(np.array(bound))
            for bound in (actions.middle, actions.half, actions.low, actions.high)
        ]

    def train(self, log: EpisodeLog, env_steps: int, on_update: OnUpdate) -> None:
        """As `Learner.train`: whole steps of all drones, at most `horizon` an update."""
        config = self.config
        log.start()
        while log.env_steps < env_steps:
            before = log.env_steps
            if config.anneal:
                self.rate = config.learning_rate * (1 - before / env_steps)
            steps = min(config.horizon, -(-(env_steps - before) // log.num_envs))
            observations, slopes = self.flight(log, steps)
            if len(observations):
                self.learn(observations, slopes)
            if not np.isfinite(self.weights.values).all():
                raise diverged(self.optimizer.steps)
            if not on_update():
                return

    def learn(self, observations: np.ndarray, slopes: np.ndarray) -> None:
        """Descend a loss by its derivatives (M, k) by the net's outputs, in one epoch."""
        config, inputs = self.config, self.inputs(observations)
        order = self._rng.permutation(len(inputs))
        for part in np.array_split(order, min(config.minibatches, len(order))):
            self._actor.net.forward(inputs[part])
            self._actor.net.backward(slopes[part] / len(part))
            clip_norm(self.weights.slopes, config.max_grad_norm)
            self.optimizer.step(self.rate)
        if self.moments is not None:
            self.moments.add(observations)

    def flight(self, log: EpisodeLog, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Fly so many steps of all drones.

        Returns the observations (M, n) of those that move the weights, and with them the
        derivatives (M, k) of minus the return from there on by the net's outputs.
        """
        env: Any = log.env
        gamma, cost = self.config.gamma, self.config.crash_cost
        # Added to the net's outputs, for the derivatives by them.
        nudges = torch.zeros((steps, log.num_envs, log.actions.size), requires_grad=True)
        weight, total, danger = torch.ones(log.num_envs), 0.0 * nudges.sum(), torch.zeros(())
        rows: list[tuple[np.ndarray, ...]] = []
        for nudge in nudges:
            seen, done = self._observations(), env.done
            log.advance(self._actions(seen, nudge), done if done.any() else None)
            ended = env.terminated | env.truncated
            rows.append((seen.detach().numpy(), weight.numpy(), env.terminated, ended, ~done))
            share = torch.where(torch.from_numpy(~done), weight, 0.0)
            total = total + (share * self._loop.rewards).sum()
            if cost:
                near = near_end(self._loop.task, self._loop.world.state, self._rng)
                danger = danger + (share * near.reshape(-1)).sum()
            weight = torch.where(torch.from_numpy(ended | done), 1.0, weight * gamma)
        (cost * danger - total).backward()  # type: ignore[no-untyped-call]
        self._loop.detach()
        if env.done.any():  # a checkpoint has running episodes only
            log.begin(env.done)
        observations, weights, terminated, ended, flew = map(np.array, zip(*rows, strict=True))
        by_outputs: Any = nudges.grad
        slopes = by_outputs.numpy() / weights[..., np.newaxis]
        kept = flew & (steps_left(ended | ~flew, terminated) > self.config.tail)
        self.terms = {"gain": total.item() / max(flew.sum(), 1), "entropy": 0.0}
        return observations[kept], slopes[kept]

    def _observations(self) -> torch.Tensor:
        """Flat, shape (N, n), with their graph."""
        loop = self._loop
        parts = [loop.observations[one.name] for one in self.spec.observation]
        return torch.cat([part.reshape(loop.num_envs, -1) for part in parts], dim=1)

    def _actions(self, seen: torch.Tensor, nudge: torch.Tensor) -> torch.Tensor:
        """Actions of the env, shape (N, k), as `NetworkPolicy.act` gives them."""
        values = seen
        if self.moments is not None:
            mean, scale = (torch.from_numpy(x) for x in (self.moments.mean, self.moments.scale))
            values = (values - mean) * scale
        bend = torch.relu if self.config.activation == "relu" else torch.tanh
        arrays = self._actor.weights.arrays
        layers = len(self.config.hidden) + 1
        for i in range(layers):
            weight, bias = (
                torch.from_numpy(arrays[f"layers.{i}.{kind}"]) for kind in ("weight", "bias")
            )
            values = torch.addmm(bias, values, weight.T)
            values = bend(values) if i + 1 < layers else values
        middle, half, low, high = self._map
        return torch.minimum(torch.maximum(middle + half * (values + nudge), low), high)


def steps_left(ends: np.ndarray, terminated: np.ndarray) -> np.ndarray:
    """Steps until the flight is cut off, by its last row or a truncation: int, shape (T, N).

    After a crash nothing is missing: before one they are more than any horizon.
    """
    left = np.zeros(ends.shape, int)
    following = np.zeros(ends.shape[1], int)
    for row in range(len(ends) - 1, -1, -1):
        following = np.where(terminated[row], 2**31, np.where(ends[row], 0, following) + 1)
        left[row] = following
    return left


def near_end(task: Any, state: Any, rng: np.random.Generator) -> torch.Tensor:
    """What has the derivative, by the state, of the chance that an episode ends near there.

    An end is a step, which has none. So the chance is over states with a Gaussian of `NEAR` about
    the state, and its derivative by position and attitude is estimated from one pair of them for
    each drone: half the difference of the ends times noise over variance. Shape (W, A); the value
    itself means nothing.
    """
    noise = {
        name: torch.from_numpy(rng.standard_normal(getattr(state, name).shape, np.float32)) * size
        for name, size in NEAR.items()
    }
    ends = []
    for sign in (1, -1):
        near = {name: getattr(state, name).detach() + sign * x for name, x in noise.items()}
        near["quaternion"] = torch.nn.functional.normalize(near["quaternion"], dim=-1)
        ends.append(task.outcome(replace(state, **near)).terminated.float())
    along = sum((getattr(state, name) * x).sum(-1) / NEAR[name] ** 2 for name, x in noise.items())
    change: torch.Tensor = (ends[0] - ends[1]) / 2 * along
    return change
