"""Array code run once on variables: NumPy's functions of a `TracedArray` extend its program.

    program = Program()
    position = read(program, "position", np.dtype(np.float32), (3,))
    velocity = read(program, "velocity", np.dtype(np.float32), (3,))
    later = position + velocity * 0.01

The program then has six loads, a constant, three products and three sums. Dtypes follow NumPy's
rules. An array has the shape that it has for one world: axes of worlds have the length 1.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce, wraps
from itertools import count
from math import prod
from typing import Any, NoReturn

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike

from .program import OPERATIONS, TYPES, DType, Function, Program, Value

Call = Callable[..., Any]
Traced = Any
"""A traced array, or what is made one; the types of NumPy's functions do not know it."""

_FLAG = np.dtype(bool)
_WHOLE = np.dtype(np.int64)
_EXPONENTS = (*range(-32, 0), *range(1, 33))
_MOVES = (np.broadcast_to, np.expand_dims, np.moveaxis, np.repeat, np.flip)
"""Functions that move components, and compute nothing."""
_JOINS = (np.stack, np.concatenate, np.column_stack, np.vstack, np.hstack)
_METHODS = ("reshape", "ravel", "squeeze", "transpose", "swapaxes", "copy")
_REDUCTIONS = {
    "sum": np.add,
    "any": np.logical_or,
    "all": np.logical_and,
    "min": np.minimum,
    "max": np.maximum,
}
_AS_METHODS = (*_METHODS, *_REDUCTIONS, "astype", "clip")
"""Functions that call an array's method of their name."""


class Untraceable(TypeError):
    """The code does what cannot be compiled. A class of its own: other errors are the code's."""


