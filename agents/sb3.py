"""Stable-Baselines3's A2C: the reference, with the same networks, settings and socket."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from stable_baselines3 import A2C
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from .learner import (
    AnyLog,
    OnUpdate,
    optimizer_arrays,
    seeds_of,
    set_optimizer_arrays,
    updates_of,
)
from .presets import A2CConfig
from .sb3_vec import SB3VecEnv
from .vector_episodes import VectorEpisodeLog

__all__ = ["SB3A2C"]


class SB3A2C:
    """SB3's A2C behind the same interface as our own algorithms.

    Adam instead of SB3's RMSprop, no clipping of gradients, and every other setting from the same
    `A2CConfig`: given the same experience, it makes the same updates as ours.

    Args:
        env: The env to train on: SB3 wants it at construction.
        config: Hyperparameters.
        seed: Seed of the run: weights and actions.
    """

    def __init__(self, env: Any, config: A2CConfig, seed: int) -> None:
        torch_seed, _ = seeds_of(seed)
        # SB3 draws from the global generators: torch for actions, NumPy for the order of samples.
        torch.manual_seed(torch_seed)
        np.random.seed(torch_seed % 2**32)  # noqa: NPY002
        self._config = config
        drones = getattr(env, "num_envs", 1)
        self._rollout = config.rollout_size(drones)
        self._ahead = 0.0
        self._model = _A2C(
            "MlpPolicy",
            SB3VecEnv(env) if isinstance(env, VectorEpisodeLog) else DummyVecEnv([lambda: env]),
            learning_rate=self._learning_rate,
            n_steps=self._rollout // drones,
            gamma=config.gamma,
            gae_lambda=config.trace,
            ent_coef=config.entropy_weight,
            vf_coef=config.value_weight,
            max_grad_norm=float("inf"),
            use_rms_prop=False,
            normalize_advantage=config.normalize and self._rollout > 1,
            policy_kwargs={
                "net_arch": {"pi": [config.hidden], "vf": [config.hidden]},
                "activation_fn": torch.nn.ReLU,
                "log_std_init": config.log_std,
                "optimizer_kwargs": {"eps": 1e-8, "foreach": True},
            },
            device="cpu",
        )
        # It keeps the numbers of the last update for us; SB3's own makes a folder in /tmp.
        self._model.set_logger(Logger(folder=None, output_formats=[]))

    def train(self, log: AnyLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, or `on_update` returns False.

        SB3 flies whole rollouts only: steps short of another rollout are left unflown.
        """
        model, rollout = self._model, self._rollout
        done, whole = model.num_timesteps, env_steps // rollout * rollout
        if done >= whole:
            return
        self._ahead = rollout / whole
        model.on_update = on_update
        with suppress(_Stopped):
            model.learn(whole - done, reset_num_timesteps=done == 0)

    def last_step(self, env_steps: int) -> int:
        """Env steps after which a training of so many ends."""
        return env_steps // self._rollout * self._rollout

    def _learning_rate(self, left: float) -> float:
        # SB3 counts what is left after the rollout; ours, and so here, before it.
        share = min(left + self._ahead, 1.0) if self._config.anneal else 1.0
        return self._config.learning_rate * share

    def actor(self) -> dict[str, np.ndarray]:
        """Weights of the policy, under our names."""
        weights = {k: v.numpy().copy() for k, v in self._model.policy.state_dict().items()}
        return {ours: weights[theirs] for ours, theirs in _NAMES.items() if theirs in weights}

    def state(self) -> dict[str, np.ndarray]:
        """Weights, optimizer, both generators and what SB3 remembers between rollouts."""
        model = self._model
        state = {
            f"policy.{name}": value.numpy().copy()
            for name, value in model.policy.state_dict().items()
        }
        state |= optimizer_arrays(model.policy.optimizer)
        state["rng.torch"] = torch.get_rng_state().numpy().copy()
        _, keys, place, *_ = np.random.get_state()  # noqa: NPY002
        state["rng.numpy"] = np.append(keys, place).astype(np.uint32)
        state["steps"] = np.array(model.num_timesteps)
        if model._last_obs is not None:
            state["observation"] = np.array(model._last_obs)
            state["starts"] = np.array(model._last_episode_starts)
        return state

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""
        model = self._model
        prefix = "policy."
        model.policy.load_state_dict(
            {k[len(prefix):]: torch.from_numpy(v.copy()) for k, v in state.items()
             if k.startswith(prefix)}
        )  # fmt: skip
        set_optimizer_arrays(model.policy.optimizer, state)
        model._n_updates = updates_of(model.policy.optimizer)
        torch.set_rng_state(torch.from_numpy(state["rng.torch"].copy()))
        *keys, place = state["rng.numpy"]
        np.random.set_state(("MT19937", np.array(keys, np.uint32), int(place), 0, 0.0))  # noqa: NPY002
        model.num_timesteps = int(state["steps"])
        if "observation" in state:
            model._last_obs = state["observation"]
            model._last_episode_starts = state["starts"]

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as SB3 logs them; none before the first."""
        kept = self._model.logger.name_to_value
        return {name: float(value) for name, value in kept.items() if name.startswith("train/")}


class _Stopped(Exception):
    """Ends SB3's loop between an update and the next rollout."""


class _A2C(A2C):
    """SB3's A2C, which has no callback between an update and the next rollout."""

    on_update: OnUpdate

    def train(self) -> None:
        super().train()
        if not self.on_update():
            raise _Stopped


_NAMES = {
    "hidden.weight": "mlp_extractor.policy_net.0.weight",
    "hidden.bias": "mlp_extractor.policy_net.0.bias",
    "output.weight": "action_net.weight",
    "output.bias": "action_net.bias",
    "log_std": "log_std",
}
