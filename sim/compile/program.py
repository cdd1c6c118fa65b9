"""A program: what array code does to the numbers of one world, as a list of operations.

Machine code runs it for many worlds at once, each in a lane of a vector. A program knows nothing of
that: `llvm.py` prints its operations for as many lanes as the processor has.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...models.files import read_own_toml

DType = np.dtype[Any]
OPERATIONS = read_own_toml(__file__, "operations")
"""LLVM's instruction of each operation, by the kind of its first input, and its name."""
TYPES = {np.dtype(name): text for name, text in OPERATIONS.pop("types").items()}
"""LLVM's type of each dtype that can be compiled."""


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """The result of an operation of a program.

    `load` reads a component of an array: its inputs are the array's name and the component's
    number. `constant` has the bytes of a number. `gather` reads a table of the program: it has the
    table's number, the component's, and a value, the row. `call` has a `Function`, the number of
    its result, and values; `parameter` is one of a function, by its number. `outside` has the
    address of a function of C, a mask, and values. All others have values.
    """

    operation: str
    dtype: DType
    inputs: tuple[Any, ...]
    number: int
    """Its place in the program."""


@dataclass(frozen=True, slots=True, eq=False)
class Function:
    """A program of its own, for what is computed often: its code is there once."""

    name: str
    program: "Program"
    results: list[Value]
    shape: tuple[int, ...]
    """Of the results."""


class Program:
    """Operations in an order in which they can be computed; equal ones are there once.

    Attributes:
        values: In that order.
        tables: Arrays of constants, two axes, that `gather` reads.
    """

    def __init__(self) -> None:
        self.values: list[Value] = []
        self.tables: list[np.ndarray] = []
        self._known: dict[object, Value] = {}

    def value(self, operation: str, dtype: DType, *inputs: object) -> Value:
        """The value of an operation; the one that is there if it is the same."""
        key = (operation, dtype, inputs)
        known = self._known.get(key)
        if known is None:
            known = Value(operation, dtype, inputs, len(self.values))
            self.values.append(known)
            self._known[key] = known
        return known

    def constant(self, number: object, dtype: DType) -> Value:
        """A number of all worlds. Its bytes tell 0.0 from -0.0."""
        return self.value("constant", dtype, np.asarray(number, dtype).tobytes())

    def cast(self, value: Value, dtype: DType) -> Value:
        """A value as another dtype."""
        return value if value.dtype == dtype else self.value("cast", dtype, value)

    def needed(self, results: Iterable[Value]) -> list[Value]:
        """The values that some results need, in order."""
        found = set[int]()
        left = list(results)
        while left:
            value = left.pop()
            if value.number not in found:
                found.add(value.number)
                left += [one for one in value.inputs if isinstance(one, Value)]
        return [value for value in self.values if value.number in found]
