"""Analytic policy gradient: the derivative of the reward itself, through the backend `rigid`.

As in Wiedemann et al., ICRA 2023, arXiv 2209.13052: no value function, no likelihoods. It needs
torch and an env in this process: derivatives do not cross the wire.
"""

from typing import TYPE_CHECKING, Any

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


class APG(Learner):
    """Backpropagation through time: policy, controller, body and task are one function.

    An update flies `horizon` steps of every drone with the most likely actions, and climbs the
    derivative of their mean discounted reward by the weights. What was before the horizon is held
    still, and nothing counts after it; running episodes go on with the next update.
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
            self.flight(log, steps)
            clip_norm(self.weights.slopes, config.max_grad_norm)
            self.optimizer.step(self.rate)
            if not np.isfinite(self.weights.values).all():
                raise diverged(self.optimizer.steps)
            if not on_update():
                return

    def flight(self, log: EpisodeLog, steps: int) -> None:
        """Fly so many steps of all drones, and set the gradient of minus their mean reward."""
        env: Any = log.env
        arrays, slopes = self._actor.weights.arrays, self._actor.weights.gradients
        leaves = {
            name: torch.tensor(array, requires_grad=True)
            for name, array in arrays.items()
            if name != "log_std"
        }
        weight, total, flown = torch.ones(log.num_envs), torch.zeros(()), 0
        seen: list[torch.Tensor] = []
        for _ in range(steps):
            seen.append(self._observations())
            done = env.done
            log.advance(self._actions(leaves, seen[-1]), done if done.any() else None)
            flew = ~torch.from_numpy(done)
            gain = torch.where(flew, weight * self._loop.rewards, 0.0)
            total, flown = total + gain.sum(), flown + int(flew.sum())
            ended = torch.from_numpy(env.terminated | env.truncated)
            weight = torch.where(ended | ~flew, 1.0, weight * self.config.gamma)
        mean = total / flown
        (-mean).backward()  # type: ignore[no-untyped-call]
        self._loop.detach()
        for name, leaf in leaves.items():
            slopes[name][...] = 0.0 if leaf.grad is None else leaf.grad.numpy()
        if self.moments is not None:
            self.moments.add(torch.cat(seen).detach().numpy())
        self.terms = {"gain": mean.item(), "entropy": 0.0}

    def _observations(self) -> torch.Tensor:
        """Flat, shape (N, n), with their graph."""
        loop = self._loop
        parts = [loop.observations[one.name] for one in self.spec.observation]
        return torch.cat([part.reshape(loop.num_envs, -1) for part in parts], dim=1)

    def _actions(self, leaves: dict[str, torch.Tensor], seen: torch.Tensor) -> torch.Tensor:
        """Actions of the env, shape (N, k), as `NetworkPolicy.act` gives them."""
        values = seen
        if self.moments is not None:
            mean, scale = (torch.from_numpy(x) for x in (self.moments.mean, self.moments.scale))
            values = (values - mean) * scale
        bend = torch.relu if self.config.activation == "relu" else torch.tanh
        layers = len(leaves) // 2
        for i in range(layers):
            weight, bias = (leaves[f"layers.{i}.{kind}"] for kind in ("weight", "bias"))
            values = torch.addmm(bias, values, weight.T)
            values = bend(values) if i + 1 < layers else values
        middle, half, low, high = self._map
        return torch.minimum(torch.maximum(middle + half * values, low), high)
