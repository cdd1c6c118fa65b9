"""What sensors with rays read, in pictures: points where rays ended, and insets."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pictures import at, pixels
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.rendering import moments as moments_now
from rotorgram.flights.filming import Film, FilmTrack, film, moments
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.trajectories import Trajectory, flown_trajectories
from rotorgram.rendering import Canvas, Stage
from rotorgram.rendering.insets import add_insets
from rotorgram.scenes.returns import Reading
from rotorgram.sim.sensors.range_sensors import RangeSensor
from rotorgram.udp.spawn import spawn_simulator

HOVER = "rotorgram/Hover-v0"
DOWN = {"model": "vl53l5cx", "pitch": -90.0, "reach": 20.0, "share": 0.0}
WIDTH, HEIGHT = 640, 480
YELLOW, BLUE = (239, 249, 33), (12, 7, 135)  # the ends of the colours, of 255


def one_ray(distance: float, point: tuple[float, ...], origin: tuple[float, ...]) -> Reading:
    return Reading("tof", np.full((1, 1), distance), 10.0, np.array(origin), np.array([[point]]))


def test_points_are_where_rays_ended() -> None:
    """Turned to the left by a right angle, 10 cm ahead of the middle of the craft."""
    settings = {"model": "multiranger", "position": (0.1, 0.0, 0.0)}
    sensor = RangeSensor("tof", settings, 0.02, 0)
    half = np.sqrt(0.5)
    pose = np.array((1.0, 2.0, 3.0, half, 0.0, 0.0, half))
    read = sensor.reading(np.array([[2.0, 1.0, 0.5, sensor.errors.reach, 3.0]], np.float32), pose)
    np.testing.assert_allclose(read.origin, (1.0, 2.1, 3.0), atol=1e-12)
    front, back, left, right, up = read.points[0]
    np.testing.assert_allclose(front, (1.0, 4.1, 3.0), atol=1e-6)
    np.testing.assert_allclose(back, (1.0, 1.1, 3.0), atol=1e-6)
    np.testing.assert_allclose(left, (0.5, 2.1, 3.0), atol=1e-6)
    np.testing.assert_allclose(up, (1.0, 2.1, 6.0), atol=1e-6)
    assert np.isnan(right).all()  # nothing returned


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("sampling", [{}, {"rate": 10.0, "delay": 0.04}])
def test_points_of_a_flight_lie_on_the_ground(sampling: dict[str, float], late: int) -> None:
    """Also those of a reading that was taken some steps before, of a craft that moved on."""
    config = EnvConfig.from_keywords(
        HOVER,
        sensors={"tof": {**DOWN, **sampling}},
        start_tilt=20.0,
        randomize={"observation_delay": late, "mass": "uniform(0.9, 1.1)"},
    )
    (flown,) = flown_trajectories(None, config, [0])
    assert len(flown) > 10
    for moment in moments(flown):
        (read,) = moment.readings
        ended = np.isfinite(read.points[..., 2])
        assert ended.any()
        np.testing.assert_allclose(read.points[ended][:, 2], 0.0, atol=1e-4)


def test_points_of_a_live_view_lie_on_the_ground() -> None:
    config = EnvConfig.from_keywords(HOVER, sensors={"tof": DOWN}, drones=1)
    loop = Loop(config, 2)
    loop.advance(np.zeros((2, 4), np.float32), resets=~loop.done, seeds=[0, 1])
    for moment in moments_now(loop, [0, 0]):
        (read,) = moment.readings
        assert read.points.shape == (8, 8, 3)
        np.testing.assert_allclose(read.points[..., 2], 0.0, atol=1e-4)


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which pixels differ, (HEIGHT, WIDTH)."""
    different: np.ndarray = abs(before.astype(int) - after).max(axis=2) > 12
    return different


def test_a_point_is_drawn_at_its_place_and_few_rays_whole(opengl: None) -> None:
    stage = Stage("plain")
    stage.show(at(5.0))
    view = stage.camera("side")
    up, across = np.array((0.0, 0.0, 1.0)), np.array((1.0, 0.0, 0.0))
    middle = np.array(view.lookat)
    scale = HEIGHT / 2 / np.tan(np.radians(25.0)) / view.distance  # pixels per metre
    place = middle + across + 0.5 * up
    start = middle - across + 0.5 * up
    one = one_ray(9.0, tuple(place), tuple(start))
    many = one._replace(
        distances=np.full((1, 65), 9.0),
        points=np.concatenate((one.points, np.full((1, 64, 3), np.nan)), axis=1),
    )
    with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
        before = canvas.draw("side")
        stage.show(replace(at(5.0), readings=[many]))
        pointed = changed(before, canvas.draw("side"))
        stage.show(replace(at(5.0), readings=[one]))
        rayed = changed(before, canvas.draw("side"))
    row = HEIGHT / 2 - 0.5 * scale
    rows, columns = np.nonzero(pointed)
    assert abs(columns.mean() - WIDTH / 2) == pytest.approx(scale, abs=2)
    assert rows.mean() == pytest.approx(row, abs=3)
    assert np.ptp(columns) < 6
    _, along = np.nonzero(rayed)
    assert np.ptp(along) == pytest.approx(2 * scale, abs=6)


