"""Specs: names, shapes, dtypes, bounds, units, frames and constants of what crosses the wire.

A simulator sends its `EnvSpec` in Hello, and an agent builds its spaces from it: it needs neither
the env's code nor MuJoCo. This module imports neither.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, field, fields, replace
from numbers import Real
from typing import Annotated, Any, Literal, Self

import numpy as np

from ..models.errors import InputError, shortened
from ..models.fields import (
    Choice,
    Limits,
    Text,
    check,
    check_fields,
    immutable,
    printable,
    set_fields,
)
from ..scenes import marks

MAX_ELEMENTS = 1 << 22  # numbers of all observations of one drone
MAX_TOLD = 1 << 14  # numbers of all its telemetry: each has a name in `info`
MAX_DIMENSIONS = 16  # axes of an array
MAX_ARRAYS = 64  # arrays of an observation or of the telemetry
MAX_AGENTS = 1024  # drones of one world
MAX_MARKS = 256  # things that pictures show
MAX_NAME = 200  # characters of a name, unit or frame

WORLD = "world"
"""Frame of vectors x, y, z: z up, right-handed."""
BODY = "body"
"""Frame of rotation rates about x forward, y left, z up."""
BODY_TO_WORLD = "body to world"
"""Frame of a quaternion w, x, y, z."""

IMAGE = ("row", "column")
"""Axes of an image, from its upper left corner on."""
PICTURE = (*IMAGE, "channel")
"""Axes of a picture."""
RINGS = ("ring", "azimuth")
"""Axes of a lidar. Azimuths close a circle: the first follows the last."""

Values = dict[str, Any]
"""Values by name, as JSON has them."""

Bound = float | tuple[float, ...]
"""One number for all elements, or one for each in C order. Infinite where there is no bound."""


class SpecError(InputError):
    """A spec is wrong: nothing of that kind can cross the wire."""


Name = Annotated[str, printable(MAX_NAME)]
_WORD = printable(MAX_NAME, 0)
Word = Annotated[str, _WORD]
_WORDS = printable(MAX_NAME, 0, several=True)
Words = Annotated[tuple[str, ...], _WORDS]
_HASH = Text("[0-9a-f]{32}", "32 hex digits")
_DIGEST = Text("([0-9a-f]{32})?", "32 hex digits")
_CONSTANT = Text("[a-z][a-z0-9_]{0,63}", "a name of a to z, 0 to 9 and _")
_DTYPE = Choice(("float32", "float64", "uint8", "int32", "int64"))
_SIZE = Limits(0.0, above=True)


class _Part:
    """A dataclass that is a JSON object: tuples are lists, infinity is null."""

    _optional: tuple[str, ...] = ()
    """Fields that are left out where they have their default."""

    def _to_content(self) -> dict[str, object]:
        content = {}
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            default = f.default if f.default_factory is MISSING else f.default_factory()
            if value != default or f.name not in self._optional:
                content[f.name] = _plain(value)
        return content

    @classmethod
    def _fields(cls, content: object) -> Values:
        """Keyword arguments from a JSON object; names that are not known are left out."""
        if not isinstance(content, dict):
            raise SpecError(
                f"spec: expected an object for {cls.__name__}, got {shortened(content)}"
            )
        given = {}
        for f in fields(cls):  # type: ignore[arg-type]
            name = f.name
            if name in content:
                value = content[name]
                given[name] = tuple(value) if isinstance(value, list) else value
            elif f.default is MISSING and f.default_factory is MISSING:
                raise SpecError(f"spec: expected {name} in {cls.__name__}, got {list(content)}")
        return given

    @classmethod
    def _from_content(cls, content: object) -> Self:
        return cls(**cls._fields(content))


@immutable
class ArraySpec(_Part):
    """An array of one drone. Bounds of the same value are kept as one number."""

    _optional = ("low", "high", "unit", "frame", "axes", "components", "categories", "privileged")

    name: Name
    shape: tuple[int, ...]
    dtype: Annotated[str, _DTYPE] = "float32"
    """`float32`, `float64`, `uint8`, `int32` or `int64`."""
    low: Bound = -math.inf
    high: Bound = math.inf
    unit: str | tuple[str, ...] = ""
    """One for all elements, or one for each."""
    frame: Word = ""
    """Frame of reference; empty where there is none."""
    axes: Words = ()
    """A name for each axis, or none: `IMAGE` and `RINGS` have neighbours."""
    components: Words = ()
    """A name for each element, or none."""
    categories: Words = ()
    """What the values 0, 1, 2... stand for, where they are numbers of something; or none."""
    privileged: bool = False
    """Of an observation: for the critic alone, in training. Only our own agents know that."""

    def __post_init__(self) -> None:
        check_fields(self, "array: ", SpecError)
        name = self.name
        shape = self.shape
        is_shape = isinstance(shape, tuple) and all(type(n) is int and n >= 1 for n in shape)
        _expect(is_shape, name, "a shape of whole numbers >= 1", shape)
        _expect(len(shape) <= MAX_DIMENSIONS, name, f"at most {MAX_DIMENSIONS} axes", len(shape))
        _expect(self.size <= MAX_ELEMENTS, name, f"at most {MAX_ELEMENTS} elements", shape)
        set_fields(self, low=self._bound("low", -math.inf), high=self._bound("high", math.inf))
        low, high = self.bounds()
        wrong = ~((low <= high) & (low < np.inf) & (high > -np.inf))
        if wrong.any():
            first = int(wrong.argmax())
            got = f"{low.flat[first]} and {high.flat[first]}"
            raise SpecError(f"{name}: expected low <= high, got {got} at element {first}")
        one_unit = isinstance(self.unit, str)
        units = (self.unit,) if one_unit else self.unit
        check(f"{name}: unit", _WORDS, units, SpecError)
        right = not self.axes or len(self.axes) == len(shape)
        _expect(right, name, f"{len(shape)} names of axes", self.axes)
        _expect(one_unit or len(units) == self.size, name, f"{self.size} units", len(units))
        _check_components(name, self.components, self.size)

    def _bound(self, name: str, infinite: float) -> Bound:
        """A bound as it is kept; JSON has null for infinity."""
        given: Any = getattr(self, name)
        objects = np.asarray(given, object)
        numbers = [infinite if number is None else number for number in objects.ravel().tolist()]
        right = objects.shape in ((), self.shape, (self.size,))
        right = right and all(_is_number(number) for number in numbers)
        _expect(right, self.name, f"one number for {name} or one for each element", given)
        kept = tuple(map(float, numbers))
        return kept[0] if len(set(kept)) == 1 else kept

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), float64, of the array's shape."""
        low = np.broadcast_to(np.asarray(self.low, np.float64), self.size)
        high = np.broadcast_to(np.asarray(self.high, np.float64), self.size)
        return low.reshape(self.shape), high.reshape(self.shape)


