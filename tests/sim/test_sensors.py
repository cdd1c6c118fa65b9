"""Sensors and the onboard estimate against closed forms, and as a part of every env."""

import csv
import json
from collections.abc import Mapping
from math import atan2, exp, hypot, log, sin, sqrt
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rotorgram.agents import PID
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim import EffectOptions, World, make_world
from rotorgram.sim.sensors import Estimator, Sensors, checked_sensors
from rotorgram.sim.sensors.barometer import isa_height, isa_pressure
from tables import SIM
from worlds import EVERY, alone, begin

approx = pytest.approx
ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
PERIOD = 0.02
LEVEL = (1.0, 0.0, 0.0, 0.0)
LEFT = (sqrt(0.5), 0.0, 0.0, sqrt(0.5))
IMU = {"gyro_noise": 0.0, "accelerometer_noise": 0.0}
GPS = {"noise": 0.0, "vertical_noise": 0.0, "velocity_noise": 0.0}
NOISY = SIM["noisy"]


def sensing(
    sensors: Mapping[str, Any], worlds: int = 1, file: Path | None = None, **pose: Any
) -> tuple[World, Sensors, Any]:
    """A world that has just begun at a pose, its sensors, and the mask of all its drones."""
    world = make_world(Vehicle.load(file), worlds, num_threads=1)
    every = np.ones(world.shape, bool)
    start = {"position": (0.0, 0.0, 5.0), **pose}
    made = Sensors(checked_sensors(sensors), world, PERIOD)
    world.random.seed(every, [100 + i for i in range(worlds)])
    begin(world, **start)
    made.begin(every)
    return world, made, every


def edited(folder: Path, old: str, new: str) -> Path:
    """A file of the paper's craft with another text in a place."""
    file = folder / "edited.xml"
    file.write_text(Vehicle.load().path.read_text().replace(old, new, 1))
    return file


def first(name: str, settings: Mapping[str, Any], **rest: Any) -> list[float]:
    """First reading of a sensor of a single drone."""
    return sensing({name: settings}, **rest)[1].readings[name][0, 0].tolist()


def readings(name: str, settings: Mapping[str, Any], worlds: int, **pose: Any) -> np.ndarray:
    """First readings of a sensor of so many drones, shape (worlds, k)."""
    _, sensors, _ = sensing({name: settings}, worlds, **pose)
    return np.array(sensors.readings[name][:, 0])


# --- what each measures ---------------------------------------------------------------------------


EXACT: dict[str, Any] = {
    "imu": IMU,
    "gps": GPS,
    "motion_capture": {"noise": 0.0, "angle_noise": 0.0},
    "rangefinder": {"noise": 0.0, "limit": 8.0},
    "barometer": {"noise": 0.0},
    "magnetometer": {"noise": 0.0},
}


@pytest.mark.parametrize(("name", "settings", "pose", "expected"), SIM["reads"]["rows"])
def test_first_readings(
    name: str, settings: dict[str, Any], pose: dict[str, Any], expected: list[float]
) -> None:
    reading = first(name, EXACT[name] | settings, **pose)
    assert reading == approx(expected, abs=1e-9)


def test_imu_of_a_craft_that_stands() -> None:
    world, sensors, every = sensing({"imu": IMU}, position=(0.0, 0.0, 0.4), thrust=[0.0] * 4)
    for _ in range(100):  # until it has come to rest
        world.step(np.zeros(4), 2)
    sensors.sample(every, 1)
    expected = (0, 0, 0, 0, 0, 9.8)
    assert sensors.readings["imu"][0, 0] == approx(expected, abs=1e-3)


def test_imu_at_the_end_of_a_step() -> None:
    """A tumbling craft: the force is that of the last thrusts, in the body's axes of the end."""
    world, sensors, every = sensing({"imu": IMU}, body_rates=(1.0, 2.0, 0.5))
    world.step(np.array((60.0, 50.0, 40.0, 30.0)), 2)
    sensors.sample(every, 1)
    reading = sensors.readings["imu"][0, 0]
    expected = (0.0, 0.0, 180.0 / 20.0)
    assert reading[3:] == approx(expected, abs=1e-9)
    assert_array_equal(reading[:3], alone(world).body_rates)


