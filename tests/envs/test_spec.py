"""The spec of an env: what may be said, JSON there and back, and JSON of somebody else."""

import json
import math
from typing import Any

import numpy as np
import pytest
from contracts import TABLES, on_both_tasks, rows_of, spec_with
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from rotorgram.envs.spaces import action_space, box, info_columns, observation_space
from rotorgram.envs.spec import (
    ArraySpec,
    Discrete,
    EnvSpec,
    Metric,
    SpecError,
    canonical_id,
    component_names,
)
from rotorgram.models.errors import InputError

ID = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
PICTURE = ArraySpec(name="picture", shape=(4, 5, 3), dtype="uint8", low=0, high=255)
WORDS = st.text(st.characters(exclude_categories=["Cc", "Cs"]), min_size=1, max_size=20)
NUMBERS = st.floats(-1e6, 1e6)


def spec_of(**rest: Any) -> EnvSpec:
    fields: dict[str, Any] = {
        "env_id": "my/Env-v0",
        "control_period": 0.02,
        "observation": (PICTURE,),
        "action": Discrete(choices=3),
    }
    return EnvSpec(**{**fields, **rest})


# --- what our envs say ----------------------------------------------------------------------------


def test_the_elevation_env_by_hand() -> None:
    spec = spec_with(ID, target=(4, 8))
    assert spec.env_id == ID
    assert spec.control_period == 0.02
    assert spec.agents == ("drone_0",)
    assert spec.options["target"] == [4.0, 8.0]  # as JSON gives it back
    arrays = [array.name for array in spec.telemetry]
    assert arrays == TABLES["spec: telemetry of the elevation env"]
    names = [name for array in spec.telemetry for name in component_names(array)]
    assert names == TABLES["spec: components of the elevation env"]
    types = {array.dtype for array in spec.telemetry}
    assert types == {"float64"}
    headline = Metric(
        name="elevation_error", unit="m", settled=0.05, held=0.1, symbol="E", signed=True
    )
    assert spec.headline == headline
    frames = {array.frame for array in spec.telemetry}
    assert frames == {"world", "body to world", "body", ""}
    assert spec.constants["gravity"] == 9.8
    _, most_thrust = spec.telemetry[4].bounds()
    assert most_thrust.tolist() == [100.0] * 4


def test_the_hover_env_by_hand() -> None:
    spec = spec_with(HOVER)
    assert spec.observation[0].shape == (19,)
    rotors = ("F1", "F2", "F3", "F4")
    assert spec.action == ArraySpec(
        name="action", shape=(4,), low=-1.0, high=1.0, components=rotors
    )
    metrics = [metric.name for metric in spec.metrics]
    assert metrics == ["position_error", "heading_error"]
    assert spec.telemetry[-1].unit == ("m", "deg")


@on_both_tasks
def test_json_there_and_back(env_id: str) -> None:
    spec = spec_with(env_id)
    text = spec.to_json()
    again = EnvSpec.from_json(text)
    assert again == spec
    assert again.to_json() == text
    assert len(text) < 4000


# --- any spec -------------------------------------------------------------------------------------


@st.composite
def arrays(draw: st.DrawFn) -> ArraySpec:
    shape = tuple(draw(st.lists(st.integers(1, 4), max_size=3)))
    size = math.prod(shape)
    low = draw(st.one_of(NUMBERS, st.lists(NUMBERS, min_size=size, max_size=size)))
    wide = draw(st.booleans())
    least = np.min(low)
    high = math.inf
    if not wide:
        high = np.maximum(low, least).max() + draw(st.floats(0, 10))
    dtype = draw(st.sampled_from(["float32", "float64", "uint8", "int32", "int64"]))
    unit = draw(st.one_of(WORDS, st.just(("m",) * size)))
    names = tuple(f"c{index}" for index in range(size))
    components = draw(st.sampled_from([(), names]))
    return ArraySpec(
        name=draw(WORDS),
        shape=shape,
        dtype=dtype,
        low=tuple(low) if isinstance(low, list) else low,
        high=high,
        unit=unit,
        frame=draw(WORDS),
        components=components,
    )