class TracedArray(NDArrayOperatorsMixin):
    """An array of values of a program, all of one dtype, with the methods of NumPy's arrays.

    Attributes:
        program: What operations extend.
        values: Of each component its `Value`, dtype object.
    """

    __hash__ = None  # type: ignore[assignment]  # as NumPy's

    def __init__(
        self, program: Program, values: object, dtype: DType, shape: Sequence[int] | None = None
    ) -> None:
        """The shape is that of the values, unless another is given."""
        array = np.asarray(values, object)
        self.program = program
        self.values = array if shape is None else array.reshape(shape)
        self.dtype = dtype

    def __getattr__(self, name: str) -> Any:
        if name in ("shape", "ndim", "size", "setflags"):
            return getattr(self.values, name)
        if name in _METHODS:
            move = getattr(self.values, name)
            return lambda *args, **options: self._like(move(*args, **options))
        if name in _REDUCTIONS:
            return partial(self._reduced, _REDUCTIONS[name])
        if name.startswith("__"):
            raise AttributeError(name)
        return _refuse(f"array.{name}")

    @property
    def T(self) -> "TracedArray":  # NumPy's name
        """Its axes in the reverse order."""
        return self._like(self.values.T)

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: Any) -> "TracedArray":
        if isinstance(index, TracedArray):
            _refuse("an index that is computed", "use looked_up() or np.take_along_axis()")
        return self._like(self.values[index])

    def __setitem__(self, index: Any, value: object) -> None:
        self.values[index] = self.lifted(value, self.dtype).values

    def __bool__(self) -> bool:
        _refuse("a branch on an array", "use np.where()")

    def __index__(self) -> int:
        _refuse("a single number of an array", "it differs from world to world")

    __float__ = __int__ = __index__

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        _refuse("a new array of this one", "use stack() or np.concatenate()")

    def astype(self, dtype: DTypeLike, *, copy: bool = True) -> "TracedArray":
        """As another dtype."""
        dtype = np.dtype(dtype)
        if dtype == self.dtype:
            return self.copy() if copy else self
        if dtype not in TYPES:
            _refuse(f"an array of {dtype}", f"take one of {', '.join(map(str, TYPES))}")
        return self._each(partial(self.program.cast, dtype=dtype), dtype, self)

    def view(self, dtype: DTypeLike | None = None) -> "TracedArray":
        """The bits of its numbers as another dtype of as many bits."""
        if dtype is None:
            return self._like(self.values)
        return self._applied("bits", np.dtype(dtype), self)

    def clip(self, low: Traced = None, high: Traced = None) -> Traced:
        """Within bounds; None is no bound."""
        above: Traced = self if low is None else np.maximum(self, low)
        return above if high is None else np.minimum(above, high)

    def rows_of(self, table: np.ndarray) -> Traced:
        """Rows of a table of constants, by their numbers, which lie within it."""
        rows = len(table)
        flat = table.reshape(rows, -1).copy()
        self.program.tables.append(flat)
        name = len(self.program.tables) - 1
        numbers = self.astype(_WHOLE).clip(0, rows - 1)
        found = []
        for row in numbers.values.ravel().tolist():
            for column in range(flat.shape[1]):
                found.append(self.program.value("gather", flat.dtype, name, column, row))
        return TracedArray(self.program, found, flat.dtype, (*self.shape, *table.shape[1:]))

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Traced:
        if method == "reduce" and ufunc in _REDUCTIONS.values():
            return self._reduced(ufunc, options.get("axis", 0))
        if method != "__call__" or options:
            _refuse(f"np.{ufunc.__name__} with {method} or {', '.join(options) or 'no options'}")
        if ufunc in _FUNCTIONS:
            return _FUNCTIONS[ufunc](self, *inputs)
        kinds = ufunc.resolve_dtypes((*map(_kind, inputs), *[None] * ufunc.nout))
        arrays = [self.lifted(one, kind) for one, kind in zip(inputs, kinds, strict=False)]
        if ufunc.__name__ not in OPERATIONS[arrays[0].dtype.kind]:
            _refuse(f"np.{ufunc.__name__} of {arrays[0].dtype}")
        return self._applied(ufunc.__name__, kinds[ufunc.nin], *arrays)

    def __array_function__(self, function: Call, types: object, inputs: Any, options: Any) -> Any:
        if function in _MOVES:
            array, *rest = inputs
            return self._like(function(array.values, *rest, **options))
        if function in _JOINS:
            parts, *rest = inputs
            arrays = self._alike(parts)
            joined = function([one.values for one in arrays], *rest, **options)
            return TracedArray(self.program, joined, arrays[0].dtype)
        name = function.__name__
        if name in _AS_METHODS:
            array, *rest = inputs
            return getattr(array, name)(*rest, **options)
        if function not in _FUNCTIONS:
            _refuse(f"np.{name}")
        return _FUNCTIONS[function](self, *inputs, **options)

    def _like(self, values: object) -> "TracedArray":
        return TracedArray(self.program, values, self.dtype)

    def lifted(self, given: Traced, dtype: DType) -> "TracedArray":
        """Anything as a traced array of this dtype."""
        if isinstance(given, TracedArray):
            if given.program is not self.program:
                raise ValueError("compiled code: expected values of one program, got another's")
            return given.astype(dtype, copy=False)
        constant = np.frompyfunc(lambda number: self.program.constant(number, dtype), 1, 1)
        return TracedArray(self.program, constant(np.asarray(given, dtype)), dtype)

    def _alike(self, given: Sequence[Traced]) -> "list[TracedArray]":
        """Arrays and numbers as arrays of the dtype that NumPy gives them together."""
        dtype = _result_type(self, *given)
        return [self.lifted(one, dtype) for one in given]

    def _each(
        self, function: Callable[..., Value], dtype: DType, *arrays: "TracedArray"
    ) -> "TracedArray":
        """A function of the values of some arrays, one after the other."""
        made = np.frompyfunc(function, len(arrays), 1)
        return TracedArray(self.program, made(*[one.values for one in arrays]), dtype)

    def _called(
        self,
        function: Call,
        made: dict[object, Function],
        given: Sequence[Traced],
        vectors: int,
    ) -> "TracedArray":
        """A call for each number or vector."""
        arrays = list(given) if vectors else self._alike(given)
        parts = [one.shape[one.ndim - vectors :] for one in arrays]
        lead = np.broadcast_shapes(*[one.shape[: one.ndim - vectors] for one in arrays])
        kinds = tuple((one.dtype, part) for one, part in zip(arrays, parts, strict=True))
        if kinds not in made:
            made[kinds] = _function(function, kinds)
        callee = made[kinds]
        dtype = callee.results[0].dtype
        rows = [
            np.broadcast_to(one.values, (*lead, *part)).reshape(prod(lead), -1)
            for one, part in zip(arrays, parts, strict=True)
        ]
        results = []
        for inputs in np.concatenate(rows, axis=1).tolist():
            for number in range(len(callee.results)):
                results.append(self.program.value("call", dtype, callee, number, *inputs))
        return TracedArray(self.program, results, dtype, (*lead, *callee.shape))

    def _applied(self, operation: str, dtype: DType, *arrays: "TracedArray") -> "TracedArray":
        return self._each(partial(self.program.value, operation, dtype), dtype, *arrays)

    def _reduced(
        self, function: np.ufunc, axis: Traced = None, *, keepdims: bool = False
    ) -> Traced:
        """A sum and the like, from the first to the last."""
        if axis is None and self.ndim > 1:
            _refuse(f"np.{function.__name__} over all worlds", "give an axis")
        axis = 0 if axis is None else axis
        axes = sorted(np.atleast_1d(axis) % self.ndim, reverse=True)
        array: Traced = self
        if function in (np.logical_or, np.logical_and):
            array = self.astype(bool)
        elif function is np.add and self.dtype == _FLAG:
            array = self.astype(_WHOLE)
        for one in axes:
            parts = [np.moveaxis(array, one, 0)[index] for index in range(array.shape[one])]
            array = reduce(function, parts)
            if function is np.add:
                array = array + array.dtype.type(0)  # NumPy begins at 0, which is not -0
            array = np.expand_dims(array, one) if keepdims else array
        return array