def test_imu_off_the_center_of_mass(tmp_path: Path) -> None:
    """The hub, 12 of 20 kg, 5 cm ahead: the center 3 cm ahead. Turning at 2 rad/s, the origin is
    drawn towards it by ω² r = 0.12 m/s²."""
    file = edited(tmp_path, 'size="0.22 0.22 0.07"', 'size="0.22 0.22 0.07" pos="0.05 0 0"')
    reading = first("imu", IMU, file=file, body_rates=(0.0, 0.0, 2.0))
    expected = (0, 0, 2.0, 0.12, 0, 9.8)
    assert reading == approx(expected, abs=1e-9)


def test_imu_feels_the_air(tmp_path: Path) -> None:
    """Drag of 2 N s/m in a wind of 5 m/s from behind: 10 N on 20 kg, as long as it stands still."""
    drag = '<custom><numeric name="rotorgram/drag.linear" data="2 2 2"/></custom>'
    vehicle = Vehicle.load(edited(tmp_path, "<worldbody>", f"{drag}<worldbody>"))
    world = make_world(vehicle, 1, effects=EffectOptions(body_drag=True, wind=(5.0, 0.0, 0.0)))
    sensors = Sensors(checked_sensors({"imu": IMU}), world, PERIOD)
    begin(world, position=(0.0, 0.0, 5.0))
    sensors.begin(EVERY)
    world.step(vehicle.hover_thrust, 1)
    sensors.sample(EVERY, 1)
    expected = (0.5, 0.0, 9.8)
    found = sensors.readings["imu"][0, 0, 3:]
    assert found == approx(expected, abs=1e-3)


def test_imu_within_its_range() -> None:
    settings = IMU | {"gyro_range": 2.0, "accelerometer_range": 5.0}
    found = first("imu", settings, body_rates=(3.0, -3.0, 0.0))
    assert found == [2.0, -2.0, 0.0, 0.0, 0.0, 5.0]
    observed = env_spec(EnvConfig.from_keywords(HOVER, sensors={"imu": settings})).observation[1]
    assert observed.high == (2.0, 2.0, 2.0, 5.0, 5.0, 5.0)


def test_imu_bias() -> None:
    """Drawn for each axis of each drone when an episode begins, and kept."""
    settings = IMU | {"gyro_bias": 0.1, "accelerometer_bias": 0.02}
    _, sensors, every = sensing({"imu": settings}, 3000)
    bias, force = np.split(sensors.readings["imu"].reshape(-1, 6), 2, axis=1)
    off = force[:, 2] - 9.8
    assert bias.std() == approx(0.1, abs=4 * 0.1 / sqrt(2 * 9000))
    assert off.std() == approx(0.02, abs=4 * 0.02 / sqrt(2 * 3000))
    assert abs(bias.mean()) < 4 * 0.1 / sqrt(9000)
    sensors.sample(every, 1)
    found = sensors.readings["imu"][:, 0, :3]
    assert_allclose(found, bias, atol=1e-15)
    some = np.arange(3000)[:, None] < 10
    sensors.begin(some)
    drawn = sensors.readings["imu"][:, 0, :3]
    assert_array_equal(drawn[10:], bias[10:])
    assert (drawn[:10] != bias[:10]).all()


def test_the_standard_atmosphere() -> None:
    """ISO 2533:1975, at geopotential heights."""
    heights = np.array((-1000.0, 0.0, 1000.0, 5000.0, 11e3))
    pressures = (113_929.0, 101_325.0, 89_874.6, 54_019.9, 22_632.0)
    assert isa_pressure(heights) == approx(pressures, rel=5e-6)
    assert isa_height(isa_pressure(heights)) == approx(heights, abs=1e-8)


def test_noise_of_the_barometer() -> None:
    # At sea level a pascal is 1 / (1.225 kg/m³ · 9.80665 m/s²) = 83.24 mm.
    off = readings("barometer", {"noise": 2.0}, 4000, position=(0.0, 0.0, 0.4)) - 0.4
    assert off.std() == approx(2 * 0.08324, abs=4 * 0.1665 / sqrt(8000))