@st.composite
def specs(draw: st.DrawFn) -> EnvSpec:
    seen = draw(st.lists(arrays(), min_size=1, max_size=3, unique_by=lambda array: array.name))
    gates = Metric(name="gates", unit="1", goal="high")
    metrics = draw(st.sampled_from([(), (gates,)]))
    told: tuple[ArraySpec, ...] = ()
    for metric in metrics:
        names = (metric.name,)
        told = (ArraySpec(name="metrics", shape=(1,), dtype="float64", components=names),)
    options = st.dictionaries(WORDS, st.one_of(NUMBERS, WORDS, st.lists(NUMBERS)))
    agents = draw(st.lists(WORDS, min_size=1, max_size=3, unique=True))
    choices = st.builds(Discrete, choices=st.integers(1, 1 << 24))
    action = draw(st.one_of(arrays(), choices))
    return spec_of(
        options=draw(options),
        control_period=draw(st.floats(1e-6, 1e3)),
        vehicle=draw(WORDS),
        vehicle_hash="0123456789abcdef" * 2,
        agents=tuple(agents),
        observation=tuple(seen),
        action=action,
        telemetry=told,
        metrics=metrics,
    )


@settings(max_examples=60)
@given(specs())
def test_any_spec_survives_json(spec: EnvSpec) -> None:
    text = spec.to_json()
    assert EnvSpec.from_json(text) == spec


def test_bounds_of_the_same_value_are_one_number() -> None:
    high: Any = np.full((2, 3), 2.0)
    one = ArraySpec(name="a", shape=(2, 3), low=(-1.0,) * 6, high=high)
    assert one == ArraySpec(name="a", shape=(2, 3), low=-1.0, high=2.0)
    assert one.low == -1.0
    assert one.high == 2.0
    _, high = one.bounds()
    assert high.tolist() == [[2.0] * 3] * 2
    spec = spec_of(observation=(one,))
    assert '"low":-1.0' in spec.to_json()


def test_names_that_an_agent_does_not_know_are_left_out() -> None:
    content = json.loads(spec_of().to_json())
    content["wind"] = 3
    content["observation"][0]["colour"] = "RGB"
    text = json.dumps(content)
    assert EnvSpec.from_json(text) == spec_of()


def test_a_name_twice_in_an_object_is_refused() -> None:  # fault 56
    text = spec_of(options={"a": 2}).to_json()
    doubled = text.replace('"a":2', '"a":1,"a":2')
    assert doubled != text
    with pytest.raises(SpecError, match="expected each name once, got 'a' twice"):
        EnvSpec.from_json(doubled)


def test_spaces() -> None:
    speed = ArraySpec(name="speed", shape=(), high=3.0)
    several = spec_of(observation=(PICTURE, speed))
    space = observation_space(several)
    assert isinstance(space, spaces.Dict)
    assert space["picture"] == spaces.Box(0, 255, (4, 5, 3), np.uint8)
    assert space["speed"] == spaces.Box(-np.inf, 3.0, (), np.float32)
    assert observation_space(spec_of()) == space["picture"]
    assert action_space(several) == spaces.Discrete(3)
    force = ArraySpec(name="f", shape=(2,), low=(0.0, -5.0), high=(100.0, 5.0))
    low = np.array([0.0, -5.0], np.float32)
    high = np.array([100.0, 5.0], np.float32)
    pushing = spec_of(action=force)
    assert action_space(pushing) == spaces.Box(low, high)


def test_columns_of_info() -> None:
    wind = ArraySpec(name="wind", shape=(2,), dtype="float64")
    battery = ArraySpec(name="battery", shape=(1,), dtype="float64")
    spec = spec_of(telemetry=(wind, battery))
    values = {"wind": np.array([[1.0, 2.0], [3.0, 4.0]])}
    values["battery"] = np.array([[5.0], [6.0]])
    columns = info_columns(spec, values)
    assert list(columns) == ["wind[0]", "wind[1]", "battery"]
    assert columns["wind[0]"].tolist() == [1.0, 3.0]
    assert columns["wind[1]"].tolist() == [2.0, 4.0]
    assert columns["battery"].tolist() == [5.0, 6.0]


