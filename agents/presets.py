"""Hyperparameters of every algorithm: the paper's setting and ours.

A preset is named `paper` (of `vpg` and `a2c`) or `tuned`. `docs/algorithms/` lists where they
differ, and why. `tuned` may depend on the task.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from ..models.errors import expect

AlgorithmName = Literal[
    "vpg", "a2c", "ppo", "ippo", "mappo", "sac", "sb3-a2c", "sb3-ppo", "sb3-sac"
]
PresetName = Literal["paper", "tuned"]


def _is_number(value: Any, low: float, high: float = math.inf) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and low <= value <= high


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 1


_RULES: Final[tuple[tuple[str, str, Callable[[Any], bool]], ...]] = (
    ("episodes_per_update steps_per_update epochs minibatches gradient_steps batch_size"
     " buffer_size learning_starts", "a whole number, 1 or more", _is_count),
    ("hidden", "whole numbers, 1 or more, one a layer",
     lambda value: len(value) > 0 and all(map(_is_count, value))),
    ("activation", "'relu' or 'tanh'", lambda value: value in ("relu", "tanh")),
    ("gamma gae_lambda", "a number from 0 to 1", lambda value: _is_number(value, 0, 1)),
    ("clip max_grad_norm", "a number above 0", lambda value: _is_number(value, 5e-324)),
    ("vf_coef ent_coef", "a number, 0 or more", lambda value: _is_number(value, 0)),
    ("anneal normalize normalize_observations", "true or false", lambda value: type(value) is bool),
    ("tau", "a number above 0, to 1", lambda value: _is_number(value, 5e-324, 1)),
    ("target_entropy", "a number, or null",
     lambda value: value is None or _is_number(value, -math.inf)),
    ("learning_rate alpha", "a number above 0", lambda value: _is_number(value, 5e-324, 1e30)),
    ("critic_learning_rate", "a number above 0, or null",
     lambda value: value is None or _is_number(value, 5e-324, 1e30)),
    ("log_std", "a number from -4 to 1", lambda value: _is_number(value, -4, 1)),
    ("baseline", "'none' or 'time'", lambda value: value in ("none", "time")),
)  # fmt: skip
"""Names of fields, what is expected of them, and whether a value is that."""


@dataclass(frozen=True, kw_only=True)
class _Config:
    """What all algorithms have."""

    hidden: tuple[int, ...] = (16,)
    """Units of each hidden layer of each network (paper: one of 16). A number is one layer."""
    activation: Literal["relu", "tanh"] = "relu"
    """Of the hidden units (paper: relu)."""
    learning_rate: float = 0.001
    """Of Adam (paper)."""
    anneal: bool = False
    """Lower the learning rate linearly to zero over the run."""
    gamma: float = 0.99
    """Discount. The paper names none."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviation, in units of the action."""
    normalize_observations: bool = False
    """Shift and scale observations to mean 0 and standard deviation 1 of all rollouts before."""

    def __post_init__(self) -> None:
        hidden: Any = self.hidden
        layers = tuple(hidden) if isinstance(hidden, list | tuple) else (hidden,)
        object.__setattr__(self, "hidden", layers)
        for names, expected, is_right in _RULES:
            for name in (name for name in names.split() if name in vars(self)):
                value = getattr(self, name)
                expect(is_right(value), name, expected, f"{value!r}")


