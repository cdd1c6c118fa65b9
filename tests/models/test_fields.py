"""The checker of ranges: every kind of rule, its sentence, and the values that are kept."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from rotorgram.models.errors import InputError
from rotorgram.models.fields import (
    Limits,
    NumberOrPair,
    Text,
    check,
    check_fields,
    limits_of,
    read_table,
    rules_of,
)


@dataclass(frozen=True, kw_only=True)
class Options:
    period: Annotated[float, Limits(0.5, 2.0, "s")] = 1.0
    laps: Annotated[int, Limits(1, 1 << 31, "rounds", whole=True)] = 1
    wind: Annotated[tuple[float, ...], Limits(-9, 9, "m/s", count=3)] = (0.0, 0.0, 0.0)
    share: Annotated[float | None, Limits(0.0, 1.0)] = None
    speed: Annotated[float | tuple[float, float], NumberOrPair(Limits(0, 5, "m/s"))] = 1.0
    frame: Literal["body", "world"] = "body"
    name: Annotated[str, Text(5)] = "quad"
    shadows: bool = False
    scale: float = 1.0
    data: Any = None

    def __post_init__(self) -> None:
        check_fields(self)


def test_numbers_are_kept_as_pythons_own() -> None:
    told = Options(period=np.float32(0.5), laps=3.0, wind=np.arange(3), speed=[1, 2], scale=2)  # type: ignore[arg-type]
    assert told.period == 0.5
    assert told.laps == 3
    assert told.wind == (0.0, 1.0, 2.0)
    assert told.speed == (1.0, 2.0)
    assert told.scale == 2.0
    assert [type(x) for x in (told.period, told.laps, told.wind[1], told.scale)] == [
        float,
        int,
        float,
        float,
    ]
    assert Options(laps=(1 << 31) - 1).laps == (1 << 31) - 1
    assert Options(share=None).share is None


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("period", 3, "period: expected a number from 0.5 to 2 s, got 3"),
        ("period", True, "period: expected a number from 0.5 to 2 s, got True"),
        ("period", "1", "period: expected a number from 0.5 to 2 s, got '1'"),
        ("period", float("nan"), "period: expected a number from 0.5 to 2 s, got nan"),
        ("laps", 1.5, "laps: expected a whole number from 1 to 2147483648 rounds, got 1.5"),
        ("wind", (1, 2), "wind: expected 3 numbers from -9 to 9 m/s, got (1, 2)"),
        ("wind", 1, "wind: expected 3 numbers from -9 to 9 m/s, got 1"),
        ("share", 2, "share: expected a number from 0 to 1, or none, got 2"),
        ("speed", (2, 1), "speed: expected a number from 0 to 5 m/s, or a pair (low, high) with "
                          "low <= high, got (2, 1)"),
        ("speed", (1, 2, 3), "speed: expected a number from 0 to 5 m/s, or a pair"),
        ("frame", "nose", "frame: expected 'body' or 'world', got 'nose'"),
        ("name", "", "name: expected a text of 1 to 5 printable characters, got ''"),
        ("name", "a\nb", "name: expected a text of 1 to 5 printable characters, got"),
        ("shadows", 1, "shadows: expected true or false, got 1"),
        ("scale", "x" * 90, f"scale: expected a number, got '{'x' * 78}…"),
        ("scale", 10**400, "scale: expected a number, got 1000"),
    ],
)  # fmt: skip
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
        (Limits(0, 1, "1", count=None), "1 or more numbers from 0 to 1"),
        (Limits(0, 1, count=None, least=0), "numbers from 0 to 1"),
        (Text(8, identifier=True), "up to 8 letters, digits and _"),
    ],
)
def test_words(rule: Any, words: str) -> None:
    assert rule.expected == words


def test_a_number_above_a_bound_is_not_the_bound() -> None:
    assert check("x", Limits(0, above=True), 5e-324) == 5e-324
    with pytest.raises(InputError, match="above 0, got 0"):
        check("x", Limits(0, above=True), 0)


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
    assert read_table(Gate, {"size": 1}, "gate 1") == Gate(size=1.0)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (3, "gate 1: expected values by name (size, heading), got 3"),
        ({"size": 1, "sise": 2}, "gate 1: expected some of size, heading, got 'sise'"),
        ({"heading": 1.0}, "gate 1: expected size, got none"),
        ({"size": 9}, "gate 1.size: expected a number from 0 to 5 m, got 9"),
    ],
)
def test_a_wrong_table_gives_one_sentence(table: Any, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        read_table(Gate, table, "gate 1")
    assert str(caught.value) == sentence
