"""Stable-Baselines3: its A2C, PPO and SAC as references, and vector envs as it wants them."""

from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from ..envs.autoreset import Step
from ..models.errors import InputError, require
from .a2c import A2C, A2CConfig
from .config import Config, SACConfig
from .episodes import EpisodeRecorder
from .layers import ByName, Floats
from .learner import OnUpdate, seeds_of
from .networks import scaled_in
from .policies import NetworkPolicy, flat_size
from .ppo import PPO, PPOConfig
from .rollouts import Diverged

try:
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common import logger as sb3_logger
    from stable_baselines3.common import vec_env as sb3_vec
    from stable_baselines3.common.vec_env.base_vec_env import (
        VecEnvIndices,
        VecEnvObs,
        VecEnvStepReturn,
    )
except ModuleNotFoundError:
    for _package in ("torch", "stable_baselines3"):
        require(_package, "train", "Stable-Baselines3")
    raise

Settings = dict[str, object]


class SB3VecEnv(sb3_vec.VecEnv):
    """A SAME_STEP vector env, such as `RemoteVectorEnv(autoreset_mode="SameStep")`, for SB3.

    Where an episode ended, `infos` has SB3's `terminal_observation` and `TimeLimit.truncated`; the
    rest of `info` is left out: SB3 wants a dictionary for each env and step. `close` closes the
    vector env. One of another autoreset raises `InputError`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise InputError(f"env: expected a vector env with autoreset SAME_STEP, got {mode}")
        self.env = env
        self.render_mode = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Begin an episode for every env, with the seeds of `seed` if it was called."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        observations: VecEnvObs = self.env.reset(seed=seeds)[0]  # type: ignore[arg-type]
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Fly every env for one step."""
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        infos: list[Settings] = [{} for _ in range(self.num_envs)]
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

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[object]:
        """An attribute of the vector env, which all envs share."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def env_method(self, *_: object, **__: object) -> NoReturn:
        """Not possible: no env is apart here."""
        raise NotImplementedError("the envs of a vector env are one")

    set_attr = env_method

    def env_is_wrapped(self, wrapper_class: object, indices: VecEnvIndices = None) -> list[bool]:
        """False: wrappers of single envs are not here."""
        return [False] * len(list(self._get_indices(indices)))


class RecordedEnv(VectorEnv[Floats, Floats, np.ndarray]):
    """A recorder as a vector env of SAME_STEP, whatever the autoreset of its env.

    Observations are flat, continuous actions in the units of `ActionMap`, and every episode has the
    seed that the recorder gives. A drone that is out observes zeros, with no reward, and terminates
    once more with its world.
    """

    def __init__(self, recorder: EpisodeRecorder, config: Config) -> None:
        self.recorder = recorder
        self._config = config
        self.num_envs = recorder.num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        size = flat_size(recorder.spec)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,))
        actions = recorder.actions
        box = spaces.Box(-1, 1, (actions.size,))
        self.single_action_space = spaces.Discrete(actions.outputs) if actions.discrete else box

    def reset(self, **_: object) -> tuple[Floats, dict[str, Any]]:
        """Begin the first episode of every drone, once; arguments are not used."""
        self.recorder.start()
        return self.recorder.observations, {}

    def step(self, actions: Floats) -> Step:
        """Fly one step. `info` has `final_obs` where an episode ended."""
        recorder = self.recorder
        env = recorder.env
        recorder.fly(np.asarray(actions, np.float32).reshape(self.num_envs, -1))
        final = recorder.observations
        rewards = self._config.scaled(env.rewards)
        terminated = env.terminated
        truncated = env.truncated
        starting = recorder.done
        if starting.any():
            truncated = truncated | recorder.begin(starting)
            terminated = terminated | (starting & ~truncated)
        ended = terminated | truncated
        info = {"final_obs": final, "_final_obs": ended} if ended.any() else {}
        observations = np.where(recorder.out[:, None], 0.0, recorder.observations)
        return observations, rewards, terminated, truncated, info


class SB3Agent:
    """SB3's A2C, PPO or SAC, by the class of its config, behind the interface of ours.

    All settings come from the same config: given the same experience, SB3 makes the same updates
    as ours. A training runs from its beginning to its end: a checkpoint has its policy, and no
    state to go on from.

    Attributes:
        model: SB3's own.

    Raises:
        InputError: The network is no MLP, or SAC is given an env of choices.
    """

    def __init__(self, log: EpisodeRecorder, config: A2CConfig | SACConfig, seed: int) -> None:
        if config.network != "mlp" or config.memory or config.reach:
            got = f"{config.network!r} with a memory of {config.memory} and reach {config.reach}"
            raise InputError(f"network: expected mlp without memory and reach with SB3, got {got}")
        needed = {"anneal_clip": False, "squashed": isinstance(config, SACConfig)}
        for name, own in needed.items():
            if getattr(config, name) is not own:
                expected, got = ("true", "false") if own else ("false", "true")
                raise InputError(f"{name}: expected {expected} with SB3, got {got}")
        if log.spec != log.spec.for_actor():
            raise InputError("sb3: expected no privileged arrays, which SB3's actor would see too")
        if any(scaled_in(log.spec.observation)):
            raise InputError(
                "sb3: expected observations without distances of rays and pictures, which our own "
                "agents scale and SB3's do not"
            )
        self.spec = log.spec
        self._config = config
        self._rate = config.learning_rate
        self._rollout = config.rollout_size(log.num_envs)
        torch.set_num_threads(1)  # a second thread slows such small nets
        policy: Settings = {
            "net_arch": list(config.hidden),
            "activation_fn": {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[config.activation],
        }
        if not isinstance(config, SACConfig):
            ours = PPO if isinstance(config, PPOConfig) else A2C
            optimizer = {"eps": ours.epsilon, "foreach": True}
            policy |= {"log_std_init": config.log_std, "optimizer_kwargs": optimizer}

        self.model = _MODELS[type(config)](
            "MlpPolicy",
            SB3VecEnv(RecordedEnv(log, config)),
            learning_rate=lambda _: self._rate,
            gamma=config.gamma,
            policy_kwargs=policy,
            seed=seeds_of(seed)[0] % 2**32,
            device="cpu",
            **_settings(config, self._rollout, log),
        )
        if isinstance(config, PPOConfig) and config.critic_learning_rate:
            self._set_rate_of_critic(config.critic_learning_rate / config.learning_rate)
        # This logger keeps the last numbers for us; SB3's own makes a folder in /tmp.
        self.model.set_logger(sb3_logger.Logger(folder=None, output_formats=[]))

    def train(self, log: EpisodeRecorder, env_steps: int, on_update: OnUpdate) -> None:
        """As `Learner.train`. SB3 flies whole rollouts only: a last part of one is not flown."""
        rollout = self._rollout
        whole = env_steps // rollout * rollout
        for flown in range(rollout, whole + 1, rollout):
            if self._config.anneal:
                left = 1.0 - flown / whole + rollout / whole  # before the rollout
                self._rate = self._config.learning_rate * min(left, 1.0)
            try:
                self.model.learn(rollout, reset_num_timesteps=False)
            finally:  # a policy that gives NaN raises ValueError in torch
                parameters = self.model.policy.parameters()
                if not torch.nn.utils.parameters_to_vector(parameters).isfinite().all():
                    updates = int(self.scalars().get("train/n_updates", 1))
                    raise Diverged(f"weights are not finite after update {updates}")
            if not on_update():
                return

    def _set_rate_of_critic(self, share: float) -> None:
        """Let the critic learn at so many times the rate of the actor."""
        policy = self.model.policy
        actor: list[torch.nn.Parameter] = []
        critic: list[torch.nn.Parameter] = []
        for name, parameter in policy.named_parameters():
            group = critic if "value_net." in name else actor
            group.append(parameter)
        parts = [{"params": actor}, {"params": critic}]
        policy.optimizer = torch.optim.Adam(parts, **policy.optimizer_kwargs)

        def scale(optimizer: torch.optim.Optimizer, *_: object) -> None:
            of_actor, of_critic = optimizer.param_groups
            of_critic["lr"] = of_actor["lr"] * share

        policy.optimizer.register_step_pre_hook(scale)

    def policy(self) -> NetworkPolicy:
        """The current policy, without exploration: a copy."""
        parameters = self.model.policy.state_dict()
        network = ("mlp_extractor.policy_net.", "action_net.")
        if isinstance(self._config, SACConfig):
            network = ("actor.latent_pi.", "actor.mu.")
        layers = [values.numpy() for name, values in parameters.items() if name.startswith(network)]
        pairs = zip(layers[0::2], layers[1::2], strict=True)
        weights = [np.column_stack((bias, weight)) for weight, bias in pairs]
        if "log_std" in parameters:
            weights.append(parameters["log_std"].numpy())
        names = NetworkPolicy(self.spec, self._config).shapes
        ours = dict(zip(names, weights, strict=True))
        return NetworkPolicy.load(ours, self.spec, self._config)

    def state(self) -> ByName:
        """Nothing: no training goes on from it."""
        return {}

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as SB3 logs them; none before the first."""
        kept = self.model.logger.name_to_value
        return {name: float(value) for name, value in kept.items() if name.startswith("train/")}


