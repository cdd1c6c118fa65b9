"""Stable-Baselines3: its A2C as the reference, and vector envs as it wants them."""

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from ..models.errors import expect, require
from . import learner
from .episodes import EpisodeLog
from .networks import arrays_of, load_arrays, torch
from .presets import A2CConfig

if TYPE_CHECKING:
    import stable_baselines3 as sb3
    from stable_baselines3.common import logger as sb3_logger
    from stable_baselines3.common import vec_env as sb3_vec
else:
    sb3 = require("stable_baselines3", "train", "sb3-a2c")
    sb3_logger, sb3_vec = sb3.common.logger, sb3.common.vec_env


class SB3VecEnv(sb3_vec.VecEnv):
    """A SAME_STEP vector env, such as `RemoteVectorEnv(autoreset_mode="SameStep")`, for SB3.

    Where an episode ended, `infos` has SB3's `terminal_observation` and `TimeLimit.truncated`; the
    rest of `info` is left out: SB3 wants a dictionary for each env and step. `close` closes the
    vector env. One of another autoreset raises `InputError`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        right = mode == AutoresetMode.SAME_STEP
        expect(right, "env", "a vector env with autoreset SAME_STEP", f"{mode}")
        self.env = env
        self.render_mode = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(0)

    def reset(self) -> Any:
        """Begin an episode for every env, with the seeds of `seed` if it was called."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        observations, _ = self.env.reset(seed=seeds)  # type: ignore[arg-type]
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Fly every env for one step."""
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(ended).tolist():
            last = info["final_obs"]
            infos[i]["terminal_observation"] = (
                {k: v[i] for k, v in last.items()} if isinstance(last, dict) else last[i]
            )
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observations, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """Close the vector env."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vector env, which all envs share."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def env_method(self, *_: Any, **__: Any) -> Any:
        """Not possible: the envs are one, without attributes to set and methods to call."""
        raise NotImplementedError("the envs of a vector env are one")

    set_attr = env_method

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False: wrappers of single envs are not here."""
        return [False] * len(list(self._get_indices(indices)))


class SB3A2C:
    """SB3's A2C behind the same interface as our own algorithms.

    With Adam, without clipping of gradients, and with all settings from the same `A2CConfig`: given
    the same experience, it makes the same updates as ours.
    """

    def __init__(self, log: EpisodeLog, config: A2CConfig, seed: int) -> None:
        torch_seed, _ = learner.seeds_of(seed)
        # SB3 draws from the global generators: torch for actions, NumPy for the order of samples.
        torch.manual_seed(torch_seed)
        np.random.seed(torch_seed % 2**32)  # noqa: NPY002
        self._config, self._ahead = config, 0.0
        self._rollout = config.rollout_size(log.num_envs)
        self._model = _A2C(
            "MlpPolicy",
            SB3VecEnv(log),
            learning_rate=self._learning_rate,
            n_steps=self._rollout // log.num_envs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            ent_coef=config.ent_coef,
            vf_coef=config.vf_coef,
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
        self._model.set_logger(sb3_logger.Logger(folder=None, output_formats=[]))

    def train(self, log: EpisodeLog, env_steps: int, on_update: learner.OnUpdate) -> None:
        """As `Learner.train`. SB3 flies whole rollouts only: a last part of one is not flown."""
        model, done, whole = self._model, log.env_steps, self.last_step(env_steps)
        if done >= whole:
            return
        if done:  # the log is where the training stopped
            model._last_obs = log.observations
            model._last_episode_starts = log.position().lengths == 0
        model.num_timesteps, model.on_update = done, on_update
        self._ahead = self._rollout / whole
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
        weights = arrays_of(self._model.policy)
        return {ours: weights[theirs] for ours, theirs in _NAMES.items() if theirs in weights}

    def state(self) -> dict[str, np.ndarray]:
        """Weights, optimizer and both generators."""
        model = self._model
        state = {f"policy.{name}": array for name, array in arrays_of(model.policy).items()}
        state |= learner.optimizer_arrays(model.policy.optimizer)
        state["rng.torch"] = torch.get_rng_state().numpy().copy()
        _, keys, place, *_ = np.random.get_state()  # noqa: NPY002
        return state | {"rng.numpy": np.append(keys, place).astype(np.uint32)}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""
        model = self._model
        load_arrays(model.policy, state, "policy.")
        learner.set_optimizer_arrays(model.policy.optimizer, state)
        model._n_updates = learner.updates_of(model.policy.optimizer)
        torch.set_rng_state(torch.from_numpy(state["rng.torch"].copy()))
        *keys, place = state["rng.numpy"]
        np.random.set_state(("MT19937", np.array(keys, np.uint32), int(place), 0, 0.0))  # noqa: NPY002

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as SB3 logs them; none before the first."""
        kept = self._model.logger.name_to_value
        return {name: float(value) for name, value in kept.items() if name.startswith("train/")}


class _Stopped(Exception):
    """Ends SB3's loop between an update and the next rollout."""


class _A2C(sb3.A2C):
    """SB3's A2C, which has no callback between an update and the next rollout."""

    on_update: learner.OnUpdate

    def train(self) -> None:
        super().train()
        learner.check_finite(self.policy.optimizer)
        if not self.on_update():
            raise _Stopped


_NAMES = {
    "hidden.weight": "mlp_extractor.policy_net.0.weight",
    "hidden.bias": "mlp_extractor.policy_net.0.bias",
    "output.weight": "action_net.weight",
    "output.bias": "action_net.bias",
    "log_std": "log_std",
}
