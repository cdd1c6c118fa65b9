"""The checker of ranges: every kind of rule, its sentence, and the values that are kept."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from rotorgram.models.errors import InputError
from rotorgram.models.fields import (
    Limits,
    NumberOrPair,
    check,
    check_fields,
    limits_of,
    printable,
    read_table,
    rules_of,
)

REFUSALS = tomllib.loads((Path(__file__).parents[1] / "data" / "refusals.toml").read_text("utf-8"))


@dataclass(frozen=True, kw_only=True)
class Options:
    period: Annotated[float, Limits(0.5, 2.0, "s")] = 1.0
    laps: Annotated[int, Limits(1, 1 << 31, "rounds", whole=True)] = 1
    wind: Annotated[tuple[float, ...], Limits(-9, 9, "m/s", count=3)] = (0.0, 0.0, 0.0)
    share: Annotated[float | None, Limits(0.0, 1.0)] = None
    length: Annotated[float | None, Limits(0.0, 2.0, "m")] = None
    speed: Annotated[float | tuple[float, float], NumberOrPair(0, 5, "m/s")] = 1.0
    frame: Literal["body", "world"] = "body"
    name: Annotated[str, printable(5)] = "quad"
    shadows: bool = False
    scale: float = 1.0
    data: Any = None

    def __post_init__(self) -> None:
        check_fields(self)


def test_numbers_are_kept_as_pythons_own() -> None:
    given: dict[str, Any] = {
        "period": np.float32(0.5),
        "laps": 3.0,
        "wind": np.arange(3),
        "length": 1,
        "speed": [1, 2],
        "scale": 2,
    }
    kept = Options(**given)
    assert kept.period == 0.5
    assert kept.laps == 3
    assert kept.wind == (0.0, 1.0, 2.0)
    assert kept.length == 1.0
    assert kept.speed == (1.0, 2.0)
    assert kept.scale == 2.0
    for number in (kept.period, kept.wind[1], kept.length, kept.scale):
        assert type(number) is float
    assert type(kept.laps) is int
    assert Options(laps=(1 << 31) - 1).laps == (1 << 31) - 1
    assert Options(share=None).share is None


LONG = [
    ["scale", "x" * 90, f"scale: expected a number, got '{'x' * 78}…"],
    ["scale", 10**400, "scale: expected a number, got 1000"],
]


@pytest.mark.parametrize(("name", "value", "sentence"), REFUSALS["field"] + LONG)
def test_a_wrong_value_gives_one_sentence(name: str, value: Any, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        Options(**{name: value})
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        (Limits(0, above=True), "a number above 0"),
        (Limits(0, 2, "m", above=True), "a number above 0, at most 2 m"),
        (Limits(3, whole=True), "a whole number of at least 3"),
        (Limits(high=3), "a number of at most 3"),
        (Limits(unit="m"), "a number in m"),
        (Limits(0, 1, "1", count=0), "1 or more numbers from 0 to 1"),
        (Limits(0, 1, count=0, least=0), "numbers from 0 to 1"),
        (printable(8), "a text of 1 to 8 characters without control characters"),
    ],
)
def test_words(rule: Any, words: str) -> None:
    assert rule.expected == words


def test_a_number_above_a_bound_is_not_the_bound() -> None:
    rule = Limits(0, above=True)
    assert check("x", rule, 5e-324) == 5e-324
    with pytest.raises(InputError, match="above 0, got 0"):
        check("x", rule, 0)


def test_a_class_with_another_default_keeps_the_limits_of_its_base() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Faster(Options):
        period: float = 0.6
        laps: Annotated[int, Limits(1, 2, whole=True)] = 2

    assert Faster().period == 0.6
    assert limits_of(Faster)["laps"].high == 2
    with pytest.raises(InputError, match=r"^period: expected a number from 0.5 to 2 s"):
        Faster(period=3.0)
    assert "data" not in rules_of(Faster)


@dataclass(frozen=True, kw_only=True)
class Gate:
    size: Annotated[float, Limits(0, 5, "m")]
    heading: float = 0.0


def test_a_table_of_a_file() -> None:
    gate = read_table(Gate, {"size": 1}, "gate 1")
    assert gate == Gate(size=1.0)


@pytest.mark.parametrize(("table", "sentence"), REFUSALS["table"])
def test_a_wrong_table_gives_one_sentence(table: Any, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        read_table(Gate, table, "gate 1")
    assert str(caught.value) == sentence
