"""A function of arrays of worlds as machine code: it runs once on variables."""

from collections.abc import Callable
from math import prod

import numpy as np

from ..compile import Program, read
from ..compile.layout import Layout, Memory
from ..compile.llvm import Region, compiled, widest
from ..state import Array

_RESULT = "result"


class Kernel:
    """A function that is compiled when it is first called with arguments of such kinds.

    The function gives an array (W, A, k). Its arguments are arrays (W, A, ...); any others, as a
    number of steps, are constants of the machine code.
    """

    def __init__(self, function: Callable[..., Array], shape: tuple[int, ...]) -> None:
        """`shape` is (W, A)."""
        self._function = function
        self._shape = shape
        self._made: dict[object, tuple[Memory, Callable[..., None]]] = {}

    def __call__(self, *given: Array) -> np.ndarray:
        """The function's result, the same bits."""
        kinds = tuple((x.dtype, x.shape) if _is_array(x) else x for x in given)
        if kinds not in self._made:
            self._made[kinds] = self._compiled(given)
        memory, code = self._made[kinds]
        for number, values in enumerate(given):
            if _is_array(values):
                memory.put(str(number), values.reshape(-1, *values.shape[2:]))
        code(memory.blocks, memory.address, None)
        return memory.get(_RESULT).reshape(*self._shape, -1)

    def _compiled(self, given: tuple[Array, ...]) -> tuple[Memory, Callable[..., None]]:
        program = Program()
        fields = {}
        variables = list(given)
        for number, values in enumerate(given):
            if _is_array(values):
                name = str(number)
                shape = values.shape[2:]
                fields[name] = values.dtype, shape
                variables[number] = read(program, name, values.dtype, (1, 1, *shape))
        result = self._function(*variables)
        fields[_RESULT] = result.dtype, result.shape[2:]
        stores = [(_RESULT, row, value) for row, value in enumerate(result.values.ravel())]
        drones = prod(self._shape)
        width = widest()
        layout = Layout(fields, lanes=-(-drones // width) * width)
        code = compiled([Region("", program, stores)], [layout], {}, width)
        return Memory(layout, drones), code


def _is_array(value: object) -> bool:
    return isinstance(value, np.ndarray)
