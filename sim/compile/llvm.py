"""Programs as a function of LLVM's vector instructions, compiled in this process by llvmlite.

The function goes over the blocks of a `Memory`, and over the lanes of each, as many at a time as
the processor's widest vectors have. For these it runs regions: a region is a program that is left
out where none of the lanes is in its mask.
"""

import ctypes
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from math import prod
from typing import Any, NamedTuple

import numpy as np

from ...models.errors import one_line
from .layout import Fields, Layout
from .program import DType, Function, Program, Value

Code = Callable[..., None]
"""Takes the number of blocks, the address of each memory, and those of arrays outside."""

_KINDS = {
    np.dtype(np.float32): "float",
    np.dtype(np.float64): "double",
    np.dtype(bool): "i1",
    np.dtype(np.int32): "i32",
    np.dtype(np.uint32): "i32",
    np.dtype(np.int64): "i64",
    np.dtype(np.uint64): "i64",
}
_FLOATS = {
    "add": "fadd",
    "subtract": "fsub",
    "multiply": "fmul",
    "divide": "fdiv",
    "remainder": "frem",
    "less": "fcmp olt",
    "less_equal": "fcmp ole",
    "greater": "fcmp ogt",
    "greater_equal": "fcmp oge",
    "equal": "fcmp oeq",
    "not_equal": "fcmp une",
}
_WHOLES = {
    "add": "add",
    "subtract": "sub",
    "multiply": "mul",
    "and": "and",
    "or": "or",
    "xor": "xor",
    "left_shift": "shl",
    "equal": "icmp eq",
    "not_equal": "icmp ne",
}
_SIGNED = {
    "less": "icmp slt",
    "less_equal": "icmp sle",
    "greater": "icmp sgt",
    "greater_equal": "icmp sge",
    "right_shift": "ashr",
    "remainder": "srem",
}
_UNSIGNED = {
    "less": "icmp ult",
    "less_equal": "icmp ule",
    "greater": "icmp ugt",
    "greater_equal": "icmp uge",
    "right_shift": "lshr",
    "remainder": "urem",
}
_CALLS = {
    "sqrt": "sqrt",
    "absolute": "fabs",
    "rint": "rint",
    "floor": "floor",
    "copysign": "copysign",
}
_SHORT = {"float": "f32", "double": "f64", "i8": "i8", "i32": "i32", "i64": "i64"}
_ATTRIBUTES = (
    'attributes #0 = { nounwind "min-legal-vector-width"="512" "prefer-vector-width"="512" }'
)
_FUNCTION = """define void @run(i64 %blocks{arguments}) #0 {{
entry:
{rows}
  br label %block
block:
  %b = phi i64 [0, %entry], [%b.next, %block.end]
{bases}
  br label %lane
lane:
  %i = phi i64 [0, %block], [%i.next, %lane.end]
  %first = mul i64 %b, {lanes}
  %world = add i64 %first, %i
{worlds}
  br label %region.0
{regions}
region.{count}:
  br label %lane.end
lane.end:
  %i.next = add i64 %i, {width}
  %more.lanes = icmp slt i64 %i.next, {lanes}
  br i1 %more.lanes, label %lane, label %block.end
block.end:
  %b.next = add i64 %b, 1
  %more.blocks = icmp slt i64 %b.next, %blocks
  br i1 %more.blocks, label %block, label %end
end:
  ret void
}}
"""


class Region(NamedTuple):
    """A program, and what it writes where a mask is true."""

    mask: str
    """Name of an array of truth values, alike for the drones of a world; empty: all worlds."""
    program: Program
    stores: list[tuple[str, int, Value]]
    """Array, component, and new value, which is that of all lanes: the mask is in the program."""

    def operations(self) -> list[Value]:
        """What the stores need, in order."""
        return self.program.needed(value for _, _, value in self.stores)


