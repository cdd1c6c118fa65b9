"""Specs: names, shapes, dtypes, bounds, units and frames of all that crosses the wire.

A simulator sends its `EnvSpec` in Hello, and an agent builds its spaces from it: it needs neither
the env's code nor MuJoCo. This module imports the standard library and NumPy alone.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, Final, Literal, Self

import numpy as np

from ..models.errors import InputError

__all__ = ["ArraySpec", "Discrete", "EnvSpec", "Metric", "SpecError", "canonical_id"]

MAX_ELEMENTS: Final = 1 << 22  # numbers of all observations of one drone
MAX_TOLD: Final = 1 << 14  # numbers of all its telemetry: each has a name in `info`
MAX_DIMENSIONS: Final = 16  # axes of an array
MAX_ARRAYS: Final = 64  # arrays of an observation or of the telemetry
MAX_AGENTS: Final = 1024  # drones of one world
MAX_NAME: Final = 200  # characters of a name, unit or frame

_DTYPES: Final = ("float32", "float64", "uint8", "int32", "int64")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_LARGEST: Final = float(np.finfo(np.float64).max)
_NO_BOUND: Final = {"low": -math.inf, "high": math.inf}

Bound = float | tuple[float, ...]
"""One number for all elements, or one for each in C order. Infinite where there is no bound."""


class SpecError(InputError):
    """A spec is wrong: nothing of that kind can cross the wire."""


class _Part:
    """A dataclass that is a JSON object: tuples are lists, infinity is null."""

    _optional: ClassVar[tuple[str, ...]] = ()
    """Fields that are left out where they have their default."""

    def _to_content(self) -> dict[str, Any]:
        return {
            f.metadata.get("json", f.name): _plain(value)
            for f in fields(self)  # type: ignore[arg-type]
            if (value := getattr(self, f.name)) != f.default or f.name not in self._optional
        }

    @classmethod
    def _fields(cls, content: Any) -> dict[str, Any]:
        """Keyword arguments from a JSON object; names that are not known are left out."""
        if not isinstance(content, dict):
            raise SpecError(f"spec: expected an object for {cls.__name__}, got {content!r:.80}")
        given = {}
        for f in fields(cls):  # type: ignore[arg-type]
            name = f.metadata.get("json", f.name)
            if name in content:
                value = content[name]
                given[f.name] = tuple(value) if isinstance(value, list) else value
            elif f.default is f.default_factory is MISSING:
                got = f"{sorted(content)!r:.80}"
                raise SpecError(f"spec: expected {name} in {cls.__name__}, got {got}")
        return given

    @classmethod
    def _from_content(cls, content: Any) -> Self:
        return cls(**cls._fields(content))


@dataclass(frozen=True, kw_only=True)
class ArraySpec(_Part):
    """An array of one drone. Bounds of the same value are kept as one number."""

    _optional = ("low", "high", "unit", "frame", "components")

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

    def __post_init__(self) -> None:
        _check_text("name", self.name)
        if not self.name:
            raise SpecError("name: expected a name for an array, got ''")
        shape = self.shape
        if not isinstance(shape, tuple) or not all(type(n) is int and n >= 1 for n in shape):
            self._expect("a shape of whole numbers >= 1", shape)
        if len(shape) > MAX_DIMENSIONS:
            self._expect(f"at most {MAX_DIMENSIONS} axes", len(shape))
        if self.size > MAX_ELEMENTS:
            self._expect(f"at most {MAX_ELEMENTS} elements", shape)
        if self.dtype not in _DTYPES:
            self._expect(f"a dtype of {', '.join(_DTYPES)}", self.dtype)
        for name in _NO_BOUND:
            object.__setattr__(self, name, self._bound(name))
        low, high = self.bounds()
        wrong = ~((low <= high) & (low < np.inf) & (high > -np.inf))
        if wrong.any():
            first = int(wrong.argmax())
            got = f"{low.flat[first]} and {high.flat[first]}"
            raise SpecError(f"{self.name}: expected low <= high, got {got} at element {first}")
        units, names = self.unit, self.components
        if isinstance(units, str):
            _check_text(f"{self.name}: unit", units)
        else:
            _check_words(f"{self.name}: unit", units)
            if len(units) != self.size:
                raise SpecError(f"{self.name}: expected {self.size} units, got {len(units)}")
        _check_text(f"{self.name}: frame", self.frame)
        _check_words(f"{self.name}: components", names)
        if names and (len(names) != self.size or len(set(names)) < len(names) or "" in names):
            self._expect(f"{self.size} different components", names)

    def _expect(self, expected: str, got: Any) -> None:
        raise SpecError(f"{self.name}: expected {expected}, got {got!r:.80}")

    def _bound(self, name: str) -> Bound:
        bound: Any = getattr(self, name)
        try:
            values = np.asarray(bound, np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.asarray(np.nan)
        if values.shape not in ((), self.shape, (self.size,)) or np.isnan(values).any():
            self._expect(f"one number for {name} or one for each element", bound)
        flat = values.ravel()
        return float(flat[0]) if (flat == flat[0]).all() else tuple(flat.tolist())

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), float64, of the array's shape."""
        pair = [np.asarray(bound, np.float64) for bound in (self.low, self.high)]
        low, high = (
            np.broadcast_to(b.reshape(self.shape) if b.ndim else b, self.shape) for b in pair
        )
        return low, high

    @classmethod
    def _from_content(cls, content: Any) -> Self:
        given = cls._fields(content)
        for name in _NO_BOUND.keys() & given:
            values = given[name] if isinstance(given[name], tuple) else (given[name],)
            if not all(value is None or _is_number(value) for value in values):
                raise SpecError(f"bounds: expected numbers or null, got {given[name]!r:.80}")
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
        if type(self.n) is not int or not 1 <= self.n <= 1 << 24:
            raise SpecError(f"action: expected 1 to 2^24 choices, got {self.n!r}")
        _check_text("action", self.name)
        _check_words("action: components", self.components)
        if self.components and len(self.components) != self.n:
            raise SpecError(f"action: expected {self.n} components, got {self.components}")


