"""Starts and alternatives that are drawn, what a critic sees of them, and perturbed envs."""

from math import cos, radians
from typing import Any

import numpy as np
import pytest
from rotorgram.agents.presets import find_preset, usual_preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.perturbations import PERTURBATIONS, for_training, perturbed, together
from rotorgram.models import InputError
from rotorgram.sim import Randomization
from rotorgram.training.settings import Row

HOVER = "rotorgram/Hover-v0"
STILL = {"start_band": 0.0, "start_tilt": 0.0, "start_heading": 0.0}
BACKENDS: list[dict[str, Any]] = [
    {"backend": "rigid"},
    {"backend": "rigid", "compiled": False},
    {"backend": "mujoco"},
]


def env_of(count: int = 64, **options: Any) -> LocalVectorEnv:
    options = {"vehicle": "hummingbird", "backend": "rigid", **options}
    env = LocalVectorEnv(HOVER, count, autoreset_mode="Disabled", **options)
    env.reset(seed=3)
    return env


@pytest.mark.parametrize("backend", BACKENDS)
def test_starts_are_moved_tilted_pushed_and_spun(backend: dict[str, Any]) -> None:
    drawn = {
        "start_x": 1.5, "start_z": -0.5, "start_tilt": 60, "start_axis": 90, "start_vy": 2,
        "start_wz": "uniform(3, 4)",
    }  # fmt: skip
    state = env_of(**STILL, **backend, randomize=drawn).loop.world.state
    np.testing.assert_allclose(state.position[:, 0], [[1.5, 0.0, 4.5]] * 64, atol=1e-6)
    np.testing.assert_allclose(state.velocity[:, 0], [[0.0, 2.0, 0.0]] * 64, atol=1e-6)
    # About y: the nose goes down, as of the half angle of 60°.
    quaternion = [cos(radians(30)), 0.0, 0.5, 0.0]
    np.testing.assert_allclose(state.quaternion[:, 0], [quaternion] * 64, atol=1e-6)
    spin = np.asarray(state.body_rates[:, 0, 2])
    assert 3.0 <= spin.min() < 3.2
    assert 3.8 < spin.max() <= 4.0


@pytest.mark.parametrize(
    ("drawn", "ends"),
    [
        ({"start_tilt": 0, "start_wx": 30}, True),  # it turns past 90°
        ({"start_tilt": 90}, False),
        ({"start_tilt": 180}, False),
    ],
)
def test_a_task_lets_a_craft_tilt_as_much_further_as_it_begins(
    drawn: dict[str, float], ends: bool
) -> None:
    env = env_of(**STILL, randomize=drawn)
    for _ in range(10):
        env.advance(np.zeros((64, 4), np.float32), frozen=env.done)
    assert (env.done == ends).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_episode_has_one_place_of_all_alternatives(backend: dict[str, Any]) -> None:
    drawn = {
        "mass": "1 | uniform(0.5, 0.6) | 2",
        "inertia": "1|loguniform(2, 4)|3",
        "reaction": 0.5,
        "action_delay": "0 | uniform(1, 2) | 3",
    }
    parameters = env_of(512, **backend, randomize=drawn).loop.world.parameters
    found = {name: np.asarray(values)[:, 0] for name, values in parameters.items()}
    case = found["case"]
    assert [140 < (case == number).sum() < 200 for number in range(3)] == [True] * 3
    assert set(found["mass"][case == 0]) == {1.0}
    assert set(found["inertia"][case == 2]) == {3.0}
    middle = found["mass"][case == 1]
    assert 0.5 <= middle.min() < 0.51 < 0.59 < middle.max() <= 0.6
    # The mean of 2 · 2^u with u from 0 to 1 is 2 / ln 2.
    assert found["inertia"][case == 1].mean() == pytest.approx(2 / np.log(2), abs=0.15)
    assert set(found["action_delay"][case == 1]) == {1.0, 2.0}
    assert set(found["action_delay"][case == 2]) == {3.0}
    assert set(found["reaction"]) == {0.5}


def test_alternatives_do_not_move_other_numbers_and_are_alike_in_a_world() -> None:
    drawn = {"mass": "1 | uniform(0.5, 1.5)"}
    env = LocalVectorEnv("rotorgram/Formation-v0", 32, drones=4, backend="rigid", randomize=drawn)
    env.reset(seed=1)
    case = np.asarray(env.loop.world.parameters["case"])
    assert (case == case[:, :1]).all()
    assert 0 < case[:, 0].sum() < 8
    plain = [env_of(randomize=drawn).observations, env_of().observations]
    np.testing.assert_array_equal(*plain)


@pytest.mark.parametrize(
    ("sentence", "drawn"),
    [
        ("as many alternatives of each, got 2 and 3", {"mass": "1|2", "inertia": "1|2|3"}),
        ("mass: expected uniform", {"mass": "1 || 2"}),
        ("mass: expected uniform", {"mass": "1 | 20"}),
    ],
)
def test_wrong_alternatives(sentence: str, drawn: dict[str, str]) -> None:
    with pytest.raises(InputError, match=sentence):
        Randomization(drawn, None)


