"""Rules of the fields of a dataclass, and the check of every range in the project.

    @immutable
    class Options:
        control_period: Annotated[float, Limits(1e-6, 1.0, "s")] = 0.02
        laps: Annotated[int, Limits(1, 1000, whole=True)] = 1
        wind: Annotated[tuple[float, ...], Limits(-100, 100, "m/s", count=3)] = (0.0, 0.0, 0.0)
        frame: Literal["body", "world"] = "body"
        shadows: bool = False

        def __post_init__(self) -> None:
            check_fields(self)

A wrong value raises `InputError`: "control_period: expected a number from 1e-06 to 1 s, got 2.0".
Imports the standard library alone.
"""

import inspect
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields
from numbers import Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    Protocol,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
)

from .errors import InputError, shortened

T = TypeVar("T")


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(field,))
def immutable(kind: type[T]) -> type[T]:
    """A frozen dataclass, whose fields are given by name."""
    return dataclass(frozen=True, kw_only=True)(kind)


class Rule(Protocol):
    """What a value may be."""

    @property
    def expected(self) -> str:
        """The rule in words, as they stand after "expected"."""

    def read(self, value: object) -> Any:
        """The value as it is kept. Raises `ValueError` or `TypeError` for a wrong one."""


@dataclass(frozen=True)
class Limits:
    """A finite number from `low` to `high`, or a tuple of `count` such numbers."""

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    """Empty or "1" for pure numbers."""
    _: KW_ONLY
    whole: bool = False
    above: bool = False
    """The number is larger than `low`."""
    count: int = 1
    """0: `least` numbers or more."""
    least: int = 1

    @property
    def expected(self) -> str:
        kind = "whole number" if self.whole else "number"
        if self.count == 1:
            numbers = f"a {kind}"
        elif self.count:
            numbers = f"{self.count} {kind}s"
        else:
            numbers = f"{self.least} or more {kind}s" if self.least else f"{kind}s"
        unit = "" if self.unit == "1" else self.unit
        if math.isinf(self.low) and math.isinf(self.high):
            unit = unit and f"in {unit}"
        return " ".join(filter(None, (numbers, self._range(), unit)))

    def _range(self) -> str:
        low = _digits(self.low)
        high = _digits(self.high)
        if math.isinf(self.low):
            return "" if math.isinf(self.high) else f"of at most {high}"
        if math.isinf(self.high):
            return f"above {low}" if self.above else f"of at least {low}"
        return f"above {low}, at most {high}" if self.above else f"from {low} to {high}"

    def read(self, value: Any) -> float | tuple[float, ...]:
        if self.count == 1:
            return self._number(value)
        numbers = tuple(map(self._number, value))
        if len(numbers) < self.least or self.count not in (0, len(numbers)):
            raise ValueError
        return numbers

    def _number(self, value: Any) -> float:
        is_real = isinstance(value, Real) and not isinstance(value, bool)
        if not is_real or not math.isfinite(value):
            raise TypeError
        if not self.low <= value <= self.high or (self.above and value == self.low):
            raise ValueError
        if not self.whole:
            return float(value)
        if value != int(value):
            raise ValueError
        return int(value)


class Direction(Limits):
    """Three numbers that are not all 0."""

    @property
    def expected(self) -> str:
        return f"{super().expected}, not all 0"

    def read(self, value: object) -> Any:
        numbers: Any = super().read(value)
        if math.hypot(*numbers) <= 1e-6:
            raise ValueError
        return numbers


PositiveInt = Annotated[int, Limits(1, whole=True)]
NonNegativeInt = Annotated[int, Limits(0, whole=True)]


class NumberOrPair(Limits):
    """A number within limits, or a pair (low, high) of them."""

    @property
    def expected(self) -> str:
        return f"{super().expected}, or a pair (low, high) with low <= high"

    def read(self, value: Any) -> float | tuple[float, ...]:
        if not isinstance(value, tuple | list):
            return self._number(value)
        low, high = map(self._number, value)
        if low > high:
            raise ValueError
        return low, high


@dataclass(frozen=True)
class Choice:
    """One of some words."""

    words: tuple[str, ...]

    @property
    def expected(self) -> str:
        return " or ".join(map(repr, self.words))

    def read(self, value: object) -> str:
        if not isinstance(value, str) or value not in self.words:
            raise ValueError
        return value


@dataclass(frozen=True)
class Text:
    """A text that a regular expression matches, or a tuple of such texts."""

    pattern: str = "(?s).*"
    expected: str = "a text"
    several: bool = False

    def read(self, value: Any) -> object:
        words = value if self.several else (value,)
        if not isinstance(words, tuple | list):
            raise TypeError
        if not all(re.fullmatch(self.pattern, word) for word in words):
            raise ValueError
        return value


