"""The motion of `body.py` as machine code: its equations run once on variables."""

import copy
from collections.abc import Callable
from itertools import count

import numpy as np
from numpy.typing import DTypeLike

from ..compile import Program, read
from ..compile.layout import Layout, Memory
from ..compile.llvm import Region, compiled, widest
from ..state import Array
from .body import RigidBody, mapped

ROWS = 13

Fly = Callable[[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, int], np.ndarray]
"""New rows (13, W) from rows, thrusts (R, W), a wrench (6, W), what varies, and physics steps."""


def flight(body: RigidBody, worlds: int, dtype: np.dtype[np.floating], rotors: int) -> Fly:
    """The flight of a body whose `varying` has the vectors that it will have."""
    varying: list[Array] = []
    mapped(body.varying, varying.append)
    sizes = {"rows": ROWS, "thrust": rotors, "wrench": 6, "varying": len(varying)}
    lanes = -(-worlds // widest()) * widest()
    layout = Layout({name: (dtype, (size,)) for name, size in sizes.items()}, lanes)
    memory = Memory(layout, worlds)
    functions = {}

    def fly(rows: Array, thrust: Array, wrench: Array, varying: Array, steps: int) -> np.ndarray:
        given = {"rows": rows, "thrust": thrust, "wrench": wrench, "varying": varying}
        for name, values in given.items():
            if values is not None:
                memory.put(name, values.T)
        kind = (steps, wrench is None)
        if kind not in functions:
            functions[kind] = compiled([_traced(body, layout, *kind)], [layout], {}, widest())
        functions[kind](1, memory.address)
        return memory.get("rows").T

    return fly


def _traced(body: RigidBody, layout: Layout, steps: int, is_calm: bool) -> Region:
    program = Program()
    arrays = {
        name: read(program, name, dtype, shape) for name, (dtype, shape) in layout.fields.items()
    }
    numbers = count()
    traced = copy.copy(body)
    traced.varying = mapped(body.varying, lambda _: arrays["varying"][next(numbers)])
    wrench = None if is_calm else arrays["wrench"]
    flown = traced.fly(arrays["rows"], arrays["thrust"], wrench, steps)
    stores = [("rows", row, value.values.item()) for row, value in enumerate(flown)]
    return Region("", program, stores)


def packed(body: RigidBody, dtype: DTypeLike) -> np.ndarray | None:
    """The vectors of `varying` as the compiled function takes them, (L, W); None if none vary."""
    found: list[np.ndarray] = []
    mapped(body.varying, found.append)
    return np.stack(found).astype(dtype).view(np.ndarray) if found else None
