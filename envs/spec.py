"""Specs: names, shapes, dtypes, bounds, units, frames and constants of what crosses the wire.

A simulator sends its `EnvSpec` in Hello, and an agent builds its spaces from it: it needs neither
the env's code nor MuJoCo. This module imports the standard library and NumPy alone.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Annotated, Any, ClassVar, Final, Literal, Self

import numpy as np

from ..models.errors import InputError, shortened
from ..models.fields import Limits, Text, check_fields
from ..scenes import marks

MAX_ELEMENTS: Final = 1 << 22  # numbers of all observations of one drone
MAX_TOLD: Final = 1 << 14  # numbers of all its telemetry: each has a name in `info`
MAX_DIMENSIONS: Final = 16  # axes of an array
MAX_ARRAYS: Final = 64  # arrays of an observation or of the telemetry
MAX_AGENTS: Final = 1024  # drones of one world
MAX_MARKS: Final = 256  # things that pictures show
MAX_NAME: Final = 200  # characters of a name, unit or frame

_DTYPES: Final = ("float32", "float64", "uint8", "int32", "int64")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")  # and halves of pairs
_SIZE: Final = Limits(0.0, above=True)
_DIGEST: Final = re.compile("[0-9a-f]{32}")
_CONSTANT: Final = re.compile(r"[a-z][a-z0-9_]{0,63}")
_LARGEST: Final = float(np.finfo(np.float64).max)
_NO_BOUND: Final = {"low": -math.inf, "high": math.inf}

WORLD: Final = "world"
"""Frame of vectors x, y, z: z up, right-handed."""
BODY: Final = "body"
"""Frame of rotation rates about x forward, y left, z up."""
BODY_TO_WORLD: Final = "body to world"
"""Frame of a quaternion w, x, y, z."""

Bound = float | tuple[float, ...]
"""One number for all elements, or one for each in C order. Infinite where there is no bound."""


class SpecError(InputError):
    """A spec is wrong: nothing of that kind can cross the wire."""


class _Part:
    """A dataclass that is a JSON object: tuples are lists, infinity is null."""

    _optional: ClassVar[tuple[str, ...]] = ()
    """Fields that are left out where they have their default."""

    def _to_content(self) -> dict[str, object]:
        content = {}
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            default = f.default if f.default_factory is MISSING else f.default_factory()
            if value != default or f.name not in self._optional:
                content[f.metadata.get("json", f.name)] = _plain(value)
        return content

    @classmethod
    def _fields(cls, content: object) -> dict[str, Any]:
        """Keyword arguments from a JSON object; names that are not known are left out."""
        if not isinstance(content, dict):
            raise SpecError(
                f"spec: expected an object for {cls.__name__}, got {shortened(content)}"
            )
        given = {}
        for f in fields(cls):  # type: ignore[arg-type]
            name = f.metadata.get("json", f.name)
            if name in content:
                value = content[name]
                given[f.name] = tuple(value) if isinstance(value, list) else value
            elif f.default is MISSING and f.default_factory is MISSING:
                raise SpecError(f"spec: expected {name} in {cls.__name__}, got {list(content)}")
        return given

    @classmethod
    def _from_content(cls, content: object) -> Self:
        return cls(**cls._fields(content))


@dataclass(frozen=True, kw_only=True)
class ArraySpec(_Part):
    """An array of one drone. Bounds of the same value are kept as one number."""

    _optional = ("low", "high", "unit", "frame", "components", "categories")

    name: str
    shape: tuple[int, ...]
    dtype: str = "float32"
    """`float32`, `float64`, `uint8`, `int32` or `int64`."""
    low: Bound = -math.inf
    high: Bound = math.inf
    unit: str | tuple[str, ...] = ""
    """One for all elements, or one for each."""
    frame: str = ""
    """Frame of reference; empty where there is none."""
    components: tuple[str, ...] = ()
    """A name for each element, or none."""
    categories: tuple[str, ...] = ()
    """What the values 0, 1, 2... stand for, where they are numbers of something; or none."""

    def __post_init__(self) -> None:
        name = self.name
        shape = self.shape
        names = self.components
        _check_text("name", name)
        _expect(name, "name", "a name for an array", name)
        is_shape = isinstance(shape, tuple) and all(type(n) is int and n >= 1 for n in shape)
        _expect(is_shape, name, "a shape of whole numbers >= 1", shape)
        _expect(len(shape) <= MAX_DIMENSIONS, name, f"at most {MAX_DIMENSIONS} axes", len(shape))
        _expect(self.size <= MAX_ELEMENTS, name, f"at most {MAX_ELEMENTS} elements", shape)
        _expect(self.dtype in _DTYPES, name, f"a dtype of {', '.join(_DTYPES)}", self.dtype)
        for end in _NO_BOUND:
            object.__setattr__(self, end, self._bound(end))
        low, high = self.bounds()
        wrong = ~((low <= high) & (low < np.inf) & (high > -np.inf))
        if wrong.any():
            first = int(wrong.argmax())
            got = f"{low.flat[first]} and {high.flat[first]}"
            raise SpecError(f"{name}: expected low <= high, got {got} at element {first}")
        one_unit = isinstance(self.unit, str)
        units = (self.unit,) if one_unit else self.unit
        _check_words(f"{name}: unit", units)
        _expect(one_unit or len(units) == self.size, name, f"{self.size} units", len(units))
        _check_text(f"{name}: frame", self.frame)
        _check_words(f"{name}: components", names)
        _check_words(f"{name}: categories", self.categories)
        right = not names or len({*names} - {""}) == len(names) == self.size
        _expect(right, name, f"{self.size} different components", names)

    def _bound(self, name: str) -> Bound:
        bound: Any = getattr(self, name)
        try:
            values = np.asarray(bound, np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.asarray(np.nan)
        fits = values.shape in ((), self.shape, (self.size,))
        right = fits and not np.isnan(values).any()
        _expect(right, self.name, f"one number for {name} or one for each element", bound)
        flat = values.ravel()
        return float(flat[0]) if (flat == flat[0]).all() else tuple(flat.tolist())

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), float64, of the array's shape."""
        pair = [np.asarray(bound, np.float64) for bound in (self.low, self.high)]
        low, high = (np.broadcast_to(bound, self.size).reshape(self.shape) for bound in pair)
        return low, high

    @classmethod
    def _from_content(cls, content: object) -> Self:
        given = cls._fields(content)
        for name in _NO_BOUND.keys() & given:
            values = given[name] if isinstance(given[name], tuple) else (given[name],)
            right = all(value is None or _is_number(value) for value in values)
            _expect(right, "bounds", "numbers or null", given[name])
            values = tuple(_NO_BOUND[name] if value is None else value for value in values)
            given[name] = values if isinstance(given[name], tuple) else values[0]
        return cls(**given)


