"""Options of all tasks: each is checked by its rule, in one sentence, and crosses the wire."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from contracts import TASKS, rows_of, spec_with
from rotorgram.envs import registry
from rotorgram.models.errors import InputError
from rotorgram.models.fields import Choice, Limits, NumberOrPair, OrNone, Rule, rules_of

OPTIONS = {env_id: registry.task_type(env_id).Options for env_id in TASKS}


def wrong_values(rule: Rule) -> list[Any]:
    if isinstance(rule, OrNone):
        return [value for value in wrong_values(rule.rule) if value is not None]
    if isinstance(rule, Choice):
        return ["neither", 3, ["full"]]
    if not isinstance(rule, Limits):
        return [3]
    values: list[Any] = ["57", True, None, math.nan, math.inf, 10**400, [[3.0]]]
    values += [edge for edge in (rule.low - 1, 2 * rule.high + 1) if math.isfinite(edge)]
    values += [2.5] * rule.whole
    if isinstance(rule, NumberOrPair):
        low, high = 4.0, 6.0
        values += [(high, low), (low,), (), (low, low, high), (low, "x")]
    if rule.count == 1:
        return values
    count = rule.count or 3
    return [5.0, (0.0,) * (count - 1), *((0.0,) * (count - 1) + (x,) for x in values)]


@pytest.mark.parametrize("env_id", TASKS)
def test_every_option_has_its_rule(env_id: str) -> None:
    options = OPTIONS[env_id]
    rules = rules_of(options)
    assert rules.keys() == options().to_options().keys()
    for name, rule in rules.items():
        for wrong in wrong_values(rule):
            expected = re.escape(f"{name}: expected {rule.expected}" if wrong != 3 else name)
            with pytest.raises(InputError, match=f"^{expected}") as caught:
                options(**{name: wrong})
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("env_id", TASKS)
def test_options_cross_the_wire(env_id: str) -> None:
    options = OPTIONS[env_id]()
    told = json.loads(json.dumps(options.to_options()))
    again = OPTIONS[env_id].from_options(told)
    assert again == options
    assert hash(again) == hash(options)
    with pytest.raises(
        InputError,
        match=r"^options: expected some of .*, got an unexpected keyword argument 'drag'",
    ):
        OPTIONS[env_id].from_options({"drag": 1.0})
    with pytest.raises(AttributeError):
        options.drag = 1.0  # type: ignore[attr-defined]


def test_numpy_numbers_become_python_numbers() -> None:
    options = OPTIONS["rotorgram/Hover-v0"](start_tilt=np.float32(0.5), goal=np.array([1, 2, 6]))
    assert options.to_options()["start_tilt"] == 0.5
    assert options.to_options()["goal"] == (1.0, 2.0, 6.0)
    kinds = {type(value) for value in options.to_options()["goal"]}
    assert kinds == {type(options.to_options()["start_tilt"])} == {float}


@rows_of("options that do not go together", "task, options, sentence")
def test_options_that_do_not_go_together(task: str, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        spec_with(f"rotorgram/{task}-v0", **options)
    assert "\n" not in str(caught.value)


@rows_of("extremes are allowed", "options", ids=str)
def test_extremes_are_allowed(options: dict[str, Any]) -> None:
    spec_with("rotorgram/Elevation-v0", **options)
