"""Compiled array code: its operations, and the same bits as by NumPy."""

import itertools
import re
import tomllib
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.sim import elementary
from rotorgram.sim.compile import Program, TracedArray, Untraceable, once, read
from rotorgram.sim.compile.layout import Layout, Memory
from rotorgram.sim.compile.llvm import Region, compiled, widest
from rotorgram.sim.random import philox
from rotorgram.sim.state import looked_up, stack

FLOATS = ["float32", "float64"]
WHOLES = ["int32", "uint32", "int64", "uint64"]
DTYPES = ["bool", *WHOLES, *FLOATS]
WIDTHS = (1, 2, 4, 8, 16)
COUNTS = (1, 2, 15, 16, 17, 300)
BITS = (0, 1, 2, 7, 31, 2**31 - 1, 2**31, 2**32 - 1, 2**40 + 5, 2**63, 2**64 - 1)
FLAGS = np.array([(False, False), (False, True), (True, False), (True, True)])
TEXTS = tomllib.loads((Path(__file__).parents[1] / "data/compile.toml").read_text())
"""Array code of x and y, by what it is of."""
ODD = TEXTS["odd numbers"]
each = pytest.mark.parametrize
each_float = each("dtype", FLOATS)
each_number = each("dtype", [*FLOATS, "int64"])
each_width = each("width", [1, 4, 8])
quietly = np.errstate(all="ignore")
TABLE = np.array([[1.5, -0.0], [np.inf, 3.0], [1e-40, -4.0]])
NAMES = {"np": np, "elementary": elementary, "stack": stack, "looked_up": looked_up, "TABLE": TABLE}

Arrays = dict[str, np.ndarray]
Code = Callable[..., Any]


def each_text(name: str) -> pytest.MarkDecorator:
    return each("text", TEXTS[name])


def code_of(text: str) -> Code:
    """A function of x, y and further arrays by name, from an expression."""
    return lambda **arrays: eval(text, {**NAMES, **arrays})


def outputs(code: Code, arrays: Arrays, width: int = 0) -> np.ndarray:
    """What compiled code gives for arrays (W, ...)."""
    width = width or widest()
    program = Program()
    fields = {}
    traced = {}
    for name, array in arrays.items():
        shape = array.shape[1:]
        fields[name] = (array.dtype, shape)
        traced[name] = read(program, name, array.dtype, (1, *shape))
    out = code(**traced)
    fields["out"] = (out.dtype, out.shape[1:])
    layout = Layout(fields, 2 * width)
    memory = Memory(layout, len(arrays["x"]))
    for name, array in arrays.items():
        memory.put(name, array)
    stores = [("out", row, value) for row, value in enumerate(out.values.ravel())]
    function = compiled([Region("", program, stores)], [layout], {}, width)
    function(memory.blocks, memory.address, None)
    return memory.get("out")


def check(text: str, arrays: Arrays, width: int = 0) -> None:
    """That compiled code has the bits, dtype and shape of NumPy."""
    code = code_of(text)
    expected = np.asarray(code(**arrays))
    found = outputs(code, arrays, width)
    assert found.dtype == expected.dtype
    assert found.shape == expected.shape
    assert same(found, expected), text


def same(found: np.ndarray, expected: np.ndarray) -> bool:
    """That two arrays have the same bits; a NaN may have other ones."""
    nans = (found != found) & (expected != expected)
    numbers = np.where(nans, 0, found)
    wanted = np.where(nans, 0, expected)
    return numbers.tobytes() == wanted.tobytes()


def floats(dtype: str, count: int | None = None) -> Arrays:
    """All pairs of odd numbers, and a few that are drawn; x and y of shape (W,)."""
    pairs = list(itertools.product(ODD, ODD))
    drawn = np.random.default_rng(1).normal(scale=3.0, size=(75, 2))
    numbers = np.concatenate([drawn, pairs])[:count]
    x, y = numbers.astype(dtype).T.copy()
    return {"x": x, "y": y}