@immutable
class Discrete(_Part):
    """An action that is one choice out of 0 ... choices - 1."""

    _optional = ("components",)

    name: Word = "action"
    choices: Annotated[int, Limits(1, 1 << 24, "choices", whole=True)]
    components: Words = ()
    """A name for each choice, or none."""

    def __post_init__(self) -> None:
        check_fields(self, "action: ", SpecError)
        _check_components("action", self.components, self.choices)


@immutable
class Metric(_Part):
    """A measure of how well a task is done. The first metric of a task is its headline."""

    _optional = ("settled", "held", "symbol", "signed", "final")

    name: Name
    unit: Word
    goal: Literal["zero", "high"] = "zero"
    """`zero`: an error, signed or not; 0 is best. `high`: larger is better."""
    settled: Annotated[float | None, _SIZE] = None
    """Size of the error below which an episode counts as settled; None if undefined."""
    held: Annotated[float | None, _SIZE] = None
    """Mean size of the error at the end of an episode below which its goal counts as held."""
    symbol: Word = ""
    """Short symbol for figures and overlays, as E; empty: the name."""
    signed: bool = False
    """Whether it changes sign where it passes its best: then there is an overshoot."""
    final: bool = False
    """Whether its value at the end of an episode counts, as of a landing, in place of the mean of
    the last quarter. An episode that terminates with its goal held is then no crash."""

    def __post_init__(self) -> None:
        check_fields(self, "metric: ", SpecError)


@immutable
class Mark(marks.Mark, _Part):
    """Something of a task that pictures show and physics does not know."""

    _optional = ("position", "heading", "moves")

    def __post_init__(self) -> None:
        check_fields(self, "mark: ", SpecError)