def once(vectors: int = 0) -> Callable[[Call], Call]:
    """Makes a function of arrays one whose traced code is there once, and is called.

    It has no state, and computes each number, or with `vectors` 1 each vector of last axes, alone.
    """

    def wrap(function: Call) -> Call:
        made: dict[object, Function] = {}

        @wraps(function)
        def call(*arrays: Traced) -> Traced:
            for one in arrays:
                if isinstance(one, TracedArray):
                    return one._called(function, made, arrays, vectors)
            return function(*arrays)

        return call

    return wrap


def call_outside(address: int, mask: Traced, *arguments: Traced) -> TracedArray:
    """float32 of a function of C at an address, for each drone of a mask; 0 for the others."""
    single = np.dtype(np.float32)
    called = partial(mask.program.value, "outside", single, address)
    result: TracedArray = mask._each(called, single, mask, *arguments)
    return result


def read(program: Program, name: str, dtype: DType, shape: tuple[int, ...]) -> TracedArray:
    """The variables of an array of a program, of such a shape for one world."""
    values = [program.value("load", dtype, name, number) for number in range(prod(shape))]
    return TracedArray(program, values, dtype, shape)


def _function(function: Call, kinds: Sequence[tuple[DType, tuple[int, ...]]]) -> Function:
    """A function traced on its parameters, of such dtypes and shapes."""
    program = Program()
    numbers = count()
    arrays = []
    for dtype, shape in kinds:
        values = [program.value("parameter", dtype, next(numbers)) for _ in range(prod(shape))]
        arrays.append(TracedArray(program, values, dtype, shape))
    out = function(*arrays)
    dtypes = ".".join(dtype.name for dtype, _ in kinds)
    name = f"{function.__name__}.{dtypes}"
    return Function(name, program, out.values.ravel().tolist(), out.shape)


def lift(program: Program, values: Traced, dtype: DType) -> list[Value]:
    """The values of an array, traced or of constants, as this dtype."""
    like = values if isinstance(values, TracedArray) else TracedArray(program, [], dtype)
    found: list[Value] = like.lifted(values, dtype).values.reshape(-1).tolist()
    return found


def _refuse(what: str, advice: str = "") -> NoReturn:
    raise Untraceable(f"{what} cannot be compiled" + (f": {advice}" if advice else ""))


def _kind(given: Traced) -> Traced:
    """The dtype of an array, or the type of one of Python's numbers, which adapt to arrays."""
    if hasattr(given, "dtype"):
        return given.dtype
    return type(given) if type(given) in (int, float) else np.asarray(given).dtype


def _result_type(_: TracedArray, *given: Traced) -> DType:
    """Python's numbers adapt to arrays, and lists do not, as in NumPy."""
    arrays = [np.asarray(one) if isinstance(one, list | tuple) else one for one in given]
    return np.result_type(*[one.dtype if isinstance(one, TracedArray) else one for one in arrays])


# ---- functions that are made of others


def _where(like: TracedArray, flag: Traced, first: Traced, second: Traced) -> Traced:
    first, second = like._alike((first, second))

    def select(chosen: Value, a: Value, b: Value) -> Value:
        return a if a is b else like.program.value("select", first.dtype, chosen, a, b)

    return like._each(select, first.dtype, like.lifted(flag, _FLAG), first, second)


def _extreme(is_before: Call, is_not_before: Call) -> Call:
    """A NaN stays, and of 0 and -0 it is the second. A constant as the second needs less."""

    def extreme(like: TracedArray, a: Traced, b: Traced) -> Traced:
        is_plain = not isinstance(b, TracedArray) and np.all(b == b)
        a, b = like._alike((a, b))
        if is_plain:
            return _where(like, is_not_before(a, b), b, a)
        return _where(like, a != a, a, _where(like, is_before(a, b), a, b))

    return extreme


