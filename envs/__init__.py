"""Gymnasium environments: the tasks of `rotorgram.envs.tasks`, and your own.

Importing this package registers them. Gymnasium 1.0 stopped reading the entry point
`gymnasium.envs`, so one of these makes them known:

    import rotorgram.envs; gym.make("rotorgram/Elevation-v0")
    gym.make("rotorgram.envs:rotorgram/Elevation-v0")  # imports by itself

Neither loads MuJoCo before an env is made.
"""

from typing import TYPE_CHECKING

from gymnasium import make, make_vec

from .. import import_when_used
from ..models.fields import Limits
from .registry import register
from .spec import ArraySpec, Discrete, EnvSpec, Mark, Metric
from .tasks import __all__ as _tasks

if TYPE_CHECKING:
    from .config import EnvConfig
    from .loop import Loop
    from .single import SingleEnv
    from .tasks.task import Outcome, Task, TaskOptions
    from .vector import LocalVectorEnv

__all__ = [
    "ArraySpec", "Discrete", "EnvConfig", "EnvSpec", "Limits", "LocalVectorEnv", "Loop", "Mark",
    "Metric", "Outcome", "SingleEnv", "Task", "TaskOptions", "make", "make_vec", "register",
]  # fmt: skip

__getattr__ = import_when_used(__name__)

for _name in _tasks:
    register(f"rotorgram/{_name}-v0", f"rotorgram.envs.tasks:{_name}")
