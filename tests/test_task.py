"""Options and arithmetic of the elevation task against values worked out by hand."""

import math
from dataclasses import FrozenInstanceError, asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.envs import ElevationConfig
from rotorgram.envs.config import action_space, observation_space
from rotorgram.envs.task import ElevationTask

# --- options ----------------------------------------------------------------------------------


def test_defaults() -> None:
    assert asdict(ElevationConfig()) == {
        "target": 5.0,
        "start_band": 1.0,
        "flight_band": 3.0,
        "episode_length": 250,
        "control_period": 0.02,
        "action_mode": "increment",
        "action_type": "continuous",
        "observation": "full",
        "thrust_scale": None,
        "linear_drag": 0.0,
    }


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"target": "5"}, "target: expected an elevation in m, or a pair .*, got '5'"),
        ({"target": "57"}, "target: expected an elevation in m, or a pair .*, got '57'"),
        ({"target": True}, "target: expected an elevation in m, or a pair .*, got True"),
        ({"target": None}, "target: expected an elevation in m, or a pair .*, got None"),
        ({"target": math.nan}, "target: expected an elevation in m, or a pair .*, got nan"),
        ({"target": 10**400}, "target: expected an elevation in m, or a pair .*, got 1000"),
        ({"target": (6.0, 4.0)}, r"target: .* low <= high, got \(6.0, 4.0\)"),
        ({"target": (4.0,)}, r"target: .* a pair \(low, high\) .*, got \(4.0,\)"),
        ({"target": ()}, r"target: .* a pair \(low, high\) .*, got \(\)"),
        ({"target": (4.0, 5.0, 6.0)}, r"target: .* a pair .*, got \(4.0, 5.0, 6.0\)"),
        ({"target": (4.0, "x")}, r"target: .* a pair .*, got \(4.0, 'x'\)"),
        ({"target": 1.9}, r"target: expected 2 m \(start_band = 1 m, and 1 m of room\) .*got 1.9"),
        ({"target": 2e6}, r"target: expected 2 m .* to 1e\+06 m, got 2000000.0"),
        ({"start_band": -0.1}, r"start_band: expected a number from 0 to 1e\+06 m, got -0.1"),
        ({"start_band": False}, r"start_band: expected a number .*, got False"),
        ({"flight_band": 1.0}, "flight_band: expected more than start_band = 1 m, got 1.0"),
        ({"flight_band": math.inf}, "flight_band: expected a number from 0 .*, got inf"),
        ({"flight_band": [3.0]}, r"flight_band: expected a number .*, got \[3.0\]"),
        ({"episode_length": 0}, "episode_length: expected a whole number .*, 1 or more, got 0"),
        ({"episode_length": 2.5}, "episode_length: expected a whole number .*, got 2.5"),
        ({"episode_length": True}, "episode_length: expected a whole number .*, got True"),
        ({"episode_length": "250"}, "episode_length: expected a whole number .*, got '250'"),
        ({"episode_length": math.inf}, "episode_length: expected a whole number .*, got inf"),
        ({"control_period": 0.0}, "control_period: expected a positive multiple .* 0.005 s, got"),
        ({"control_period": 0.012}, "control_period: expected a positive multiple .*, got 0.012"),
        ({"control_period": 1.005}, "control_period: expected a number from 0 to 1 s, got 1.005"),
        ({"action_mode": "delta"}, "action_mode: expected 'increment' or 'offset', got 'delta'"),
        ({"action_type": 3}, "action_type: expected 'continuous' or 'discrete', got 3"),
        ({"observation": ["full"]}, r"observation: expected 'full' or 'error', got \['full'\]"),
        ({"thrust_scale": 0}, "thrust_scale: expected a number above 0 and at most 100 N, or None"),
        ({"thrust_scale": 101.0}, "thrust_scale: expected .* at most 100 N, or None, got 101.0"),
        ({"thrust_scale": "5"}, "thrust_scale: expected .*, or None, got '5'"),
        ({"linear_drag": -1.0}, "linear_drag: expected a number from 0 to 100 /s, got -1.0"),
        ({"linear_drag": 101.0}, "linear_drag: expected a number from 0 to 100 /s, got 101.0"),
        ({"linear_drag": 1j}, "linear_drag: expected a number .*, got 1j"),
        ({"drag": 1.0}, "options: expected some of target, start_band, .*linear_drag, got 'drag'"),
    ],
)
def test_a_wrong_option_gives_one_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}") as caught:
        ElevationConfig.from_options(options)
    assert "\n" not in str(caught.value)


