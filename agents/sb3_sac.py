"""Stable-Baselines3's SAC as the reference for ours."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..models.errors import expect
from . import learner
from .episodes import EpisodeLog
from .policies import ActionMap, NetworkPolicy
from .presets import SACConfig
from .sb3 import (
    SB3Agent,
    SB3VecEnv,
    Stopped,
    arrays_of,
    check_finite,
    generator_arrays,
    load_arrays,
    optimizer_arrays,
    seed_generators,
    set_generators,
    set_optimizer_arrays,
)

if TYPE_CHECKING:
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common import logger as sb3_logger
else:
    from .sb3 import sb3, sb3_logger, torch

_COLUMNS: Final = ("observations", "actions", "next_observations", "rewards", "dones", "timeouts")


class SB3SAC(SB3Agent):
    """SB3's SAC behind the same interface as our own, with all settings from the same `SACConfig`.

    Given the same weights, batch and noise, it makes the same update as ours.

    Attributes:
        model: SB3's own.
    """

    def __init__(self, log: EpisodeLog, config: SACConfig, seed: int) -> None:
        choices = ActionMap(log.spec.action).discrete
        expect(not choices, "sb3-sac", "an env of continuous actions", "one of choices")
        torch_seed, aim = seed_generators(seed), config.target_entropy
        self.spec, self._config, self._ahead = log.spec, config, 0.0  # type: ignore[assignment]
        self._rollout = config.rollout_size(log.num_envs)
        self.model: Any = _SAC(
            "MlpPolicy",
            SB3VecEnv(log),
            learning_rate=self._learning_rate,
            buffer_size=config.buffer_size,
            learning_starts=config.learning_starts - 1,  # SB3 learns after more than so many
            batch_size=config.batch_size,
            tau=config.tau,
            gamma=config.gamma,
            train_freq=self._rollout // log.num_envs,
            gradient_steps=config.gradient_steps,
            ent_coef=f"auto_{config.alpha}",
            target_entropy="auto" if aim is None else aim,
            policy_kwargs={
                "net_arch": list(config.hidden),
                "activation_fn": torch.nn.ReLU if config.activation == "relu" else torch.nn.Tanh,
            },
            device="cpu",
        )
        self.model.action_space.seed(torch_seed)  # for the uniform actions of the beginning
        self.model.set_logger(sb3_logger.Logger(folder=None, output_formats=[]))

    def actor(self) -> dict[str, np.ndarray]:
        """Weights of the policy, under our names."""
        weights = arrays_of(self.model.actor)
        layers = [*(f"latent_pi.{2 * i}" for i in range(len(self._config.hidden))), "mu"]
        return {
            f"layers.{i}.{kind}": weights[f"{name}.{kind}"]
            for i, name in enumerate(layers)
            for kind in ("weight", "bias")
        }

    def policy(self) -> NetworkPolicy:
        """The current policy, without exploration: a copy."""
        return NetworkPolicy(self.actor(), self.spec, self._config.activation, squash=True)

    def state(self) -> dict[str, np.ndarray]:
        """Weights, optimizers, temperature, buffer and generators."""
        model, buffer = self.model, self.model.replay_buffer
        state = learner.named("policy.", arrays_of(model.policy))
        for name, optimizer in self._optimizers().items():
            state |= learner.named(f"{name}.", optimizer_arrays(optimizer))
        filled = buffer.buffer_size if buffer.full else buffer.pos
        state |= {f"buffer.{name}": getattr(buffer, name)[:filled].copy() for name in _COLUMNS}
        state["counts"] = np.array([buffer.pos, buffer.full, model._n_updates])
        state["log_alpha"] = model.log_ent_coef.detach().numpy().copy()
        state["rng.space"] = learner.generator_array(model.action_space.np_random)
        return state | generator_arrays()

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""
        model, buffer = self.model, self.model.replay_buffer
        load_arrays(model.policy, state, "policy.")
        for name, optimizer in self._optimizers().items():
            set_optimizer_arrays(optimizer, learner.part_of(state, f"{name}."))
        place, full, model._n_updates = map(int, state["counts"])
        filled = buffer.buffer_size if full else place
        for name in _COLUMNS:
            rows, given = getattr(buffer, name), state[f"buffer.{name}"]
            if given.shape != (expected := (filled, *rows.shape[1:])):
                raise ValueError(f"buffer.{name}: expected {expected}, got {given.shape}")
            rows[:filled] = given
        buffer.pos, buffer.full = place, bool(full)
        model.log_ent_coef.data = torch.from_numpy(state["log_alpha"].copy())
        set_generators(state)
        learner.set_generator(model.action_space.np_random, state["rng.space"])

    def _optimizers(self) -> dict[str, Any]:
        model = self.model
        return {"actor": model.actor.optimizer, "critic": model.critic.optimizer,
                "alpha": model.ent_coef_optimizer}  # fmt: skip


class _SAC(sb3.SAC):
    """SB3 has no callback between an update and the next rollout."""

    on_update: learner.OnUpdate

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, batch_size)
        check_finite(self.actor.optimizer)
        check_finite(self.critic.optimizer)
        if not self.on_update():
            raise Stopped
