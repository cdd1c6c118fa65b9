"""Algorithms that learn to fly, and one that need not.

`make_agent` imports torch (and SB3 where it is asked for); policies fly without either.
"""

from typing import TYPE_CHECKING, Any

from .presets import PRESETS, A2CConfig, AlgorithmName, VPGConfig, preset

if TYPE_CHECKING:
    from .learner import Agent

__all__ = ["PRESETS", "A2CConfig", "AlgorithmName", "VPGConfig", "make_agent", "preset"]


def make_agent(algorithm: str, env: Any, config: VPGConfig | A2CConfig, seed: int) -> "Agent":
    """A fresh agent for the spaces of `env`.

    Args:
        algorithm: `vpg`, `a2c` or `sb3-a2c`.
        env: The `EpisodeLog` to train on.
        config: Hyperparameters of that algorithm.
        seed: Seed of the run.

    Raises:
        ValueError: No such algorithm, or a config of another one.
    """
    match algorithm, config:
        case "vpg", VPGConfig():
            from .vpg import VPG

            return VPG(env, config, seed)
        case "a2c", A2CConfig():
            from .a2c import A2C

            return A2C(env, config, seed)
        case "sb3-a2c", A2CConfig():
            from .sb3 import SB3A2C

            return SB3A2C(env, config, seed)
    raise ValueError(
        f"expected an algorithm of {sorted(PRESETS)} with its config, got {algorithm!r} "
        f"with {type(config).__name__}"
    )
