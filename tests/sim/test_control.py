"""Action levels: hand-computed thrusts, batch as single, and all vehicles fly."""

import json
from math import atan2, cos, degrees, pi, radians, sin
from pathlib import Path
from typing import Any

import contracts
import gymnasium as gym
import numpy as np
import pytest
from rotorgram.agents import Geometric
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.models.library import vehicle_names
from rotorgram.sim import (
    LEVELS,
    EffectOptions,
    WorldState,
    make_controller,
    make_world,
)
from rotorgram.sim.control import MixedController
from rotorgram.sim.control.cascade import Position, mixed
from rotorgram.sim.control.gains import Gains, shared_ranges
from tables import SIM
from worlds import alone, begin

approx = pytest.approx
DATA = Path(__file__).parents[1] / "data"
DOCS = Path(__file__).parents[2] / "docs"
HOVER = "rotorgram/Hover-v0"
MOCAP = {"noise": 0.001, "angle_noise": 0.002}
ESTIMATE = {"imu": True, "motion_capture": MOCAP, "estimate": True, "observe": "estimate"}
LAG = EffectOptions(motor_lag=True)
CASCADE = ("rates", "attitude", "velocity", "position")
FILES: dict[str, Any] = contracts.FILES | {"lively": DATA / "lively.toml"}


def state_of(vehicle: Vehicle, **given: Any) -> WorldState:
    """A single drone, level, at rest and at hover thrust where nothing else is given."""
    thrust = vehicle.hover_thrust
    usual = {"position": np.zeros(3), "quaternion": np.array((1.0, 0.0, 0.0, 0.0))}
    usual |= {"velocity": np.zeros(3), "body_rates": np.zeros(3)}
    usual |= {"command": thrust, "thrust": thrust, "touching": np.zeros((), bool)}
    return WorldState(**(usual | given))


# --- gains and ranges -----------------------------------------------------------------------------


def test_gains_of_the_papers_craft() -> None:
    """20 kg, 196 N of at most 400 N; J = 5.0257 and 10.0016 kg m²; arms of 1 m; yaw 0.05 m.

    A roll of 1 N m is 1 N up on one side and down on the other, of collective thrust; a yaw of it
    20 N. So α = 196 / 5.0257 = 38.9993 rad/s² and 196 / 200.03 = 0.97984 rad/s², p = sqrt(α / 2).
    """
    gains = Gains.of(Vehicle.load(), 0.01)
    assert gains.lowest == 0.0
    assert gains.highest == approx(400.0)
    assert gains.lead == 1.0
    assert gains.attitude == approx(4.41584, abs=1e-4)
    expected = (8.83168, 8.83168, 1.39987)
    assert gains.rate == approx(expected, abs=1e-4)
    assert gains.heading == approx(0.69994, abs=1e-4)
    assert (gains.velocity, gains.position) == approx((2.20792, 0.88317), abs=1e-4)
    expected = (11.0689, 11.0689, 1.75449)
    assert gains.most_rate == approx(expected, abs=1e-4)
    # 196 N of 196 + 0.75 · 204 N = 349 N; 9.8 m/s² · tan; and half of g.
    assert degrees(gains.most_tilt) == approx(55.833, abs=1e-3)
    assert gains.most_acceleration == approx((14.4382, 4.9), abs=1e-3)
    assert gains.most_velocity == approx((5.37368, 3.13050), abs=1e-4)  # sqrt(2 m · a)
    assert gains.most_offset == approx((6.08455, 4.0), abs=1e-3)  # 5.37368 / 0.88317


def test_a_lag_slows_the_loops_and_is_led() -> None:
    """72 ms are led to 24 ms; a step of 5 ms: L = 29 ms, p = 1 / (5 L) = 6.8966 rad/s.

    The lead: (1 - exp(-5 / 24)) / (1 - exp(-5 / 72)) = 0.188056 / 0.067088.
    """
    vehicle = Vehicle.load("crazyflie2")
    gains = Gains.of(vehicle, 0.005, 0.072)
    assert gains.attitude == approx(6.8966, abs=1e-4)
    assert gains.lead == approx(2.8032, abs=1e-3)
    assert Gains.of(vehicle, 0.005).attitude > 15.0
    state = state_of(vehicle, thrust=vehicle.hover_thrust - 0.001)
    controller = make_controller("rates", vehicle, 0.005, LAG)
    found = controller.thrust(np.zeros(4), state)
    expected = vehicle.hover_thrust - 0.001 + 0.0028032
    assert found == approx(expected, abs=1e-6)


