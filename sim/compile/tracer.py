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
_FLAGS = {"or": [True, True], "select": [True, False, False]}
"""Which inputs are flags; of all others none is."""


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
        """The value of a function of NumPy's. Raises `TypeError` for one that is not known, and for
        flags where numbers are wanted, or numbers where flags are.
        """
        if function is np.minimum:  # NaN stays NaN, and of 0 and -0 it is the second
            first, second = inputs
            less = self.call(np.less, first, second)
            chosen = self.call(np.bitwise_or, less, self.call(np.not_equal, first, first))
            return self.call(np.where, chosen, first, second)
        if function not in _NAMES:
            known = ", ".join(one.__name__ for one in _NAMES)
            raise TypeError(f"compiled code: expected {known} or minimum, got {function.__name__}")
        name = _NAMES[function]
        flags = []
        words = []
        for one in inputs:
            is_traced = isinstance(one, TracedArray)
            if is_traced and one.trace is not self:
                raise TypeError("compiled code: expected values of one trace, got another's")
            flags.append(is_traced and one.is_flag)
            words.append(one.name if is_traced else repr(float(one)))
        if flags != _FLAGS.get(name, [False] * len(flags)):
            what = f"{function.__name__} of {len(flags)}"
            raise TypeError(f"compiled code: {what}: expected a number, got a flag, or the reverse")
        is_flag = name == "or" or name.startswith("fcmp")
        return self._add(Operation(name, tuple(words)), is_flag=is_flag)

    def _add(self, operation: Operation, *, is_flag: bool = False) -> "TracedArray":
        name = self.operations.setdefault(operation, f"%v{len(self.operations)}")
        return TracedArray(self, name, is_flag=is_flag)


class TracedArray(NDArrayOperatorsMixin):
    """A variable, or a flag: NumPy's functions of it become operations of its trace."""

    shape = ()

    def __init__(self, trace: Trace, name: str, *, is_flag: bool) -> None:
        self.trace = trace
        self.name = name
        self.dtype = trace.dtype
        self.is_flag = is_flag

    def __bool__(self) -> bool:
        raise TypeError("compiled code: expected np.where, got a branch on a traced value")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any) -> "TracedArray":
        if method != "__call__":
            raise TypeError(f"compiled code: expected a function, got {ufunc.__name__}.{method}")
        return self.trace.call(ufunc, *inputs)

    def __array_function__(
        self, function: Callable[..., Any], types: object, inputs: Any, options: object
    ) -> "TracedArray":
        return self.trace.call(function, *inputs)
