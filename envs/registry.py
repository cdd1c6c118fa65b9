"""Tasks by env id.

An id from a checkpoint, a journal or a peer is looked up here; its module is never imported.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

import gymnasium

from ..models.errors import InputError, shortened
from ..models.fields import Text, check
from .spec import EnvSpec, canonical_id

if TYPE_CHECKING:
    from .config import EnvConfig
    from .tasks.task import Task

_ID = Text(r"([\w.-]+/)?[\w.-]+-v\d+", "name-v0 or namespace/name-v0")
_tasks: dict[str, "str | type[Task]"] = {}


def register(env_id: str, task: "str | type[Task]") -> None:
    """Make a task known by an id, to rotorgram and to Gymnasium. Registering again replaces it.

    The task is a class derived from `Task`, or "module:Class", which is imported when needed.
    Raises `InputError` if the id is not as `name-v0` or `namespace/name-v0`, or belongs to another
    package's env.
    """
    check("env id", _ID, env_id)
    if env_id in gymnasium.registry and env_id not in _tasks:
        raise InputError(f"env id: expected one that is free, got {shortened(env_id)}")
    gymnasium.registry.pop(env_id, None)
    _tasks[env_id] = task
    # No max_episode_steps: the env truncates by itself, since over UDP no wrapper would.
    gymnasium.register(
        id=env_id,
        entry_point="rotorgram.envs.single:SingleEnv",
        vector_entry_point="rotorgram.envs.vector:LocalVectorEnv",
        kwargs={"env_id": env_id},
    )


def load(env_id: str) -> str:
    """Import the module of an id and return the id without it. For ids that a user typed only.

    The module of "module:Name-v0" is looked for in the working folder too. Raises `InputError`:
    there is no such module, or it registers no such env.
    """
    if not isinstance(env_id, str):
        raise InputError(f"env: expected the id of a task, got {env_id!r}")
    module, colon, name = env_id.rpartition(":")
    if colon:
        if not module or module.startswith("."):
            raise InputError(f"env: expected MODULE:NAME with the name of a module, got {env_id!r}")
        _import_here(module)
        if not is_known(name):
            raise InputError(f"env: expected {module} to register {name}, it does not")
    return name


def _import_here(module: str) -> None:
    """Import an installed module, or else one from the working folder, which is searched last."""
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise
        raise InputError(f"env: expected a module {module} here, got none") from None


def is_known(env_id: str) -> bool:
    """Whether a task of ours or of the user's is registered under this id."""
    return canonical_id(env_id) in _tasks


def task_type(env_id: str) -> "type[Task]":
    """The class of a task. Raises `InputError` for an id that is not registered."""
    task = _tasks.get(canonical_id(env_id))
    if task is None:
        expected = ", ".join(_tasks)
        raise InputError(
            f"env: expected a registered id ({expected}), or --env MODULE:{env_id} with the module "
            f"that registers it, got {env_id!r}"
        )
    if isinstance(task, str):
        module, _, name = task.partition(":")
        task = _tasks[canonical_id(env_id)] = getattr(import_module(module), name)
    return task


def env_spec(config: "EnvConfig") -> EnvSpec:
    """The spec of an env. Raises `InputError`."""
    from .specification import make_task, spec_of

    config = config.resolve()
    return spec_of(config, make_task(config, (1, config.drones)))
