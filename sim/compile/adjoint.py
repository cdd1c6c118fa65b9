"""Reverse mode: derivatives of what a program computes, as further operations of the program.

The adjoint of a value is the derivative of one number by it. The adjoints of the outputs are given;
those of all values between the inputs and the outputs follow, from the last value to the first
(Griewank and Walther, Evaluating Derivatives, 2008, section 3.2).
"""

from collections.abc import Sequence
from functools import cache

import numpy as np

from .program import Function, Program, Value
from .tracer import Traced, TracedArray, call_outside

Pairs = Sequence[tuple[Value, Value]]
"""Values, each with an adjoint, or with a part of it."""
Found = dict[Value, Value]
"""Adjoints by their values."""

_STEP = 2.0**-7
"""To each end of a difference, in the argument's unit."""


def adjoints(program: Program, outputs: Pairs, inputs: Sequence[Value]) -> list[Value]:
    """Adjoints of the inputs, from outputs with theirs; a value may be an output twice.

    Roundings and comparisons are steps: their derivative is 0, as that of whole numbers. A `select`
    passes an adjoint to the value that it takes. The branch that it leaves gets zeros, which stay
    zeros through a quotient or a root, so that branch may divide by 0. The root of 0 has the
    derivative 0, and so has |0|. Functions of C are differentiated by central differences.
    """
    found: Found = {}
    _add(program, found, outputs)
    for value in reversed(_between(program, list(found), inputs)):
        if value not in found:
            continue
        rule = _RULES.get(value.operation, _through_operation)
        _add(program, found, rule(program, value, found))
    return [found.get(one) or program.constant(0.0, one.dtype) for one in inputs]


def _add(program: Program, found: Found, parts: Pairs) -> None:
    for value, part in parts:
        if value in found:
            part = program.value("add", value.dtype, found[value], part)
        found[value] = part


def _between(program: Program, outputs: Sequence[Value], inputs: Sequence[Value]) -> list[Value]:
    """Floats that depend on the inputs, and on which the outputs depend, in order."""
    reached: set[object] = set(inputs)
    between = []
    for value in program.needed(outputs):
        if value.dtype.kind == "f" and not reached.isdisjoint(value.inputs):
            reached.add(value)
            between.append(value)
    return between


def _through_operation(program: Program, value: Value, found: Found) -> Pairs:
    """Inputs of an operation, with what it adds to their adjoints."""
    values = (found[value], value, *value.inputs)
    arrays = [TracedArray(program, one, one.dtype) for one in values]
    parts = _parts(value.operation, *arrays)
    pairs = zip(_floats(value.inputs), parts, strict=False)
    return [(one, part.values.item()) for one, part in pairs]


def _parts(operation: str, adjoint: Traced, result: Traced, *inputs: Traced) -> tuple[Traced, ...]:
    """What an operation adds to the adjoints of its first floats; the others have none."""
    x = inputs[0]
    y = inputs[-1]
    if operation in ("rint", "floor"):
        return ()
    if operation == "select":
        return np.where(x, adjoint, 0.0), np.where(x, 0.0, adjoint)
    if operation == "add":
        return adjoint, adjoint
    if operation == "subtract":
        return adjoint, -adjoint
    if operation == "multiply":
        return adjoint * y, adjoint * x
    if operation == "divide":
        is_nothing = adjoint == 0.0
        share = adjoint / np.where(is_nothing, 1.0, y)
        return share, -share * np.where(is_nothing, 0.0, result)
    if operation == "remainder":
        return adjoint, -adjoint * np.rint((x - result) / y)
    if operation == "negative":
        return (-adjoint,)
    if operation in ("absolute", "copysign"):
        signed = np.where(result == x, adjoint, -adjoint)
        return (np.where(x == 0.0, 0.0, signed),)
    if operation == "sqrt":
        return (0.5 * adjoint / np.where(result > 0.0, result, np.inf),)
    if operation == "cast":
        return (adjoint.astype(x.dtype),)
    raise NotImplementedError(f"{operation}: expected an operation with a derivative")


def _through_call(program: Program, value: Value, found: Found) -> Pairs:
    """As `_through_operation`, of all results of a call at once: nothing lies between them."""
    function, _, *inputs = value.inputs
    given = list(inputs)
    for number, one in enumerate(function.results):
        result = program.value("call", one.dtype, function, number, *inputs)
        given.append(found.pop(result, None) or program.constant(0.0, one.dtype))
    backward = _backward(function)
    pairs = []
    for number, one in enumerate(_floats(inputs)):
        pairs.append((one, program.value("call", one.dtype, backward, number, *given)))
    return pairs


def _through_outside(program: Program, value: Value, found: Found) -> Pairs:
    """As `_through_operation`, by differences: exact where the function is straight over them."""
    address, *inputs = value.inputs
    adjoint, *given = [TracedArray(program, one, one.dtype) for one in (found[value], *inputs)]
    pairs = []
    for place, x in enumerate(given):
        if x.dtype.kind == "f":
            low, high = x - _STEP, x + _STEP
            before, after = given[:place], given[place + 1 :]
            rise = call_outside(address, *before, high, *after)
            rise = rise - call_outside(address, *before, low, *after)
            slope = adjoint * (rise / (high - low))
            pairs.append((inputs[place], slope.values.item()))
    return pairs


_RULES = {"call": _through_call, "outside": _through_outside}


@cache
def _backward(function: Function) -> Function:
    """The adjoints of a function's floats, from its parameters and the adjoints of its results.

    It extends the function's program, of which only what is needed is printed.
    """
    program = function.program
    parameters = [one for one in program.values if one.operation == "parameter"]
    outputs = []
    for number, one in enumerate(function.results, len(parameters)):
        outputs.append((one, program.value("parameter", one.dtype, number)))
    results = adjoints(program, outputs, _floats(parameters))
    return Function(f"{function.name}.adjoint", program, results, (len(results),))


def _floats(values: Sequence[Value]) -> list[Value]:
    return [one for one in values if one.dtype.kind == "f"]
