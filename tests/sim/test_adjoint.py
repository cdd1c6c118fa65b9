"""Derivatives of programs: each operation against differences, and where a difference has none."""

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.sim import elementary
from rotorgram.sim.compile import Program, once, read
from rotorgram.sim.compile.adjoint import adjoints
from rotorgram.sim.compile.layout import Layout, Memory
from rotorgram.sim.compile.llvm import Region, compiled
from rotorgram.sim.state import interpolated, length, looked_up, stack

WORLDS = 200
STEP = 1e-6
TEXTS = tomllib.loads((Path(__file__).parents[1] / "data/compile.toml").read_text())
TABLE = np.array([1.5, -2.0, 4.0, 3.0])
NAMES = {"np": np, "e": elementary, "length": length, "stack": stack, "TABLE": TABLE}
NAMES |= {"interpolated": interpolated, "looked_up": looked_up}

Arrays = dict[str, np.ndarray]
Code = Callable[..., Any]
each = pytest.mark.parametrize


@once(vectors=1)
def turned(vector: Any) -> Any:
    """Two results, of which each depends on both numbers."""
    x, y = vector[..., 0], vector[..., 1]
    return np.stack((x * y, x - y), axis=-1)


def code_of(text: str) -> Code:
    """A function of x and y, from an expression."""
    return lambda **arrays: eval(text, {**NAMES, "turned": turned, **arrays})


def derivatives(code: Code, arrays: Arrays, by_output: np.ndarray) -> Arrays:
    """Of the sum of the output times `by_output`, (W, ...), by each array (W, ...)."""
    program = Program()
    known = arrays | {"by": by_output}
    fields = {}
    traced = {}
    for name, array in known.items():
        shape = array.shape[1:]
        fields[name] = (array.dtype, shape)
        traced[name] = read(program, name, array.dtype, (1, *shape))
    by = traced.pop("by")
    out = code(**traced)
    outputs = list(zip(out.values.flat, by.values.flat, strict=True))
    inputs = [value for array in traced.values() for value in array.values.flat]
    found = iter(adjoints(program, outputs, inputs))
    stores = []
    for name, array in traced.items():
        fields[f"by {name}"] = fields[name]
        stores += [(f"by {name}", row, next(found)) for row in range(array.size)]
    layout = Layout(fields, 16)
    memory = Memory(layout, len(by_output))
    for name, array in known.items():
        memory.put(name, array)
    run = compiled([Region("", program, stores)], [layout], {}, 8)
    run(memory.blocks, memory.address, None)
    return {name: memory.get(f"by {name}") for name in arrays}


def numbers(dtype: str = "float64") -> Arrays:
    x, y = np.random.default_rng(0).normal(scale=2.0, size=(2, WORLDS)).astype(dtype)
    return {"x": x, "y": y}


@each("text", TEXTS["differentiable"])
def test_an_operation_against_a_difference(text: str) -> None:
    code = code_of(text)
    arrays = numbers()
    by = np.random.default_rng(1).normal(size=code(**arrays).shape)
    found = derivatives(code, arrays, by)
    for name, array in arrays.items():
        high = code(**arrays | {name: array + STEP})
        low = code(**arrays | {name: array - STEP})
        change = by * (high - low) / (2 * STEP)
        expected = change.reshape(WORLDS, -1).sum(axis=1)
        assert found[name] == pytest.approx(expected, rel=1e-6, abs=1e-7), name


def test_a_float32_and_a_cast() -> None:
    """x is float32, y float64: the adjoint of each has its dtype."""
    arrays = {"x": numbers("float32")["x"], "y": numbers()["y"]}
    found = derivatives(code_of("x.astype(float) * y * y"), arrays, np.ones(WORLDS))
    assert found["x"].dtype == np.float32
    assert found["x"] == pytest.approx(arrays["y"] ** 2, rel=1e-6)
    assert found["y"] == pytest.approx(2 * arrays["x"].astype(float) * arrays["y"], rel=1e-12)


@each(("text", "by_x", "by_y"), TEXTS["of kinks"])
def test_where_there_is_no_difference(text: str, by_x: float, by_y: float) -> None:
    """At x = 3 and y = 0: a branch that is not taken changes nothing, whatever it divides by."""
    for dtype in ("float32", "float64"):
        arrays = {"x": np.full(16, 3.0, dtype), "y": np.zeros(16, dtype)}
        found = derivatives(code_of(text), arrays, np.ones(16, dtype))
        assert found["x"].tolist() == [by_x] * 16
        assert found["y"].tolist() == [by_y] * 16


def test_an_output_that_is_there_twice() -> None:
    arrays = numbers()
    found = derivatives(code_of("stack((x, x, y))"), arrays, np.ones((WORLDS, 3)))
    assert found["x"].tolist() == [2.0] * WORLDS


def test_an_operation_without_a_derivative_is_refused() -> None:
    program = Program()
    x = program.value("load", np.dtype(float), "x", 0)
    strange = program.value("strange", np.dtype(float), x)
    with pytest.raises(NotImplementedError, match="strange"):
        adjoints(program, [(strange, x)], [x])
