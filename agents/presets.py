"""Presets: hyperparameters of an algorithm for a task, from `presets.toml`."""

from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from functools import cache
from typing import Any, Literal

from ..envs.registry import is_known, task_type
from ..models import Backend
from ..models.errors import InputError
from ..models.fields import check_names, immutable
from ..models.files import read_own_toml
from .config import Config
from .registry import find_algorithm

PresetName = Literal["paper", "tuned", "robust"]
DEFAULT_TASK = "rotorgram/Elevation-v0"
"""Its presets serve tasks for which there is no other."""

_FLIGHT = ("num_envs", "env_steps", "backend", "episode_length", "perturbations")

Tables = dict[str, dict[str, dict[str, Any]]]


@immutable
class Preset:
    """Hyperparameters, and what they were found with."""

    config: Config
    env_id: str = DEFAULT_TASK
    """Of the task for which they were found."""
    fits: bool = True
    """Whether that task is the one that was asked for, or one that it derives from."""
    num_envs: int = 1
    """Drones that fly at the same time."""
    env_steps: int = 200_000
    """Of all drones together."""
    backend: Backend | None = None
    """Of the training; None: the task's."""
    episode_length: int | None = None
    """Control steps of an episode of the training that names none; None: the task's."""
    perturbations: Mapping[str, float] = field(default_factory=dict, hash=False)
    """What each episode draws: names of `envs.perturbations` and sizes."""

    def whole_worlds(self, drones: int) -> int:
        """`num_envs` in whole worlds of so many drones, one at least."""
        return max(self.num_envs // drones, 1) * drones


@cache
def presets_of(algorithm: str) -> Tables:
    """An algorithm's tables by preset and task; one without any has an empty `tuned`."""
    content = read_own_toml(__file__, "presets")
    found: Tables = {}
    for table in content["preset"]:
        algorithms = table.pop("algorithms")
        tasks = table.pop("tasks")
        name = table.pop("name", "tuned")
        base = content["settings"].get(table.pop("settings", None), {})
        if algorithm in algorithms:
            found.setdefault(name, {}).update(dict.fromkeys(tasks, base | table))
    return found or {"tuned": {}}


def _lineage(env_id: str, tasks: list[str]) -> Iterator[str]:
    """The task of an id, if it is among the tasks, and the tasks that it derives from, in order."""
    if env_id in tasks:
        yield env_id
    if is_known(env_id):
        bases = task_type(env_id).__mro__[1:]
        by_class = {task_type(task): task for task in tasks if is_known(task)}
        yield from (by_class[base] for base in bases if base in by_class)


def usual_preset(algorithm: str, env_id: str) -> PresetName:
    """The preset of a training that names none: `robust` where the task has one."""
    return "robust" if env_id in presets_of(algorithm).get("robust", ()) else "tuned"


def find_preset(algorithm: str, name: str, env_id: str = DEFAULT_TASK) -> Preset:
    """The preset of an algorithm for a task.

    A task without a preset has that of the nearest task from which it derives; where there is
    none, that of `DEFAULT_TASK`, which then does not fit. Raises `InputError` if there is no such
    algorithm or name.
    """
    row = find_algorithm(algorithm)
    presets = presets_of(algorithm)
    if name not in presets:
        raise InputError(
            f"preset: expected {' or '.join(sorted(presets))} for {algorithm}, got {name!r}"
        )
    tables = presets[name]
    found = next(_lineage(env_id, list(tables)), None)
    if name == "robust" and not found:  # its draws are those of a task
        raise InputError(f"preset: expected robust for {' or '.join(tables)}, got {env_id}")
    task = found or DEFAULT_TASK
    settings = dict(tables.get(task, {}))
    flight = {name: settings.pop(name) for name in _FLIGHT if name in settings}
    if not found:  # no other task was flown without contact
        flight.pop("backend", None)
    return Preset(config=row.config(**settings), env_id=task, fits=found is not None, **flight)


def preset(algorithm: str, name: str, env_id: str = DEFAULT_TASK, **changes: Any) -> Config:
    """Hyperparameters of a preset, with some of them changed. Raises `InputError`."""
    base = find_preset(algorithm, name, env_id).config
    check_names(changes, vars(base), "hyperparameters")
    return replace(base, **changes)
