"""Traced array code: its operations, and the same bits by LLVM as by NumPy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rotorgram.sim.compile import Trace, TracedArray, compiled

KINDS = (np.float32, np.float64)
COUNTS = (1, 2, 15, 16, 17, 200)
ODD = (0.0, -0.0, 0.5, -0.5, 1.5, 2.5, -2.5, np.inf, -np.inf, np.nan, 1e-40, 3e38, -7.0, 7.0)

STATE = ("state", "given")

Code = Callable[[Any, Any], Any]
ONE: dict[str, Code] = {
    "add": lambda x, y: x + y,
    "a number on the left": lambda x, y: 0.1 - x,
    "multiply": lambda x, y: x * y * 0.3,
    "divide": lambda x, y: x / y,
    "negative": lambda x, y: -x,
    "absolute": lambda x, y: abs(x) + y,
    "sqrt": lambda x, y: np.sqrt(x),
    "rint": lambda x, y: np.rint(x) * y,
    "floor": lambda x, y: np.floor(x),
    "minimum": lambda x, y: np.minimum(x, y),
    "minimum of a number": lambda x, y: np.minimum(2.0, x),
    "where": lambda x, y: np.where((x == 0.5) | (x >= y), x, -1.0),
    "greater": lambda x, y: np.where(x > y, 2.0, y),
    "a sum of products is not fused": lambda x, y: x * y + x * 1.1 + y,
}


def traced(code: Code, dtype: Any) -> Any:
    trace = Trace(np.dtype(dtype))
    x, y = trace.read("state", 0), trace.read("given", 0)
    return compiled(trace, "state", [code(x, y)], STATE)


def same(found: np.ndarray, expected: np.ndarray) -> bool:
    """Bit for bit; only the bits of a NaN may differ."""
    nans = np.isnan(found) & np.isnan(expected)
    return bool(np.where(nans, 0, found).tobytes() == np.where(nans, 0, expected).tobytes())


@pytest.mark.parametrize("dtype", KINDS)
@pytest.mark.parametrize("name", ONE)
@np.errstate(all="ignore")
def test_each_function_has_the_bits_of_numpy(name: str, dtype: Any) -> None:
    """Also of the lanes that are left of the widest vector, and of odd numbers."""
    function = traced(ONE[name], dtype)
    rng = np.random.default_rng(1)
    for count in COUNTS:
        x = rng.normal(scale=3.0, size=(1, count)).astype(dtype)
        y = rng.normal(scale=3.0, size=(1, count)).astype(dtype)
        x[0, : len(ODD)] = np.array(ODD, dtype)[:count]
        y[0, : len(ODD)] = np.array(ODD, dtype)[:count][::-1]
        expected = np.asarray(ONE[name](x, y))
        assert expected.dtype == dtype
        out = np.empty((1, count), dtype)
        function(x, y, out=out, steps=1)
        assert same(out, expected), count


@pytest.mark.parametrize("dtype", KINDS)
def test_steps_follow_each_other(dtype: Any) -> None:
    def swing(x: Any, y: Any) -> Any:
        return x - 0.01 * np.sqrt(abs(x)) * y

    function = traced(swing, dtype)
    x = np.linspace(-1.0, 1.0, 37, dtype=dtype)[None]
    y = np.linspace(0.5, 2.0, 37, dtype=dtype)[None]
    out = np.empty_like(x)
    function(x, y, out=out, steps=100)
    expected = x
    for _ in range(100):
        expected = swing(expected, y)
    assert out.tobytes() == expected.tobytes()


def test_each_step_reads_all_rows_of_the_last_one() -> None:
    trace = Trace(np.dtype(np.float32))
    a, b, c = (trace.read("state", row) for row in range(3))
    function = compiled(trace, "state", [b, a, trace.read("given", 0) * np.inf + c], STATE)
    state = np.arange(60, dtype=np.float32).reshape(3, 20)
    out = np.empty_like(state)
    given = np.zeros((1, 20), np.float32)
    function(state, given, out=out, steps=3)
    assert out[:2].tobytes() == state[1::-1].tobytes()
    assert np.isnan(out[2]).all()


def test_what_has_no_code_is_refused() -> None:
    trace = Trace(np.dtype(np.float64))
    x, y = trace.read("state", 0), trace.read("given", 0)
    other = Trace(np.dtype(np.float64)).read("state", 0)
    attempts: list[tuple[Callable[[], object], str]] = [
        (lambda: x if x > 2.0 else y, "expected np.where, got a branch"),
        (lambda: np.add.outer(x, y), "got add.outer"),
        (lambda: np.add.reduce(x), "got add.reduce"),
        (lambda: x - (x > y), "expected a number, got a flag"),
        (lambda: (x > y) | 1.0, "expected a number, got a flag, or the reverse"),
        (lambda: np.where(x, x, y), "or the reverse"),
        (lambda: x + other, "expected values of one trace"),
    ]
    for attempt, sentence in attempts:
        with pytest.raises(TypeError, match=sentence):
            attempt()


def test_the_same_operation_is_there_once() -> None:
    trace = Trace(np.dtype(np.float32))
    position = trace.read("position", 0)
    velocity = trace.read("velocity", 0)
    later = position + velocity * 0.01
    assert len(trace.operations) == 4
    assert (position + velocity * 0.01).name == later.name
    assert (position + velocity * 0.02).name != later.name
    assert (position + 0.0).name != (position + -0.0).name
    assert (position - velocity).name != (velocity - position).name


def test_what_is_not_known_is_refused_by_its_name() -> None:
    value: TracedArray = Trace(np.dtype(np.float32)).read("state", 0)
    with pytest.raises(TypeError, match=r"^compiled code: expected add, .* got sin$"):
        np.sin(value)  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="got concatenate"):
        np.concatenate([value])  # type: ignore[call-overload]
