"""Gymnasium environments: importing this package registers `rotorgram/Elevation-v0`.

Gymnasium 1.0 stopped reading the entry point `gymnasium.envs`, so one of these makes the env known:

    import rotorgram.envs; gym.make("rotorgram/Elevation-v0")
    gym.make("rotorgram.envs:rotorgram/Elevation-v0")  # imports by itself

Neither loads MuJoCo before an env is made.
"""

from typing import TYPE_CHECKING, Any

import gymnasium

from .config import ENV_ID, TELEMETRY_NAMES, ElevationConfig

if TYPE_CHECKING:
    from .elevation import ElevationEnv
    from .vector import ElevationVectorEnv

__all__ = [
    "ENV_ID",
    "TELEMETRY_NAMES",
    "ElevationConfig",
    "ElevationEnv",
    "ElevationVectorEnv",
    "register",
]

WARP_ENV_ID = "rotorgram/ElevationWarp-v0"  # needs rotorgram[gpu]; a vector env only


def register() -> None:
    """Add the envs to Gymnasium's registry, once."""
    if ENV_ID not in gymnasium.registry:
        # No max_episode_steps: the env truncates by itself, since over UDP no wrapper would.
        gymnasium.register(
            id=ENV_ID,
            entry_point="rotorgram.envs.elevation:ElevationEnv",
            vector_entry_point="rotorgram.envs.vector:ElevationVectorEnv",
        )
    if WARP_ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=WARP_ENV_ID, vector_entry_point="rotorgram.envs.warp:ElevationWarpEnv"
        )


def __getattr__(name: str) -> Any:
    if name == "ElevationEnv":
        from .elevation import ElevationEnv

        return ElevationEnv
    if name == "ElevationVectorEnv":
        from .vector import ElevationVectorEnv

        return ElevationVectorEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register()