def tame(dtype: str, shape: tuple[int, ...] = (40,)) -> Arrays:
    """Normal numbers of several sizes, x and y."""
    rng = np.random.default_rng(2)
    scale = 10 ** rng.uniform(-3, 3, (2, *shape))
    x, y = (scale * rng.normal(size=scale.shape)).astype(dtype)
    return {"x": x, "y": y}


def wholes(dtype: str) -> Arrays:
    """All pairs of odd whole numbers, those beyond the range with fewer bits."""
    pairs = np.array(list(itertools.product(BITS, BITS)), np.uint64)
    x, y = pairs.astype(dtype).T.copy()
    return {"x": x, "y": y}


@each_float
@each_text("of floats")
@quietly
def test_functions_of_floats(text: str, dtype: str) -> None:
    """Each result of odd numbers; a sum of products is not fused."""
    check(text, floats(dtype))


@each("width", WIDTHS)
@each_float
@quietly
def test_widths_and_numbers_of_worlds_change_no_bit(dtype: str, width: int) -> None:
    text = "np.where(x > y, np.minimum(x, y) % 2.0, np.sqrt(abs(x)) * y - np.rint(y) + (x < 0.0))"
    for count in COUNTS:
        check(text, floats(dtype, count), width)


@each_float
def test_of_two_zeros_the_second_is_least_and_greatest(dtype: str) -> None:
    x = np.array([0.0, -0.0], dtype)
    for text in ("np.minimum(x, y)", "np.maximum(x, y)"):
        found = outputs(code_of(text), {"x": x, "y": -x})
        assert same(found, -x)


@each("dtype", WHOLES)
@each_text("of whole numbers")
@quietly
def test_functions_of_whole_numbers(text: str, dtype: str) -> None:
    check(text, wholes(dtype))


@each_text("of truth values")
def test_functions_of_truth_values(text: str) -> None:
    check(text, {"x": FLAGS[:, 0].copy(), "y": FLAGS[:, 1].copy()})


@each("y", DTYPES)
@each("x", DTYPES)
@each_text("two dtypes")
@quietly
def test_dtypes_of_two_arrays_are_those_of_numpy(text: str, x: str, y: str) -> None:
    numbers = np.array([0, 1, 2, 5, 100])
    first = numbers.astype(x)
    second = numbers[::-1].astype(y)
    check(text, {"x": first, "y": second})


@each("dtype", ["float32", "uint32"])
@each_text("weak and strong")
def test_a_python_number_adapts_and_an_array_of_float64_does_not(text: str, dtype: str) -> None:
    check(text, {"x": np.arange(5, dtype=dtype)})


@each("after", DTYPES)
@each("before", DTYPES)
def test_casts(before: str, after: str) -> None:
    """From whole numbers of any bits, and from floats within the range of the result."""
    x = np.array([0.0, 1.0, 2.75, 100.5]).astype(before)
    if before in WHOLES:
        x = wholes(before)["x"]
    check(f"x.astype('{after}')", {"x": x})


@each_float
@each("kind, expected", [("int32", [-(2**31), -1, 0, 2**31 - 1]), ("uint32", [0, 0, 0, 2**32 - 1])])
def test_a_float_beyond_the_whole_numbers_becomes_the_nearest(
    dtype: str, kind: str, expected: list[int]
) -> None:
    x = np.array([-1e30, -1.5, np.nan, 1e30], dtype)
    found = outputs(lambda x: x.astype(kind), {"x": x})
    assert found.tolist() == expected


@each_text("bits")
def test_bits_of_floats(text: str) -> None:
    check(text, {"x": np.array([1.0, -0.75, 3e-38, 3e38, -0.0, np.inf], np.float32)})
    check(text.replace("32", "64"), {"x": np.array([1.0, -0.75, 5e-324, 3e38, -0.0, np.inf])})


@each_float
@each("text, ours", TEXTS["elementary"].items())
def test_elementary_functions_are_ours(text: str, ours: str, dtype: str) -> None:
    arrays = tame(dtype)
    expected = code_of(ours)(**arrays)
    found = outputs(code_of(text), arrays)
    assert same(found, expected)


