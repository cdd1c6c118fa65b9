"""`rotorgram sweep`: train an algorithm over a grid of hyperparameters and task options."""

import json
from collections.abc import Iterable, Mapping
from itertools import chain, product

from tyro.conf import Positional

from ..agents.registry import AlgorithmName
from ..models import InputError
from ..training.settings import Row, Study
from ._flags import NamedValues, Options, parse_value
from ._study import StudyFlags

Values = tuple[object, ...]


class Sweep(StudyFlags):
    """Train an algorithm over a grid of hyperparameters, every point on the same seeds.

    Ctrl-C keeps the runs that are done; --resume flies the others.
    """

    kinds = ("sweep",)

    algorithm: Positional[AlgorithmName]
    """The algorithm."""
    grid: NamedValues = ()
    """Values to try, in JSON: learning_rate=0.003,0.01 hidden=[64,64],[32,32], and options of the
    task as env.start_band=0.5,2. Every combination is a point."""

    @property
    def words(self) -> str:
        return f"sweep {self.algorithm}"

    def study(self) -> Study:
        """A row for each point, on seeds that no comparison uses by default."""
        grid = parse_grid(chain.from_iterable(self.grid))
        if not grid:
            raise InputError("grid: expected a hyperparameter (--grid gamma=0.99,0.999), got none")
        rows = [
            self._row(dict(zip(grid, values, strict=True))) for values in product(*grid.values())
        ]
        settings: Options = {"seeds": 3, "first_seed": 1000, "snapshots": 1}
        settings |= self.given_of_study()
        return Study(rows=tuple(rows), kind="sweep", evaluation="tuning", **settings)

    def _row(self, point: Mapping[str, object]) -> Row:
        changes = self.changes()
        options: Options = {}
        for name, value in point.items():
            if name.startswith("env."):
                options[name.removeprefix("env.").replace("-", "_")] = value
            else:
                changes[name] = value
        words = [f"{name}={json.dumps(value)}" for name, value in point.items()]
        name = " ".join(words).replace('"', "").replace(", ", ",")
        return self.new_row(
            self.algorithm, name, changes, self.env_config(backend=None).changed(**options)
        )


def parse_grid(words: Iterable[str]) -> dict[str, Values]:
    """Values by the name of their hyperparameter, each in JSON. Raises `InputError`."""
    grid: dict[str, Values] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise InputError(f"grid: expected NAME=VALUE,VALUE,…, got {word!r}")
        if name in grid:
            raise InputError(f"grid: expected each name once, got {name} twice")
        grid[name] = _values(text)
    return grid


def _values(text: str) -> Values:
    """JSON values with commas between them; without brackets, words are texts."""
    try:
        return tuple(json.loads(f"[{text}]"))
    except (ValueError, RecursionError):
        if set(text) & set("[]{}"):
            raise InputError(f"grid: expected values in JSON, got {text!r}") from None
        return tuple(parse_value(value) for value in text.split(","))