def test_numpy_numbers_become_python_numbers() -> None:
    config = ElevationConfig(
        target=np.array([4, 6])[0],
        start_band=np.float32(0.5),
        episode_length=np.int64(10),  # type: ignore[arg-type]
        linear_drag=np.float64(2.0),
    )
    assert config == ElevationConfig(target=4, start_band=0.5, episode_length=10, linear_drag=2)
    kinds = {name: type(value) for name, value in asdict(config).items()}
    assert kinds["target"] is kinds["start_band"] is kinds["linear_drag"] is float
    assert kinds["episode_length"] is int


def test_a_pair_read_from_json_is_a_tuple() -> None:
    config = ElevationConfig.from_options({"target": [3, 6.5]})
    assert config.target == (3.0, 6.5)
    assert config.target_range == (3.0, 6.5)
    assert hash(config) == hash(ElevationConfig(target=(3.0, 6.5)))


def test_extremes_are_allowed() -> None:
    assert ElevationConfig(target=2.0).target_range == (2.0, 2.0)
    assert ElevationConfig(start_band=0.0, target=1.0).start_band == 0.0
    assert ElevationConfig(control_period=0.005).substeps == 1
    assert ElevationConfig(control_period=1).substeps == 200
    assert ElevationConfig(episode_length=250.0).episode_length == 250  # type: ignore[arg-type]
    assert ElevationConfig(thrust_scale=100).newtons_per_action == 100.0


def test_options_do_not_change() -> None:
    with pytest.raises(FrozenInstanceError):
        ElevationConfig().target = 3.0  # type: ignore[misc]


def test_newtons_per_action() -> None:
    assert ElevationConfig().newtons_per_action == 5.0
    assert ElevationConfig(action_mode="offset").newtons_per_action == 20.0
    assert ElevationConfig(action_mode="offset", thrust_scale=7).newtons_per_action == 7.0


def test_bounds_by_hand() -> None:
    # 2 * 10.2 * 6 = 122.4; half a period at 10.2 m/s2: 0.102, squared 0.010404.
    # sqrt(122.410404) = 11.06392354; one period more: + 0.204.
    config = ElevationConfig()
    assert config.rate_bound == pytest.approx(11.26792354, abs=1e-8)
    assert config.error_bound == pytest.approx(3 + 0.02 * 11.26792354, abs=1e-9)
    space = observation_space(config)
    np.testing.assert_allclose(space.high, [3.2253585, 11.267928, 100 / 49 - 1], rtol=1e-6)
    np.testing.assert_allclose(space.low, [-3.2253585, -11.267928, -1.0], rtol=1e-6)


def test_float32_bounds_lie_outside_the_float64_ones() -> None:
    for band in np.linspace(1.1, 40.0, 100).tolist():
        config = ElevationConfig(flight_band=band)
        space = observation_space(config)
        assert space.dtype == np.float32
        assert float(space.high[0]) > config.error_bound
        assert float(space.high[1]) > config.rate_bound
        assert float(space.high[2]) > 51 / 49
        assert float(space.low[2]) < -1
        assert (space.low[:2] == -space.high[:2]).all()


def test_spaces() -> None:
    assert observation_space(ElevationConfig(observation="error")).shape == (1,)
    assert observation_space(ElevationConfig()).shape == (3,)
    assert repr(action_space(ElevationConfig())) == "Box(-1.0, 1.0, (1,), float32)"
    assert repr(action_space(ElevationConfig(action_type="discrete"))) == "Discrete(3)"


