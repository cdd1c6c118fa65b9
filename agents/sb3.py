"""Stable-Baselines3: its A2C and PPO as references, and vector envs as it wants them."""

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from ..models.errors import expect, require
from . import learner
from .checkpoints import Checkpoint
from .episodes import EpisodeLog
from .policies import NetworkPolicy
from .presets import A2CConfig, PPOConfig

if TYPE_CHECKING:
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common import logger as sb3_logger
    from stable_baselines3.common import vec_env as sb3_vec
else:
    sb3 = require("stable_baselines3", "train", "sb3-a2c")
    torch = require("torch", "train", "sb3-a2c")
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


class SB3Agent:
    """SB3's A2C, or its PPO for a `PPOConfig`, behind the same interface as our own algorithms.

    With all settings from the same config, Adam, and in A2C without clipping of gradients: given
    the same experience, it makes the same updates as ours. Normalised observations raise
    `InputError`.

    Attributes:
        model: SB3's own.
    """

    def __init__(self, log: EpisodeLog, config: A2CConfig, seed: int) -> None:
        right = not config.normalize_observations
        expect(right, "normalize_observations", "false with SB3", "true")
        seed_generators(seed)
        self.spec, self._config, self._ahead = log.spec, config, 0.0
        self._rollout = config.rollout_size(log.num_envs)
        kind, settings = _kind_of(config, self._rollout)
        self.model = kind(
            "MlpPolicy",
            SB3VecEnv(log),
            learning_rate=self._learning_rate,
            n_steps=self._rollout // log.num_envs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            ent_coef=config.ent_coef,
            vf_coef=config.vf_coef,
            normalize_advantage=config.normalize and self._rollout > 1,
            policy_kwargs={
                "net_arch": {"pi": list(config.hidden), "vf": list(config.hidden)},
                "activation_fn": torch.nn.ReLU if config.activation == "relu" else torch.nn.Tanh,
                "log_std_init": config.log_std,
                "optimizer_kwargs": {"eps": 1e-8, "foreach": True},
            },
            device="cpu",
            **settings,
        )
        if isinstance(config, PPOConfig):
            self.model.set_rates(config)
        # It keeps the numbers of the last update for us; SB3's own makes a folder in /tmp.
        self.model.set_logger(sb3_logger.Logger(folder=None, output_formats=[]))

    def train(self, log: EpisodeLog, env_steps: int, on_update: learner.OnUpdate) -> None:
        """As `Learner.train`. SB3 flies whole rollouts only: a last part of one is not flown."""
        model, done = self.model, log.env_steps
        whole = env_steps // self._rollout * self._rollout
        if done >= whole:
            return
        if done:  # the log is where the training stopped
            model._last_obs = log.observations
            model._last_episode_starts = log.position().lengths == 0
        model.num_timesteps, model.on_update = done, on_update
        self._ahead = self._rollout / whole
        with suppress(Stopped):
            model.learn(whole - done, reset_num_timesteps=done == 0)

    def _learning_rate(self, left: float) -> float:
        # SB3 counts what is left after the rollout; ours, and so here, before it.
        share = min(left + self._ahead, 1.0) if self._config.anneal else 1.0
        return self._config.learning_rate * share

    def actor(self) -> dict[str, np.ndarray]:
        """Weights of the policy, under our names."""
        weights = arrays_of(self.model.policy)
        last = len(self._config.hidden)
        layers = [*(f"mlp_extractor.policy_net.{2 * i}" for i in range(last)), "action_net"]
        actor = {
            f"layers.{i}.{kind}": weights[f"{name}.{kind}"]
            for i, name in enumerate(layers)
            for kind in ("weight", "bias")
        }
        return actor | ({"log_std": weights["log_std"]} if "log_std" in weights else {})

    def policy(self) -> NetworkPolicy:
        """The current policy: a copy."""
        return NetworkPolicy(self.actor(), self.spec, self._config.activation)

    def state(self) -> dict[str, np.ndarray]:
        """Weights, optimizer and both generators."""
        model = self.model
        state = {f"policy.{name}": array for name, array in arrays_of(model.policy).items()}
        return state | optimizer_arrays(model.policy.optimizer) | generator_arrays()

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""
        model = self.model
        load_arrays(model.policy, state, "policy.")
        set_optimizer_arrays(model.policy.optimizer, state)
        model._n_updates = updates_of(model.policy.optimizer) // model.steps_per_count
        set_generators(state)

    def start_from(self, kept: Checkpoint) -> None:
        """As `Learner.start_from`."""
        policy = self.model.policy
        load_arrays(policy, kept.state, "policy.")
        if hasattr(policy, "log_std"):
            policy.log_std.data.fill_(self._config.log_std)

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as SB3 logs them; none before the first."""
        kept = self.model.logger.name_to_value
        return {name: float(value) for name, value in kept.items() if name.startswith("train/")}


class Stopped(Exception):
    """Ends SB3's loop between an update and the next rollout."""


class _Watched:
    """SB3 has no callback between an update and the next rollout."""

    on_update: learner.OnUpdate
    steps_per_count = 1
    """Steps of Adam that SB3 counts as one update."""

    def train(self) -> None:
        optimizer = self.policy.optimizer  # type: ignore[attr-defined]
        try:
            super().train()  # type: ignore[misc]
        except ValueError:  # torch's, of a policy that gives NaN
            check_finite(optimizer)
            raise
        check_finite(optimizer)
        if not self.on_update():
            raise Stopped