def test_barometer_walks() -> None:
    """K √t after a time t: 0.5 Pa/s/√Hz for 4 s are 1 Pa."""
    _, sensors, every = sensing({"barometer": {"noise": 0.0, "walk": 0.5}}, 2000)
    found = sensors.readings["barometer"].ravel()
    assert found == approx([5.0] * 2000)
    for _ in range(200):
        sensors.sample(every, 1)
    pressure = isa_pressure(sensors.readings["barometer"].ravel()) - isa_pressure(5.0)
    # The bias of a reading is that before its own step of the walk.
    expected = 0.5 * sqrt(200 * PERIOD)
    assert pressure.std() == approx(expected, abs=4 * expected / sqrt(4000))


def test_noise_of_the_magnetometer() -> None:
    settings = {"noise": 0.3, "field": [0, 0, 0]}
    noise = readings("magnetometer", settings, 2000)
    assert noise.std() == approx(0.3, abs=4 * 0.3 / sqrt(12_000))


def test_rangefinder_sees_what_stands_in_a_vehicles_file(tmp_path: Path) -> None:
    table = '<geom type="box" size="0.1 0.1 0.5" pos="7 0 0.5"/>'
    file = edited(tmp_path, "<worldbody>", f"<worldbody>{table}")
    settings = EXACT["rangefinder"]
    for x, expected in ((0.0, 3.0), (7.0, 2.0)):
        reading = first("rangefinder", settings, file=file, position=(x, 0.0, 3.0))
        assert reading == approx([expected], abs=1e-9)


def test_rangefinder_looks_past_what_is_fixed_to_the_craft(tmp_path: Path) -> None:
    leg = '<body pos="0 0 -0.3"><geom type="box" size="0.1 0.1 0.1" mass="0"/></body>'
    file = edited(tmp_path, "<freejoint", f"{leg}<freejoint")
    found = first("rangefinder", EXACT["rangefinder"], file=file)
    assert found == approx([5.0])


def test_gps_and_motion_capture() -> None:
    pose = {"position": (1.0, -2.0, 3.0), "velocity": (4.0, 5.0, -6.0), "quaternion": LEFT}
    assert first("gps", GPS, **pose) == [1.0, -2.0, 3.0, 4.0, 5.0, -6.0]
    noisy = {"noise": 2.0, "vertical_noise": 3.0, "velocity_noise": 0.5}
    deviation = readings("gps", noisy, 4000, **pose).std(axis=0)
    expected = (2, 2, 3, 0.5, 0.5, 0.5)
    assert_allclose(deviation, expected, rtol=4 / sqrt(8000))
    turned = {"noise": 0.0, "angle_noise": 0.02}
    quaternion = readings("motion_capture", turned, 4000, **pose)[:, 3:]
    assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-12)
    # The mean square of a rotation about three axes of σ is 3 σ².
    angle = 2 * np.arccos(np.clip(np.abs(quaternion @ LEFT), 0, 1))
    found = sqrt((angle**2).mean() / 3)
    assert found == approx(0.02, rel=4 / sqrt(24_000))


# --- the gyroscope's noise ------------------------------------------------------------------------


def allan_deviation(rates: np.ndarray, m: int) -> float:
    """Overlapping Allan deviation over m samples, of the series (n, series) together.

    IEEE Std 952-1997, annex C.1: half the mean square of what two averages side by side differ.
    """
    angle = np.concatenate((np.zeros((1, rates.shape[1])), rates.cumsum(axis=0)))
    second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
    return sqrt(0.5 * np.mean((second / m) ** 2))


