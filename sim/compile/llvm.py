"""Programs as a function of LLVM's vector instructions, compiled in this process by llvmlite.

The function goes over the blocks of a `Memory`, and over the lanes of each, as many at a time as
the processor's widest vectors have. For these it runs regions: a region is a program that is left
out where none of the lanes is in its mask.
"""

import ctypes
from collections.abc import Callable, Sequence
from copy import copy
from functools import cache, lru_cache
from math import prod
from typing import Any, NamedTuple

import numpy as np

from ...models.errors import one_line
from .layout import Fields, Layout
from .program import OPERATIONS, TYPES, DType, Function, Program, Value

Code = Callable[..., None]
"""Takes the number of blocks, the address of each memory, and that of the addresses of arrays
outside, or None without any."""

_SHORT = {"float": "f32", "double": "f64"}
_MODULE = """define void @run(i64 %blocks{memories}, ptr %table) #0 {{
{addresses}
  call void @step(i64 %blocks{memories}{outside})
  ret void
}}
define internal void @step(i64 %blocks{memories}{outside}) #0 {{
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
{further}
attributes #0 = {{ nounwind "min-legal-vector-width"="512" "prefer-vector-width"="512" }}
"""
_BASE = """  %start.{0} = mul i64 %b, {1}
  %base.{0} = getelementptr i8, ptr %"memory.{0}", i64 %start.{0}"""
"""Lines that give the address of a block of a memory, by the memory's number and a block's size."""
_ADDRESS = """  %place.{0} = getelementptr ptr, ptr %table, i64 {0}
  %"out.{1}" = load ptr, ptr %place.{0}"""
"""Lines that read the address of an array outside, by its number and name."""


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
    return _machine_code(text, len(layouts))