@dataclass(frozen=True, kw_only=True)
class Discrete(_Part):
    """An action that is one choice out of 0 ... n - 1."""

    _optional = ("components",)

    name: str = "action"
    n: int = field(metadata={"json": "choices"})
    components: tuple[str, ...] = ()
    """A name for each choice, or none."""

    def __post_init__(self) -> None:
        n, names = self.n, self.components
        _expect(type(n) is int and 1 <= n <= 1 << 24, "action", "1 to 2^24 choices", n)
        _check_text("action", self.name)
        _check_words("action: components", names)
        _expect(not names or len(names) == n, "action", f"{n} components", names)


@dataclass(frozen=True, kw_only=True)
class Metric(_Part):
    """A measure of how well a task is done. The first metric of a task is its headline."""

    _optional = ("settled", "held", "symbol", "signed", "final")

    name: Annotated[str, Text(MAX_NAME)]
    unit: Annotated[str, Text(MAX_NAME, empty=True)]
    goal: Literal["zero", "high"] = "zero"
    """`zero`: an error, signed or not; 0 is best. `high`: larger is better."""
    settled: Annotated[float | None, _SIZE] = None
    """Size of the error below which an episode counts as settled; None if undefined."""
    held: Annotated[float | None, _SIZE] = None
    """Mean size of the error at the end of an episode below which its goal counts as held."""
    symbol: Annotated[str, Text(MAX_NAME, empty=True)] = ""
    """Short symbol for figures and overlays, as E; empty: the name."""
    signed: bool = False
    """Whether it changes sign where it passes its best: then there is an overshoot."""
    final: bool = False
    """Whether its value at the end of an episode counts, as of a landing, in place of the mean of
    the last quarter. An episode that terminates with its goal held is then no crash."""

    def __post_init__(self) -> None:
        check_fields(self, "metric: ", SpecError)


