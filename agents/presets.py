"""Hyperparameters of every algorithm: the paper's setting and ours.

A preset is named `paper` or `tuned`. `docs/algorithms/` lists where they differ, and why.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from ..models.errors import InputError

__all__ = ["PRESETS", "A2CConfig", "AlgorithmName", "PresetName", "VPGConfig", "preset"]

AlgorithmName = Literal["vpg", "a2c", "sb3-a2c"]
PresetName = Literal["paper", "tuned"]


@dataclass(frozen=True, kw_only=True)
class VPGConfig:
    """Vanilla Policy Gradient (paper, section 2.3, Algorithm 1). Defaults: the paper's setting."""

    hidden: int = 16
    """Units of the hidden layer (paper)."""
    learning_rate: float = 0.001
    """Of Adam (paper)."""
    anneal: bool = False
    """Lower the learning rate linearly to zero over the run."""
    gamma: float = 0.99
    """Discount. The paper names none."""
    episodes_per_update: int = 1
    """Episodes flown with one policy ("a set of drone data"; the paper gives no number)."""
    baseline: Literal["none", "time"] = "none"
    """Taken off the returns: nothing (paper), or their mean at the same step of the episode."""
    normalize: bool = False
    """Divide the returns of an update by their standard deviation."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviation, in units of the action."""

    def __post_init__(self) -> None:
        _check(self, counts=("hidden", "episodes_per_update"), shares=("gamma",),
               flags=("anneal", "normalize"))  # fmt: skip
        if self.baseline not in ("none", "time"):
            raise InputError(f"baseline: expected 'none' or 'time', got {self.baseline!r}")
        if self.baseline == "time" and self.episodes_per_update < 2:
            raise InputError(
                "episodes_per_update: expected 2 or more with baseline 'time', where a single "
                f"episode is its own mean, got {self.episodes_per_update}"
            )


@dataclass(frozen=True, kw_only=True)
class A2CConfig:
    """Advantage Actor-Critic (paper, section 2.3, Algorithm 2). Defaults: the paper's setting.

    Serves our A2C and Stable-Baselines3's.
    """

    hidden: int = 16
    """Units of the hidden layer of each of the two networks (paper)."""
    learning_rate: float = 0.001
    """Of Adam (paper)."""
    anneal: bool = False
    """Lower the learning rate linearly to zero over the run."""
    gamma: float = 0.99
    """Discount. The paper names none."""
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
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviation, in units of the action."""

    def __post_init__(self) -> None:
        _check(self, counts=("hidden", "steps_per_update"), shares=("gamma", "gae_lambda"),
               flags=("anneal", "normalize"))  # fmt: skip
        for name in ("vf_coef", "ent_coef"):
            _expect(self, name, "a number, 0 or more", _is_number(getattr(self, name), 0.0))

    def rollout_size(self, drones: int) -> int:
        """Env steps of a rollout: `steps_per_update`, rounded up to whole steps of all drones."""
        return -(-self.steps_per_update // drones) * drones


def _check(
    config: Any, *, counts: tuple[str, ...], shares: tuple[str, ...], flags: tuple[str, ...]
) -> None:
    for name in counts:
        value = getattr(config, name)
        _expect(config, name, "a whole number, 1 or more", type(value) is int and value >= 1)
    for name in shares:
        _expect(config, name, "a number from 0 to 1", _is_number(getattr(config, name), 0.0, 1.0))
    for name in flags:
        _expect(config, name, "true or false", type(getattr(config, name)) is bool)
    rate = config.learning_rate
    _expect(config, "learning_rate", "a number above 0", _is_number(rate, 0.0, 1e30) and rate > 0)
    _expect(config, "log_std", "a number from -4 to 1", _is_number(config.log_std, -4.0, 1.0))


def _is_number(value: Any, low: float, high: float = math.inf) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and low <= value <= high


def _expect(config: Any, name: str, expected: str, ok: bool) -> None:
    if not ok:
        raise InputError(f"{name}: expected {expected}, got {getattr(config, name)!r}")


PRESETS: Final[dict[str, dict[str, VPGConfig | A2CConfig]]] = {
    "vpg": {
        "paper": VPGConfig(),
        "tuned": VPGConfig(
            learning_rate=0.01,
            anneal=True,
            gamma=0.98,
            episodes_per_update=4,
            baseline="time",
            normalize=True,
        ),
    },
    "a2c": {
        "paper": A2CConfig(),
        "tuned": A2CConfig(
            learning_rate=0.01,
            anneal=True,
            gamma=0.98,
            steps_per_update=256,
            gae_lambda=0.98,
            normalize=True,
        ),
    },
}
# The reference gets the very same settings: only the implementation differs.
PRESETS["sb3-a2c"] = PRESETS["a2c"]


def preset(algorithm: str, name: str, **changes: Any) -> VPGConfig | A2CConfig:
    """A preset, with some of its fields changed.

    Raises:
        InputError: No such algorithm, preset or field.
    """
    if algorithm not in PRESETS:
        raise InputError(f"algorithm: expected one of {sorted(PRESETS)}, got {algorithm!r}")
    if name not in PRESETS[algorithm]:
        raise InputError(f"preset: expected one of {sorted(PRESETS[algorithm])}, got {name!r}")
    base = PRESETS[algorithm][name]
    if unknown := sorted(set(changes) - set(vars(base))):
        raise InputError(f"hyperparameters: expected some of {sorted(vars(base))}, got {unknown}")
    return replace(base, **changes)
