"""Specs: names, shapes, dtypes, bounds, units and frames of all that crosses the wire.

A simulator sends its `EnvSpec` in Hello, and an agent builds its spaces from it: it needs neither
the env's code nor MuJoCo. This module imports the standard library and NumPy alone.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Self

import numpy as np

from ..models.errors import InputError

__all__ = ["ArraySpec", "Discrete", "EnvSpec", "Metric", "SpecError", "canonical_id"]

MAX_ELEMENTS: Final = 1 << 22
"""Most numbers of all observations of one drone."""
MAX_TOLD: Final = 1 << 14
"""Most numbers of all telemetry of one drone: each has a name in `info`."""
MAX_DIMENSIONS: Final = 16
"""Most axes of an array."""
MAX_ARRAYS: Final = 64
"""Most arrays of an observation or of the telemetry."""
MAX_AGENTS: Final = 1024
"""Most drones of one world."""
MAX_NAME: Final = 200
"""Longest name, unit or frame, characters."""

_DTYPES: Final = ("float32", "float64", "uint8", "int32", "int64")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_LARGEST: Final = float(np.finfo(np.float64).max)
_HASH: Final = re.compile(r"[0-9a-f]{32}")

Bound = float | tuple[float, ...]
"""One number for all elements, or one for each in C order. Infinite where there is no bound."""


class SpecError(InputError):
    """A spec is wrong: nothing of that kind can cross the wire."""


@dataclass(frozen=True, kw_only=True)
class ArraySpec:
    """An array of one drone. Bounds of the same value are kept as one number."""

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
            raise SpecError(
                f"{self.name}: expected a shape of whole numbers >= 1, got {shape!r:.80}"
            )
        if len(shape) > MAX_DIMENSIONS:
            raise SpecError(
                f"{self.name}: expected at most {MAX_DIMENSIONS} axes, got {len(shape)}"
            )
        if self.size > MAX_ELEMENTS:
            raise SpecError(
                f"{self.name}: expected at most {MAX_ELEMENTS} elements, got {shape!r:.80}"
            )
        if self.dtype not in _DTYPES:
            raise SpecError(
                f"{self.name}: expected a dtype of {', '.join(_DTYPES)}, got {self.dtype!r}"
            )
        for name in ("low", "high"):
            object.__setattr__(self, name, self._bound(name))
        low, high = self.bounds()
        wrong = ~((low <= high) & (low < np.inf) & (high > -np.inf))
        if wrong.any():
            first = int(wrong.argmax())
            got = f"{low.flat[first]} and {high.flat[first]}"
            raise SpecError(f"{self.name}: expected low <= high, got {got} at element {first}")
        self._check_words()

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), float64, of the array's shape."""
        pair = [np.asarray(b, np.float64) for b in (self.low, self.high)]
        low, high = (np.broadcast_to(b.reshape(self.shape) if b.ndim else b, self.shape)
                     for b in pair)  # fmt: skip
        return low, high

    def _bound(self, name: str) -> Bound:
        bound: Any = getattr(self, name)
        try:
            values = np.asarray(bound, np.float64)
        except (TypeError, ValueError, OverflowError):
            raise SpecError(
                f"{self.name}: expected numbers for {name}, got {bound!r:.80}"
            ) from None
        if values.shape not in ((), self.shape, (self.size,)) or np.isnan(values).any():
            raise SpecError(
                f"{self.name}: expected one number for {name} or one for each element, "
                f"got {bound!r:.80}"
            )
        flat = values.ravel()
        if not flat.size or (flat == flat[0]).all():
            return float(flat[0])
        return tuple(flat.tolist())

    def _check_words(self) -> None:
        units = (self.unit,) if isinstance(self.unit, str) else self.unit
        for words, name in ((units, "unit"), ((self.frame,), "frame"),
                            (self.components, "components")):  # fmt: skip
            if not isinstance(words, tuple):
                raise SpecError(f"{self.name}: expected a tuple for {name}, got {words!r:.80}")
            for word in words:
                _check_text(f"{self.name}: {name}", word)
        if not isinstance(self.unit, str) and len(self.unit) != self.size:
            raise SpecError(f"{self.name}: expected {self.size} units, got {len(self.unit)}")
        names = self.components
        if names and (len(names) != self.size or len(set(names)) < len(names) or "" in names):
            raise SpecError(
                f"{self.name}: expected {self.size} different components, got {names!r:.80}"
            )

    def to_json(self) -> dict[str, Any]:
        """A JSON object; fields that have their default are left out, infinity is null."""
        content: dict[str, Any] = {"name": self.name, "shape": list(self.shape)}
        content["dtype"] = self.dtype
        for name, none in (("low", -math.inf), ("high", math.inf)):
            bound = getattr(self, name)
            if bound != none:
                content[name] = _finite_or_null(bound)
        for name in ("unit", "frame", "components"):
            if value := getattr(self, name):
                content[name] = list(value) if isinstance(value, tuple) else value
        return content

    @classmethod
    def from_json(cls, content: Any) -> Self:
        """The reverse of `to_json`. Raises `SpecError`."""
        known = ("name", "shape", "dtype", "low", "high", "unit", "frame", "components")
        fields = _fields(content, "an array", known, required=("name", "shape"))
        for name, none in (("low", -math.inf), ("high", math.inf)):
            if name in fields:
                fields[name] = _from_null(fields[name], none)
        for name in ("shape", "unit", "components"):
            if isinstance(fields.get(name), list):
                fields[name] = tuple(fields[name])
        return cls(**fields)