@dataclass(frozen=True, kw_only=True)
class Mark(marks.Mark, _Part):
    """Something of a task that pictures show and physics does not know."""

    _optional = ("position", "heading", "moves")

    def __post_init__(self) -> None:
        check_fields(self, "mark: ", SpecError)


@dataclass(frozen=True, kw_only=True)
class EnvSpec(_Part):
    """Everything that an agent must know of an env. Arrays are those of one drone."""

    _optional = ("config_digest", "constants", "marks")

    env_id: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Every option of the env, as JSON values."""
    control_period: float
    """Time that one step simulates, s."""
    vehicle: str = ""
    """Name of the vehicle's model."""
    vehicle_hash: str = "0" * 32
    """32 hexadecimal digits: the same model, the same hash; zeros where there is none."""
    config_digest: str = ""
    """32 hexadecimal digits of the resolved `EnvConfig`, or empty. The same digest, the same
    numbers."""
    agents: tuple[str, ...] = ("drone_0",)
    """One name for each drone of a world."""
    observation: tuple[ArraySpec, ...]
    action: ArraySpec | Discrete
    telemetry: tuple[ArraySpec, ...] = ()
    """Further arrays of a State, for logs and pictures; the last, `metrics`, has the metrics."""
    metrics: tuple[Metric, ...] = ()
    constants: Mapping[str, Bound] = field(default_factory=dict)
    """Numbers that a controller needs: gravity, radius, gains, scales. `docs/protocol.md` has their
    names and units."""
    marks: tuple[Mark, ...] = ()
    """What pictures show of the task."""

    def __post_init__(self) -> None:
        _check_text("env_id", self.env_id)
        object.__setattr__(self, "options", json_values(self.options))
        object.__setattr__(self, "constants", _checked_constants(self.constants))
        period = self.control_period
        agents = self.agents
        right = _is_number(period) and 1e-6 <= period <= 1e3
        _expect(right, "control_period", "1e-6 to 1e3 s", period)
        _check_text("vehicle", self.vehicle)
        for name in ("vehicle_hash", "config_digest"):
            digits = getattr(self, name)
            right = isinstance(digits, str) and bool(_DIGEST.fullmatch(digits))
            right = right or (digits == "" and name in self._optional)
            _expect(right, name, "32 hex digits", digits)
        _check_words("agents", agents)
        right = 1 <= len({*agents}) == len(agents) <= MAX_AGENTS
        _expect(right, "agents", f"1 to {MAX_AGENTS} different names", agents)
        _expect(self.observation, "observation", "at least one array", self.observation)
        _expect(len(self.marks) <= MAX_MARKS, "marks", f"at most {MAX_MARKS}", len(self.marks))
        for what, most in (("observation", MAX_ELEMENTS), ("telemetry", MAX_TOLD)):
            arrays = getattr(self, what)
            listed = [array.name for array in arrays]
            right = len({*listed}) == len(listed) <= MAX_ARRAYS
            _expect(right, what, f"at most {MAX_ARRAYS} different names", listed)
            size = sum(array.size for array in arrays)
            _expect(size <= most, what, f"at most {most} elements in all", size)
        names = tuple(metric.name for metric in self.metrics)
        in_telemetry = next((a.components for a in self.telemetry if a.name == "metrics"), ())
        expected = f"the components of the telemetry 'metrics' to be {shortened(names)}"
        _expect(in_telemetry == names, "metrics", expected, in_telemetry)
        components = [name for array in self.telemetry for name in component_names(array)]
        right = len({*components}) == len(components)
        _expect(right, "telemetry", "each component once", components)

    def constant(self, name: str, user: str) -> float:
        """One of the constants. Raises `InputError`, which names its `user`, if it is not there."""
        value = self.constants.get(name)
        if not isinstance(value, float):
            raise InputError(f"{user}: expected the constant {name!r} in the spec, got {value!r}")
        return value

    @property
    def action_scale(self) -> np.ndarray:
        """What 1 stands for in each number of an action, in its unit, float64, shape (k,)."""
        scale = self.constants.get("action_scale", 1.0)
        size = 1 if isinstance(self.action, Discrete) else self.action.size
        return np.broadcast_to(np.asarray(scale, np.float64), size)

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
        kinds: dict[str, type[_Part]] = {
            "observation": ArraySpec, "telemetry": ArraySpec, "metrics": Metric, "marks": Mark
        }  # fmt: skip
        for name in kinds.keys() & given:
            _expect(isinstance(given[name], tuple), name, "a list", given[name])
            given[name] = tuple(map(kinds[name]._from_content, given[name]))
        action = given["action"]
        is_discrete = isinstance(action, dict) and "choices" in action
        given["action"] = (Discrete if is_discrete else ArraySpec)._from_content(action)
        return cls(**given)


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


