"""Gymnasium environments: the tasks of `rotorgram.envs.tasks`, and your own.

Importing this package registers them. Gymnasium 1.0 stopped reading the entry point
`gymnasium.envs`, so one of these makes them known:

    import rotorgram.envs; gym.make("rotorgram/Elevation-v0")
    gym.make("rotorgram.envs:rotorgram/Elevation-v0")  # imports by itself

Neither loads MuJoCo before an env is made.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from ..models.fields import Limits
from .registry import register
from .spec import ArraySpec, Discrete, EnvSpec, Mark, Metric

if TYPE_CHECKING:
    from .config import EnvConfig
    from .loop import Loop
    from .single import SingleEnv
    from .tasks.task import Outcome, Task, TaskOptions
    from .vector import LocalVectorEnv

__all__ = [
    "ArraySpec", "Discrete", "EnvConfig", "EnvSpec", "Limits", "LocalVectorEnv", "Loop", "Mark",
    "Metric", "Outcome", "SingleEnv", "Task", "TaskOptions", "register",
]  # fmt: skip

_HOMES: Final = {
    "EnvConfig": "config",
    "Loop": "loop",
    "LocalVectorEnv": "vector",
    "SingleEnv": "single",
}


def __getattr__(name: str) -> Any:
    """Import what needs MuJoCo on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES.get(name, 'tasks.task')}", __name__), name)


for _module, _name in (
    ("elevation", "Elevation"),
    ("hover", "Hover"),
    ("waypoints", "Waypoints"),
    ("tracking", "Tracking"),
    ("racing", "Racing"),
    ("landing", "Landing"),
    ("recovery", "Recovery"),
    ("payload_hover", "PayloadHover"),
    ("formation", "Formation"),
    ("crossing", "Crossing"),
    ("escort", "Escort"),
    ("cable", "Cable"),
):
    register(f"rotorgram/{_name}-v0", f"rotorgram.envs.tasks.{_module}:{_name}")