class _A2C(_Watched, sb3.A2C):
    pass


class _PPO(_Watched, sb3.PPO):
    """With a learning rate of its own for the critic; counts epochs."""

    critic_share = 1.0
    """Learning rate of the critic over that of the actor."""

    def set_rates(self, config: PPOConfig) -> None:
        rate, size = config.learning_rate, self.n_steps * self.n_envs
        self.critic_share = (config.critic_learning_rate or rate) / rate
        self.steps_per_count = -(-size // self.batch_size)
        named = list(self.policy.named_parameters())
        groups: Any = [
            {"params": [parameter for name, parameter in named if ("value_net." in name) == critic]}
            for critic in (False, True)
        ]
        self.policy.optimizer = torch.optim.Adam(groups, **self.policy.optimizer_kwargs)

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        actor, critic = self.policy.optimizer.param_groups
        critic["lr"] = actor["lr"] * self.critic_share


def _kind_of(config: A2CConfig, rollout: int) -> tuple[Any, dict[str, Any]]:
    """Class of SB3 that serves a config, and the settings that it alone has."""
    if not isinstance(config, PPOConfig):
        return _A2C, {"max_grad_norm": float("inf"), "use_rms_prop": False}
    return _PPO, {
        "max_grad_norm": config.max_grad_norm,
        "batch_size": -(-rollout // config.minibatches),
        "n_epochs": config.epochs,
        "clip_range": config.clip,
    }


def arrays_of(module: torch.nn.Module) -> dict[str, np.ndarray]:
    """Copies of a module's parameters."""
    return {name: p.detach().numpy().copy() for name, p in module.state_dict().items()}


def load_arrays(
    module: torch.nn.Module, arrays: Mapping[str, np.ndarray], prefix: str = ""
) -> None:
    """Set a module's parameters from the arrays whose names begin with a prefix."""
    given = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    module.load_state_dict({name: torch.from_numpy(a.copy()) for name, a in given.items()})


def check_finite(optimizer: torch.optim.Optimizer) -> None:
    """Raise `Diverged` unless all weights that an optimizer moves are finite numbers."""
    weights = torch.cat([parameter.detach().flatten() for parameter in parameters_of(optimizer)])
    if not torch.isfinite(weights).all():
        raise learner.diverged(updates_of(optimizer))


def seed_generators(seed: int) -> int:
    """Seed what SB3 draws from: torch for actions, NumPy for samples. The seed that they get."""
    torch_seed, _ = learner.seeds_of(seed)
    torch.manual_seed(torch_seed)
    torch.set_num_threads(1)  # such small nets lose by a second thread
    np.random.seed(torch_seed % 2**32)  # noqa: NPY002
    return torch_seed


def generator_arrays() -> dict[str, np.ndarray]:
    """States of the global generators."""
    _, keys, place, *_ = np.random.get_state()  # noqa: NPY002
    return {"rng.torch": torch.get_rng_state().numpy().copy(),
            "rng.numpy": np.append(keys, place).astype(np.uint32)}  # fmt: skip


def set_generators(arrays: Mapping[str, np.ndarray]) -> None:
    """Take over what `generator_arrays` gave."""
    torch.set_rng_state(torch.from_numpy(arrays["rng.torch"].copy()))
    *keys, place = arrays["rng.numpy"]
    np.random.set_state(("MT19937", np.array(keys, np.uint32), int(place), 0, 0.0))  # noqa: NPY002


def optimizer_arrays(optimizer: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """An optimizer's state as arrays named `optimizer.<parameter>.<quantity>`."""
    return {
        f"optimizer.{index}.{key}": value.numpy().copy()
        for index, entries in optimizer.state_dict()["state"].items()
        for key, value in entries.items()
    }


def set_optimizer_arrays(
    optimizer: torch.optim.Optimizer, arrays: Mapping[str, np.ndarray]
) -> None:
    """Take over what `optimizer_arrays` gave. Raises `ValueError` unless it is whole."""
    given = {k: v for k, v in arrays.items() if k.startswith("optimizer.")}
    expected = {
        f"optimizer.{index}.{key}": () if key == "step" else tuple(parameter.shape)
        for index, parameter in enumerate(parameters_of(optimizer))
        for key in ("step", "exp_avg", "exp_avg_sq")
    }
    got = {name: array.shape for name, array in given.items()}
    if got not in (expected, {}):
        raise ValueError(f"optimizer: expected arrays of shapes {expected}, got {got}")
    steps = {float(array) for name, array in given.items() if name.endswith(".step")}
    if len(steps) > 1 or min(steps, default=1) < 1:
        raise ValueError(f"optimizer: expected one step of 1 or more, got {sorted(steps)}")
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in given.items():
        _, index, key = name.split(".")
        state.setdefault(int(index), {})[key] = torch.from_numpy(value.copy())
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def updates_of(optimizer: torch.optim.Optimizer) -> int:
    """Number of steps that an Adam optimizer has taken."""
    states = list(optimizer.state.values())
    return int(states[0]["step"]) if states else 0


def parameters_of(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    """What an optimizer moves, in the order of its state."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