def freedom(n: int, m: int) -> float:
    """Least degrees of freedom of that estimator: white and random walk frequency noise, whichever
    has fewer (NIST SP 1065, table 5)."""
    white = (1.5 * (n - 1) / m - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)
    walk = (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / (n - 3) ** 2
    return min(white, walk)


@pytest.mark.parametrize("rate", [50.0, 25.0])
def test_allan_deviation_of_the_gyroscope(rate: float) -> None:
    """N / √τ at short, K √(τ / 3) at long times: the numbers that the datasheet gives."""
    density = 1e-3
    walk = 3e-3
    samples = 6000
    worlds = 16
    settings = IMU | {"gyro_noise": density, "gyro_walk": walk, "rate": rate}
    _, sensors, every = sensing({"imu": settings}, worlds)
    interval = 1 / rate
    series = []
    every_th = round(interval / PERIOD)
    for sample in range(samples):
        for step in range(1, every_th + 1):
            sensors.sample(every, sample * every_th + step)
        series.append(sensors.readings["imu"][:, 0, :3].ravel())
    rates = np.array(series)
    found = {}
    for m in (1, 2, 4, 16, 64, 256, 1024):
        time = m * interval
        expected = sqrt(density**2 / time + walk**2 * time / 3)
        found[m] = allan_deviation(rates, m)
        # Of a χ² with f degrees of freedom, the relative error of the square root: √(1 / 2f).
        error = sqrt(0.5 / (freedom(samples, m) * rates.shape[1]))
        assert found[m] == approx(expected, rel=4 * error), m
    assert found[1] == approx(density / sqrt(interval), rel=0.02)
    assert found[1024] == approx(walk * sqrt(1024 * interval / 3), rel=0.2)


@pytest.mark.parametrize("backend", ["mujoco", "rigid"])
def test_voltage_of_the_battery(backend: str) -> None:
    """That of the terminals: it drops under load, and is noisy as it is told."""
    keywords = {"vehicle": "heavy_hexa", "effects": {"battery": True}, "backend": backend}
    sensors: dict[str, Any] = {"battery": {"rate": 25.0}}
    loop = Loop(EnvConfig.from_keywords(HOVER, sensors=sensors, **keywords), 200)
    noisy = Loop(
        EnvConfig.from_keywords(HOVER, sensors={"battery": {"noise": 0.1}}, **keywords), 200
    )
    every = np.ones(200, bool)
    actions = np.full((200, 6), 0.2, np.float32)
    for one in (loop, noisy):
        one.advance(actions, every, range(200))
    told = [loop.observations["battery"].copy()]
    exact = [loop.telemetry["battery"][:, 1:].copy()]
    for _ in range(4):
        for one in (loop, noisy):
            one.advance(actions)
        told.append(loop.observations["battery"].copy())
        exact.append(loop.telemetry["battery"][:, 1:].copy())
    for step, read in enumerate((0, 0, 2, 2, 4)):
        assert_array_equal(told[step], exact[read].astype(np.float32))
    assert (exact[4] < exact[1]).all()
    off = noisy.observations["battery"] - noisy.telemetry["battery"][:, 1:]
    assert off.std() == approx(0.1, abs=4 * 0.1 / sqrt(400))


def test_a_voltage_needs_a_battery() -> None:
    sentence = r"^sensors\.battery: expected the effect battery, got none$"
    with pytest.raises(InputError, match=sentence):
        EnvConfig.from_keywords(HOVER, sensors={"battery": True})


# --- rate, delay and dropout ----------------------------------------------------------------------


@pytest.mark.parametrize("worlds", [1, 2])
def test_a_delay_is_exact_and_a_rate_holds(worlds: int) -> None:
    """Read every 5th step and told 3 steps later; the first reading until then."""
    settings = GPS | {"rate": 10.0, "delay": 0.06}
    world, sensors, every = sensing({"gps": settings}, worlds, velocity=(1.0, 2.0, 3.0))
    flown = [world.state.position.copy()]
    told = [sensors.readings["gps"][..., :3]]
    for step in range(1, 21):
        world.step(np.full((*world.shape, 4), 60.0), 2)
        sensors.sample(every, step)
        flown.append(world.state.position.copy())
        told.append(sensors.readings["gps"][..., :3])
    of_step = [0, 0, 0, 0, 0, 0, 0, 0, 5, 5, 5, 5, 5, 10, 10, 10, 10, 10, 15, 15, 15]
    for step, sampled in enumerate(of_step):
        assert_array_equal(told[step], flown[sampled])


def test_dropouts() -> None:
    """A lost reading leaves the one before: 30 % of 100,000."""
    settings = {"noise": 1.0, "vertical_noise": 1.0, "velocity_noise": 1.0, "dropout": 0.3}
    _, sensors, every = sensing({"gps": settings}, 2000)
    lost = 0
    before = sensors.readings["gps"]
    for _ in range(50):
        sensors.sample(every, 1)
        now = sensors.readings["gps"]
        same = (now == before).all(axis=-1)
        assert (same == (now == before).any(axis=-1)).all()
        lost = lost + int(same.sum())
        before = now
    assert lost / 1e5 == approx(0.3, abs=4 * sqrt(0.3 * 0.7 / 1e5))


# --- options --------------------------------------------------------------------------------------


def test_a_vehicles_numbers_and_the_settings_that_replace_them(tmp_path: Path) -> None:
    numbers = {"gyro_noise": 0.0, "accelerometer_noise": 0.0, "gyro_range": 2.0}
    told = "".join(
        f'<numeric name="rotorgram/sensors.{name}" data="{value}"/>'
        for name, value in numbers.items()
    )
    file = edited(tmp_path, "<worldbody>", f"<custom>{told}</custom><worldbody>")
    fast = {"body_rates": (5.0, 0.0, 0.0)}
    found = sensing({"imu": True}, file=file, **fast)[1].readings["imu"][0, 0, 0]
    assert found == 2.0
    assert first("imu", {"gyro_range": 4.0}, file=file, **fast)[0] == 4.0


def test_options_are_plain_values_in_one_order() -> None:
    given = {"gps": {**GPS, "delay": 1}, "barometer": False, "imu": True, "observe": "added"}
    sensors = checked_sensors(given)
    assert list(sensors.items()) == [("imu", {}), ("gps", {**GPS, "delay": 1.0})]
    assert checked_sensors(sensors) == sensors
    found = env_spec(EnvConfig.from_keywords(ELEVATION, sensors={"imu": False}))
    assert found == env_spec(EnvConfig(env_id=ELEVATION))


def test_a_wrong_option_gives_one_sentence() -> None:
    wrong = SIM["wrong"]
    of_gps = [(sentence, {"gps": GPS | settings}) for sentence, settings in wrong["gps"]]
    empty = (r": expected settings by sensor, got \[\]", [])
    for sentence, sensors in (empty, *of_gps, *wrong["sensors"]):
        with pytest.raises(InputError, match=f"^sensors{sentence}") as caught:
            env_spec(EnvConfig.from_keywords(HOVER, sensors=sensors))
        assert "\n" not in str(caught.value)


# --- as a part of an env --------------------------------------------------------------------------


@pytest.mark.parametrize("worlds", [1, 3])
def test_sensors_move_nothing_else(worlds: int) -> None:
    """Physics with contact, starts, and the readings of the other sensors keep their bits."""
    two = {name: NOISY[name] for name in ("imu", "gps")}
    none, some, all_of_them = (
        Loop(EnvConfig.from_keywords(HOVER, sensors=sensors, flight_band=100.0), worlds)
        for sensors in ({}, two, NOISY)
    )
    every = np.ones(worlds, bool)
    down = np.full((worlds, 4), -0.5, np.float32)
    for seeds in (range(worlds), None):  # two episodes
        for loop in (none, some, all_of_them):
            loop.advance(down, every, seeds)
        while not none.terminated.any():  # by contact with the floor
            for loop in (none, some, all_of_them):
                loop.advance(down)
            exact = none.observations["observation"].tobytes()
            assert some.observations["observation"].tobytes() == exact
            assert all_of_them.observations["observation"].tobytes() == exact
            for name in two:
                ours, theirs = (loop.observations[name] for loop in (some, all_of_them))
                assert ours.tobytes() == theirs.tobytes()


def test_contacts_are_the_same_with_an_imu() -> None:
    """What reads the acceleration leaves the solver's warm start as it was."""
    states = []
    for sensors in ({}, {"imu": IMU}):
        world, made, every = sensing(sensors, 2, position=(0.0, 0.0, 0.45), body_rates=(1, 0.5, 0))
        for _ in range(100):
            world.step(np.full((2, 1, 4), 20.0), 2)
            made.sample(every, 1)
        assert world.state.touching.all()
        states.append(world.state.position.tobytes() + world.state.velocity.tobytes())
    assert states[0] == states[1]


def test_an_estimate_stays_within_the_bounds_of_a_task() -> None:
    """A barometer that is 40 m off: the task sees the end of its bounds."""
    sensors = {"imu": IMU, "barometer": {"noise": 400.0, "altitude": 500.0}, "estimate": True}
    env = gym.make(ELEVATION, sensors={**sensors, "observe": "estimate"})
    seen, _ = env.reset(seed=1)
    ends = 0
    for _ in range(60):
        seen, *_, info = env.step(np.zeros(1, np.float32))
        assert env.observation_space.contains(seen)
        ends += abs(seen[0]) > 3.2
        assert abs(info["elevation_error"]) < 2.0
    assert ends > 10


# --- the estimate ---------------------------------------------------------------------------------

HALF_LIFE = PERIOD / log(2)  # a time constant with which a step takes half of an error


@pytest.fixture
def half_life(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rotorgram.sim.sensors.estimator.TIME", HALF_LIFE)


def estimator(**state: Any) -> Estimator:
    made = Estimator(PERIOD, 10.0)
    start = {"position": (0, 0, 0), "velocity": (0, 0, 0), "quaternion": LEVEL, **state}
    exact: Any = SimpleNamespace(**{k: np.array(v, float) for k, v in start.items()})
    made.begin(np.True_, exact, np.zeros(6))
    return made


def channel(*value: float, fresh: bool = True) -> Any:
    values = {"altitude": 100.0, "field": (0.0, 20.0, -40.0)}
    is_fresh = np.array(fresh)
    return SimpleNamespace(value=np.array(value), fresh=is_fresh, interval=PERIOD, values=values)


def angles_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vector of a quaternion."""
    size = np.linalg.norm(quaternion[1:])
    return 2 * atan2(size, quaternion[0]) * quaternion[1:] / max(size, 1e-30)


STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 10.0)


@pytest.mark.usefixtures("half_life")
@pytest.mark.parametrize("row", SIM["estimates"])
def test_a_step_by_hand(row: dict[str, Any]) -> None:
    """At rest, unless the IMU reads otherwise; then half of the rest for each measurement."""
    state = row.get("state", {})
    made = estimator(**state)
    others = row.keys() - {"state", "imu", "position", "velocity", "turned"}
    channels = {name: channel(*row[name]) for name in others}
    imu = row.get("imu", STILL)
    channels["imu"] = channel(*imu)
    made.update(np.True_, channels)
    if "turned" in row:
        assert angles_of(made.quaternion) == approx(row["turned"])
    else:
        assert made.position == approx(row["position"], abs=1e-12)
        assert made.velocity == approx(row["velocity"], abs=1e-12)


@pytest.mark.usefixtures("half_life")
def test_a_reading_counts_once() -> None:
    stale = {
        "barometer": channel(140.0, fresh=False), "gps": channel(9, 9, 9, 9, 9, 9, fresh=False),
        "motion_capture": channel(9, 9, 9, *LEFT, fresh=False),
        "magnetometer": channel(20, 0, -40, fresh=False),
    }  # fmt: skip
    made = estimator(position=(1, 2, 3))
    made.update(np.True_, {"imu": channel(*STILL), **stale})
    assert made.position == approx((1, 2, 3))
    assert made.velocity == approx((0, 0, 0))
    assert made.quaternion == approx(LEVEL)


@pytest.mark.usefixtures("half_life")
def test_a_gyroscopes_bias_tilts_the_estimate_by_so_much() -> None:
    """What the bias adds in a step is what the accelerometer takes away: b T = sin(tilt) / 2."""
    made = estimator()
    bias = 0.5
    for _ in range(100):
        imu = channel(bias, 0, 0, 0, 0, 10)
        made.update(np.True_, {"imu": imu})
    tilt = angles_of(made.quaternion)[0]
    found = sin(tilt)
    assert found == approx(2 * bias * PERIOD)


def test_errors_of_a_long_hover_are_those_of_the_biases() -> None:
    """With a time constant of τ steps: tilt by b τ and a / g, height by a τ²."""
    gyro = 0.01
    force = 0.1
    drones = 400
    biases = IMU | {"gyro_bias": gyro, "accelerometer_bias": force}
    sensors = {"imu": biases, "barometer": {"noise": 0.0}, "estimate": True}
    _, made, every = sensing(sensors, drones)
    for _ in range(600):  # 12 s: a filter of 1 s has settled
        made.sample(every, 1)
    estimate = made.readings["estimate"][:, 0]
    turned = 2 * estimate[:, 7:10]  # small angles, about x, y, z
    pole = exp(-PERIOD)
    tilt = hypot(gyro * PERIOD / (1 - pole), force / 9.8)
    # A step's rise of a T² is made up by h times what the barometer tells before the pull.
    height = force * (pole * PERIOD / (1 - pole)) ** 2
    error = 4 / sqrt(2 * drones)
    found = turned[:, :2].std()
    assert found == approx(tilt, rel=error / sqrt(2) + 0.01)
    assert (estimate[:, 2] - 5.0).std() == approx(height, rel=error + 0.01)
    assert turned[:, 2].std() == approx(12 * gyro, rel=error + 0.01)
    assert estimate[:, :2].std() > 10 * height  # nothing measures it


def test_an_exact_estimate_of_a_steady_climb() -> None:
    """Constant thrust, level: the integral is exact, and nothing pulls it away."""
    sensors = {"imu": IMU, "barometer": {"noise": 0.0}, "magnetometer": {"noise": 0.0}}
    world, made, every = sensing({**sensors, "estimate": True}, velocity=(1.0, -2.0, 0.0))
    for _ in range(100):
        world.step(np.full(4, 55.0), 2)
        made.sample(every, 1)
    estimate = made.readings["estimate"][0, 0]
    expected = alone(world).position.tolist()
    assert estimate[:3] == approx(expected, abs=1e-9)
    expected = alone(world).velocity.tolist()
    assert estimate[3:6] == approx(expected, abs=1e-9)
    assert estimate[6:10] == approx(LEVEL, abs=1e-12)
    # 55 N · 4 / 20 kg - 9.8 = 1.2 m/s² for 2 s
    assert estimate[2] == approx(5.0 + 0.5 * 1.2 * 4)


def test_a_controller_flies_on_the_estimate() -> None:
    """PID on barometer and accelerometer: what it sees is off, and it holds the elevation."""
    imu = {"gyro_noise": 2e-4, "accelerometer_noise": 2e-3, "accelerometer_bias": 0.05}
    sensors = {"imu": imu, "barometer": {"noise": 0.4}, "estimate": True, "observe": "estimate"}
    env = gym.make(ELEVATION, sensors=sensors, disable_env_checker=True)
    pilot = PID(env.unwrapped.env_spec)  # type: ignore[attr-defined]
    pilot.reset()
    seen, _ = env.reset(seed=5)
    errors = []
    differences = []
    for _ in range(250):
        seen, _, terminated, _, info = env.step(pilot.act(seen))
        assert not terminated
        errors.append(abs(info["elevation_error"]))
        differences.append(abs(info["elevation_error"] - seen[0]))
    assert 1e-3 < max(differences) < 0.5
    assert max(errors[-100:]) < 0.5


# --- the page -------------------------------------------------------------------------------------


def test_the_page_tells_what_the_benchmark_wrote() -> None:
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "sensors.md").read_text()
    results = docs / "results" / "sensors"
    one, many = json.loads((results / "cost.json").read_text()).values()
    for name, time in one.items():
        assert f"| {name} | {time:.0f} | {many[name]:,.0f} |" in page
    with (results / "allan.csv").open(newline="") as file:
        _, *rows = csv.reader(file)
    told = 0
    for row in rows:
        time, found, expected, ratio = map(float, row)
        told += f"| {time:g} | {found:.3e} | {expected:.3e} |" in page
        assert abs(ratio - 1) < 0.05
    assert told == page.split("| τ, s")[1].split("\n\n")[0].count("\n") - 1
