"""Hyperparameters of every algorithm: the paper's setting and ours.

A preset is named `paper` or `tuned`. `docs/algorithms/` lists where they differ, and why.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from ..models.errors import expect

AlgorithmName = Literal["vpg", "a2c", "sb3-a2c"]
PresetName = Literal["paper", "tuned"]


def _is_number(value: Any, low: float, high: float = math.inf) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and low <= value <= high


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 1


_RULES: Final[tuple[tuple[str, str, Callable[[Any], bool]], ...]] = (
    ("episodes_per_update steps_per_update", "a whole number, 1 or more", _is_count),
    ("hidden", "whole numbers, 1 or more, one a layer",
     lambda value: len(value) > 0 and all(map(_is_count, value))),
    ("activation", "'relu' or 'tanh'", lambda value: value in ("relu", "tanh")),
    ("gamma gae_lambda", "a number from 0 to 1", lambda value: _is_number(value, 0, 1)),
    ("vf_coef ent_coef", "a number, 0 or more", lambda value: _is_number(value, 0)),
    ("anneal normalize", "true or false", lambda value: type(value) is bool),
    ("learning_rate", "a number above 0", lambda value: _is_number(value, 5e-324, 1e30)),
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


_TUNED: Final[Any] = {"learning_rate": 0.01, "anneal": True, "gamma": 0.98, "normalize": True}
PRESETS: Final[dict[str, dict[str, VPGConfig | A2CConfig]]] = {
    "vpg": {
        "paper": VPGConfig(),
        "tuned": VPGConfig(**_TUNED, episodes_per_update=4, baseline="time"),
    },
    "a2c": {
        "paper": A2CConfig(),
        "tuned": A2CConfig(**_TUNED, steps_per_update=256, gae_lambda=0.98),
    },
}
# The reference gets the very same settings: only the implementation differs.
PRESETS["sb3-a2c"] = PRESETS["a2c"]


def preset(algorithm: str, name: str, **changes: Any) -> VPGConfig | A2CConfig:
    """A preset, with some of its fields changed. Raises `InputError` if there is no such one."""
    names = sorted(PRESETS)
    expect(algorithm in PRESETS, "algorithm", f"one of {names}", f"{algorithm!r}")
    presets = PRESETS[algorithm]
    expect(name in presets, "preset", f"one of {sorted(presets)}", f"{name!r}")
    base, unknown = presets[name], sorted({*changes} - {*vars(presets[name])})
    expect(not unknown, "hyperparameters", f"some of {sorted(vars(base))}", f"{unknown}")
    return replace(base, **changes)