@immutable
class EnvSpec(_Part):
    """Everything that an agent must know of an env. Arrays are those of one drone."""

    _optional = ("config_digest", "constants", "marks", "asks")

    env_id: Word
    options: Mapping[str, Any] = field(default_factory=dict)
    """Every option of the env, as JSON values."""
    control_period: Annotated[float, Limits(1e-6, 1e3, "s")]
    """Time that one step simulates, s."""
    vehicle: Word = ""
    """Name of the vehicle's model."""
    vehicle_hash: Annotated[str, _HASH] = "0" * 32
    """32 hexadecimal digits: the same model, the same hash; zeros where there is none."""
    config_digest: Annotated[str, _DIGEST] = ""
    """32 hexadecimal digits of the resolved `EnvConfig`, or empty. The same digest, the same
    numbers."""
    agents: Words = ("drone_0",)
    """One name for each drone of a world."""
    observation: tuple[ArraySpec, ...]
    """Privileged arrays come last."""
    action: ArraySpec | Discrete
    telemetry: tuple[ArraySpec, ...] = ()
    """Further arrays of a State, for logs and pictures; the last, `metrics`, has the metrics."""
    metrics: tuple[Metric, ...] = ()
    constants: Mapping[str, Bound] = field(default_factory=dict)
    """Numbers that a controller needs: gravity, radius, gains, scales. `docs/protocol.md` has their
    names and units."""
    marks: tuple[Mark, ...] = ()
    """What pictures show of the task."""
    asks: Words = ()
    """For each of the option `events` its kind, where a Command may ask for it; else empty."""

    def __post_init__(self) -> None:
        check_fields(self, "", SpecError)
        options = json_values(self.options)
        set_fields(self, options=options, constants=_checked_constants(self.constants))
        _check_different("agents", self.agents, MAX_AGENTS)
        _expect(self.agents, "agents", "at least one name", self.agents)
        hidden = [array.privileged for array in self.observation]
        expected = "at least one array for the actor, and privileged ones last"
        _expect(not all(hidden) and hidden == sorted(hidden), "observation", expected, hidden)
        _expect(len(self.asks) <= MAX_ARRAYS, "asks", f"at most {MAX_ARRAYS}", len(self.asks))
        _expect(len(self.marks) <= MAX_MARKS, "marks", f"at most {MAX_MARKS}", len(self.marks))
        for what, most in (("observation", MAX_ELEMENTS), ("telemetry", MAX_TOLD)):
            arrays = getattr(self, what)
            _check_different(what, [array.name for array in arrays], MAX_ARRAYS)
            size = sum(array.size for array in arrays)
            _expect(size <= most, what, f"at most {most} elements in all", size)
        names = tuple(metric.name for metric in self.metrics)
        in_telemetry = next((a.components for a in self.telemetry if a.name == "metrics"), ())
        expected = f"the components of the telemetry 'metrics' to be {shortened(names)}"
        _expect(in_telemetry == names, "metrics", expected, in_telemetry)
        components = [name for array in self.telemetry for name in component_names(array)]
        _check_different("telemetry: components", components, MAX_TOLD)

    def for_actor(self) -> Self:
        """The same without privileged arrays."""
        seen = tuple(array for array in self.observation if not array.privileged)
        return replace(self, observation=seen)

    def constant(self, name: str, user: str) -> float:
        """One of the constants. Raises `InputError`, which names its `user`, if it is not there."""
        value = self.constants.get(name)
        if not isinstance(value, float):
            raise InputError(f"{user}: expected the constant {name!r} in the spec, got {value!r}")
        return value

    def vectors(
        self, user: str, needed: Sequence[str], further: Sequence[str] = ()
    ) -> dict[str, list[int]]:
        """Where components x, y and z of vectors are in a flat observation, by name.

        Raises `InputError`, which names the `user`, if a needed vector is not there. Of the further
        ones those that are not are left out, and one may lack z.
        """
        names = [name for array in self.observation for name in component_names(array)]
        at = {}
        for vector in (*needed, *further):
            found = [names.index(n) for axis in "xyz" if (n := f"{vector} {axis}") in names]
            if found:
                at[vector] = found
            elif vector in needed:
                raise InputError(
                    f"{user}: expected the observation '{vector} x', got {self.env_id} without it"
                )
        return at

    def check_telemetry(self, names: Sequence[str], user: str) -> None:
        """Raise `InputError`, which names the `user`, if these are not all in the telemetry."""
        missing = set(names).difference(array.name for array in self.telemetry)
        if missing:
            wanted = ", ".join(sorted(missing))
            raise InputError(f"{user}: expected telemetry of {wanted}, {self.env_id} has none")

    @property
    def action_scale(self) -> np.ndarray:
        """What 1 stands for in each number of an action, in its unit, float64, shape (k,)."""
        scale = self.constants.get("action_scale", 1.0)
        size = 1 if isinstance(self.action, Discrete) else self.action.size
        return np.broadcast_to(np.asarray(scale, np.float64), size)

    @property
    def fps(self) -> int:
        """Control steps per second, rounded, at least 1: `render_fps` of Gymnasium's metadata."""
        return max(1, round(1 / self.control_period))

    @property
    def vehicle_text(self) -> str:
        """Name of the vehicle, and the first digits of its hash."""
        return f"{self.vehicle} (model {self.vehicle_hash[:8]})"

    @property
    def headline(self) -> Metric | None:
        """The metric that decides; None where the env names none."""
        return self.metrics[0] if self.metrics else None

    def to_json(self) -> str:
        """JSON text, the same for the same spec."""
        content = self._to_content()
        return json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The reverse of `to_json`. Raises `SpecError`, and nothing else, for any other text."""
        try:
            content = json.loads(
                text,
                parse_float=_finite,
                parse_constant=_finite,
                object_pairs_hook=_without_repeats,
            )
        except (ValueError, RecursionError) as error:
            raise SpecError(f"spec: expected JSON, got {text[:80]!r}: {error}") from None
        given = cls._fields(content)
        for name, kind in _KINDS.items():
            parts = given.get(name, ())
            _expect(isinstance(parts, tuple), name, "a list", parts)
            given[name] = tuple(map(kind._from_content, parts))
        action = given["action"]
        is_discrete = isinstance(action, dict) and "choices" in action
        given["action"] = (Discrete if is_discrete else ArraySpec)._from_content(action)
        return cls(**given)


_KINDS: dict[str, type[_Part]] = {
    "observation": ArraySpec, "telemetry": ArraySpec, "metrics": Metric, "marks": Mark,
}  # fmt: skip


def canonical_id(env_id: str) -> str:
    """An env id without the module that Gymnasium is to import for it: `module:Name-v0`."""
    return env_id.rpartition(":")[2]


def component_names(array: ArraySpec) -> tuple[str, ...]:
    """A name for each element of an array: its components, or the array's name and an index."""
    if array.components:
        return array.components
    if array.size == 1:
        return (array.name,)
    return tuple(f"{array.name}[{index}]" for index in range(array.size))


