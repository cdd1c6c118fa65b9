"""A trace as a function of LLVM's vector instructions, compiled in this process by llvmlite.

The function, `fly(…, out, count, steps)`, runs a trace step by step on rows of numbers. One loop
goes over the lanes of the rows, as many at a time as the processor's widest vectors have, then one
by one over those that are left; within it another goes over the steps, in registers.
"""

import ctypes
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np

from ...models.errors import one_line
from .tracer import Operation, Trace, TracedArray

Function = Callable[..., None]
"""Takes an array, or None, for each name; `out` for the results; and `steps`, one or more. All
arrays are C-contiguous, of the trace's dtype and with rows of equally many lanes: not checked."""

_CALLS = ("sqrt", "fabs", "rint", "floor")
_KINDS = {4: ("float", "f32"), 8: ("double", "f64")}
_ATTRIBUTES = (
    'attributes #0 = { nounwind "min-legal-vector-width"="512" "prefer-vector-width"="512" }'
)
_FUNCTION = """define void @fly({arrays}, ptr noalias %out, i64 %count, i64 %steps) #0 {{
entry:
  %left = urem i64 %count, {lanes}
  %whole = sub i64 %count, %left
  br label %test.wide
{wide}
{narrow}
end:
  ret void
}}
"""
_LOOP = """test.{loop}:
  %i.{loop} = phi i64 [{start}], [%next.{loop}, %done.{loop}]
  %more.{loop} = icmp slt i64 %i.{loop}, {stop}
  br i1 %more.{loop}, label %lanes.{loop}, label %{after}
lanes.{loop}:
{loads}
  br label %step.{loop}
step.{loop}:
  %s.{loop} = phi i64 [0, %lanes.{loop}], [%s.next.{loop}, %step.{loop}]
{carried}
{lines}
  %s.next.{loop} = add i64 %s.{loop}, 1
  %again.{loop} = icmp slt i64 %s.next.{loop}, %steps
  br i1 %again.{loop}, label %step.{loop}, label %done.{loop}
done.{loop}:
{stores}
  %next.{loop} = add i64 %i.{loop}, {lanes}
  br label %test.{loop}"""


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


def compiled(
    trace: Trace, state: str, results: Sequence[TracedArray], arrays: Sequence[str]
) -> Function:
    """The function of a trace. Takes a tenth of a second.

    Args:
        trace: Of one step.
        state: The array of which each step reads the rows that the one before it gave.
        results: The new rows of that array.
        arrays: Names of all arrays that the trace reads, in the order of the arguments.
    """
    names = [one.name for one in results]
    text = _module(trace, state, names, arrays, _width(trace.dtype.itemsize))
    call = _machine_code(text, len(arrays) + 1)

    def fly(*given: np.ndarray | None, out: np.ndarray, steps: int) -> None:
        places = [None if array is None else array.ctypes.data for array in given]
        call(*places, out.ctypes.data, out.shape[-1], steps)

    return fly


def _width(itemsize: int) -> int:
    """Lanes of a vector: 64 bytes where there are registers of 32 or more, otherwise 16."""
    is_wide = _llvm().get_host_cpu_features().get("avx2", False)
    return (64 if is_wide else 16) // itemsize


# ---- text


def _module(
    trace: Trace, state: str, results: Sequence[str], arrays: Sequence[str], width: int
) -> str:
    wide = _Printer(trace, state, results, "wide", width)
    narrow = _Printer(trace, state, results, "narrow", 1)
    text = _FUNCTION.format(
        arrays=", ".join(f"ptr %in.{name}" for name in arrays),
        lanes=width,
        wide=wide.loop("0, %entry", "%whole", "test.narrow"),
        narrow=narrow.loop("%whole, %test.wide", "%count", "end"),
    )
    return "\n".join([text, *wide.declared(), *narrow.declared(), _ATTRIBUTES])


