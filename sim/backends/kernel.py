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
from math import factorial, pi
from pathlib import Path
from typing import Any, Final

import numpy as np

from ...models.errors import InputError
from .body import RigidBody, mapped

ROWS: Final = 13
COMPILE_SECONDS: Final = 60.0
"""Time limit of the compiler, s."""

_FLAGS: Final = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp-simd",
    "-ffp-contract=off",
)
_TERMS: Final = {"float": 7, "double": 12}  # of the series of a sine, up to a quarter turn
_SOURCE: Final = """#include <math.h>
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
        tool, *flags = shlex.split(words) or [""]
        if path := shutil.which(tool):
            return [path, *flags]
    return None


def compiled(body: RigidBody, rotors: int, dtype: Any, *, wrench: bool) -> Fly:
    """The flight of a body whose `varying` has the vectors that it will have.

    Takes half a second. Raises `InputError` if the compiler fails.
    """
    dtype = np.dtype(dtype)
    found = _library(_source(body, rotors, "float" if dtype.itemsize == 4 else "double", wrench))
    pointer = ctypes.c_void_p
    found.fly.argtypes = [ctypes.c_long, ctypes.c_long, *[pointer] * 5]

    def fly(rows: Any, thrust: Any, wrench: Any, varying: Any, steps: int) -> np.ndarray:
        out = np.empty(rows.shape, dtype)
        given = (rows, thrust, wrench, varying)
        places = [None if x is None else x.ctypes.data for x in given]
        found.fly(rows.shape[1], steps, *places, out.ctypes.data)
        return out

    return fly


def packed(body: RigidBody, dtype: Any) -> np.ndarray | None:
    """The vectors of `varying` as the compiled function takes them, (L, W); None if none vary."""
    found: list[np.ndarray] = []
    mapped(body.varying, found.append)
    return np.stack(found).astype(dtype).view(np.ndarray) if found else None


class _Lines:
    """The lines of a function; the same operation on the same variables is one line."""

    def __init__(self, terms: int) -> None:
        self.terms = terms
        self._names = dict[str, Variable]()

    def text(self) -> list[str]:
        """The lines of C."""
        return [f"      const T {x.name} = {text};" for text, x in self._names.items()]

    def new(self, text: str) -> "Variable":
        """The variable of an expression."""
        if text not in self._names:
            self._names[text] = Variable(self, f"x{len(self._names)}")
        return self._names[text]


class Variable:
    """A number of the C function. Its methods are those of `body.Lanes`."""

    shape = ()
    __array_ufunc__ = None  # NumPy's numbers leave operators to it

    def __init__(self, lines: _Lines, name: str) -> None:
        self._lines = lines
        self.name = name

    def _made(self, text: str, *others: Any) -> "Variable":
        names = (x.name if isinstance(x, Variable) else f"(T){float(x)!r}" for x in others)
        return self._lines.new(text.format(self.name, *names))

    def __add__(self, other: Any) -> "Variable":
        return self._made("{} + {}", other)

    __radd__ = __add__

    def __mul__(self, other: Any) -> "Variable":
        return self._made("{} * {}", other)

    __rmul__ = __mul__

    def __sub__(self, other: Any) -> "Variable":
        return self._made("{} - {}", other)

    def __rsub__(self, other: Any) -> "Variable":
        return self._made("{1} - {0}", other)

    def __truediv__(self, other: Any) -> "Variable":
        return self._made("{} / {}", other)

    def __rtruediv__(self, other: Any) -> "Variable":
        return self._made("{1} / {0}", other)

    def __abs__(self) -> "Variable":
        return self._made("fabs({})")

    def add(self, other: Any, *, alpha: float) -> Any:
        """Itself and `alpha` times another."""
        return self + other * alpha

    def addcmul(self, a: Any, b: Any, *, value: float = 1.0) -> Any:
        """Itself and `value` times a product."""
        return self + (a * b if value == 1.0 else a * b * value)

    def clip(self, *, max: float) -> "Variable":
        """The lesser of itself and a number."""
        return self._made("{0} > {1} ? {1} : {0}", max)  # NaN stays NaN

    def sqrt(self) -> "Variable":
        """Square root."""
        return self._made("sqrt({})")

    def sin(self) -> Any:
        """Sine."""
        return self._wave(1)

    def cos(self) -> Any:
        """Cosine."""
        return self._wave(0)

    def _wave(self, first: int) -> Any:
        """A sine (1) or cosine (0) by its series within a quarter turn of whole half turns.

        With a library's functions the compiler would use no vectors.
        """
        turns = self._made("rint({} * {})", 1 / pi)
        near = float(np.float32(pi))  # the two parts of pi make the rest exact
        rest = self - turns * near - turns * (pi - near)
        square = rest * rest
        series: Any = 0.0
        for n in reversed(range(1, self._lines.terms)):
            series = (series + (-1) ** n / factorial(2 * n + first)) * square
        odd = turns - self._lines.new(f"floor({turns.name} * (T)0.5)") * 2.0
        return (series * rest + rest if first else series + 1.0) * (1.0 - odd * 2.0)


def _source(body: RigidBody, rotors: int, kind: str, wrench: bool) -> str:
    lines = _Lines(_TERMS[kind])

    def read(array: str, count: int) -> list[Variable]:
        return [lines.new(f"{array}[{k} * count + i]") for k in range(count)]

    rows = read("rows", ROWS)
    thrust = read("thrust", rotors)
    numbers = count()
    traced = copy.copy(body)
    traced.varying = mapped(
        body.varying, lambda _: lines.new(f"varying[{next(numbers)} * count + i]")
    )
    flown = traced.fly(rows, thrust, read("wrench", 6) if wrench else None)
    out = [f"      out[{k} * count + i] = {x.name};" for k, x in enumerate(flown)]
    return _SOURCE.format(kind=kind, lines="\n".join([*lines.text(), *out]))


@lru_cache
def _library(source: str) -> Any:
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