_MODELS: dict[type, Any] = {A2CConfig: sb3.A2C, PPOConfig: sb3.PPO, SACConfig: sb3.SAC}


def _settings(config: A2CConfig | SACConfig, rollout: int, log: EpisodeRecorder) -> Settings:
    """Settings of SB3's that not all of its algorithms have."""
    steps = rollout // log.num_envs
    if isinstance(config, SACConfig):
        if log.actions.discrete:
            raise InputError("sb3-sac: expected an env of continuous actions, got one of choices")
        return {
            "buffer_size": config.buffer_size,
            "learning_starts": config.learning_starts - 1,  # SB3 begins one step later
            "batch_size": config.batch_size,
            "tau": config.tau,
            "train_freq": steps,
            "gradient_steps": config.gradient_steps,
            "ent_coef": f"auto_{config.alpha}",
        }
    settings: Settings = {
        "n_steps": steps,
        "gae_lambda": config.gae_lambda,
        "ent_coef": config.ent_coef,
        "vf_coef": config.vf_coef,
        "normalize_advantage": config.normalize and rollout > 1,
    }
    if not isinstance(config, PPOConfig):
        return {**settings, "max_grad_norm": float("inf"), "use_rms_prop": False}
    return {
        **settings,
        "max_grad_norm": config.max_grad_norm,
        "batch_size": -(-rollout // config.minibatches),
        "n_epochs": config.epochs,
        "clip_range": config.clip,
        "target_kl": config.target_kl,
    }