@dataclass(frozen=True, kw_only=True)
class Metric(_Part):
    """A measure of how well a task is done. The first metric of a task is its headline."""

    _optional = ("settled", "held", "symbol", "signed")

    name: str
    unit: str
    goal: Literal["zero", "high"] = "zero"
    """`zero`: an error, signed or not; 0 is best. `high`: larger is better."""
    settled: float | None = None
    """Size of the error below which an episode counts as settled; None if undefined."""
    held: float | None = None
    """Mean size of the error at the end of an episode below which its goal counts as held."""
    symbol: str = ""
    """Short symbol for figures and overlays, as E; empty: the name."""
    signed: bool = False
    """Whether it changes sign where it passes its best: then there is an overshoot."""

    def __post_init__(self) -> None:
        for name in ("name", "unit", "symbol"):
            _check_text(f"metric: {name}", getattr(self, name))
        if not self.name:
            raise SpecError("metric: expected a name, got ''")
        if self.goal not in ("zero", "high"):
            raise SpecError(f"{self.name}: expected the goal 'zero' or 'high', got {self.goal!r}")
        if type(self.signed) is not bool:
            raise SpecError(
                f"{self.name}: expected signed to be true or false, got {self.signed!r}"
            )
        for name in ("settled", "held"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and 0 < value <= _LARGEST):
                raise SpecError(f"{self.name}: expected {name} > 0 or None, got {value!r:.80}")