@each_text("moves")
def test_moves_and_reductions(text: str) -> None:
    check(text, tame(np.float32, (40, 4, 3)))


@each_float
def test_a_sum_goes_from_the_first_to_the_last(dtype: str) -> None:
    x = tame(dtype, (40, 20))["x"]
    expected = reduce(np.add, list(x.T))
    found = outputs(code_of("x.sum(axis=-1)"), {"x": x})
    assert same(found, expected)


@each_number
def test_argsort_is_stable(dtype: str) -> None:
    rows = list(itertools.product((2, 0, -1), repeat=4))
    x = np.array(rows, dtype)
    check("np.argsort(x, kind='stable')", {"x": x})
    check("np.argsort(x, axis=1, kind='stable')", {"x": x[..., None]})


@each_number
def test_rows_of_a_table(dtype: str) -> None:
    """Beyond it the last ones."""
    x = {"x": np.array([0.0, 1.0, 2.0, 3.0, 1e9, -1.0, -np.inf])}
    table = np.array([[1.0, -2.0], [3.0, 0.0], [7.0, 9.0]], dtype)
    expected = looked_up(table, x["x"])
    found = outputs(lambda x: looked_up(table, x), x)
    assert same(found, expected)
    check("looked_up(TABLE, x)", x)
    check("looked_up(TABLE[:, 1], x) + 1.0", x)


def test_a_function_that_is_there_once_reads_its_own_table() -> None:
    first = np.array([10.0, 20.0])
    second = np.array([3.0, 5.0])
    own = once()(lambda x: looked_up(second, x))
    x = {"x": np.array([0.0, 1.0, 1.0])}
    found = outputs(lambda x: looked_up(first, x) + own(x), x)
    assert found.ravel().tolist() == [13.0, 25.0, 25.0]


def test_a_table_that_changes_later_does_not_change_the_code() -> None:
    x = {"x": np.arange(3.0)}
    table = np.array([3.0, 4.0, 5.0])
    code = lambda x: looked_up(table, x)  # noqa: E731
    before = outputs(code, x)
    table[:] = 0.0
    now = outputs(code, x)
    table[:] = before
    again = outputs(code, x)
    assert before.tolist() == again.tolist() == [3.0, 4.0, 5.0]
    assert not now.any()


def test_random_words_are_those_of_philox() -> None:
    words = np.random.default_rng(3).integers(0, 2**32, (40, 4), np.uint32)
    key = words[:, ::-2].copy()
    found = outputs(lambda x, y: philox(x, y), {"x": words, "y": key})
    assert same(found, philox(words, key))


# ---- arrays that change in place


CHANGES = {
    "a copy": lambda x: x.copy(),
    "the same dtype": lambda x: x.astype(x.dtype),
    "a view": lambda x: x[:, :2],
    "zeros": lambda x: np.zeros_like(x, shape=(*x.shape[:-1], 2)),
}


@each("kind", CHANGES)
def test_a_change_in_place_reaches_what_it_reaches_in_numpy(kind: str) -> None:
    def code(x: Any, y: Any) -> Any:
        old = 1.0 * x
        new = CHANGES[kind](old)
        new[..., 1] = y[..., 0]
        return np.concatenate((old, new), axis=-1)

    arrays = {"x": np.arange(6.0).reshape(2, 3), "y": np.full((2, 1), 9.0)}
    expected = code(**arrays)
    found = outputs(code, arrays)
    assert same(found, expected)


def test_an_array_that_is_read_alone_cannot_be_changed() -> None:
    x = read(Program(), "x", np.dtype(float), (1, 3))
    x.setflags(write=False)
    with pytest.raises(ValueError, match="read-only"):
        x[..., 0] = 1.0


# ---- regions