class _Printer:
    """The text of a module."""

    def __init__(self, layouts: Sequence[Layout], outside: Fields, width: int) -> None:
        self._layouts = layouts
        self._outside = outside
        self._width = width
        self._bases = {name: i for i, one in enumerate(layouts) for name in one.fields}
        self._lines: list[str] = []
        self._functions: dict[str, str] = {}
        self._constants: dict[str, str] = {}
        self._count = 0

    def text(self, regions: Sequence[Region]) -> str:
        """All of it."""
        for number, region in enumerate(regions):
            self._region(number, region)
        spread = [name for name in self._outside if self._is_spread(name)]
        further = [*self._functions.values()]
        further += [f"{name} = internal {kept}" for kept, name in self._constants.items()]
        return _MODULE.format(
            memories="".join(f", ptr noalias %memory.{i}" for i in range(len(self._layouts))),
            outside="".join(f', ptr noalias %"out.{name}"' for name in self._outside),
            addresses="\n".join(_ADDRESS.format(i, one) for i, one in enumerate(self._outside)),
            rows="\n".join(f'  %"rows.{name}" = alloca {self._size(name)}' for name in spread),
            bases="\n".join(_BASE.format(i, one.size) for i, one in enumerate(self._layouts)),
            lanes=self._layouts[0].lanes,
            width=self._width,
            worlds=self._worlds(),
            regions="\n".join(self._lines),
            count=len(regions),
            further="\n".join(further),
        )

    def _region(self, number: int, region: Region) -> None:
        after = f"%region.{number + 1}"
        self._names: dict[int, str] = {}
        self._calls: dict[str, str] = {}
        self._tables = region.program.tables
        self._lines.append(f"region.{number}:")
        some = "true"
        if region.mask:
            flags = f"{self._lanes('i1')} {self._load(region.mask, 0)}"
            some = self._new(f"call i1 @llvm.vector.reduce.or.{self._suffix('i1')}({flags})")
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
        if operation == "outside":
            return self._called(*value.inputs)
        inputs = [self._names[one.number] for one in value.inputs]
        before = value.inputs[0].dtype
        if operation == "cast":
            operation = _cast(before, value.dtype)
        instruction: str = OPERATIONS[before.kind][operation].format(
            *inputs,
            kind=self._type(before),
            lane=TYPES[before],
            lanes=self._suffix(TYPES[before]),
            result=self._type(value.dtype),
            to=self._suffix(TYPES[value.dtype]),
        )
        return self._new(instruction)

    def _called(self, address: int, mask: Value, *inputs: Value) -> str:
        """What a function of C gives for each lane of a mask, and 0 elsewhere."""
        self._count += 1
        n = self._count
        lanes = self._lanes("float")
        flags = f"{self._lanes('i1')} {self._names[mask.number]}"
        some = self._new(f"call i1 @llvm.vector.reduce.or.{self._suffix('i1')}({flags})")
        self._lines += [
            f"  br label %before.{n}",
            f"before.{n}:",
            f"  br i1 {some}, label %lane.{n}, label %done.{n}",
            f"lane.{n}:",
            f"  %l.{n} = phi i64 [0, %before.{n}], [%n.{n}, %next.{n}]",
            f"  %out.{n} = phi {lanes} [zeroinitializer, %before.{n}], [%new.{n}, %next.{n}]",
            f"  %flag.{n} = extractelement {flags}, i64 %l.{n}",
            f"  br i1 %flag.{n}, label %call.{n}, label %next.{n}",
            f"call.{n}:",
        ]
        given = []
        for one in inputs:
            vector = f"{self._type(one.dtype)} {self._names[one.number]}"
            given.append(f"{TYPES[one.dtype]} {self._new(f'extractelement {vector}, i64 %l.{n}')}")
        result = self._new(f"call float inttoptr (i64 {address} to ptr)({', '.join(given)})")
        put = self._new(f"insertelement {lanes} %out.{n}, float {result}, i64 %l.{n}")
        self._lines += [
            f"  br label %next.{n}",
            f"next.{n}:",
            f"  %new.{n} = phi {lanes} [%out.{n}, %lane.{n}], [{put}, %call.{n}]",
            f"  %n.{n} = add i64 %l.{n}, 1",
            f"  %more.{n} = icmp slt i64 %n.{n}, {self._width}",
            f"  br i1 %more.{n}, label %lane.{n}, label %done.{n}",
            f"done.{n}:",
        ]
        ends = f"[zeroinitializer, %before.{n}], [%new.{n}, %next.{n}]"
        return self._new(f"phi {lanes} {ends}")

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
        return self._new(f"extractvalue {kind} {self._calls[call]}, {number}")

    def _returned(self, function: Function) -> str:
        """Type of what a function returns."""
        kinds = ", ".join(self._type(one.dtype) for one in function.results)
        return f"{{{kinds}}}"

    def _definition(self, function: Function, inputs: Sequence[Value]) -> str:
        """The text of a function."""
        inner = copy(self)
        inner._lines = []
        inner._names = {}
        inner._calls = {}
        inner._tables = function.program.tables
        for value in function.program.needed(function.results):
            inner._names[value.number] = inner._printed(value)
        kind = self._returned(function)
        out = "poison"
        for number, one in enumerate(function.results):
            part = f"{self._type(one.dtype)} {inner._names[one.number]}"
            out = inner._new(f"insertvalue {kind} {out}, {part}, {number}")
        body = "\n".join((*inner._lines, f"  ret {kind} {out}"))
        parameters = ", ".join(f"{self._type(one.dtype)} %p{i}" for i, one in enumerate(inputs))
        return f'define internal {kind} @"{function.name}"({parameters}) #0 {{\n{body}\n}}'

    # ---- types, numbers, memory

    def _lanes(self, kind: str) -> str:
        return f"<{self._width} x {kind}>"

    def _type(self, dtype: DType) -> str:
        return self._lanes(TYPES[dtype])

    def _new(self, instruction: str) -> str:
        self._count += 1
        self._lines.append(f"  %v{self._count} = {instruction}")
        return f"%v{self._count}"

    def _number(self, value: Value) -> str:
        """A constant: LLVM reads floats as the bits of a double."""
        number = np.frombuffer(value.inputs[0], value.dtype)[0]
        kind = TYPES[value.dtype]
        if value.dtype.kind != "f":
            return f"splat ({kind} {int(number)})"
        bits = int(np.float64(number).view(np.uint64))
        return f"splat ({kind} 0x{bits:016X})"

    def _suffix(self, kind: str) -> str:
        """Of the names of LLVM's own functions: their lanes."""
        return f"v{self._width}{_SHORT.get(kind, kind)}"

    def _address(self, array: str, row: int) -> tuple[str, str, int]:
        """Pointer to a row at these lanes, its type in memory, and its alignment."""
        if array in self._outside:
            kind = _in_memory(self._outside[array][0])
            start, index = f'%"out.{array}"', "%world"
            if self._is_spread(array):
                start, index = f'%"rows.{array}"', str(row * self._width)
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
            dtype, shape = self._outside[array]
            kind = _in_memory(dtype)
            components = f'[{prod(shape)} x {kind}], ptr %"out.{array}"'
            value = self._gathered(components, kind, "%worlds", row)
        else:
            place, kind, align = self._address(array, row)
            value = self._new(f"load {self._lanes(kind)}, ptr {place}, align {align}")
        if kind == "i8":
            return self._new(f"trunc {self._lanes(kind)} {value} to {self._lanes('i1')}")
        return value

    def _store(self, array: str, row: int, value: str) -> None:
        place, kind, align = self._address(array, row)
        if kind == "i8":
            value = self._new(f"zext {self._lanes('i1')} {value} to {self._lanes(kind)}")
        self._lines.append(f"  store {self._lanes(kind)} {value}, ptr {place}, align {align}")

    def _worlds(self) -> str:
        """Lines that number the worlds of these lanes."""
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
        world = self._new(f"add i64 %world, %l.{number}")
        lanes = f'[{self._width} x {kind}], ptr %"rows.{array}"'
        components = f'[{prod(shape)} x {kind}], ptr %"out.{array}"'
        for row in rows:
            source = self._new(f"getelementptr {lanes}, i64 {row}, i64 %l.{number}")
            target = self._new(f"getelementptr {components}, i64 {world}, i64 {row}")
            one = self._new(f"load {kind}, ptr {source}")
            self._lines.append(f"  store {kind} {one}, ptr {target}, align 1")
        self._lines.append(f"  %n.{number} = add i64 %l.{number}, 1")
        more = self._new(f"icmp slt i64 %n.{number}, {self._width}")
        self._lines += [
            f"  br i1 {more}, label %turn.{number}, label %turned.{number}",
            f"turned.{number}:",
        ]

    def _gathered(self, array: str, kind: str, rows: str, column: int) -> str:
        """A column of an array outside, or of a table, at a row for each lane."""
        rows = f"{self._lanes('i64')} {rows}"
        places = self._new(f"getelementptr {array}, {rows}, i64 {column}")
        function = f"@llvm.masked.gather.{self._suffix(kind)}.{self._suffix('p0')}"
        arguments = f"{self._lanes('ptr')} {places}, i32 1, {self._lanes('i1')} splat (i1 true)"
        lanes = self._lanes(kind)
        return self._new(f"call {lanes} {function}({arguments}, {lanes} poison)")

    def _constant(self, table: np.ndarray) -> str:
        """The name of a table in the module, where equal ones are there once."""
        content = table.tobytes().hex("\\")
        kept = f'constant [{table.nbytes} x i8] c"\\{content}", align 64'
        return self._constants.setdefault(kept, f"@table.{len(self._constants)}")

    def _gather(self, value: Value) -> str:
        """A column of a table, at rows that lie within it."""
        number, column, row = value.inputs
        table = self._tables[number]
        kind = TYPES[value.dtype]
        array = f"[{table.shape[1]} x {kind}], ptr {self._constant(table)}"
        return self._gathered(array, kind, self._names[row.number], column)


def _cast(before: DType, after: DType) -> str:
    """The operation of a cast, as NumPy's `astype`; a float beyond the whole numbers gives the
    nearest of them.
    """
    name = f"to_{after.kind}"
    if name in OPERATIONS[before.kind]:
        return name
    if before.itemsize == after.itemsize:
        return "bits"
    return "wider" if before.itemsize < after.itemsize else "narrower"


def _in_memory(dtype: DType) -> str:
    return "i8" if dtype.kind == "b" else TYPES[dtype]


@lru_cache
def _machine_code(text: str, memories: int) -> Code:
    """The function of a module's text, of so many memories, for this processor."""
    binding = _llvm()
    features = binding.get_host_cpu_features().flatten()
    machine = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=features, opt=2, jit=True
    )
    module = binding.parse_assembly(text)
    module.verify()
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int64, *[ctypes.c_void_p] * (memories + 1))
    call = kind(engine.get_function_address("run"))
    call.engine = engine  # type: ignore[attr-defined]  # it owns the machine code
    return call