def printable(longest: int, least: int = 1, *, several: bool = False) -> Text:
    """Texts of so many characters, none of which is a control or half of a surrogate pair."""
    visible = r"[^\x00-\x1f\x7f-\x9f\ud800-\udfff]"
    words = f"a text of {least} to {longest} characters without control characters"
    return Text(f"{visible}{{{least},{longest}}}", words, several)


class Flag:
    """True or false."""

    expected = "true or false"

    def read(self, value: object) -> bool:
        if type(value) is not bool:
            raise TypeError
        return value


@dataclass(frozen=True)
class OrNone:
    """None, or what another rule accepts."""

    rule: Rule

    @property
    def expected(self) -> str:
        return f"{self.rule.expected}, or none"

    def read(self, value: object) -> Any:
        return None if value is None else self.rule.read(value)


def check(name: str, rule: Rule, value: object, error: type[InputError] = InputError) -> Any:
    """A value as its rule keeps it. Raises the error with the sentence "name: expected…, got…"."""
    try:
        return rule.read(value)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{name}: expected {rule.expected}, got {shortened(value)}") from None


def check_fields(instance: object, where: str = "", error: type[InputError] = InputError) -> None:
    """Check the fields of a dataclass that have rules; keep numbers as floats, ints and tuples.

    For `__post_init__`, also of a frozen class. `where` stands before the field's name.
    """
    for name, rule in rules_of(type(instance)).items():
        set_fields(instance, **{name: check(where + name, rule, getattr(instance, name), error)})


def set_fields(instance: object, **values: object) -> None:
    """Set fields of a frozen dataclass, in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def read_table(kind: type[T], table: object, where: str) -> T:
    """An instance of a dataclass from its fields by name, as TOML and JSON have them.

    Names of fields stand behind `where` and a dot. Unknown, missing and wrong fields raise.
    """
    known = {one.name: one for one in fields(kind) if one.init}  # type: ignore[arg-type]
    values = mapping(table, where, f"values by name ({', '.join(known)})")
    check_names(values, known, where)
    for name, rule in rules_of(kind).items():
        if name in values:
            values[name] = check(f"{where}.{name}", rule, values[name])
    for name, one in known.items():
        needed = one.default is MISSING and one.default_factory is MISSING
        if needed and name not in values:
            raise InputError(f"{where}: expected {name}, got none")
    return kind(**values)


def mapping(given: object, where: str, expected: str = "a table") -> dict[str, Any]:
    """A copy of values by name. Raises `InputError`."""
    if not isinstance(given, Mapping):
        raise InputError(f"{where}: expected {expected}, got {shortened(given)}")
    return dict(given)


def check_names(table: Iterable[str], known: Iterable[str], where: str) -> None:
    """Raise `InputError` for the first name that is not known."""
    names = list(known)
    for name in table:
        if name not in names:
            raise InputError(f"{where}: expected some of {', '.join(names)}, got {shortened(name)}")


def rules_of(kind: type) -> Mapping[str, Rule]:
    """The rules of a dataclass's fields, by name.

    They are those of annotations: `Annotated` with a rule, `Literal`, and the types bool, int,
    float and str. A class that gives a field another default keeps the rule of its base.
    """
    if kind in _RULES:
        return _RULES[kind]
    rules: dict[str, Rule | None] = {}
    for base in reversed(kind.__mro__):
        for name, hint in inspect.get_annotations(base, eval_str=True).items():
            if hint not in _PLAIN or not rules.get(name):
                rules[name] = _rule_of(hint)
    _RULES[kind] = {name: rule for name, rule in rules.items() if rule is not None}
    return _RULES[kind]


_RULES: dict[type, Mapping[str, Rule]] = {}
"""What `rules_of` has found."""


def limits_of(kind: type) -> dict[str, Limits]:
    """The limits of a dataclass's numbers by name; None is no number."""
    found = {}
    for name, rule in rules_of(kind).items():
        inner = rule.rule if isinstance(rule, OrNone) else rule
        if isinstance(inner, Limits):
            found[name] = inner
    return found


_PLAIN: Mapping[object, Rule] = {
    bool: Flag(),
    int: Limits(whole=True),
    float: Limits(),
    str: Text(),
}


def _rule_of(hint: object) -> Rule | None:
    kinds = get_args(hint)
    if get_origin(hint) is Annotated:
        rule: Rule | None = next((mark for mark in kinds[1:] if hasattr(mark, "expected")), None)
        kinds = get_args(kinds[0])
    elif get_origin(hint) in (Union, UnionType):
        others = [kind for kind in kinds if kind is not NoneType]
        rule = _rule_of(others[0]) if len(others) == 1 else None
    elif get_origin(hint) is Literal and all(isinstance(word, str) for word in kinds):
        rule = Choice(kinds)
    else:
        rule = _PLAIN.get(hint)
    return OrNone(rule) if rule and NoneType in kinds else rule


def _digits(value: float) -> str:
    """Six digits; whole numbers have all of them."""
    return f"{value:d}" if isinstance(value, int) else f"{value:g}"