@dataclass(frozen=True, kw_only=True)
class EnvSpec(_Part):
    """Everything that an agent must know of an env. Arrays are those of one drone."""

    env_id: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Every option of the env, as JSON values."""
    control_period: float
    """Time that one step simulates, s."""
    vehicle: str = ""
    """Name of the vehicle's model."""
    vehicle_hash: str = "0" * 32
    """32 hexadecimal digits: the same model, the same hash; zeros where there is none."""
    agents: tuple[str, ...] = ("drone_0",)
    """One name for each drone of a world."""
    observation: tuple[ArraySpec, ...]
    action: ArraySpec | Discrete
    telemetry: tuple[ArraySpec, ...] = ()
    """Further arrays of a State, for logs and pictures; the last, `metrics`, has the metrics."""
    metrics: tuple[Metric, ...] = ()

    def __post_init__(self) -> None:
        _check_text("env_id", self.env_id)
        object.__setattr__(self, "options", _json_values(self.options))
        period = self.control_period
        if not (_is_number(period) and 1e-6 <= period <= 1e3):
            raise SpecError(f"control_period: expected 1e-6 to 1e3 s, got {period!r:.80}")
        _check_text("vehicle", self.vehicle)
        digits = self.vehicle_hash
        if not (isinstance(digits, str) and re.fullmatch("[0-9a-f]{32}", digits)):
            raise SpecError(f"vehicle_hash: expected 32 hex digits, got {digits!r:.80}")
        _check_words("agents", self.agents)
        if not 1 <= len(self.agents) <= MAX_AGENTS or len(set(self.agents)) < len(self.agents):
            raise SpecError(
                f"agents: expected 1 to {MAX_AGENTS} different names, got {self.agents!r:.80}"
            )
        if not self.observation:
            raise SpecError("observation: expected at least one array, got none")
        for what, most in (("observation", MAX_ELEMENTS), ("telemetry", MAX_TOLD)):
            arrays = getattr(self, what)
            if len(arrays) > MAX_ARRAYS or len({array.name for array in arrays}) < len(arrays):
                raise SpecError(f"{what}: expected at most {MAX_ARRAYS} different names")
            if (size := sum(array.size for array in arrays)) > most:
                raise SpecError(f"{what}: expected at most {most} elements in all, got {size}")
        names = tuple(metric.name for metric in self.metrics)
        told = next((a.components for a in self.telemetry if a.name == "metrics"), ())
        if told != names:
            raise SpecError(
                f"metrics: expected the components of the telemetry 'metrics' to be {names!r:.80}, "
                f"got {told!r:.80}"
            )
        listed = [name for array in self.telemetry for name in component_names(array)]
        if len(set(listed)) < len(listed):
            raise SpecError(f"telemetry: expected each component once, got {listed!r:.80}")

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
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SpecError(f"spec: expected JSON, got {text[:80]!r}: {error}") from None
        given = cls._fields(content)
        kinds: dict[str, type[_Part]] = {
            "observation": ArraySpec, "telemetry": ArraySpec, "metrics": Metric
        }  # fmt: skip
        for name in kinds.keys() & given:
            if not isinstance(given[name], tuple):
                raise SpecError(f"{name}: expected a list, got {given[name]!r:.80}")
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


def _check_text(name: str, text: Any) -> None:
    if not isinstance(text, str) or len(text) > MAX_NAME or _CONTROL.search(text):
        raise SpecError(
            f"{name}: expected a text of at most {MAX_NAME} characters without control "
            f"characters, got {text!r:.80}"
        )
    try:
        text.encode()
    except UnicodeEncodeError:
        raise SpecError(f"{name}: expected Unicode text, got {text!r:.80}") from None


def _check_words(name: str, words: Any) -> None:
    if not isinstance(words, tuple):
        raise SpecError(f"{name}: expected a tuple of texts, got {words!r:.80}")
    for word in words:
        _check_text(name, word)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def _plain(value: Any) -> Any:
    """A field's value for JSON."""
    if isinstance(value, _Part):
        return value._to_content()
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return None if value in (math.inf, -math.inf) else value


def _json_values(options: Any) -> dict[str, Any]:
    """Options as JSON gives them back: tuples become lists. Raises `SpecError`."""
    try:
        text = json.dumps(dict(options), allow_nan=False, ensure_ascii=False)
        text.encode()  # half a surrogate pair cannot be sent
        plain: dict[str, Any] = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise SpecError(f"options: expected JSON values, got {options!r:.80}: {error}") from None
    for name in plain:
        _check_text("options", name)
    return plain