class _Printer:
    """One loop over lanes, so many at a time."""

    def __init__(
        self, trace: Trace, state: str, results: Sequence[str], loop: str, width: int
    ) -> None:
        self._trace = trace
        self._state = state
        self._results = results
        self._loop = loop
        self._width = width
        self._kind, self._suffix = _KINDS[trace.dtype.itemsize]
        self._type = self._lanes(self._kind)

    def loop(self, start: str, stop: str, after: str) -> str:
        """Its text."""
        loads: list[str] = []
        carried: list[str] = []
        lines: list[str] = []
        for operation, value in self._trace.operations.items():
            name = self._named(value)
            if operation.function != "load":
                lines.append(f"  {name} = {self._instruction(operation)}")
                continue
            array, row = operation.inputs
            if array == self._state:
                first = f"{name}.first"
                later = self._named(self._results[int(row)])
                ways = f"[{first}, %lanes.{self._loop}], [{later}, %step.{self._loop}]"
                carried.append(f"  {name} = phi {self._type} {ways}")
                name = first
            loads += self._load(name, array, row)
        stores: list[str] = []
        for place, value in enumerate(self._results):
            stores += self._store(f"%out.{place}.{self._loop}", str(place), value)
        return _LOOP.format(
            loop=self._loop,
            start=start,
            stop=stop,
            after=after,
            lanes=self._width,
            loads="\n".join(loads),
            carried="\n".join(carried),
            lines="\n".join(lines),
            stores="\n".join(stores),
        )

    def declared(self) -> list[str]:
        """Declarations of LLVM's own functions."""
        return [f"declare {self._type} {self._function(name)}({self._type})" for name in _CALLS]

    def _lanes(self, kind: str) -> str:
        return kind if self._width == 1 else f"<{self._width} x {kind}>"

    def _named(self, value: str) -> str:
        return f"{value}.{self._loop}"

    def _function(self, name: str) -> str:
        lanes = "" if self._width == 1 else f"v{self._width}"
        return f"@llvm.{name}.{lanes}{self._suffix}"

    def _instruction(self, operation: Operation) -> str:
        function = operation.function
        inputs = [self._input(word) for word in operation.inputs]
        flags = self._lanes("i1")
        if function in _CALLS:
            return f"call {self._type} {self._function(function)}({self._type} {inputs[0]})"
        if function == "select":
            flag, first, second = inputs
            return f"select {flags} {flag}, {self._type} {first}, {self._type} {second}"
        kind = flags if function == "or" else self._type
        return f"{function} {kind} {', '.join(inputs)}"

    def _input(self, word: str) -> str:
        """A value, or a number: LLVM reads floats as the bits of a double."""
        if word.startswith("%"):
            return self._named(word)
        bits = np.float64(self._trace.dtype.type(float(word))).view(np.uint64)
        number = f"0x{int(bits):016X}"
        return number if self._width == 1 else f"splat ({self._kind} {number})"

    def _place(self, name: str, array: str, row: str) -> list[str]:
        """The address of a row at these lanes."""
        loop = self._loop
        return [
            f"  {name}.start = mul i64 %count, {row}",
            f"  {name}.at = add i64 {name}.start, %i.{loop}",
            f"  {name}.place = getelementptr {self._kind}, ptr {array}, i64 {name}.at",
        ]

    def _load(self, name: str, array: str, row: str) -> list[str]:
        align = self._trace.dtype.itemsize
        load = f"  {name} = load {self._type}, ptr {name}.place, align {align}"
        return [*self._place(name, f"%in.{array}", row), load]

    def _store(self, name: str, row: str, value: str) -> list[str]:
        align = self._trace.dtype.itemsize
        store = f"  store {self._type} {self._named(value)}, ptr {name}.place, align {align}"
        return [*self._place(name, "%out", row), store]


# ---- machine code


@lru_cache
def _machine_code(text: str, arrays: int) -> Any:
    """The function of a module's text, of so many arrays, for this processor."""
    binding = _llvm()
    features = binding.get_host_cpu_features().flatten()
    machine = binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=features, opt=2, jit=True
    )
    module = binding.parse_assembly(text)
    module.verify()
    options = binding.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = False  # the text is vectors already
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    pointers = [ctypes.c_void_p] * arrays
    kind = ctypes.CFUNCTYPE(None, *pointers, ctypes.c_int64, ctypes.c_int64)
    call = kind(engine.get_function_address("fly"))
    call.engine = engine  # type: ignore[attr-defined]  # it owns the machine code
    return call
