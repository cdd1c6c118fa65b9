"""Gymnasium environments: `rotorgram/Elevation-v0`, `rotorgram/Hover-v0`, and tasks of your own.

Importing this package registers them. Gymnasium 1.0 stopped reading the entry point
`gymnasium.envs`, so one of these makes them known:

    import rotorgram.envs; gym.make("rotorgram/Elevation-v0")
    gym.make("rotorgram.envs:rotorgram/Elevation-v0")  # imports by itself

Neither loads MuJoCo before an env is made.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from .registry import is_known, register
from .spec import ArraySpec, Discrete, EnvSpec, Metric

if TYPE_CHECKING:
    from .loop import Loop
    from .single import SingleEnv
    from .tasks.task import Outcome, Task, TaskOptions, check_choice, check_number
    from .vector import LocalVectorEnv

__all__ = [
    "ArraySpec", "Discrete", "EnvSpec", "LocalVectorEnv", "Loop", "Metric", "Outcome",
    "SingleEnv", "Task", "TaskOptions", "check_choice", "check_number", "register",
    "register_all",
]  # fmt: skip

_HOMES: Final = {"Loop": "loop", "LocalVectorEnv": "vector", "SingleEnv": "single"}


def register_all() -> None:
    """Add our envs to Gymnasium's registry, once."""
    for name in ("Elevation", "Hover"):
        if not is_known(f"rotorgram/{name}-v0"):
            register(f"rotorgram/{name}-v0", f"rotorgram.envs.tasks.{name.lower()}:{name}")


def __getattr__(name: str) -> Any:
    """Import what needs MuJoCo on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES.get(name, 'tasks.task')}", __name__), name)


register_all()