def component_units(array: ArraySpec) -> tuple[str, ...]:
    """A unit for each element of an array; empty for pure numbers."""
    units = array.unit if isinstance(array.unit, tuple) else (array.unit,) * array.size
    return tuple("" if unit == "1" else unit for unit in units)


def _checked_constants(constants: Any) -> dict[str, Bound]:
    _expect(isinstance(constants, Mapping), "constants", "an object", constants)
    _expect(len(constants) <= MAX_ARRAYS, "constants", f"at most {MAX_ARRAYS}", len(constants))
    checked: dict[str, Bound] = {}
    for name, value in constants.items():
        check("constants", _CONSTANT, name, SpecError)
        several = isinstance(value, tuple | list)
        what = f"constants: {name}"
        _expect(not several or len(value) <= MAX_TOLD, what, f"at most {MAX_TOLD} numbers", value)
        rule = Limits(count=0, least=0) if several else Limits()
        checked[name] = check(what, rule, value, SpecError)
    return checked


def _expect(right: object, name: str, expected: str, got: object) -> None:
    if not right:
        raise SpecError(f"{name}: expected {expected}, got {shortened(got)}")


def _is_number(value: object) -> bool:
    """Whether it is a number of float64, infinity among them."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return not math.isnan(value)
    except OverflowError:
        return False


def _check_different(what: str, names: Sequence[str], most: int) -> None:
    right = len(set(names)) == len(names) <= most
    _expect(right, what, f"at most {most} different names", names)


def _check_components(name: str, components: tuple[str, ...], size: int) -> None:
    right = not components or len({*components} - {""}) == len(components) == size
    _expect(right, name, f"{size} different components", components)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {text:.80}")
    return value


def _without_repeats(pairs: list[tuple[str, Any]]) -> Values:
    """A JSON object. Raises `ValueError` for a name that it has twice."""
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"expected each name once, got {repeated[:40]!r} twice")
    return content


def _plain(value: object) -> object:
    """A field's value for JSON."""
    if isinstance(value, _Part):
        return value._to_content()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return None if value in (math.inf, -math.inf) else value


def json_values(options: Any) -> Values:
    """Options as JSON gives them back: tuples become lists. Raises `SpecError`."""
    try:
        text = json.dumps({**options}, allow_nan=False, ensure_ascii=False)
        text.encode()  # half a surrogate pair cannot be sent
        plain: Values = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise SpecError(
            f"options: expected JSON values, got {shortened(options)}: {error}"
        ) from None
    for name in plain:
        check("options", _WORD, name, SpecError)
    return plain


def options_difference(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    """In which options two envs differ, in words; "" if in none."""
    differing = []
    for name in {**ours, **theirs}:
        pair = []
        for options in (ours, theirs):
            pair.append(repr(options[name]) if name in options else "not to be there")
        if ours.get(name, pair) != theirs.get(name, pair):
            differing.append(f"expected {name} {pair[0]}, got {pair[1]}")
    return "; ".join(differing)
