"""Array code run once on variables: its operations, in their order.

    trace = Trace(np.dtype(np.float32))
    position = trace.read("position", 0)
    velocity = trace.read("velocity", 0)
    later = position + velocity * 0.01

`trace.operations` then has four: two loads, a product and a sum.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

_NAMES: dict[Callable[..., Any], str] = {
    np.add: "fadd",
    np.subtract: "fsub",
    np.multiply: "fmul",
    np.true_divide: "fdiv",
    np.negative: "fneg",
    np.absolute: "fabs",
    np.sqrt: "sqrt",
    np.rint: "rint",
    np.floor: "floor",
    np.equal: "fcmp oeq",
    np.not_equal: "fcmp une",
    np.less: "fcmp olt",
    np.greater: "fcmp ogt",
    np.greater_equal: "fcmp oge",
    np.bitwise_or: "or",
    np.where: "select",
}
"""NumPy's functions, and their operations by LLVM's names."""


class Operation(NamedTuple):
    """A function and its inputs: names of values, which begin with %, and numbers as text.

    `load` reads a row of an array: its inputs are the array's name and the row.
    """

    function: str
    inputs: tuple[str, ...]


class Trace:
    """The operations of a piece of array code.

    Attributes:
        dtype: Of all numbers.
        operations: With the names of their values. The same one on the same values is there once.
    """

    def __init__(self, dtype: np.dtype[np.floating]) -> None:
        self.dtype = dtype
        self.operations = dict[Operation, str]()

    def read(self, array: str, row: int) -> "TracedArray":
        """The variable of a row of an array."""
        return self._add(Operation("load", (array, str(row))))

    def call(self, function: Callable[..., Any], *inputs: Any) -> "TracedArray":
        """The value of a function of NumPy's. Raises `TypeError` for one that is not known."""
        if function is np.minimum:  # NaN stays NaN, and of 0 and -0 it is the second
            first, second = inputs
            return self.call(np.where, (first < second) | (first != first), first, second)
        if function not in _NAMES:
            known = ", ".join(one.__name__ for one in _NAMES)
            raise TypeError(f"compiled code: expected {known} or minimum, got {function.__name__}")
        words = (x.name if isinstance(x, TracedArray) else repr(float(x)) for x in inputs)
        return self._add(Operation(_NAMES[function], tuple(words)))

    def _add(self, operation: Operation) -> "TracedArray":
        name = self.operations.setdefault(operation, f"%v{len(self.operations)}")
        return TracedArray(self, name)


class TracedArray(NDArrayOperatorsMixin):
    """A variable: NumPy's functions of it become operations of its trace."""

    shape = ()

    def __init__(self, trace: Trace, name: str) -> None:
        self._trace = trace
        self.name = name
        self.dtype = trace.dtype

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any) -> "TracedArray":
        return self._trace.call(ufunc, *inputs)

    def __array_function__(
        self, function: Callable[..., Any], types: object, inputs: Any, options: object
    ) -> "TracedArray":
        return self._trace.call(function, *inputs)