def test_the_module_of_an_id_is_no_part_of_it() -> None:
    assert canonical_id(f"rotorgram.envs:{ID}") == canonical_id(ID) == ID


# --- refusals -------------------------------------------------------------------------------------


KINDS: dict[str, Any] = {
    "ArraySpec": ArraySpec, "Discrete": Discrete, "Metric": Metric, "EnvSpec": spec_of
}  # fmt: skip


def refused(kind: str, fields: dict[str, Any], sentence: str) -> None:
    values = {}
    for name, value in fields.items():
        values[name] = tuple(value) if isinstance(value, list) else value
    with pytest.raises(SpecError, match=f"^{sentence}") as caught:
        KINDS[kind](**values)
    assert isinstance(caught.value, InputError)
    assert "\n" not in str(caught.value)


@rows_of("what makes no sense is one sentence", "kind, fields, sentence")
def test_what_makes_no_sense_is_one_sentence(
    kind: str, fields: dict[str, Any], sentence: str
) -> None:
    refused(kind, fields, sentence)


def test_parts_that_do_not_fit_together_are_refused() -> None:
    refused("EnvSpec", {"observation": [PICTURE, PICTURE]}, "observation: .* different names")
    refused("EnvSpec", {"options": {"a": object()}}, "options: expected JSON values")
    error = Metric(name="e", unit="m")
    refused("EnvSpec", {"metrics": [error]}, "metrics: expected the components")


def test_a_short_spec_cannot_ask_for_much_memory() -> None:
    """Arrays of 2^22 numbers, 64 of them, and a name for each number: gigabytes from 3 kB."""
    arrays = tuple(ArraySpec(name=f"a{i}", shape=(1 << 22,)) for i in range(2))
    with pytest.raises(SpecError, match="observation: expected at most 4194304 elements in all"):
        spec_of(observation=arrays)
    with pytest.raises(SpecError, match="telemetry: expected at most 16384 elements in all"):
        spec_of(telemetry=arrays[:1])


GOOD = json.loads(spec_with(HOVER).to_json())
SHORT = st.text(max_size=9)
PLAIN = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), SHORT)


def nested(inner: Any) -> Any:
    lists = st.lists(inner, max_size=4)
    return st.one_of(lists, st.dictionaries(SHORT, inner, max_size=4))


JSON = st.recursive(PLAIN, nested, max_leaves=12)


def _paths(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    if isinstance(content, list):
        items = enumerate(content)
    found = [path]
    for key, value in items:
        found += _paths(value, (*path, key))
    return found


PATHS = _paths(GOOD)


@settings(max_examples=300)
@given(st.sampled_from(PATHS[1:]), JSON)
def test_a_spec_of_which_one_part_is_something_else(path: tuple[Any, ...], value: Any) -> None:
    """Any part of Hover's spec put in place by anything: a spec, or one sentence."""
    content = json.loads(json.dumps(GOOD))
    *way, last = path
    place = content
    for key in way:
        place = place[key]
    place[last] = value
    try:
        spec = EnvSpec.from_json(json.dumps(content))
    except SpecError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert EnvSpec.from_json(spec.to_json()) == spec


PERIOD = '"control_period":0.02'
LONG = ["[" * 100_000, '{"a":' * 100_000, "1" * 5000]


@pytest.mark.parametrize("text", TABLES["text that is no spec"] + LONG)
def test_text_that_is_no_spec(text: str) -> None:
    with pytest.raises(SpecError):
        EnvSpec.from_json(text)


@rows_of("no control period", "period")
def test_a_control_period_and_what_follows_that_is_no_spec(period: str) -> None:
    text = spec_of().to_json()
    assert PERIOD in text
    wrong = text.replace(PERIOD, f'"control_period":{period}')
    with pytest.raises(SpecError):
        EnvSpec.from_json(wrong)


@pytest.mark.parametrize("low", [None, 0.0])
def test_whole_numbers_without_bounds_have_those_of_their_dtype(low: float | None) -> None:
    space = box(ArraySpec(name="n", shape=(1,), dtype="int64", low=low))
    limits = np.iinfo(np.int64)
    assert space.high.tolist() == [limits.max]
    assert space.low.tolist() == [limits.min if low is None else 0]
