"""Write docs/observations.md from the specs of the tasks: `python docs/observations.py`."""

import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import gymnasium
import numpy as np
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec, task_type
from rotorgram.envs.spec import ArraySpec, Discrete

__all__ = ["page"]

NUMBER = re.compile(r"(?<![.\d])\d+(?![.\d])")
PAGE = Path(__file__).with_suffix(".md")
HEAD = """\
# Observations and actions of the tasks

`python docs/observations.py` writes this page from the specs of the tasks, with the paper's
quadcopter, default options and the least number of drones. `env.unwrapped.env_spec` has the same
for every vehicle and option. Numbers beyond the bounds are clipped.
"""


def page() -> str:
    """The page: a section for each task."""
    parts = [HEAD]
    for env_id in [name for name in gymnasium.registry if name.startswith("rotorgram/")]:
        drones = task_type(env_id).min_drones
        spec = env_spec(EnvConfig(env_id=env_id, drones=drones))
        parts.append(f"\n## {env_id.rpartition('/')[2]}\n")
        for array in spec.observation:
            parts.append(_array(array))
        if not isinstance(spec.action, Discrete):
            parts.append(_array(spec.action))
    return "".join(parts)


def _array(array: ArraySpec) -> str:
    frame = f"; frame: {array.frame}" if array.frame else ""
    title = f"\n`{array.name}`, `{array.dtype}`, shape {array.shape}{frame}\n\n"
    lines = ["| index | quantity | unit | bounds |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in _rows(array)]
    return title + "\n".join(lines) + "\n"


def _rows(array: ArraySpec) -> Iterator[tuple[str, ...]]:
    """Index, quantity, unit and bounds; a vector has one row, and so have rotors."""
    low, high = (bound.ravel() for bound in array.bounds())
    units = [array.unit] * low.size if isinstance(array.unit, str) else array.unit
    if low.size > 1 and not array.components:
        rows, columns = array.shape
        quantity = f"{rows} rows of {columns} distances"
        yield f"0-{low.size - 1}", quantity, units[0], _bounds(low[0], high[0])
        return
    names = array.components or (array.name,)

    def key(index: int) -> tuple[object, ...]:
        stem, _, axis = names[index].rpartition(" ")
        same = stem if axis in ("x", "y", "z") else NUMBER.sub("", names[index])
        return same, units[index], low[index], high[index]

    for _, group in groupby(range(low.size), key=key):
        first, *others = group
        last = others[-1] if others else first
        quantity = names[first]
        if quantity.endswith(" x"):
            quantity += "".join(f", {names[index][-1]}" for index in others)
        elif others:
            quantity += f" to {names[last]}"
        span = f"{first}" if first == last else f"{first}-{last}"
        yield span, quantity, units[first], _bounds(low[first], high[first])


def _bounds(low: np.floating, high: np.floating) -> str:
    return f"±{high:.6g}" if low == -high else f"{low:.6g} to {high:.6g}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