@dataclass(frozen=True, kw_only=True)
class Discrete:
    """An action that is one choice out of 0 ... n - 1."""

    n: int
    name: str = "action"
    components: tuple[str, ...] = ()
    """A name for each choice, or none."""

    def __post_init__(self) -> None:
        if type(self.n) is not int or not 1 <= self.n <= 1 << 24:
            raise SpecError(f"action: expected 1 to 2^24 choices, got {self.n!r}")
        _check_text("action", self.name)
        for word in self.components:
            _check_text("action: components", word)
        if self.components and len(self.components) != self.n:
            raise SpecError(f"action: expected {self.n} components, got {self.components}")

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        content: dict[str, Any] = {"name": self.name, "choices": self.n}
        if self.components:
            content["components"] = list(self.components)
        return content

    @classmethod
    def from_json(cls, content: Any) -> Self:
        """The reverse of `to_json`. Raises `SpecError`."""
        known = ("name", "choices", "components")
        fields = _fields(content, "a discrete action", known, required=("choices",))
        components = fields.get("components", [])
        if not isinstance(components, list):
            raise SpecError(f"action: expected a list of components, got {components!r:.80}")
        return cls(n=fields["choices"], name=fields.get("name", "action"),
                   components=tuple(components))  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A measure of how well a task is done. The first metric of a task is its headline."""

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

    def to_json(self) -> dict[str, Any]:
        """A JSON object."""
        content = {"name": self.name, "unit": self.unit, "goal": self.goal}
        rest: dict[str, Any] = {"settled": self.settled, "held": self.held, "symbol": self.symbol}
        rest["signed"] = self.signed
        return content | {name: value for name, value in rest.items() if value}

    @classmethod
    def from_json(cls, content: Any) -> Self:
        """The reverse of `to_json`. Raises `SpecError`."""
        known = ("name", "unit", "goal", "settled", "held", "symbol", "signed")
        return cls(**_fields(content, "a metric", known, required=("name", "unit")))


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
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
        object.__setattr__(self, "options", _plain(dict(self.options)))
        period = self.control_period
        if not (_is_number(period) and 1e-6 <= period <= 1e3):
            raise SpecError(f"control_period: expected 1e-6 to 1e3 s, got {period!r:.80}")
        _check_text("vehicle", self.vehicle)
        if not (isinstance(self.vehicle_hash, str) and _HASH.fullmatch(self.vehicle_hash)):
            raise SpecError(f"vehicle_hash: expected 32 hex digits, got {self.vehicle_hash!r:.80}")
        for name in self.agents:
            _check_text("agents", name)
        if not 1 <= len(self.agents) <= MAX_AGENTS or len(set(self.agents)) < len(self.agents):
            raise SpecError(
                f"agents: expected 1 to {MAX_AGENTS} different names, got {self.agents!r:.80}"
            )
        if not self.observation:
            raise SpecError("observation: expected at least one array, got none")
        for name, arrays in (("observation", self.observation), ("telemetry", self.telemetry)):
            names = [array.name for array in arrays]
            if len(arrays) > MAX_ARRAYS or len(set(names)) < len(names):
                raise SpecError(f"{name}: expected at most {MAX_ARRAYS} different names")
            most = MAX_ELEMENTS if name == "observation" else MAX_TOLD
            if (size := sum(array.size for array in arrays)) > most:
                raise SpecError(f"{name}: expected at most {most} elements in all, got {size}")
        self._check_metrics()

    def _check_metrics(self) -> None:
        names = tuple(metric.name for metric in self.metrics)
        told = {a.name: a for a in self.telemetry}.get("metrics")
        if (told.components if told else ()) != names:
            raise SpecError(
                f"metrics: expected the components of the telemetry 'metrics' to be {names!r:.80}, "
                f"got {told.components if told else ()!r:.80}"
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
        content = {
            "env_id": self.env_id,
            "options": self.options,
            "control_period": self.control_period,
            "vehicle": self.vehicle,
            "vehicle_hash": self.vehicle_hash,
            "agents": list(self.agents),
            "observation": [array.to_json() for array in self.observation],
            "action": self.action.to_json(),
            "telemetry": [array.to_json() for array in self.telemetry],
            "metrics": [metric.to_json() for metric in self.metrics],
        }
        return json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The reverse of `to_json`. Raises `SpecError`, and nothing else, for any other text."""
        try:
            content = json.loads(text, parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise SpecError(f"spec: expected JSON, got {text[:80]!r}: {error}") from None
        known = ("env_id", "options", "control_period", "vehicle", "vehicle_hash", "agents",
                 "observation", "action", "telemetry", "metrics")  # fmt: skip
        required = ("env_id", "control_period", "observation", "action")
        fields = _fields(content, "a spec", known, required=required)
        for name in ("agents", "observation", "telemetry", "metrics"):
            if not isinstance(fields.get(name, []), list):
                raise SpecError(f"{name}: expected a list, got {fields[name]!r:.80}")
        if not isinstance(fields.get("options", {}), dict):
            raise SpecError(f"options: expected an object, got {fields['options']!r:.80}")
        for name in ("observation", "telemetry"):
            if len(fields.get(name, [])) > MAX_ARRAYS:
                raise SpecError(f"{name}: expected at most {MAX_ARRAYS} arrays")
            fields[name] = tuple(map(ArraySpec.from_json, fields.get(name, [])))
        fields["metrics"] = tuple(map(Metric.from_json, fields.get("metrics", [])))
        if "agents" in fields:
            fields["agents"] = tuple(fields["agents"])
        action = fields["action"]
        is_discrete = isinstance(action, dict) and "choices" in action
        fields["action"] = (Discrete if is_discrete else ArraySpec).from_json(action)
        return cls(**fields)


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


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def _finite_or_null(bound: Bound) -> Any:
    if isinstance(bound, tuple):
        return [value if math.isfinite(value) else None for value in bound]
    return bound if math.isfinite(bound) else None


def _from_null(bound: Any, none: float) -> Any:
    values = bound if isinstance(bound, list) else [bound]
    if not all(value is None or _is_number(value) for value in values):
        raise SpecError(f"bounds: expected numbers or null, got {bound!r:.80}")
    numbers = tuple(none if value is None else value for value in values)
    return numbers if isinstance(bound, list) else numbers[0]


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    """Options as JSON gives them back: tuples become lists. Raises `SpecError`."""
    try:
        text = json.dumps(options, allow_nan=False, ensure_ascii=False)
        text.encode()  # half a surrogate pair cannot be sent
        plain: dict[str, Any] = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise SpecError(f"options: expected JSON values, got {options!r:.80}: {error}") from None
    for name in plain:
        _check_text("options", name)
    return plain


def _fields(
    content: Any, what: str, known: tuple[str, ...], required: tuple[str, ...]
) -> dict[str, Any]:
    """A JSON object as keyword arguments. Names that are not known are left out."""
    if not isinstance(content, dict):
        raise SpecError(f"spec: expected an object for {what}, got {content!r:.80}")
    for name in required:
        if name not in content:
            raise SpecError(f"spec: expected {name} in {what}, got {sorted(content)!r:.80}")
    return {name: content[name] for name in known if name in content}


def _no_constant(word: str) -> Any:
    raise ValueError(f"expected finite numbers, got {word}")