class Machine:
    """Code of regions, for W worlds with `x` and `y`, shape (W, 2), and a mask `some`."""

    def __init__(self, worlds: int, width: int = 4) -> None:
        flag = (np.dtype(bool), ())
        vector = (np.dtype(float), (2,))
        fields = {"x": vector, "some": flag, "y": vector}
        outside = {"given": vector, "flags": flag}
        self.outside = outside
        self.layout = Layout(fields, 8)
        self.memory = Memory(self.layout, worlds)
        self.regions: list[Region] = []
        self._width = width

    def add(self, mask: str, code: Code) -> None:
        """A region of a function of all arrays."""
        program = Program()
        layout = self.layout
        arrays = {}
        for name, (dtype, shape) in {**layout.fields, **self.outside}.items():
            arrays[name] = read(program, name, dtype, (1, *shape))
        stores = []
        for name, values in code(**arrays).items():
            for row, value in enumerate(values.values.ravel()):
                stores.append((name, row, value))
        self.regions.append(Region(mask, program, stores))

    def run(self, given: Any = None, flags: Any = None) -> None:
        memory = self.memory
        if given is None:
            given = np.zeros((memory.size, 2))
            flags = np.zeros(memory.size, bool)
        function = compiled(self.regions, [self.layout], self.outside, self._width)
        table = np.array([given.ctypes.data, flags.ctypes.data])
        function(memory.blocks, memory.address, table.ctypes.data)


def test_a_region_is_left_out_where_no_lane_is_in_its_mask() -> None:
    """Elsewhere it stores what it computes for all lanes: 4 of a vector."""
    machine = Machine(21)
    machine.add("some", lambda x, **_: {"x": x + 1.0})
    some = np.zeros(21, bool)
    some[[5, 6, 20]] = True
    machine.memory.put("some", some)
    machine.run()
    before = machine.memory.get("x")
    changed = np.flatnonzero(before[:, 0])
    assert changed.tolist() == [4, 5, 6, 7, 20]
    machine.memory.put("some", 0 * some)
    machine.run()
    after = machine.memory.get("x")
    assert same(after, before)


def test_a_region_under_a_mask_keeps_the_others_by_its_program() -> None:
    machine = Machine(21)

    def code(x: TracedArray, some: TracedArray, **_: object) -> dict[str, TracedArray]:
        flags = some[..., None]
        return {"x": np.where(flags, x + 1.0, x)}

    machine.add("some", code)
    some = np.arange(21) % 3 == 0
    machine.memory.put("some", some)
    machine.run()
    found = machine.memory.get("x")
    assert found[:, 1].tolist() == some.tolist()


@each_width
def test_regions_follow_each_other_and_a_region_reads_before_it_stores(width: int) -> None:
    machine = Machine(5, width)
    machine.add("", lambda x, **_: {"x": x[..., ::-1]})
    machine.add("", lambda x, **_: {"y": x * 2.0})
    machine.add("", lambda x, y, **_: {"x": x + y, "some": x[..., 0] > 2.0})
    start = np.arange(10.0).reshape(5, 2)
    machine.memory.put("x", start)
    for _ in range(3):
        machine.run()
    found = machine.memory.get("x")
    flags = machine.memory.get("some")
    assert same(found, 27.0 * start[:, ::-1])
    assert flags.all()


@each_width
def test_arrays_outside_are_read_and_written_where_they_are(width: int) -> None:
    machine = Machine(21, width)
    machine.add("", lambda given, **_: {"x": given + 1.0})
    machine.add("", lambda x, given, **_: {"given": 2.0 * given, "flags": x[..., 0] > 5.0})
    before = np.arange(48.0).reshape(24, 2)
    given = before.copy()
    flags = np.zeros(24, bool)
    machine.run(given, flags)
    found = machine.memory.get("x")
    assert same(found, before[:21] + 1.0)
    assert same(given, 2.0 * before)
    assert flags.tolist() == [False] * 3 + [True] * 21


# ---- memory