def test_five_equal_poles() -> None:
    """Rotors with the lag L = 1 / 5p, and the four loops: (s + p)⁵."""
    vehicle = Vehicle.load("crazyflie2")
    lag = 0.072
    gains = Gains.of(vehicle, 0.005, lag)
    rate = gains.rate[0]
    p = gains.attitude
    ends = rate * np.array((1, p, p * gains.velocity, p * gains.velocity * gains.position))
    roots = np.roots((lag / 3 + 0.005, 1.0, *ends))
    found = np.abs(roots + p).max()
    assert found < 0.01 * p


# --- each level by hand ---------------------------------------------------------------------------


@pytest.mark.parametrize("table", SIM["thrusts"])
def test_thrusts_by_hand(table: dict[str, Any]) -> None:
    vehicle = Vehicle.load()
    controller = make_controller(table["level"], vehicle, vehicle.timestep)
    given = {name: np.array(values) for name, values in table.get("state", {}).items()}
    state = state_of(vehicle, **given)
    for action, expected in table["rows"]:
        found = controller.thrust(np.array(action, float), state)
        assert found == approx(expected, abs=2e-3)


def test_mixing_keeps_roll_and_pitch_before_collective_and_that_before_yaw() -> None:
    gains = Gains.of(Vehicle.load(), 0.01)
    for (collective, *torque), expected in SIM["mixed"]["rows"]:
        found = mixed(gains, collective, torque)
        assert found == approx(expected, abs=1e-6)


# --- array code -----------------------------------------------------------------------------------