def test_a_depth_image_is_an_inset_below_its_scale() -> None:
    picture = np.zeros((360, 640, 3), np.uint8)
    distances = np.full((2, 4), 10.0)
    distances[0, 1] = 0.0
    reading = Reading("depth", distances, 10.0, np.zeros(3), np.zeros((2, 4, 3)))
    add_insets(picture, replace(at(5.0), readings=[reading]))
    side = 64  # pixels of a cell: 0.4 of 640 over 4 columns
    inset = picture[6 : 6 + 3 * side, 640 - 6 - 4 * side : 634].astype(int)
    for row, column, color in ((0, 0, YELLOW), (0, 3, BLUE), (1, 1, YELLOW), (1, 0, BLUE)):
        cell = inset[row * side : (row + 1) * side, column * side : (column + 1) * side]
        assert (abs(cell - color) < 3).all()
    outside = picture.copy()
    outside[6 : 6 + 3 * side, 640 - 6 - 4 * side : 634] = 0
    assert not outside.any()


def test_a_lidar_has_a_row_for_each_ring() -> None:
    picture = np.zeros((360, 640, 3), np.uint8)
    distances = np.full((3, 32), 10.0)
    distances[1, 20] = 0.0
    reading = Reading("lidar", distances, 10.0, np.zeros(3), np.zeros((3, 32, 3)))
    add_insets(picture, replace(at(5.0), readings=[reading]))
    side = 8  # pixels of a cell: 0.4 of 640 over 32 columns
    inset = picture[6 : 6 + 4 * side, 640 - 6 - 32 * side : 634].astype(int)
    yellow = (abs(inset - YELLOW) < 3).all(axis=2)[side::side, ::side]
    assert np.argwhere(yellow).tolist() == [[1, 20]]


@pytest.fixture(scope="module")
def flown() -> Trajectory:
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid", episode_length=4)
    (found,) = flown_trajectories(None, config, [0])
    return found


def filmed(flown: Trajectory, out: Path, *, overlay: bool = False) -> np.ndarray:
    config = Film(width=320, height=240, fast=True, overlay=overlay, vehicle="hummingbird")
    film(out, [FilmTrack(name="", trajectories=[flown])], config)
    return pixels(out)


def test_a_film_shows_readings_and_without_them_is_as_of_a_craft_that_has_no_sensor(
    flown: Trajectory, opengl: None, tmp_path: Path
) -> None:
    assert flown.observations["depth"].shape == (len(flown) + 1, 6, 32)
    blind = replace(flown, observations={})
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid", sensors={})
    bare = replace(blind, spec=env_spec(config))
    with_rays = filmed(flown, tmp_path / "rays.png")
    without = filmed(blind, tmp_path / "blind.png")
    np.testing.assert_array_equal(without, filmed(bare, tmp_path / "bare.png"))
    different = changed(without, with_rays)
    assert different[6 : 6 + 7 * 4, 320 - 6 - 32 * 4 : 314].mean() > 0.9  # the inset
    assert different[40:].any()  # points in the scene


class Watching:
    """Flies level, and keeps the depth images that it gets."""

    seen: ClassVar[list[np.ndarray]] = []

    def reset(self) -> None:
        self.seen.clear()

    def act(self, observation: Any) -> np.ndarray:
        self.seen.append(observation["depth"])
        return np.zeros(4, np.float32)


def test_a_flight_has_the_readings_that_its_policy_got() -> None:
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid", episode_length=4)
    (found,) = flown_trajectories(Watching(), config, [0])
    assert len(Watching.seen) == len(found) == 4
    np.testing.assert_array_equal(found.observations["depth"][:-1], Watching.seen)
    assert list(found.observations) == ["depth"]
    (without,) = flown_trajectories(Watching(), config, [0], observations=())
    assert without.observations == {}


def test_a_journal_gives_the_observations_that_are_wanted(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    path = tmp_path / "forest.mcap"
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid")
    with spawn_simulator(config, record=path) as env:
        seen = [env.reset(seed=1)[0]["depth"]]
        for _ in range(3):
            seen.append(env.step(np.zeros(4, np.float32))[0]["depth"])
    (plain,) = recorded_trajectories(path)
    assert plain.observations == {}
    assert plain.readings(0) == []
    (wanted,) = recorded_trajectories(path, observations=("depth", "lidar"))
    np.testing.assert_array_equal(wanted.observations["depth"], seen)
    np.testing.assert_array_equal(wanted.readings(2)[0].distances, seen[2])
    assert list(wanted.observations) == ["depth"]


def test_insets_stop_at_the_lower_edge_of_a_small_picture() -> None:
    loop = Loop(
        EnvConfig.from_keywords(
            "rotorgram/Forest-v0", backend="rigid", sensors={"lidar": True, "tof": True}
        )
    )
    loop.advance(np.zeros((1, 4), np.float32), np.ones(1, bool), [0])
    (moment,) = moments_now(loop, [0])
    for size in ((16, 16), (64, 64), (90, 160)):
        picture = np.zeros((*size, 3), np.uint8)
        add_insets(picture, moment)
        assert picture.any()