def _checked_constants(constants: Any) -> dict[str, Bound]:
    _expect(isinstance(constants, Mapping), "constants", "an object", constants)
    _expect(len(constants) <= MAX_ARRAYS, "constants", f"at most {MAX_ARRAYS}", len(constants))
    checked: dict[str, Bound] = {}
    for name, value in constants.items():
        is_name = isinstance(name, str) and _CONSTANT.fullmatch(name)
        _expect(is_name, "constants", "names of a to z, 0 to 9 and _", name)
        several = isinstance(value, tuple | list)
        numbers = tuple(value) if several else (value,)
        right = all(_is_number(number) and abs(number) <= _LARGEST for number in numbers)
        expected = f"at most {MAX_TOLD} finite numbers"
        _expect(right and len(numbers) <= MAX_TOLD, f"constants: {name}", expected, value)
        floats = tuple(map(float, numbers))
        checked[name] = floats if several else floats[0]
    return checked


def _expect(right: object, name: str, expected: str, got: object) -> None:
    if not right:
        raise SpecError(f"{name}: expected {expected}, got {shortened(got)}")


def _check_text(name: str, text: object) -> None:
    right = isinstance(text, str) and len(text) <= MAX_NAME and not _CONTROL.search(text)
    expected = f"a text of at most {MAX_NAME} characters without control characters"
    _expect(right, name, expected, text)


def _check_words(name: str, words: Any) -> None:
    _expect(isinstance(words, tuple), name, "a tuple of texts", words)
    for word in words:
        _check_text(name, word)


def _is_number(value: object) -> bool:
    return type(value) in (int, float)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {text:.80}")
    return value


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
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


def json_values(options: Any) -> dict[str, Any]:
    """Options as JSON gives them back: tuples become lists. Raises `SpecError`."""
    try:
        text = json.dumps({**options}, allow_nan=False, ensure_ascii=False)
        text.encode()  # half a surrogate pair cannot be sent
        plain: dict[str, Any] = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise SpecError(
            f"options: expected JSON values, got {shortened(options)}: {error}"
        ) from None
    for name in plain:
        _check_text("options", name)
    return plain