def random_states(vehicle: Vehicle, n: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    dice = np.random.default_rng(7)
    quaternion = dice.normal(size=(n, 1, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    span = vehicle.thrust_high - vehicle.thrust_low
    given = {
        "position": dice.normal(size=(n, 1, 3)),
        "quaternion": quaternion,
        "velocity": dice.normal(size=(n, 1, 3)),
        "body_rates": 3 * dice.normal(size=(n, 1, 3)),
        "command": np.zeros((n, 1, vehicle.num_rotors)),
        "thrust": vehicle.thrust_low + span * dice.uniform(size=(n, 1, vehicle.num_rotors)),
        "touching": np.zeros((n, 1), bool),
    }
    return given, dice.uniform(-1.2, 1.2, (n, 1, 4))


@pytest.mark.parametrize("level", CASCADE)
@pytest.mark.parametrize("name", ["quad", "racer", "crazyflie2"])
def test_a_batch_has_the_bits_of_single_drones(name: str, level: str) -> None:
    vehicle = Vehicle.load(FILES[name])
    effects = EffectOptions(
        motor_lag=vehicle.coefficients["rotors.time_constant"] is not None,
        thrust_curve=vehicle.coefficients["rotors.curve"] is not None,
    )
    controller = make_controller(level, vehicle, vehicle.timestep, effects)
    given, actions = random_states(vehicle, 50)
    batch = controller.thrust(actions, WorldState(**given))
    assert batch.shape == (50, 1, vehicle.num_rotors)
    assert (batch >= vehicle.thrust_low).all()
    assert (batch <= vehicle.thrust_high).all()
    for i in range(50):
        one = WorldState(**{name: array[i, 0] for name, array in given.items()})
        found = controller.thrust(actions[i, 0], one).tobytes()
        assert found == batch[i, 0].tobytes()


# --- every vehicle flies --------------------------------------------------------------------------


def flown(
    vehicle: Vehicle, level: str, effects: EffectOptions, quaternion: Any, time: float
) -> list[Any]:
    """Distance, tilt cosine and heading after each physics step of a flight to (0, 0, 50) m."""
    world = make_world(vehicle, 1, effects=effects)
    controller: Any = make_controller(level, vehicle, vehicle.timestep, effects)
    goal = np.array((0.0, 0.0, 50.0))
    start = np.array((0.8, -0.6, 0.5)) if level == "position" else np.zeros(3)
    begin(world, position=goal + start, quaternion=quaternion)
    seen = []
    for _ in range(round(time / vehicle.timestep)):
        state = alone(world)
        w, x, y, z = state.quaternion
        heading = atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        action = np.zeros(4)
        if level == "position":
            offset = goal - state.position
            c = cos(heading)
            s = sin(heading)
            turned = c * offset[0] + s * offset[1], c * offset[1] - s * offset[0], offset[2]
            action = np.array((*turned, -heading)) / controller.constants["action_scale"]
        world.step(controller.thrust(action, state), 1)
        state = alone(world)
        seen.append((np.linalg.norm(goal - state.position), state.tilt_cosine, heading))
    return seen


def check_flights(vehicle: Vehicle) -> None:
    has_lag = vehicle.coefficients["rotors.time_constant"] is not None
    for effects in [EffectOptions(), LAG][: 1 + has_lag]:
        tilted = (cos(0.2618), 0.6 * sin(0.2618), 0.8 * sin(0.2618), 0.0)  # by 30°
        seen = np.array(flown(vehicle, "position", effects, tilted, 4.0))
        assert seen[:, 0].max() < 1.5
        settled = seen[round(3.0 / vehicle.timestep) :]
        assert settled[:, 0].max() < 0.05
        assert abs(settled[-1, 2]) < radians(10)
        over = np.array(flown(vehicle, "attitude", effects, (0.0, 1.0, 0.0, 0.0), 2.0))
        assert over[-1, 1] > cos(radians(3))


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_every_vehicle_holds_a_position_and_turns_upright_without_tuning(file: Path) -> None:
    check_flights(Vehicle.load(file))


@pytest.mark.parametrize("frame", ["plus", "hexa", "octo"])
def test_a_new_vehicle_flies_without_tuning(frame: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    status = main(["vehicle", "new", str(file), "--frame", frame])
    assert status == 0
    check_flights(Vehicle.load(file))


def hover_error(**options: Any) -> float:
    """Distance from the goal after 6 s of the geometric controller, m."""
    env = env_of("position", flight_band=8.0, episode_length=300, **options)
    agent = Geometric(env.env_spec)
    observation, _ = env.reset(seed=0)
    for _ in range(300):
        observation, _, terminated, _, info = env.step(agent.act(observation))
        assert not terminated
    return info["position_error"]  # type: ignore[no-any-return]


@pytest.mark.parametrize("mass", [1.4, 1.5, 1.6])
def test_a_heavier_craft_holds_its_height(mass: float) -> None:
    """The paper's craft lifts 2.04 times its mass."""
    assert hover_error(randomize={"mass": mass}) < 0.05


def test_loops_invert_the_thrust_curve() -> None:
    """Rotors of 4 N give 0.4 u + 0.6 u² of it: hover, 1.4715 N, is a throttle of 0.5177."""
    vehicle = Vehicle.load(FILES["racer"])
    effects = EffectOptions(thrust_curve=True)
    controller = make_controller("rates", vehicle, vehicle.timestep, effects)
    command = controller.thrust(np.zeros(4), state_of(vehicle))
    expected = [4 * 0.517687] * 4
    assert command == approx(expected, abs=1e-5)
    world = make_world(vehicle, 1, effects=effects)
    begin(world, position=(0.0, 0.0, 50.0))
    world.step(command, 1)
    assert alone(world).thrust == approx(vehicle.hover_thrust, abs=1e-5)
    found = hover_error(vehicle=FILES["racer"], effects={"thrust_curve": True})
    assert found < 0.01


# --- in an env ------------------------------------------------------------------------------------


def env_of(level: str, **options: Any) -> Any:
    return gym.make(HOVER, action=level, **options).unwrapped


def test_the_spec_tells_names_units_and_frames() -> None:
    spec = env_of("position").env_spec
    action = spec.action
    assert action.components == ("offset x", "offset y", "offset z", "offset of the heading")
    assert action.unit == ("m", "m", "m", "rad")
    assert action.frame == "world turned by the heading"
    expected = [6.084548, 6.084548, 4.0, pi]
    assert spec.action_scale == approx(expected)
    assert spec.constants["position_gain"] == approx(0.8831687)
    assert spec.constants["gravity"] == 9.8
    spec = env_of("rates").env_spec
    action = spec.action
    assert action.unit == ("1", "rad/s", "rad/s", "rad/s")
    expected = [1.0, 11.06888]
    assert spec.action_scale[:2] == approx(expected)
    assert action.low == -1.0
    assert action.high == 1.0
    assert action.shape == (4,)
    assert env_of("rotors").env_spec.action.unit == ""


@pytest.mark.parametrize(("estimate", "calls"), [(False, 4), (True, 1)], ids=["exact", "estimate"])
def test_loops_run_in_every_physics_step_unless_they_see_an_estimate(
    estimate: bool, calls: int
) -> None:
    sensors = ESTIMATE if estimate else {}
    loop = Loop(
        EnvConfig.from_keywords(HOVER, action="attitude", sensors=sensors, vehicle="crazyflie2")
    )
    controller = loop.task.controller
    looked = []
    thrust = controller.thrust
    controller.thrust = lambda action, state: looked.append(1) or thrust(action, state)
    loop.advance(np.zeros(4), np.ones(1, bool))
    loop.advance(np.zeros(4))
    assert len(looked) == calls  # of a control period of 0.02 s in steps of 0.005 s


def test_a_touch_in_an_earlier_physics_step_counts() -> None:
    vehicle = Vehicle.load()
    world = make_world(vehicle, 1)
    begin(world, position=(0.0, 0.0, vehicle.rest_height - 1e-3))
    full = np.full(4, 100.0)
    world.command(full, None)
    calls = world.calls(31, 1)
    for call in calls:
        world.push(None)
        world.fly(call, None)
        assert world.state.touching
    assert [call.left for call in calls[::10]] == pytest.approx([30 / 31, 20 / 31, 10 / 31, 0.0])
    world.step(full, 1)
    assert not world.state.touching


def test_delayed_actions_and_wrong_levels() -> None:
    env = env_of("velocity", randomize={"action_delay": "3"})
    env.reset(seed=0)
    climb = np.array((0, 0, 1, 0), np.float32)
    late = [env.step(climb)[4]["F1"] for _ in range(5)]
    assert late[3] > late[2] + 10.0  # three steps of the neutral action, then the climb
    with pytest.raises(InputError, match=r"action: expected .*'position'.* got 'torque'"):
        env_of("torque")
    with pytest.raises(InputError, match="action: expected 'increment' or 'offset', got 'rates'"):
        gym.make("rotorgram/Elevation-v0", action="rates")


def test_a_craft_that_cannot_yaw_is_refused(tmp_path: Path) -> None:
    text = QUAD_XML.read_text(encoding="utf-8")
    file = tmp_path / "still.xml"
    file.write_text(text.replace('0.05"', '0"').replace('-0"', '0"'), encoding="utf-8")
    vehicle = Vehicle.load(file)
    with pytest.raises(InputError, match=r"vehicle: expected .* yaw it.* got .* of rank 3"):
        make_controller("rates", vehicle, 0.01)


def test_controllers_of_different_vehicles_share_their_ranges() -> None:
    """Of a Crazyflie and a heavy hexacopter: an action stands for what the least able can."""
    crafts = [Vehicle.load(name) for name in ("crazyflie2", "heavy_hexa")]
    gains = [Gains.of(craft, craft.timestep) for craft in crafts]
    shared = shared_ranges(gains)
    pairs = [
        (Position(craft, own, EffectOptions()), [drone])
        for drone, (craft, own) in enumerate(zip(crafts, shared, strict=True))
    ]
    mixed = MixedController(pairs)
    level = min(one.most_offset[0] for one in gains)
    up = min(one.most_offset[1] for one in gains)
    assert mixed.units == ("m", "m", "m", "rad")
    assert mixed.constants["action_scale"] == (level, level, up, pi)


# --- the page -------------------------------------------------------------------------------------


def test_the_page_tells_what_the_benchmark_wrote_and_the_code_gives() -> None:
    page = (DOCS / "control.md").read_text(encoding="utf-8")
    told = json.loads((DOCS / "results/control/control.json").read_text(encoding="utf-8"))
    assert sorted(told["gains"]) == sorted(
        name for name, file in FILES.items() if "vehicles" in str(file)
    )
    for name, given in told["gains"].items():
        gains = Gains.of(Vehicle.load(name), given["timestep"], given["lag"])
        for field in given.keys() - {"timestep", "lag"}:
            assert getattr(gains, field) == approx(given[field], abs=1e-4)
        tilt = degrees(gains.most_tilt)
        (level, up) = gains.most_offset
        assert f"| {tilt:.0f} | {given['most_velocity'][0]:.2f}, " in page
        assert f"{given['most_velocity'][1]:.2f} | {level:.2f}, {up:.2f} |" in page
        assert f"| {gains.velocity:.2f} | {given['position']:.3f} | {given['lead']:.2f} |" in page
    for name, steps in told["responses"].items():
        cells = [
            f"{one['rise_s']:.2f} s, {100 * one['overshoot']:.0f} %, {one['settled_s']:.2f} s"
            for one in steps.values()
        ]
        row = f"| `{name}` | {' | '.join(cells)} | {100 * told['circle_m'][name]:.0f} cm |"
        assert row in page
    for level in LEVELS:
        costs = [f"{told['cost'][n]['ratio_to_rotors'][level]:.2f}" for n in ("1", "1024")]
        assert f"| `{level}` | {' | '.join(costs)} |" in page


def test_the_page_tells_how_near_a_shared_payload_is_held() -> None:
    page = (DOCS / "algorithms" / "geometric.md").read_text()
    told = json.loads((DOCS / "results" / "control" / "cable.json").read_text())
    for name in vehicle_names():
        cells = [
            f"{100 * row['error_m']:.2f} cm"
            + (f", {row['terminated']} ended" if row["terminated"] else "")
            for row in told[name].values()
        ]
        assert f"| `{name}` | {' | '.join(cells)} |" in page