@cache
def _llvm() -> Any:
    """LLVM, ready for this processor. Imported when it is needed: NumPy flies without it."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    binding.check_jit_execution()
    return binding


def trouble() -> str:
    """Why nothing can be compiled here: no llvmlite, or no memory that may be executed; or ""."""
    try:
        _llvm()
    except (ImportError, OSError, RuntimeError) as error:
        return one_line(error)
    return ""


def widest() -> int:
    """Lanes of a vector: what 64 bytes hold of float32 where registers are wide, otherwise 4."""
    return 16 if _llvm().get_host_cpu_features().get("avx2", False) else 4


def compiled(
    regions: Sequence[Region], layouts: Sequence[Layout], outside: Fields, width: int
) -> Code:
    """The function of some regions. Many operations take seconds.

    Args:
        regions: In their order.
        layouts: Of memories, all with as many lanes.
        outside: Arrays of the caller's, shape (worlds of all blocks, *shape), C-contiguous.
        width: Lanes of a vector.
    """
    text = _Printer(layouts, outside, width).text(regions)
    return _machine_code(text, len(layouts) + len(outside))


class _Printer:
    """The text of a module."""

    def __init__(self, layouts: Sequence[Layout], outside: Fields, width: int) -> None:
        self._layouts = layouts
        self._outside = outside
        self._width = width
        self._bases = {name: i for i, one in enumerate(layouts) for name in one.fields}
        self._lines: list[str] = []
        self._declared: dict[str, str] = {}
        self._names: dict[int, str] = {}
        self._calls: dict[str, str] = {}
        self._functions: dict[str, str] = {}
        self._tables: list[np.ndarray] = []
        self._constants: dict[str, str] = {}
        self._count = 0

    def text(self, regions: Sequence[Region]) -> str:
        """All of it."""
        for number, region in enumerate(regions):
            self._region(number, region)
        names = [f"memory.{i}" for i in range(len(self._layouts))]
        names += [f"out.{name}" for name in self._outside]
        spread = [name for name in self._outside if self._is_spread(name)]
        function = _FUNCTION.format(
            arguments="".join(f', ptr noalias %"{name}"' for name in names),
            rows="\n".join(f"  {self._rows(name)} = alloca {self._size(name)}" for name in spread),
            bases="\n".join(self._base(i, one.size) for i, one in enumerate(self._layouts)),
            lanes=self._layouts[0].lanes,
            width=self._width,
            worlds=self._worlds(),
            regions="\n".join(self._lines),
            count=len(regions),
        )
        parts = [function, *self._functions.values(), *self._declared.values(), _ATTRIBUTES]
        parts += [f"{name} = internal {kept}" for kept, name in self._constants.items()]
        return "\n".join(parts)

    def _region(self, number: int, region: Region) -> None:
        after = f"%region.{number + 1}"
        self._names = {}
        self._calls = {}
        self._tables = region.program.tables
        self._lines.append(f"region.{number}:")
        if not region.mask:
            self._lines.append(f"  br label %body.{number}")
        else:
            some = self._some(self._load(region.mask, 0))
            self._lines.append(f"  br i1 {some}, label %body.{number}, label {after}")
        self._lines.append(f"body.{number}:")
        for value in region.operations():
            self._names[value.number] = self._printed(value)
        spread: dict[str, list[int]] = {}
        for array, row, value in region.stores:
            self._store(array, row, self._names[value.number])
            if self._is_spread(array):
                spread.setdefault(array, []).append(row)
        for array, rows in spread.items():
            self._turn(array, rows)
        self._lines.append(f"  br label {after}")

    def _printed(self, value: Value) -> str:
        """The name of a value, after its instructions."""
        operation = value.operation
        if operation == "constant":
            return self._number(value)
        if operation == "load":
            return self._load(*value.inputs)
        if operation == "parameter":
            return f"%p{value.inputs[0]}"
        if operation == "gather":
            return self._gather(value)
        if operation == "call":
            return self._result(*value.inputs)
        inputs = [self._names[one.number] for one in value.inputs]
        dtype = value.inputs[0].dtype
        if operation == "cast":
            return self._cast(inputs[0], dtype, value.dtype)
        if operation == "select":
            kind = self._type(value.dtype)
            flags, first, second = inputs
            return self._new(f"select {self._lanes('i1')} {flags}, {kind} {first}, {kind} {second}")
        if operation == "bits":
            kinds = self._type(dtype), self._type(value.dtype)
            return self._new(f"bitcast {kinds[0]} {inputs[0]} to {kinds[1]}")
        if operation in _CALLS and dtype.kind == "f":
            return self._call(_CALLS[operation], dtype, *inputs)
        kind = self._type(dtype)
        if operation == "negative":
            if dtype.kind == "f":
                return self._new(f"fneg {kind} {inputs[0]}")
            return self._new(f"sub {kind} {self._splat(0, _KINDS[dtype])}, {inputs[0]}")
        if operation == "not":
            return self._new(f"xor {kind} {inputs[0]}, {self._splat(-1, _KINDS[dtype])}")
        names = _FLOATS
        if dtype.kind != "f":
            names = _WHOLES | (_SIGNED if dtype.kind == "i" else _UNSIGNED)
        return self._new(f"{names[operation]} {kind} {inputs[0]}, {inputs[1]}")

    # ---- functions of the programs

    def _result(self, function: Function, number: int, *inputs: Value) -> str:
        """A result of a call, which is there once for all its results."""
        pairs = [f"{self._type(one.dtype)} {self._names[one.number]}" for one in inputs]
        arguments = ", ".join(pairs)
        kind = self._returned(function)
        call = f'call {kind} @"{function.name}"({arguments})'
        if call not in self._calls:
            self._calls[call] = self._new(call)
        if function.name not in self._functions:
            self._functions[function.name] = self._definition(function, inputs)
        if len(function.results) == 1:
            return self._calls[call]
        return self._new(f"extractvalue {kind} {self._calls[call]}, {number}")

    def _returned(self, function: Function) -> str:
        """Type of what a function returns."""
        kinds = [self._type(one.dtype) for one in function.results]
        return kinds[0] if len(kinds) == 1 else f"{{{', '.join(kinds)}}}"

    def _definition(self, function: Function, inputs: Sequence[Value]) -> str:
        """The text of a function."""
        outer = self._lines, self._names, self._calls
        self._lines, self._names, self._calls = [], {}, {}
        for value in function.program.needed(function.results):
            self._names[value.number] = self._printed(value)
        kind = self._returned(function)
        out = self._names[function.results[0].number]
        if len(function.results) > 1:
            out = "poison"
            for number, one in enumerate(function.results):
                part = f"{self._type(one.dtype)} {self._names[one.number]}"
                out = self._new(f"insertvalue {kind} {out}, {part}, {number}")
        body = "\n".join((*self._lines, f"  ret {kind} {out}"))
        self._lines, self._names, self._calls = outer
        parameters = ", ".join(f"{self._type(one.dtype)} %p{i}" for i, one in enumerate(inputs))
        return f'define internal {kind} @"{function.name}"({parameters}) #0 {{\n{body}\n}}'

    # ---- types, numbers, memory

    def _lanes(self, kind: str) -> str:
        return kind if self._width == 1 else f"<{self._width} x {kind}>"

    def _type(self, dtype: DType) -> str:
        return self._lanes(_KINDS[dtype])

    def _new(self, instruction: str) -> str:
        self._count += 1
        self._lines.append(f"  %v{self._count} = {instruction}")
        return f"%v{self._count}"

    def _splat(self, number: object, kind: str) -> str:
        """A number of all lanes."""
        return f"{number}" if self._width == 1 else f"splat ({kind} {number})"

    def _number(self, value: Value) -> str:
        """A constant: LLVM reads floats as the bits of a double."""
        number = np.frombuffer(value.inputs[0], value.dtype)[0]
        kind = _KINDS[value.dtype]
        if value.dtype.kind != "f":
            return self._splat(int(number), kind)
        bits = int(np.float64(number).view(np.uint64))
        return self._splat(f"0x{bits:016X}", kind)

    def _call(self, name: str, dtype: DType, *inputs: str) -> str:
        """One of LLVM's own functions, of inputs of one type."""
        kind = self._type(dtype)
        lanes = "" if self._width == 1 else f"v{self._width}"
        function = f"@llvm.{name}.{lanes}f{8 * dtype.itemsize}"
        self._declared[function] = f"declare {kind} {function}({', '.join([kind] * len(inputs))})"
        return self._new(f"call {kind} {function}({', '.join(f'{kind} {one}' for one in inputs)})")

    def _some(self, flags: str) -> str:
        """Whether a lane is true."""
        if self._width == 1:
            return flags
        kind = self._lanes("i1")
        function = f"@llvm.vector.reduce.or.v{self._width}i1"
        self._declared[function] = f"declare i1 {function}({kind})"
        return self._new(f"call i1 {function}({kind} {flags})")

    def _address(self, array: str, row: int) -> tuple[str, str, int]:
        """Pointer to a row at these lanes, its type in memory, and its alignment."""
        if array in self._outside:
            kind = _in_memory(self._outside[array][0])
            start, index = f'%"out.{array}"', "%world"
            if self._is_spread(array):
                start, index = self._rows(array), str(row * self._width)
            return self._new(f"getelementptr {kind}, ptr {start}, i64 {index}"), kind, 1
        number = self._bases[array]
        layout = self._layouts[number]
        dtype, _ = layout.fields[array]
        kind = _in_memory(dtype)
        place = layout.place(array, row)
        start = self._new(f"getelementptr i8, ptr %base.{number}, i64 {place}")
        align = dtype.itemsize
        return self._new(f"getelementptr {kind}, ptr {start}, i64 %i"), kind, align

    def _load(self, array: str, row: int) -> str:
        """A row at these lanes; a truth value is a byte in memory."""
        if self._is_spread(array):
            place, kind = self._places(array, row)
            value = self._gathered(place, kind)
        else:
            place, kind, align = self._address(array, row)
            value = self._new(f"load {self._lanes(kind)}, ptr {place}, align {align}")
        if kind == "i8":
            return self._new(f"trunc {self._lanes(kind)} {value} to {self._lanes('i1')}")
        return value

    def _store(self, array: str, row: int, value: str) -> None:
        place, kind, align = self._address(array, row)
        value = self._in_memory(value, kind)
        self._lines.append(f"  store {self._lanes(kind)} {value}, ptr {place}, align {align}")

    def _in_memory(self, value: str, kind: str) -> str:
        """A value as it is stored: a truth value as a byte."""
        if kind != "i8":
            return value
        return self._new(f"zext {self._lanes('i1')} {value} to {self._lanes(kind)}")

    def _base(self, number: int, size: int) -> str:
        """Lines that give the address of a block of a memory."""
        return (
            f"  %start.{number} = mul i64 %b, {size}\n"
            f'  %base.{number} = getelementptr i8, ptr %"memory.{number}", i64 %start.{number}'
        )

    def _worlds(self) -> str:
        """Lines that number the worlds of these lanes."""
        if self._width == 1:
            return "  %worlds = add i64 %world, 0"
        lanes = self._lanes("i64")
        numbers = ", ".join(f"i64 {lane}" for lane in range(self._width))
        mask = f"<{self._width} x i32> zeroinitializer"
        return (
            f"  %one = insertelement {lanes} poison, i64 %world, i64 0\n"
            f"  %all = shufflevector {lanes} %one, {lanes} poison, {mask}\n"
            f"  %worlds = add {lanes} %all, <{numbers}>"
        )

    def _is_spread(self, array: str) -> bool:
        """Whether a component of neighbours lies apart, as of an array outside with several."""
        return array in self._outside and prod(self._outside[array][1]) > 1

    def _rows(self, array: str) -> str:
        """Pointer to the components of an array that is spread, each for all lanes."""
        return f'%"rows.{array}"'

    def _size(self, array: str) -> str:
        """The type of all of these components."""
        dtype, shape = self._outside[array]
        return f"[{prod(shape) * self._width} x {_in_memory(dtype)}], align 64"

    def _turn(self, array: str, rows: Sequence[int]) -> None:
        """Write the components lane by lane, as they lie outside: faster than a scatter."""
        dtype, shape = self._outside[array]
        kind = _in_memory(dtype)
        self._count += 1
        number = self._count
        self._lines += [
            f"  br label %before.{number}",
            f"before.{number}:",
            f"  br label %turn.{number}",
            f"turn.{number}:",
            f"  %l.{number} = phi i64 [0, %before.{number}], [%n.{number}, %turn.{number}]",
        ]
        source = self._new(f"getelementptr {kind}, ptr {self._rows(array)}, i64 %l.{number}")
        world = self._new(f"add i64 %world, %l.{number}")
        first = self._new(f"mul i64 {world}, {prod(shape)}")
        target = self._new(f'getelementptr {kind}, ptr %"out.{array}", i64 {first}')
        for row in rows:
            place = self._new(f"getelementptr {kind}, ptr {source}, i64 {row * self._width}")
            one = self._new(f"load {kind}, ptr {place}")
            place = self._new(f"getelementptr {kind}, ptr {target}, i64 {row}")
            self._lines.append(f"  store {kind} {one}, ptr {place}, align 1")
        self._lines.append(f"  %n.{number} = add i64 %l.{number}, 1")
        more = self._new(f"icmp slt i64 %n.{number}, {self._width}")
        self._lines += [
            f"  br i1 {more}, label %turn.{number}, label %turned.{number}",
            f"turned.{number}:",
        ]

    def _places(self, array: str, row: int) -> tuple[str, str]:
        """Pointers to a component of an array outside, and its type in memory."""
        dtype, shape = self._outside[array]
        kind = _in_memory(dtype)
        wholes = self._lanes("i64")
        place = self._new(f"mul {wholes} %worlds, {self._splat(prod(shape), 'i64')}")
        place = self._new(f"add {wholes} {place}, {self._splat(row, 'i64')}")
        pointers = self._new(f'getelementptr {kind}, ptr %"out.{array}", {wholes} {place}')
        return pointers, kind

    def _gathered(self, pointers: str, kind: str) -> str:
        """What lies at some places, a place for each lane."""
        if self._width == 1:
            return self._new(f"load {kind}, ptr {pointers}, align 1")
        lanes, places, flags = map(self._lanes, (kind, "ptr", "i1"))
        function = f"@llvm.masked.gather.v{self._width}{_SHORT[kind]}.v{self._width}p0"
        self._declared[function] = f"declare {lanes} {function}({places}, i32, {flags}, {lanes})"
        always = self._splat("true", "i1")
        return self._new(
            f"call {lanes} {function}({places} {pointers}, i32 1, {flags} {always}, {lanes} poison)"
        )

    def _constant(self, table: np.ndarray) -> str:
        """The name of a table in the module, where equal ones are there once."""
        content = "".join(f"\\{byte:02x}" for byte in table.tobytes())
        kept = f'constant [{table.nbytes} x i8] c"{content}", align 64'
        return self._constants.setdefault(kept, f"@table.{len(self._constants)}")

    def _gather(self, value: Value) -> str:
        """A column of a table, at rows that lie within it."""
        number, column, row = value.inputs
        table = self._tables[number]
        kind = _KINDS[value.dtype]
        start = column * table.itemsize
        base = f"getelementptr (i8, ptr {self._constant(table)}, i64 {start})"
        wholes = self._lanes("i64")
        place = self._new(
            f"mul {wholes} {self._names[row.number]}, {self._splat(table.shape[1], 'i64')}"
        )
        pointers = self._new(f"getelementptr {kind}, ptr {base}, {wholes} {place}")
        return self._gathered(pointers, kind)

    # ---- conversions

    def _cast(self, value: str, before: DType, after: DType) -> str:
        """As NumPy's `astype`; a float beyond the whole numbers gives the nearest of them."""
        first, second = self._type(before), self._type(after)
        if after.kind == "b":
            zero = self._splat("0.0" if before.kind == "f" else 0, _KINDS[before])
            compare = "fcmp une" if before.kind == "f" else "icmp ne"
            return self._new(f"{compare} {first} {value}, {zero}")
        if before.kind == "f" and after.kind != "f":
            lanes = "" if self._width == 1 else f"v{self._width}"
            way = f"{lanes}i{8 * after.itemsize}.{lanes}f{8 * before.itemsize}"
            function = f"@llvm.fpto{'u' if after.kind == 'u' else 's'}i.sat.{way}"
            self._declared[function] = f"declare {second} {function}({first})"
            return self._new(f"call {second} {function}({first} {value})")
        if after.kind == "f" and before.kind == "f":
            word = "fpext" if before.itemsize < after.itemsize else "fptrunc"
        elif after.kind == "f":
            word = "sitofp" if before.kind == "i" else "uitofp"
        elif before.itemsize == after.itemsize and before.kind != "b":
            return value
        elif before.kind == "b" or before.itemsize < after.itemsize:
            word = "sext" if before.kind == "i" else "zext"
        else:
            word = "trunc"
        return self._new(f"{word} {first} {value} to {second}")


def _in_memory(dtype: DType) -> str:
    return "i8" if dtype.kind == "b" else _KINDS[dtype]


@lru_cache
def _machine_code(text: str, addresses: int) -> Code:
    """The function of a module's text, of so many addresses, for this processor."""
    binding = _llvm()
    features = binding.get_host_cpu_features().flatten()
    machine = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=features, opt=2, jit=True
    )
    module = binding.parse_assembly(text)
    module.verify()
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int64, *[ctypes.c_void_p] * addresses)
    call = kind(engine.get_function_address("run"))
    call.engine = engine  # type: ignore[attr-defined]  # it owns the machine code
    return call
