"""What a program does alike for each drone of a world, as a function: its code is there once."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from math import prod

from .layout import Fields
from .program import Function, Program, Value

_LEAST = 500  # Operations of a drone for which a function pays

Stores = list[tuple[str, int, Value]]
Each = tuple[Value, ...]
"""A value of each drone."""


def with_calls(
    name: str, program: Program, stores: Stores, fields: Fields, drones: int
) -> tuple[Program, Stores]:
    """A program and its stores, where drones call a function for what they do alike.

    A drone's own values depend on what it loads, and on nothing of another drone.

    Args:
        name: Of the function.
        program: Of one world.
        stores: What it writes: array, component, and value.
        fields: Of arrays by name: a first axis of `drones` is that of the drones. Others are of
            the world. A wrong one costs speed, and no bit.
        drones: Of a world.
    """
    results = [value for _, _, value in stores]
    values = program.needed(results)
    of_drones, alike = _alike(values, fields, drones)
    if len(alike) < _LEAST:
        return program, stores
    given: list[Each] = []
    body = Program()
    inner: dict[Each, Value] = {}
    for each in alike:
        first = each[0]
        inputs: list[object] = []
        for place, one in enumerate(first.inputs):
            if isinstance(one, Value):
                needs = tuple(value.inputs[place] for value in each)
                if needs not in inner:
                    inner[needs] = _parameter(body, needs, given)
                one = inner[needs]
            inputs.append(one)
        inner[each] = body.value(first.operation, first.dtype, *inputs)

    inside = {value for each in alike for value in each}
    asked = {*results}
    for value in values:
        if value not in inside:
            asked.update(one for one in value.inputs if one in inside)
    leaving = [each for each in alike if not asked.isdisjoint(each)]
    function = Function(name, body, [inner[each] for each in leaving], (len(leaving),))

    caller = Program()
    caller.tables = program.tables
    copies: dict[Value, Value] = {}
    _copy([value for value in values if value not in of_drones], caller, copies)
    _copy([value for each in given for value in each], caller, copies)
    for drone in range(drones):
        arguments = [copies[each[drone]] for each in given]
        for number, each in enumerate(leaving):
            dtype = each[drone].dtype
            copies[each[drone]] = caller.value("call", dtype, function, number, *arguments)
    _copy([value for value in values if value not in inside], caller, copies)
    return caller, [(array, row, copies[value]) for array, row, value in stores]


def _alike(values: Sequence[Value], fields: Fields, drones: int) -> tuple[set[Value], list[Each]]:
    """Values that depend on drones; and operations that all drones do alike, in order.

    Inputs of the latter are of that kind too, or a drone loads them, or they depend on no drone.
    """
    owners: dict[Value, int | None] = {}  # None: several
    kinds = defaultdict[object, dict[int, Value]](dict)  # by key, and how often the drone had it
    times = Counter[object]()
    keys: dict[Value, int] = {}
    for value in values:
        if value.operation == "load":
            array, row = value.inputs
            shape = fields[array][1] if array in fields else ()
            if shape[:1] != (drones,):
                continue
            owner, component = divmod(row, prod(shape[1:]))
            key: object = array, component
        else:
            of = {owners[one] for one in value.inputs if one in owners}
            if not of:
                continue
            owner = of.pop() if len(of) == 1 else None
            inputs = [keys.get(one) if isinstance(one, Value) else one for one in value.inputs]
            key = value.operation, value.dtype, *inputs
        owners[value] = owner
        if owner is not None:
            times[key, owner] += 1
            kind = kinds[key, times[key, owner]]
            kind[owner] = value
            keys[value] = id(kind)
    found = [tuple(of[i] for i in range(drones)) for of in kinds.values() if len(of) == drones]
    return {*owners}, [each for each in found if each[0].operation != "load"]


def _parameter(body: Program, needs: Each, given: list[Each]) -> Value:
    """A new parameter of a function, or a constant that is the same for all drones."""
    first = needs[0]
    if first.operation == "constant" and {*needs} == {first}:
        return body.value("constant", first.dtype, *first.inputs)
    given.append(needs)
    return body.value("parameter", first.dtype, len(given) - 1)


def _copy(values: Sequence[Value], program: Program, copies: dict[Value, Value]) -> None:
    """Extend a program by copies of values, whose inputs have copies, and note them."""
    for value in values:
        if value not in copies:
            inputs = [copies.get(one, one) for one in value.inputs]
            copies[value] = program.value(value.operation, value.dtype, *inputs)