# --- arithmetic -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "present", "action", "thrust", "clipped"),
    [
        ("increment", 49.0, 0.0, 49.0, False),
        ("increment", 49.0, 1.0, 54.0, False),
        ("increment", 49.0, -0.5, 46.5, False),
        ("increment", 49.0, 7.0, 54.0, False),  # an action counts as 1 at most
        ("increment", 95.0, 1.0, 100.0, False),  # reaches the limit, does not exceed it
        ("increment", 96.0, 1.0, 100.0, True),
        ("increment", 5.0, -1.0, 0.0, False),
        ("increment", 4.0, -1.0, 0.0, True),
        ("offset", 90.0, 0.0, 49.0, False),  # the present thrust does not count
        ("offset", 90.0, 1.0, 69.0, False),
        ("offset", 0.0, -0.5, 39.0, False),
        ("offset", 49.0, -9.0, 29.0, False),
    ],
)
def test_thrust(mode: Any, present: float, action: float, thrust: float, clipped: bool) -> None:
    task = ElevationTask(ElevationConfig(action_mode=mode))
    assert task.thrust(action, present) == (thrust, clipped)


def test_offset_is_clipped_too() -> None:
    task = ElevationTask(ElevationConfig(action_mode="offset", thrust_scale=100.0))
    assert task.thrust(1.0, 49.0) == (100.0, True)
    assert task.thrust(-0.5, 49.0) == (0.0, True)
    assert task.thrust(0.5, 49.0) == (99.0, False)


@pytest.mark.parametrize(
    ("error", "reward"),
    [(0.0, 1.0), (0.5, 0.0), (-0.5, 0.0), (1.5, -0.5), (-1.5, -0.5), (0.125, 0.6), (2.0, -0.6)],
)
def test_reward(error: float, reward: float) -> None:
    task = ElevationTask(ElevationConfig())
    assert task.reward_terms(error, False) == (pytest.approx(reward), 0.0)
    assert task.reward_terms(error, True) == (pytest.approx(reward), -20.0)


@given(st.floats(0, 100), st.floats(0, 100))
def test_reward_falls_with_distance_and_is_bounded(a: float, b: float) -> None:
    task = ElevationTask(ElevationConfig())
    near, far = (task.reward_terms(x, False)[0] for x in sorted((a, b)))
    assert -1 < far <= near <= 1


def test_ends_by_hand() -> None:
    task = ElevationTask(ElevationConfig())
    assert not task.terminated(3.0, 1.0, False)
    assert task.terminated(math.nextafter(3.0, 4.0), 1.0, False)
    assert task.terminated(-3.1, 1.0, False)
    assert not task.terminated(0.0, 0.5, False)  # cosine of 60 degrees
    assert task.terminated(0.0, 0.499, False)
    assert task.terminated(0.0, 1.0, True)


FLOATS = st.floats(-200, 200)


@pytest.mark.parametrize("mode", ["increment", "offset"])
@given(rows=st.lists(st.tuples(FLOATS, FLOATS, FLOATS, FLOATS, st.booleans()), min_size=1))
def test_one_and_many_agree_bit_for_bit(mode: Any, rows: list[tuple[Any, ...]]) -> None:
    task = ElevationTask(ElevationConfig(action_mode=mode, thrust_scale=17.3))
    action, thrust, error, cosine, touching = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    many = [
        *task.thrust(action, thrust),
        task.terminated(error, cosine, touching),
        *task.reward_terms(error, touching),
    ]
    for i, (a, f, e, c, t) in enumerate(rows):
        one = [*task.thrust(a, f), task.terminated(e, c, t), *task.reward_terms(e, t)]
        for value, values in zip(one, many, strict=True):
            assert np.asarray(value).tobytes() == values[i].tobytes()
