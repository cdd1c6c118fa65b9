"""What tests of tasks share: states and draws that are written out."""

import math
from typing import Any

import numpy as np
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.specification import make_task
from rotorgram.envs.state import State
from rotorgram.sim import Draw
from rotorgram.sim.random import Random


def task_of(env_id: str, **options: Any) -> Any:
    """A task for arrays of one drone in one world."""
    config = EnvConfig.from_keywords(env_id, **options)
    return make_task(config)


def state_of(rotors: int = 4, time: float = 0.0, **arrays: Any) -> State:
    """A single level craft at rest at (0, 0, 5), but for the arrays that are given.

    `about`: arguments of the function of that name, in place of a quaternion.
    """
    fields: dict[str, Any] = {
        "position": (0.0, 0.0, 5.0),
        "quaternion": (1.0, 0.0, 0.0, 0.0),
        "velocity": (0.0,) * 3,
        "body_rates": (0.0,) * 3,
        "thrust": (49.0,) * rotors,
        "touching": False,
    }
    if "about" in arrays:
        arrays["quaternion"] = about(*arrays.pop("about"))
    given = {name: np.array(value) for name, value in {**fields, **arrays}.items()}
    steps = round(time / 0.02)
    return State(
        **given, command=given["thrust"], action=np.zeros(rotors), steps=steps, time=time,
        distance=lambda points: 1000.0 + 0.0 * points[..., 0],
    )  # fmt: skip


def about(axis: tuple[float, float, float], degrees: float) -> tuple[float, ...]:
    """Quaternion of a turn about a unit vector."""
    half = math.radians(degrees) / 2
    return (math.cos(half), *(math.sin(half) * part for part in axis))


class Shares(Draw):
    """Gives, one after another, these shares of the way from the low end of a draw to the high."""

    def __init__(self, *shares: Any) -> None:
        super().__init__(Random((1, 1)), 0, None)
        self._shares = iter(shares)

    def uniform(self, low: float, high: float, size: tuple[int, ...] = ()) -> Any:
        share = next(self._shares)
        if hasattr(share, "shape"):
            return low + (high - low) * share
        values = low + (high - low) * np.asarray(share, np.float64)
        return np.broadcast_to(values, size).copy()[()]
