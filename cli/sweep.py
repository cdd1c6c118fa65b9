"""`rotorgram sweep`: train an algorithm over a grid of hyperparameters and task options."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import Positional, UseAppendAction, arg

from ..agents import AlgorithmName
from ..models.errors import InputError
from ._flags import parse_value
from ._study import StudyFlags

if TYPE_CHECKING:
    from ..training.settings import Row, Study


@dataclass(frozen=True, kw_only=True)
class Sweep(StudyFlags):
    """Train an algorithm over a grid of hyperparameters, every point on the same seeds.

    Ctrl-C keeps the runs that are done; --resume flies the others.
    """

    kinds: ClassVar[tuple[str, ...]] = ("sweep",)

    algorithm: Positional[AlgorithmName]
    """The algorithm."""
    grid: UseAppendAction[
        Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE,... ...")]
    ] = ()
    """Values to try, in JSON: learning_rate=0.003,0.01 hidden=[64,64],[32,32], and options of the
    task as env.start_band=0.5,2. Every combination is a point."""

    @property
    def words(self) -> str:
        return f"sweep {self.algorithm}"

    def study(self) -> "Study":
        """A row for each point, on seeds that no comparison uses by default."""
        from ..training.settings import Study

        grid = parse_grid(word for words in self.grid for word in words)
        if not grid:
            raise InputError("grid: expected at least one hyperparameter, got none")
        rows = [
            self._row(dict(zip(grid, values, strict=True))) for values in product(*grid.values())
        ]
        settings: dict[str, Any] = {"seeds": 3, "first_seed": 1000, "snapshots": 1}
        settings |= self.given_of_study()
        return Study(rows=tuple(rows), kind="sweep", evaluation="tuning", **settings)

    def _row(self, point: Mapping[str, Any]) -> "Row":
        from ..training.settings import Row

        changes = self.changes()
        options: dict[str, Any] = {}
        for name, value in point.items():
            if name.startswith("env."):
                options[name.removeprefix("env.").replace("-", "_")] = value
            else:
                changes[name] = value
        words = [f"{name}={json.dumps(value)}" for name, value in point.items()]
        env = self.env_config().changed(**options)
        settings: dict[str, Any] = {"env_steps": 200_000, "num_envs": env.drones}
        settings |= {"backend": "mujoco"} | self.given_of_rows()
        name = " ".join(words).replace('"', "").replace(", ", ",")
        return Row(agent=self.algorithm, name=name, env=env, set=changes, **settings)


def parse_grid(words: Iterable[str]) -> dict[str, tuple[Any, ...]]:
    """Values by the name of their hyperparameter, each in JSON. Raises `InputError`."""
    grid: dict[str, tuple[Any, ...]] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise InputError(f"grid: expected NAME=VALUE,VALUE,…, got {word!r}")
        if name in grid:
            raise InputError(f"grid: expected each name once, got {name} twice")
        values = _values(text)
        for place, value in enumerate(values):
            if value in values[:place]:
                raise InputError(f"grid: expected each {name} once, got {value!r} twice")
        grid[name] = values
    return grid


def _values(text: str) -> tuple[Any, ...]:
    """JSON values with commas between them; without brackets, words are texts."""
    try:
        return tuple(json.loads(f"[{text}]"))
    except (ValueError, RecursionError):
        if set(text) & set("[]{}"):
            raise InputError(f"grid: expected values in JSON, got {text!r}") from None
        return tuple(parse_value(value) for value in text.split(","))
