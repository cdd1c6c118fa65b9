"""A function of arrays of worlds as machine code: it runs once on variables."""

from collections.abc import Callable
from math import prod

import numpy as np

from ..compile import Program, read
from ..compile.layout import Layout, Memory
from ..compile.llvm import Region, compiled, widest
from ..compile.program import DType
from ..state import Array

_RESULT = "result"


class Kernel:
    """A function that is compiled when it is first called with arguments of such kinds.

    The function gives an array (W, A, k) from a number of physics steps, which is a constant of the
    machine code, and from arrays (W, A, ...) or nested tuples of them, as of `mapped`.
    """

    def __init__(self, function: Callable[..., Array], shape: tuple[int, ...]) -> None:
        """`shape` is (W, A)."""
        self._function = function
        self._shape = shape
        self._made: dict[object, tuple[Memory, Callable[..., None]]] = {}

    def __call__(self, steps: int, *given: Array) -> np.ndarray:
        """The function's result, the same bits."""
        arrays: list[np.ndarray] = []
        mapped(given, arrays.append)
        kinds = (steps, *[(values.dtype, values.shape) for values in arrays])
        if kinds not in self._made:
            self._made[kinds] = self._compiled(steps, given)
        memory, code = self._made[kinds]
        for number, values in enumerate(arrays):
            memory.put(str(number), values)
        code(memory.blocks, memory.address, None)
        return memory.get(_RESULT).reshape(*self._shape, -1)

    def _compiled(self, steps: int, given: tuple[Array, ...]) -> tuple[Memory, Callable[..., None]]:
        program = Program()
        fields: dict[str, tuple[DType, tuple[int, ...]]] = {}

        def variable(values: np.ndarray) -> Array:
            name = str(len(fields))
            shape = values.shape[2:]
            fields[name] = values.dtype, shape
            return read(program, name, values.dtype, (1, 1, *shape))

        result = self._function(steps, *mapped(given, variable))
        fields[_RESULT] = result.dtype, result.shape[2:]
        stores = [(_RESULT, row, value) for row, value in enumerate(result.values.ravel())]
        drones = prod(self._shape)
        width = widest()
        layout = Layout(fields, lanes=-(-drones // width) * width)
        code = compiled([Region("", program, stores)], [layout], {}, width)
        return Memory(layout, drones), code


def mapped(tree: Array, change: Callable[[Array], Array]) -> Array:
    """Nested tuples and lists with `change` applied to every vector, in a fixed order."""
    if isinstance(tree, tuple | list):
        parts = [mapped(one, change) for one in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return change(tree) if hasattr(tree, "shape") else tree
