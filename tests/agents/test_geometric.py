"""The agent `geometric` flies to goals at rest and moving, in calm and wind, over UDP too."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from drones import infos_of
from remotes import flying
from rotorgram.agents import Geometric
from rotorgram.agents.geometric import swing_gains
from rotorgram.cli import main
from rotorgram.envs import register
from rotorgram.envs.state import State
from rotorgram.envs.tasks.hover import Hover
from rotorgram.models import QUAD_XML
from rotorgram.models.errors import InputError
from rotorgram.sim import Array, stack

PAYLOAD = "rotorgram/PayloadHover-v0"
HOVER = "rotorgram/Hover-v0"
MOVING = "Moving-v0"
DATA = Path(__file__).parents[1] / "data"
MOCAP = {"noise": 0.001, "angle_noise": 0.002}
FILES = {"quad": QUAD_XML, "tiny": DATA / "tiny.xml", "hexa": DATA / "hexa.xml"}
FILES |= {path.parent.name: path for path in sorted(QUAD_XML.parent.glob("*/*/vehicle.toml"))}


class Moving(Hover):
    """A goal that turns on a circle of 1 m, at 1 m/s."""

    def goal(self, state: State) -> Array:
        return stack((np.cos(state.time), np.sin(state.time), 5.0))


if MOVING not in gym.registry:
    register(MOVING, Moving)


def flown(env: Any, seed: int = 0) -> list[dict[str, Any]]:
    """The info of each step."""
    return infos_of(env, Geometric(env.get_wrapper_attr("env_spec")), seed)


def distances(env: Any) -> list[float]:
    """To the goal after each step, m."""
    return [info["position_error"] for info in flown(env)]


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_every_vehicle_goes_to_the_goal_and_the_heading(file: Path) -> None:
    infos = flown(gym.make(HOVER, action="position", vehicle=file, heading=90.0))
    errors = [info["position_error"] for info in infos]
    headings = [abs(info["heading_error"]) for info in infos]
    assert errors[0] > 0.3
    assert max(errors[200:]) < 0.02
    assert headings[-1] < headings[0] / 4


@pytest.mark.parametrize("frame", ["world", "body"])
@pytest.mark.parametrize("name", ["Waypoints-v0", "Racing-v0"])
def test_courses_are_flown_in_both_frames(name: str, frame: str) -> None:
    env = gym.make(f"rotorgram/{name}", action="position", frame=frame)
    pilot = Geometric(env.get_wrapper_attr("env_spec"))
    observation, _ = env.reset(seed=0)
    terminated = False
    while not terminated:
        observation, _, terminated, truncated, info = env.step(pilot.act(observation))
        assert not truncated
    assert info["points_left" if name == "Waypoints-v0" else "gates_left"] == 0.0
    assert info["flight_time"] < 17.0


def test_a_thrown_craft_comes_back_in_the_body_frame() -> None:
    env = gym.make("rotorgram/Recovery-v0", action="position", frame="body")
    assert max(distances(env)[300:]) < 0.1


def test_a_goal_that_moves_is_followed() -> None:
    """Without the goal's velocity and acceleration it would stay 1 / 0.88 m behind."""
    errors = distances(gym.make(MOVING, action="position", episode_length=400))
    assert max(errors[300:]) < 0.15


def test_wind_and_a_payload_are_held_against() -> None:
    """3 m/s push 27 g sideways by 0.04 N; a payload of a tenth of the mass pulls it down."""
    effects = {"body_drag": True, "wind": (3.0, 0.0, 0.0), "motor_lag": True}
    env = gym.make(HOVER, action="position", vehicle="crazyflie2", effects=effects)
    assert distances(env)[-1] < 0.02
    effects = {"payload": 2.0, "cable": 0.5}
    env = gym.make(HOVER, action="position", effects=effects, goal=(0, 0, 8), episode_length=500)
    assert distances(env)[-1] < 0.05


