"""The motion of `body.py` as machine code: its equations run once on variables."""

import copy
from collections.abc import Callable
from itertools import count

import numpy as np
from numpy.typing import DTypeLike

from ..compile import Trace, compiled
from ..state import Array
from .body import RigidBody, mapped

ROWS = 13
_ARRAYS = ("rows", "thrust", "wrench", "varying")

Fly = Callable[[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, int], np.ndarray]
"""New rows (13, W) from rows, thrusts (R, W), a wrench (6, W), what varies, and physics steps."""


def flight(body: RigidBody, rotors: int, dtype: np.dtype[np.floating], *, wrench: bool) -> Fly:
    """The flight of a body whose `varying` has the vectors that it will have."""
    trace = Trace(dtype)
    numbers = count()
    traced = copy.copy(body)
    traced.varying = mapped(body.varying, lambda _: trace.read("varying", next(numbers)))
    rows = [trace.read("rows", row) for row in range(ROWS)]
    thrust = [trace.read("thrust", row) for row in range(rotors)]
    push = [trace.read("wrench", row) for row in range(6)] if wrench else None
    flown = traced.fly(rows, thrust, push)
    function = compiled(trace, "rows", flown, _ARRAYS)

    def fly(rows: Array, thrust: Array, wrench: Array, varying: Array, steps: int) -> np.ndarray:
        out = np.empty(rows.shape, dtype)
        function(rows, thrust, wrench, varying, out=out, steps=steps)
        return out

    return fly


def packed(body: RigidBody, dtype: DTypeLike) -> np.ndarray | None:
    """The vectors of `varying` as the compiled function takes them, (L, W); None if none vary."""
    found: list[np.ndarray] = []
    mapped(body.varying, found.append)
    return np.stack(found).astype(dtype).view(np.ndarray) if found else None