@dataclass(frozen=True, kw_only=True)
class VPGConfig(_Config):
    """Vanilla Policy Gradient (paper, section 2.3, Algorithm 1). Defaults: the paper's setting."""

    episodes_per_update: int = 1
    """Episodes flown with one policy ("a set of drone data"; the paper gives no number)."""
    baseline: Literal["none", "time"] = "none"
    """Taken off the returns: nothing (paper), or their mean at the same step of the episode."""
    normalize: bool = False
    """Divide the returns of an update by their standard deviation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        count = self.episodes_per_update
        right = self.baseline != "time" or count > 1
        expected = "2 or more with baseline 'time', where a single episode is its own mean"
        expect(right, "episodes_per_update", expected, f"{count}")


@dataclass(frozen=True, kw_only=True)
class A2CConfig(_Config):
    """Advantage Actor-Critic (paper, section 2.3, Algorithm 2). Defaults: the paper's setting.

    Serves our A2C and Stable-Baselines3's.
    """

    steps_per_update: int = 1
    """Env steps between updates (paper: one), of all drones together."""
    gae_lambda: float = 0.0
    """Lambda of generalised advantage estimation; 0 is the paper's Equation 3."""
    normalize: bool = False
    """Shift and scale the advantages of an update to mean 0 and standard deviation 1."""
    vf_coef: float = 0.5
    """Weight of the squared error of the value."""
    ent_coef: float = 0.0
    """Weight of the policy's entropy."""

    def rollout_size(self, drones: int) -> int:
        """Env steps of a rollout: `steps_per_update`, rounded up to whole steps of all drones."""
        return -(-self.steps_per_update // drones) * drones


@dataclass(frozen=True, kw_only=True)
class PPOConfig(A2CConfig):
    """Proximal Policy Optimisation (Schulman et al. 2017). Defaults: where it says so, the paper's.

    Serves our PPO and Stable-Baselines3's.
    """

    learning_rate: float = 0.0003
    """Of Adam (Schulman et al., table 3)."""
    critic_learning_rate: float | None = None
    """Of the critic's weights; null: the same."""
    steps_per_update: int = 2048
    """Env steps of a rollout, of all drones together (table 3)."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation (table 3)."""
    normalize: bool = True
    """Shift and scale the advantages of a minibatch to mean 0 and standard deviation 1."""
    epochs: int = 10
    """Passes over a rollout (table 3)."""
    minibatches: int = 32
    """Parts of a rollout, each for one step of Adam (table 3: of 64 transitions)."""
    clip: float = 0.2
    """Change of an action's probability that the objective rewards (table 3)."""
    max_grad_norm: float = 0.5
    """The gradient, as one vector, is scaled down to this length."""


@dataclass(frozen=True, kw_only=True)
class SACConfig(_Config):
    """Soft Actor-Critic (Haarnoja et al. 2018, arXiv 1812.05905). Defaults: its Table 1.

    Serves our SAC and Stable-Baselines3's.
    """

    hidden: tuple[int, ...] = (256, 256)
    """Units of each hidden layer of each network."""
    learning_rate: float = 0.0003
    """Of Adam: actor, critics and temperature."""
    steps_per_update: int = 1
    """Env steps between updates, of all drones together."""
    gradient_steps: int = 1
    """Updates that follow them."""
    batch_size: int = 256
    """Transitions of an update, drawn from the buffer."""
    buffer_size: int = 1_000_000
    """Transitions that are kept; a checkpoint has them."""
    learning_starts: int = 1_000
    """Transitions of uniform actions before the first update. Table 1 has none."""
    tau: float = 0.005
    """Share of the critics that their targets take over in each update."""
    alpha: float = 1.0
    """Temperature at the beginning. Table 1 has none."""
    target_entropy: float | None = None
    """Entropy that the temperature aims at, nats; null: minus the number of actions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        least, got = self.learning_starts, self.buffer_size
        expect(got >= least, "buffer_size", f"learning_starts ({least}) or more", f"{got}")
        right = not self.normalize_observations
        expect(right, "normalize_observations", "false with SAC", "true")

    def rollout_size(self, drones: int) -> int:
        """Env steps between updates: `steps_per_update`, rounded up to whole steps of all."""
        return -(-self.steps_per_update // drones) * drones


NETWORKS: Final = ("hidden", "activation", "normalize_observations")
"""Hyperparameters that all have, which say what networks there are."""
Config = VPGConfig | A2CConfig | PPOConfig | SACConfig


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Hyperparameters, and what they were found with."""

    config: Config
    num_envs: int = 1
    """Drones that fly at the same time."""
    env_steps: int = 200_000
    """Of all drones together."""
    backend: str = "mujoco"
    """Of `rotorgram.sim.Backend`."""


_TUNED: Final[Any] = {"learning_rate": 0.01, "anneal": True, "gamma": 0.98, "normalize": True}
_PPO: Final = PPOConfig(
    learning_rate=0.01, critic_learning_rate=0.02, anneal=True, gamma=0.98, gae_lambda=0.98,
    log_std=0.0, steps_per_update=1024, epochs=8, minibatches=8,
)  # fmt: skip
_VPG: Final = {
    "paper": Preset(config=VPGConfig()),
    "tuned": Preset(config=VPGConfig(**_TUNED, episodes_per_update=4, baseline="time")),
}
_A2C: Final = {
    "paper": Preset(config=A2CConfig()),
    "tuned": Preset(config=A2CConfig(**_TUNED, steps_per_update=256, gae_lambda=0.98)),
}
_PPOS: Final = {"tuned": Preset(config=_PPO, num_envs=32, env_steps=41_000)}
_SACS: Final = {
    "tuned": Preset(
        config=SACConfig(
            hidden=(32, 32), learning_rate=0.01, anneal=True, gamma=0.98, batch_size=64,
            buffer_size=100_000, steps_per_update=8, tau=0.02, alpha=0.1,
        ),
        num_envs=8,
        env_steps=30_000,
    )
}  # fmt: skip
# The references get the very same settings: only the implementation differs.
PRESETS: Final[dict[str, dict[str, Preset]]] = {
    "vpg": _VPG, "a2c": _A2C, "ppo": _PPOS, "ippo": _PPOS, "mappo": _PPOS, "sac": _SACS,
    "sb3-a2c": _A2C, "sb3-ppo": _PPOS, "sb3-sac": _SACS,
}  # fmt: skip
"""By algorithm and name: of the paper's task, and of all others that `_OF_TASKS` does not have."""
_HOVER: Final = PPOConfig(
    hidden=(64, 64), activation="tanh", learning_rate=0.003, anneal=True, gamma=0.98,
    gae_lambda=0.95, log_std=-1.0, steps_per_update=4096, epochs=4, minibatches=16,
)  # fmt: skip
_HOLD: Final = Preset(config=_HOVER, num_envs=128, env_steps=1_000_000)


def _large(env_steps: int, **changes: Any) -> Preset:
    config = replace(_HOVER, steps_per_update=16_384, minibatches=32, **changes)
    return Preset(config=config, num_envs=512, env_steps=env_steps, backend="rigid")


# Rollouts as long as an episode: worlds begin together, and shorter ones show one phase of it.
_SWARM: Final = Preset(
    config=replace(_HOVER, gamma=0.99, log_std=-0.5, steps_per_update=16_384, minibatches=32),
    num_envs=32,
    env_steps=1_000_000,
)
_SWARMS: Final = {
    (algorithm, "tuned", f"rotorgram/{task}-v0"): _SWARM
    for algorithm in ("ppo", "ippo", "mappo")
    for task in ("Formation", "Crossing", "Escort")
}

_OF_TASKS: Final[dict[tuple[str, str, str], Preset]] = {
    ("ppo", "tuned", "rotorgram/Hover-v0"): replace(_HOLD, backend="rigid"),
    ("ppo", "tuned", "rotorgram/PayloadHover-v0"): _HOLD,
    ("ppo", "tuned", "rotorgram/Tracking-v0"): _large(1_000_000),
    ("ppo", "tuned", "rotorgram/Racing-v0"): _large(2_500_000),
    ("ppo", "tuned", "rotorgram/Waypoints-v0"): _large(3_000_000),
    ("ppo", "tuned", "rotorgram/Landing-v0"): _large(4_000_000, gamma=0.99),
    ("ppo", "tuned", "rotorgram/Recovery-v0"): _large(2_000_000, log_std=-0.5, gae_lambda=0.97),
    ("sac", "tuned", "rotorgram/Hover-v0"): Preset(
        config=SACConfig(
            hidden=(64, 64), learning_rate=0.003, anneal=True, gamma=0.98, batch_size=128,
            buffer_size=25_000, steps_per_update=64, gradient_steps=8, tau=0.02, alpha=0.1,
        ),
        num_envs=64,
        env_steps=200_000,
    ),
    **_SWARMS,
}  # fmt: skip
"""By algorithm without `sb3-`, name and id of the env."""


SQUASHED: Final = ("sac", "sb3-sac")
"""Algorithms whose policy bounds its output by tanh."""


def find_preset(algorithm: str, name: str, env_id: str = "") -> Preset:
    """The preset of an algorithm for a task. Raises `InputError` if there is no such one."""
    expect(algorithm in PRESETS, "algorithm", f"one of {', '.join(PRESETS)}", f"{algorithm!r}")
    presets = PRESETS[algorithm]
    those = f"{' or '.join(presets)} for {algorithm}"
    expect(name in presets, "preset", those, f"{name!r}")
    own = algorithm.removeprefix("sb3-"), name, env_id
    return _OF_TASKS.get(own, presets[name])


def preset(algorithm: str, name: str, env_id: str = "", **changes: Any) -> Config:
    """Hyperparameters of a preset, with some of them changed. Raises `InputError`."""
    base = find_preset(algorithm, name, env_id).config
    unknown = sorted({*changes} - {*vars(base)})
    known = ", ".join(sorted(vars(base)))
    expect(not unknown, "hyperparameters", f"some of {known}", ", ".join(unknown))
    return replace(base, **changes)


def config_type(algorithm: str) -> type[Config]:
    """Class of the hyperparameters of an algorithm. Raises `InputError`."""
    return type(preset(algorithm, "tuned"))
