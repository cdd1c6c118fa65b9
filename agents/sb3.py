"""Stable-Baselines3's A2C: the reference, with the same networks, settings and socket."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from .episodes import EpisodeLog
from .learner import OnUpdate, optimizer_arrays, seeds_of, set_optimizer_arrays
from .presets import A2CConfig

__all__ = ["SB3A2C"]


class SB3A2C:
    """SB3's A2C behind the same interface as our own algorithms.

    Adam instead of SB3's RMSprop, no clipping of gradients, and every other setting from the same
    `A2CConfig`, so that what differs is the implementation alone.

    Args:
        env: The env to train on: SB3 wants it at construction.
        config: Hyperparameters.
        seed: Seed of the run: weights and actions.
    """

    def __init__(self, env: gym.Env[Any, Any], config: A2CConfig, seed: int) -> None:
        torch_seed, _ = seeds_of(seed)
        # SB3 draws from the global generators: torch for actions, NumPy for the order of samples.
        torch.manual_seed(torch_seed)
        np.random.seed(torch_seed % 2**32)  # noqa: NPY002
        rate = config.learning_rate
        self._model = A2C(
            "MlpPolicy",
            DummyVecEnv([lambda: env]),
            learning_rate=(lambda left: rate * left) if config.anneal else rate,
            n_steps=config.steps_per_update,
            gamma=config.gamma,
            gae_lambda=config.trace,
            ent_coef=config.entropy_weight,
            vf_coef=config.value_weight,
            max_grad_norm=float("inf"),
            use_rms_prop=False,
            normalize_advantage=config.normalize and config.steps_per_update > 1,
            policy_kwargs={
                "net_arch": {"pi": [config.hidden], "vf": [config.hidden]},
                "activation_fn": torch.nn.ReLU,
                "log_std_init": config.log_std,
                "optimizer_kwargs": {"eps": 1e-8, "foreach": True},
            },
            device="cpu",
        )

    def train(self, log: EpisodeLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, or `on_update` returns False.

        SB3 flies whole rollouts only: steps short of another rollout are left unflown.
        """
        done = self._model.num_timesteps
        whole = env_steps // self._model.n_steps * self._model.n_steps
        if done >= whole:
            return
        callback = _AfterUpdate(on_update)
        self._model.learn(whole - done, callback=callback, reset_num_timesteps=done == 0)
        callback.finish()

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
        torch.set_rng_state(torch.from_numpy(state["rng.torch"].copy()))
        *keys, place = state["rng.numpy"]
        np.random.set_state(("MT19937", np.array(keys, np.uint32), int(place), 0, 0.0))  # noqa: NPY002
        model.num_timesteps = int(state["steps"])
        if "observation" in state:
            model._last_obs = state["observation"]
            model._last_episode_starts = state["starts"]


class _AfterUpdate(BaseCallback):
    """Calls back after each update: SB3 itself has a hook before the next rollout."""

    def __init__(self, on_update: OnUpdate) -> None:
        super().__init__()
        self._on_update = on_update
        self._first = True
        self._stopped = False

    def _on_rollout_start(self) -> None:
        if not self._first and not self._on_update():
            self._stopped = True
        self._first = False

    def _on_step(self) -> bool:
        return not self._stopped

    def finish(self) -> None:
        """Report the last update, after which no rollout follows."""
        if not self._stopped:
            self._on_update()


_NAMES = {
    "hidden.weight": "mlp_extractor.policy_net.0.weight",
    "hidden.bias": "mlp_extractor.policy_net.0.bias",
    "output.weight": "action_net.weight",
    "output.bias": "action_net.bias",
    "log_std": "log_std",
}
