"""`Forest-v0`: the wood, the ends of a flight, and what a policy sees."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv, Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.filming import Film, FilmTrack, film
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.models import InputError
from rotorgram.scenes import SceneConfig, Solids

FOREST = "rotorgram/Forest-v0"


def straight(loop: Loop, steps: int) -> None:
    """Fly at the goal."""
    scale = loop.spec.action_scale
    worlds = loop.num_envs
    loop.advance(np.zeros((worlds, 4)), np.ones(worlds, bool), list(range(worlds)))
    ended = np.zeros(worlds, bool)
    for _ in range(steps):
        seen = loop.observations["observation"]
        wanted = np.column_stack((seen[:, :3], np.zeros(worlds)))
        loop.advance(np.clip(wanted / scale, -1, 1), None, None, ended)
        ended = ended | loop.done


def test_a_config_has_the_wood_of_its_options() -> None:
    config = EnvConfig.from_keywords(FOREST, density=0.2, way=20.0)
    assert config.scene == SceneConfig(
        name="forest",
        layouts="new",
        options={"density": 0.2, "size": (24.0, 16.0), "clear": "ends"},
    )
    assert config.vehicle == ("hummingbird",)
    assert config.sensors["depth"]["rows"] == 6
    assert config.changed(density=0.05).scene.options["density"] == 0.05
    assert EnvConfig.from_keywords(**config.keywords()) == config
    assert EnvConfig.from_dict(config.to_dict()) == config
    other = EnvConfig.from_keywords(FOREST, scene="warehouse:2", vehicle="crazyflie2")
    assert other.scene.name == "warehouse"
    assert EnvConfig.from_keywords(**other.keywords()) == other
    blind = config.changed(sensors={})
    assert blind.sensors == {}
    assert EnvConfig.from_keywords(**blind.keywords()) == blind
    digests = {config.digest, other.digest, config.unseen().digest, EnvConfig(env_id=FOREST).digest}
    assert len(digests) == 4


def test_without_trees_a_straight_flight_arrives_at_the_wanted_speed() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", density=0.001, speed=4.0)
    loop = Loop(config, 8)
    straight(loop, 250)
    metrics = loop.metrics
    arrived = metrics["success"] == 1.0
    assert arrived.sum() >= 7
    assert loop.terminated.all() or loop.done.all()
    assert metrics["mean_speed"][arrived] == pytest.approx(3.8, abs=0.3)
    assert metrics["top_speed"][arrived].max() < 4.6
    assert metrics["flight_time"][arrived] == pytest.approx(7.6, abs=0.6)
    assert (metrics["least_clearance"] > 0)[arrived].all()


def test_in_a_dense_wood_it_touches() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", density=0.2)
    loop = Loop(config, 16)
    straight(loop, 250)
    touched = loop.metrics["touched"] == 1.0
    assert touched.sum() >= 14
    assert (loop.metrics["least_clearance"][touched] < 0.01).all()
    assert (loop.metrics["success"][touched] == 0).all()


def test_a_speed_of_a_pair_is_drawn() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", speed=[2.0, 6.0])
    loop = Loop(config, 32)
    straight(loop, 0)
    wanted = loop.observations["observation"][:, 14]
    assert 2.0 <= wanted.min() < 3.0
    assert 5.0 < wanted.max() <= 6.0
    assert np.hypot(*loop.observations["observation"][:, :2].T) == pytest.approx(wanted, rel=1e-4)


def test_trees_leave_room_at_start_and_goal_and_have_their_density() -> None:
    counts = []
    for seed in range(40):
        scene = EnvConfig(env_id=FOREST).scene.with_seed(seed)
        solids = Solids.of_scene(scene).standing()
        trunks = [i for i, name in enumerate(solids.names) if "trunk" in name]
        counts.append(len(trunks))
        ends = np.array([(-15.0, 0.0), (15.0, 0.0)])
        for height in (1.3, 2.2):
            points = np.column_stack((ends, [height, height]))
            assert solids.distance(points).min() > 0.99
        assert (solids.centers[trunks, :2].max(axis=0) <= (17.0, 8.0)).all()
        crowns = [i for i, name in enumerate(solids.names) if "tree" in name and i not in trunks]
        assert (solids.centers[crowns, 2] - solids.halves[crowns, 2]).min() > 3.5
    assert set(counts) == {54}  # 34 m by 16 m, 0.1 per m²


def test_policies_are_tried_in_unseen_layouts() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", episode_length=3)
    (flown,) = flown_trajectories(None, config.unseen(), [0])
    assert flown.spec.config_digest == config.unseen().digest != config.digest
    layout = int(flown.telemetry["layout"][0, 0])
    assert layout % 2 == 1
    assert flown.scene == config.scene.with_seed(layout)
    env = LocalVectorEnv(config, 4)
    _, info = env.reset(seed=3)
    assert (info["layout"] == env.loop.world.scenery.seeds).all()
    assert (info["layout"] % 2 == 0).all()
    assert len(set(info["layout"])) == 4
    env.close()


def test_a_film_has_one_wood(tmp_path: Path) -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", episode_length=3)
    first, second = flown_trajectories(None, config, [0, 1])
    tracks = [FilmTrack(name=str(i), trajectories=[one]) for i, one in enumerate((first, second))]
    expected = "scene: expected one for all flights of a picture, got forest:[0-9]+,.* and forest:"
    with pytest.raises(InputError, match=expected):
        film(tmp_path / "film.png", tracks, Film(width=64, height=48))


def test_a_picture_shows_the_wood_of_its_episode(opengl: None) -> None:
    env: Any = gym.make(FOREST, backend="rigid", render_mode="rgb_array", density=0.3)
    pictures = []
    for seed in (1, 1, 2):
        env.reset(seed=seed)
        pictures.append(env.render())
    assert (pictures[0] == pictures[1]).all()
    assert (pictures[0] != pictures[2]).mean() > 0.2
    env.close()