def _absolute(like: TracedArray, x: Traced) -> Traced:
    if x.dtype.kind == "f":
        return like._applied("absolute", x.dtype, x)
    return _where(like, x < 0, 0 - x, x).astype(x.dtype)


def _sign(like: TracedArray, x: Traced) -> Traced:
    return _where(like, x > 0, 1.0, _where(like, x < 0, -1.0, x + 0.0)).astype(x.dtype)


def _remainder(like: TracedArray, x: Traced, by: Traced) -> Traced:
    """With the sign of the divisor; of a whole number and 0 it is 0."""
    x, by = like._alike((x, by))
    if x.dtype.kind == "i":  # By 0, and the least number by -1, processors stop the program.
        by = _where(like, by == -1, 1, by)
    if x.dtype.kind != "f":
        by = _where(like, by == 0, 1, by)
    rest = like._applied("remainder", x.dtype, x, by)
    whole = np.copysign(0.0 * rest, by) if x.dtype.kind == "f" else rest
    return _where(like, rest == 0, whole, _where(like, (rest < 0) != (by < 0), rest + by, rest))


def _power(like: TracedArray, x: Traced, exponent: Traced) -> Traced:
    if isinstance(exponent, list | tuple):
        _refuse("np.power with several exponents")
    if exponent == 0:
        return np.ones_like(x)
    if exponent == 0.5:
        return np.sqrt(x)
    if exponent in _EXPONENTS:  # of numbers below 0 too, which have no logarithm
        product = reduce(np.multiply, [x] * abs(int(exponent)))
        return product if exponent > 0 else 1.0 / product
    from ..elementary import power  # which is made of traced functions

    return power(x, exponent)


def _take_along_axis(like: TracedArray, array: Traced, indices: Traced, axis: int) -> Traced:
    """By comparing the index with each that there is."""
    count = array.shape[axis]
    parts = [np.expand_dims(np.moveaxis(array, axis, 0)[i], axis) for i in range(count)]
    chosen = parts[0]
    for index in range(count):
        is_it = (indices == index) | (indices == index - count)  # counted from the end too
        chosen = _where(like, is_it, parts[index], chosen)
    return chosen


def _argsort(like: TracedArray, array: Traced, axis: int = -1, **_: object) -> Traced:
    """Places by their ranks, the number of those that come before; of equal ones the first does."""
    values = np.moveaxis(array, axis, -1)
    count = values.shape[-1]
    numbers = np.arange(count)
    a, b = values[..., :, None], values[..., None, :]
    earlier = numbers[:, None] > numbers
    ranks = ((b < a) | ((b == a) & earlier)).astype(_WHOLE).sum(axis=-1)
    places = (ranks[..., None, :] == numbers[:, None]).astype(_WHOLE) * numbers
    return np.moveaxis(places.sum(axis=-1), -1, axis)


def _filled(number: float) -> Callable[..., Traced]:
    def filled(
        like: TracedArray,
        array: Traced,
        dtype: DTypeLike | None = None,
        shape: tuple[int, ...] | None = None,
    ) -> Traced:
        numbers = np.full(array.shape if shape is None else shape, number, dtype or array.dtype)
        return like.lifted(numbers, numbers.dtype)

    return filled


_FUNCTIONS: dict[Call, Call] = {
    np.where: _where,
    np.minimum: _extreme(np.less, np.greater_equal),
    np.maximum: _extreme(np.greater, np.less_equal),
    np.absolute: _absolute,
    np.sign: _sign,
    np.power: _power,
    np.remainder: _remainder,
    np.square: lambda like, x: x * x,
    np.logical_and: lambda like, a, b: like.lifted(a, _FLAG) & like.lifted(b, _FLAG),
    np.logical_or: lambda like, a, b: like.lifted(a, _FLAG) | like.lifted(b, _FLAG),
    np.logical_not: lambda like, x: ~like.lifted(x, _FLAG),
    np.isnan: lambda like, x: x != x,
    np.isfinite: lambda like, x: abs(x) < np.inf,
    np.take_along_axis: _take_along_axis,
    np.argsort: _argsort,
    np.zeros_like: _filled(0.0),
    np.ones_like: _filled(1.0),
    np.empty_like: _filled(0.0),
    np.result_type: _result_type,
    np.ndim: lambda like, x: x.ndim,
    np.shape: lambda like, x: x.shape,
}


def add_function(function: Call, ours: Call) -> None:
    """Trace one of NumPy's functions as another."""
    _FUNCTIONS[function] = lambda _, *arrays: ours(*arrays)