def test_alternatives_have_a_canonical_text() -> None:
    drawn = Randomization({"mass": "1|uniform( .5,1.50 )", "inertia": "2"}, None)
    assert drawn.to_options() == {"mass": "1 | uniform(0.5, 1.5)", "inertia": 2.0}
    assert Randomization(drawn.to_options(), None).to_options() == drawn.to_options()
    delayed = Randomization({"action_delay": "0 | uniform(1, 4) | 2"}, None)
    assert delayed.most_steps("action_delay") == 4


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_critic_sees_what_is_drawn_between_its_ends(backend: dict[str, Any]) -> None:
    drawn = {"mass": "uniform(0.5, 1.5)", "start_x": "1 | uniform(-3, 1)", "inertia": 2}
    env = env_of(**backend, randomize=drawn, observe_drawn=True, history=2)
    array = env.env_spec.observation[-1]
    assert (array.name, array.privileged, array.shape) == ("drawn", True, (4,))
    assert array.components == ("mass", "inertia", "start_x", "case")
    seen = env.observations["drawn"]
    parameters = env.loop.world.parameters
    np.testing.assert_allclose(seen[:, 0], 2 * (parameters["mass"][:, 0] - 1), atol=1e-6)
    np.testing.assert_allclose(seen[:, 2], (parameters["start_x"][:, 0] + 1) / 2, atol=1e-6)
    np.testing.assert_allclose(seen[:, 3], 2 * parameters["case"][:, 0] - 1, atol=1e-6)
    assert set(seen[:, 1]) == {-1.0}
    with pytest.raises(InputError, match="observe_drawn: expected something in randomize"):
        env_of(observe_drawn=True)


def test_every_perturbation_is_an_env_of_its_size() -> None:
    config = EnvConfig.from_keywords(HOVER, vehicle="crazyflie2", backend="rigid")
    for name, table in PERTURBATIONS.items():
        if name == "obstacles":
            continue
        assert len(table["sizes"]) in (1, 3), name
        changed, drawn = perturbed(config, name, table["sizes"][-1])
        together_drawn = Randomization(changed.randomize | drawn, changed.effects)
        assert together_drawn.names or changed != config, name
    wind, drawn = perturbed(config, "wind", 5)
    assert (wind.effects.body_drag, drawn) == (True, {"wind_x": 5.0})
    _, drawn = perturbed(config, "lag", 50)
    assert drawn == {"time_constant": pytest.approx(0.05 / 0.072)}
    kicked, _ = perturbed(config, "kick", 2)
    assert kicked.events[0]["impulse"] == (0.054, 0.0, 0.0)
    assert kicked.events[0]["at"] == 2.5
    assert perturbed(config, "start", 1)[0].task["flight_band"] == 9.0
    with pytest.raises(InputError, match="expected a task with density, it has none"):
        perturbed(config, "obstacles", 10)
    forest = EnvConfig.from_keywords("rotorgram/Forest-v0")
    own = forest.scene.values.density
    denser = perturbed(forest, "obstacles", 50)[0].scene.values.density
    assert denser == pytest.approx(1.5 * own)


def test_a_training_draws_what_its_vehicle_has_and_says_what_not() -> None:
    config = EnvConfig.from_keywords(HOVER, backend="rigid", randomize={"mass": 1.1})
    sizes = {"lighter": 20, "lag": 50, "action_delay": 20, "rotor": 10}
    env, refused = for_training(config, sizes)
    drawn = {"action_delay": "uniform(0, 1)", "thrust_1": "uniform(0.9, 1.1)"}
    assert env.randomize == {"mass": 1.1, **drawn}
    assert list(refused) == ["lag"]
    assert "rotors.time_constant" in refused["lag"]
    _, drawn, refused = together(config.changed(vehicle="crazyflie2"), sizes)
    assert not refused
    assert drawn["mass"] == "uniform(0.8, 1.2)"
    assert drawn["thrust_1"] == "uniform(0.9, 1.1)"
    assert drawn["time_constant"].startswith("loguniform(0.69")


def test_the_robust_preset_is_that_of_a_flight_task_and_of_a_row() -> None:
    assert usual_preset("ppo", HOVER) == "robust"
    assert usual_preset("ppo", "rotorgram/Elevation-v0") == "tuned"
    assert usual_preset("a2c", HOVER) == "tuned"
    found = find_preset("ppo", "robust", HOVER)
    assert set(found.perturbations) <= set(PERTURBATIONS)
    with pytest.raises(InputError, match=f"preset: expected robust for {HOVER}, got .*Tracking-v0"):
        find_preset("ppo", "robust", "rotorgram/Tracking-v0")
    row = Row(agent="ppo", preset="robust", env=EnvConfig(env_id=HOVER, vehicle=("crazyflie2",)))
    trained = row.run(0).env
    assert trained.randomize.keys() >= {"mass", "start_x", "time_constant"}
    assert row.env.randomize == {}
