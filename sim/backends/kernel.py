"""The motion of `body.py` as a C function, which a C compiler makes for a vehicle.

The equations run on variables in place of numbers, and every operation writes a line of C. One loop
over the worlds has all lines of a physics step, so that the compiler uses the widest vectors of the
processor.
"""

import copy
import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import lru_cache
from itertools import count
from pathlib import Path

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike

from ...models.errors import InputError
from ..state import Array
from .body import RigidBody, mapped

Precision = np.dtype[np.floating]
ROWS = 13
COMPILE_SECONDS = 60.0
"""Time limit of the compiler, s."""

_FLAGS = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp-simd",
    "-ffp-contract=off",
)
_EXPRESSIONS = {
    np.add: "{} + {}",
    np.subtract: "{} - {}",
    np.multiply: "{} * {}",
    np.true_divide: "{} / {}",
    np.negative: "-{}",
    np.absolute: "fabs({})",
    np.sqrt: "sqrt({})",
    np.rint: "rint({})",
    np.floor: "floor({})",
    np.equal: "{} == {}",
    np.greater_equal: "{} >= {}",
    np.bitwise_or: "{} | {}",
    np.minimum: "{0} > {1} ? {1} : {0}",  # NaN stays NaN
    np.where: "{} ? {} : {}",
}
"""NumPy's functions in C. Together with `-ffp-contract=off` they give the same bits."""
_SOURCE = """#include <math.h>
#include <tgmath.h>
typedef {kind} T;
void fly(long count, long steps, const T *rows, const T *thrust, const T *wrench, const T *varying,
         T *out) {{
  for (long step = 0; step < steps; step++) {{
    #pragma omp simd
    for (long i = 0; i < count; i++) {{
{lines}
    }}
    rows = out;
  }}
}}
"""

Fly = Callable[[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, int], np.ndarray]
"""New rows (13, W) from rows, thrusts (R, W), a wrench (6, W), what varies, and physics steps."""


def compiler() -> list[str] | None:
    """Path and flags of the C compiler: of the variable CC, or `cc`, `gcc` or `clang`; or None."""
    for words in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        try:
            tool, *flags = shlex.split(words) or [""]
        except ValueError:  # a quotation without its end
            continue
        if path := shutil.which(tool):
            return [path, *flags]
    return None


def compiled(body: RigidBody, rotors: int, dtype: Precision, *, wrench: bool) -> Fly:
    """The flight of a body whose `varying` has the vectors that it will have.

    Takes half a second. Raises `InputError` if the compiler fails.
    """
    found = _library(_source(body, rotors, dtype, wrench))
    pointer = ctypes.c_void_p
    found.fly.argtypes = [ctypes.c_long, ctypes.c_long, *[pointer] * 5]

    def fly(rows: Array, thrust: Array, wrench: Array, varying: Array, steps: int) -> np.ndarray:
        out = np.empty(rows.shape, dtype)
        given = (rows, thrust, wrench, varying)
        places = [None if x is None else x.ctypes.data for x in given]
        found.fly(rows.shape[1], steps, *places, out.ctypes.data)
        return out

    return fly


def packed(body: RigidBody, dtype: DTypeLike) -> np.ndarray | None:
    """The vectors of `varying` as the compiled function takes them, (L, W); None if none vary."""
    found: list[np.ndarray] = []
    mapped(body.varying, found.append)
    return np.stack(found).astype(dtype).view(np.ndarray) if found else None


class _Lines:
    """The lines of a function; the same operation on the same variables is one line."""

    def __init__(self, dtype: Precision) -> None:
        self.dtype = dtype
        self._names = dict[str, TracedArray]()

    def text(self) -> list[str]:
        """The lines of C."""
        return [f"      const __auto_type {x.name} = {text};" for text, x in self._names.items()]

    def of(self, expression: str, *inputs: Array) -> "TracedArray":
        """The variable of an expression of variables and numbers."""
        names = (x.name if isinstance(x, TracedArray) else f"(T){float(x)!r}" for x in inputs)
        text = expression.format(*names)
        if text not in self._names:
            self._names[text] = TracedArray(self, f"x{len(self._names)}")
        return self._names[text]


class TracedArray(NDArrayOperatorsMixin):
    """A number of the C function: NumPy's functions of it write lines."""

    shape = ()

    def __init__(self, lines: _Lines, name: str) -> None:
        self._lines = lines
        self.name = name
        self.dtype = lines.dtype

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Array) -> "TracedArray":
        return self._lines.of(_EXPRESSIONS[ufunc], *inputs)

    def __array_function__(
        self, function: object, types: object, inputs: Array, options: object
    ) -> "TracedArray":
        return self._lines.of(_EXPRESSIONS[function], *inputs)


def _source(body: RigidBody, rotors: int, dtype: Precision, wrench: bool) -> str:
    lines = _Lines(dtype)

    def read(array: str, count: int) -> list[TracedArray]:
        return [lines.of(f"{array}[{k} * count + i]") for k in range(count)]

    rows = read("rows", ROWS)
    thrust = read("thrust", rotors)
    numbers = count()
    traced = copy.copy(body)
    traced.varying = mapped(
        body.varying, lambda _: lines.of(f"varying[{next(numbers)} * count + i]")
    )
    flown = traced.fly(rows, thrust, read("wrench", 6) if wrench else None)
    out = [f"      out[{k} * count + i] = {x.name};" for k, x in enumerate(flown)]
    kind = "float" if dtype.itemsize == 4 else "double"
    return _SOURCE.format(kind=kind, lines="\n".join([*lines.text(), *out]))


@lru_cache
def _library(source: str) -> ctypes.CDLL:
    """The compiled source. Raises `InputError` if it cannot be compiled or loaded."""
    command = compiler() or ["cc"]
    tool = command[0]
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            given = Path(folder) / "fly.c"
            made = Path(folder) / "fly.so"
            given.write_text(source)
            words = [*command, *_FLAGS, "-shared", "-fPIC", "-o", str(made), str(given), "-lm"]
            done = subprocess.run(
                words, capture_output=True, check=False, errors="replace", timeout=COMPILE_SECONDS
            )
            first, *_ = done.stderr.strip().splitlines() or ["nothing"]
            said = "".join(letter for letter in first if letter.isprintable())
            if done.returncode != 0:
                raise InputError(f"compiled: expected {tool} to compile the equations, got {said}")
            return ctypes.CDLL(str(made))
    except (OSError, subprocess.TimeoutExpired) as error:
        expected = f"{tool} to make a library that loads from the folder for temporary files"
        raise InputError(f"compiled: expected {expected}, got {error}") from error