def test_gravity_is_the_vehicles(tmp_path: Path) -> None:
    """On the moon twice the thrust of a hover lifts with 1.62 m/s²: nothing else pushes."""
    file = tmp_path / "moon.toml"
    text = (QUAD_XML.parent / "vehicles/crazyflie2/vehicle.toml").read_text(encoding="utf-8")
    file.write_text(f"gravity = 1.62\n{text}", encoding="utf-8")
    policy = Geometric(gym.make(HOVER, action="position", vehicle=file).unwrapped.env_spec)
    for time in (0.0, 0.02):
        below = -1.62 * time**2 / 2
        nose = (1, 0, 0)
        up = (0, 0, 1)
        seen = [0, 0, below, 0, 0, 1.62 * time, *nose, *up, 0, 0, 0, 1, 1, 1, 1]
        assert policy.act(np.array(seen)) == pytest.approx([0, 0, below / 4, 0], abs=1e-6)


def test_the_poles_of_a_swing() -> None:
    """p = 5 /s, ω² = 9 /s², a ninth of the mass: the swing's ω² of 10 /s², half damped."""
    plant = np.zeros((6, 6))
    plant[(0, 1, 1, 2, 4), (1, 2, 4, 3, 5)] = 1
    plant[3, 2] = -10
    plant[3, 4] = -1
    plant[5, 4] = -50
    plant[5, 5] = -10
    closed = plant
    closed[5] -= 50 * swing_gains(1.0, 9.0, 1 / 9)
    half = [-1.25 + 0.9682458j, -5 + 5j, -1.5811388 + 2.7386128j]
    expected = sorted([*half, *np.conj(half)], key=lambda pole: (pole.real, pole.imag))
    poles = sorted(np.linalg.eigvals(closed), key=lambda pole: (round(pole.real, 6), pole.imag))
    assert poles == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("vehicle", [None, "crazyflie2"])
def test_a_payload_swings_no_more(vehicle: str | None) -> None:
    """The payload alone would swing for minutes: MuJoCo's cable has hardly any damping."""
    options = {} if vehicle is None else {"vehicle": vehicle}
    env = gym.make(PAYLOAD, action="position", **options)
    infos = flown(env, seed=100)
    swings = [info["swing"] for info in infos]
    errors = [info["payload_error"] for info in infos]
    assert max(swings) > 5.0
    assert max(swings[200:]) < 1.5
    assert max(errors[200:]) < 0.1


def test_an_estimate_is_flown_by() -> None:
    """The accelerometer's bias moves the estimate itself by some 0.2 m."""
    sensors = {"imu": True, "motion_capture": MOCAP, "estimate": True, "observe": "estimate"}
    env = gym.make(HOVER, action="position", vehicle="crazyflie2", sensors=sensors)
    assert max(distances(env)[150:]) < 0.3


def test_from_hello_alone_over_udp() -> None:
    with flying(HOVER, action="position", vehicle="crazyflie2") as pair:
        pair.remote.connect()
        remote = flown(pair.remote)
    local = flown(gym.make(HOVER, action="position", vehicle="crazyflie2"))
    for name in ("position_error", "heading_error"):
        assert [info[name] for info in remote] == [info[name] for info in local]
    assert remote[-1]["position_error"] < 0.01


def test_it_says_what_it_needs() -> None:
    spec = gym.make(HOVER).get_wrapper_attr("env_spec")
    with pytest.raises(InputError, match=r"geometric: expected actions of the level position"):
        Geometric(spec)
    spec = gym.make(HOVER, action="position").get_wrapper_attr("env_spec")
    nameless = replace(spec, observation=(replace(spec.observation[0], components=()),))
    with pytest.raises(InputError, match=r"geometric: expected .*'goal - position x', got"):
        Geometric(nameless)


def test_evaluate_flies_it_at_its_level(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "geometric", "--env", HOVER, "--episodes", "1"]) == 0
    assert "geometric on rotorgram/Hover-v0\nepisodes   1, 0 terminated" in capsys.readouterr().out
    assert main(["evaluate", "geometric", "--episodes", "1"]) != 0
    expected = "geometric: expected a task flown by position, got rotorgram/Elevation-v0"
    assert expected in capsys.readouterr().err
