"""The names that most programs need, each imported when it is first used.

    import rotorgram
    env = rotorgram.make("rotorgram/Hover-v0", vehicle="crazyflie2")

`import rotorgram.envs` makes the envs known to `gymnasium.make` as well.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

# `python -m rotorgram.cli`: no file of the working directory takes the place of a package.
_runs_ours = sys.argv[:1] == ["-m"] and "rotorgram" in " ".join(sys.orig_argv[:4])
if _runs_ours and not sys.flags.safe_path:
    del sys.path[0]

if TYPE_CHECKING:
    from gymnasium import make, make_vec

    from .agents import load
    from .envs import EnvConfig, LocalVectorEnv, Loop, Outcome, Task, TaskOptions, register
    from .models import Vehicle
    from .udp import RemoteEnv, RemoteVectorEnv

__all__ = [
    "EnvConfig", "LocalVectorEnv", "Loop", "Outcome", "RemoteEnv", "RemoteVectorEnv", "Task",
    "TaskOptions", "Vehicle", "load", "make", "make_vec", "register",
]  # fmt: skip

_HOMES: Final = {
    "RemoteEnv": "udp",
    "RemoteVectorEnv": "udp",
    "Vehicle": "models",
    "load": "agents",
}


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    envs = import_module(".envs", __name__)  # registers them
    if name in ("make", "make_vec"):
        return getattr(import_module("gymnasium"), name)
    home = _HOMES.get(name)
    return getattr(envs if home is None else import_module(f".{home}", __name__), name)