@each("worlds", [1, 7, 8, 9, 64])
def test_memory_gives_back_what_was_put(worlds: int) -> None:
    """Copies, which nothing changes later."""
    rng = np.random.default_rng(4)
    arrays = {
        "numbers": rng.normal(size=(worlds, 3, 2)).astype(np.float32),
        "flags": rng.normal(size=worlds) > 0.0,
        "counters": rng.integers(0, 2**64, (worlds, 1), np.uint64),
    }
    fields = {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}
    memory = Memory(Layout(fields, 8), worlds)
    assert memory.address % 64 == 0
    assert memory.size == 8 * memory.blocks
    assert 0 <= memory.size - worlds < 8
    for name, array in arrays.items():
        memory.put(name, array)
    copies = {name: memory.get(name) for name in fields}
    for name, array in arrays.items():
        memory.put(name, np.zeros_like(array))
    for name, found in copies.items():
        expected = arrays[name]
        assert found.dtype == expected.dtype
        assert same(found, expected)


def test_memory_of_one_array_gives_copies() -> None:
    layout = Layout({"x": (np.dtype(np.float32), ())}, 16)
    memory = Memory(layout, 32)
    before = memory.get("x")
    memory.put("x", np.ones(32, np.float32))
    assert not before.any()


def test_a_function_that_is_used_often_is_there_once() -> None:
    """With several results, of another function, and with a number for an array."""

    @once()
    def half(x: Any, y: Any) -> Any:
        return 0.5 * x + y

    @once(vectors=1)
    def turned(x: Any) -> Any:
        return np.stack((x[..., 1], half(x[..., 0], 1.0)), axis=-1)

    rows = np.arange(12.0).reshape(2, 3, 2)
    program = Program()
    x = read(program, "x", rows.dtype, (1, 3, 2))
    values = turned(turned(x)).values.ravel()
    operations = [one.operation for one in program.needed(values)]
    assert sorted(set(operations)) == ["call", "load"]
    assert operations.count("call") == 12
    found = outputs(lambda x: turned(turned(x)), {"x": rows})
    assert same(found, turned(turned(rows)))


# ---- programs, and what is refused


def test_the_same_operation_is_there_once() -> None:
    program = Program()
    dtype = np.dtype(float)
    position = read(program, "position", dtype, (1,))
    velocity = read(program, "velocity", dtype, (1,))

    def is_same(a: TracedArray, b: TracedArray) -> bool:
        return a.values.item() is b.values.item()

    later = position + velocity * 0.01
    operations = [value.operation for value in program.values]
    assert operations == ["load", "load", "constant", "multiply", "add"]
    assert is_same(position + velocity * 0.01, later)
    assert not is_same(position + velocity * 0.02, later)
    assert not is_same(position + 0.0, position + -0.0)
    assert not is_same(position - velocity, velocity - position)
    assert len(program.needed([later.values.item()])) == 5


@each(("text", "sentence"), TEXTS["refused"].items())
def test_what_cannot_be_compiled_is_refused(text: str, sentence: str) -> None:
    program = Program()
    dtype = np.dtype(float)
    x = read(program, "x", dtype, (1, 3))
    y = read(program, "y", dtype, (1, 3))
    code = code_of(text)
    with pytest.raises(Untraceable) as error:
        code(x=x, y=y)
    assert sentence in str(error.value)


def test_values_of_two_programs_are_an_error() -> None:
    dtype = np.dtype(float)
    x = read(Program(), "x", dtype, (1,))
    y = read(Program(), "x", dtype, (1,))
    with pytest.raises(ValueError, match="expected values of one program, got another's"):
        x + y


def test_what_numpy_refuses_is_refused_as_there() -> None:
    flag = read(Program(), "x", np.dtype(bool), (1,))
    for text in ("x - x", "-x", "x & 1.5"):
        code = code_of(text)
        with pytest.raises(TypeError):
            code(x=flag)


def test_the_page_shows_the_operations_of_its_program(capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(__file__).parents[2] / "docs/compile.md"
    page = path.read_text(encoding="utf-8")
    _, code, *_ = re.split("```python\n|```\n", page)
    _, shown, *_ = re.split("```text\n|```\n", page.split("**Trace**")[1])
    exec(code, {})
    printed = capsys.readouterr().out.split()
    operations = dict(re.findall(r"(\d+) ([a-z]{3,})", shown))
    assert len(operations) == 13
    for number, operation in zip(printed[::2], printed[1::2], strict=True):
        assert operations.pop(number) == operation
    assert not operations
