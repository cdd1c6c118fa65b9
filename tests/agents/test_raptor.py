"""RAPTOR: what the policy is told, and which rotor each of its motors is."""

import math
import sys
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import output, refused
from rotorgram.agents import find_controller
from rotorgram.agents.raptor import Raptor
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import EnvSpec
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.models import InputError, MissingPackage, Vehicle

HOVER = "rotorgram/Hover-v0"
LEVEL = np.array([0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0], np.float32)
"""At rest at the goal."""
MOTORS = {  # front right, rear right, rear left, front left; of the Skydio X2, seen from its left
    "crazyflie2": ("M1", "M2", "M3", "M4"),
    "crazyflie_brushless": ("M1", "M2", "M3", "M4"),
    "hummingbird": ("r2", "r3", "r4", "r1"),
    "paper": ("rotor2", "rotor3", "rotor4", "rotor1"),
    "skydio_x2": ("rotor3", "rotor4", "rotor1", "rotor2"),
}
CROSS = {
    "front right": (0.1, -0.1, "ccw"),
    "rear right": (-0.1, -0.1, "cw"),
    "rear left": (-0.1, 0.1, "ccw"),
    "front left": (0.1, 0.1, "cw"),
}
FLIPPED = {name: (x, y, "cw" if turn == "ccw" else "ccw") for name, (x, y, turn) in CROSS.items()}
PLUS = {
    "front": (0.14, 0.0, "ccw"),
    "right": (0.0, -0.14, "cw"),
    "rear": (-0.14, 0.0, "ccw"),
    "left": (0.0, 0.14, "cw"),
}


class Motors:
    """A policy of given motor commands, which keeps what it was told."""

    def __init__(self):
        self.told = []
        self.command = np.zeros(4)

    def reset(self):
        self.told = []

    def evaluate_step(self, rows):
        self.told.append(rows[0])
        return self.command[None]


@pytest.fixture
def motors(monkeypatch):
    policy = Motors()
    package = SimpleNamespace(Raptor=lambda: policy)
    monkeypatch.setitem(sys.modules, "foundation_policy", package)
    return policy


def spec_of(vehicle, env_id=HOVER, **settings):
    """As it comes over the wire."""
    config = EnvConfig.from_keywords(env_id, vehicle=vehicle, **{**Raptor.options, **settings})
    return EnvSpec.from_json(env_spec(config).to_json())


def written(folder: Path, rotors) -> str:
    """A vehicle's file, whose rotors are (name, (x, y, turn))."""
    lines = ['name = "mine"', "[body]", "mass = 0.5", "inertia = [2e-3, 2e-3, 4e-3]", "[rotors]"]
    lines += ["thrust = [0.0, 3.0]", "reaction = 0.016"]
    for name, (x, y, turn) in rotors:
        place = f"position = [{x}, {y}, 0.0]"
        lines += ["[[rotors.list]]", f'name = "{name}"', place, f'turn = "{turn}"']
    file = folder / "mine.toml"
    file.write_text("\n".join(lines))
    return str(file)


def order_of(motors, vehicle) -> list[str]:
    """Names of the rotors that each motor drives, one after the other."""
    pilot = Raptor(spec_of(vehicle))
    names = [rotor.name for rotor in Vehicle.load(vehicle).rotors]
    order = []
    for motor in range(4):
        motors.command = np.full(4, -1.0)
        motors.command[motor] = 3.0  # clipped
        action = pilot.act({"observation": LEVEL})
        assert sorted(action) == pytest.approx([-1.0, -1.0, -1.0, 1.0])
        order.append(names[int(action.argmax())])
        pilot.act({"observation": LEVEL})
        assert motors.told[-1][18:] == pytest.approx(np.clip(motors.command, -1, 1))
    return order


@pytest.mark.parametrize("vehicle", MOTORS)
def test_each_motor_is_a_rotor_of_the_library(motors, vehicle):
    assert order_of(motors, vehicle) == list(MOTORS[vehicle])


@pytest.mark.parametrize("order", list(permutations(CROSS))[::5])
def test_the_order_of_a_file_does_not_matter(motors, order, tmp_path):
    file = written(tmp_path, [(name, CROSS[name]) for name in order])
    assert order_of(motors, file) == list(CROSS)


def test_rotors_that_turn_the_other_way_are_seen_from_the_side(motors, tmp_path):
    order = order_of(motors, written(tmp_path, FLIPPED.items()))
    places = [FLIPPED[name] for name in order]
    assert [turn for _, _, turn in places] == ["ccw", "cw", "ccw", "cw"]
    angles = np.unwrap([math.atan2(y, x) for x, y, _ in places])
    assert np.diff(angles) == pytest.approx([-math.pi / 2] * 3)


def test_a_plus_is_turned_by_45_degrees(motors, tmp_path):
    file = written(tmp_path, PLUS.items())
    order = order_of(motors, file)
    assert [PLUS[name][2] for name in order] == ["ccw", "cw", "ccw", "cw"]
    pilot = Raptor(spec_of(file))
    pilot.act({"observation": [0.2, 0, 0, *LEVEL[3:]]})
    x, y, _ = motors.told[0][:3]
    assert (abs(x), abs(y)) == pytest.approx((0.2 / math.sqrt(2), 0.2 / math.sqrt(2)))
    assert motors.told[0][3:12] == pytest.approx(np.eye(3).ravel())


def test_it_is_told_the_state_about_the_goal(motors):
    pilot = Raptor(spec_of("crazyflie2"))
    seen = LEVEL.copy()
    seen[:3] = 0.0, -3.0, 4.0  # goal - position
    seen[3:6] = 0.5, 0.0, -1.0
    seen[6:9] = 0.0, 1.0, 0.0  # the nose to the left
    seen[12:15] = 0.1, 0.2, 0.3
    pilot.act({"observation": seen})
    told = motors.told[0]
    assert told[:3] == pytest.approx([0.0, 0.6, -0.8])  # no further than 1 m
    assert told[3:12].reshape(3, 3) == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert told[12:15] == pytest.approx([0.5, 0.0, -1.0])
    assert told[15:18] == pytest.approx([0.1, 0.2, 0.3])
    assert told[18:] == pytest.approx([0.0] * 4)


def test_it_is_told_the_same_from_the_left(motors):
    """The Skydio X2's rotors are in its order in a frame that is turned by 90°."""
    pilot = Raptor(spec_of("skydio_x2"))
    seen = LEVEL.copy()
    seen[:3] = -0.2, 0.0, 0.0
    seen[9:12] = 0.6, 0.0, 0.8  # nose down
    seen[6:9] = 0.8, 0.0, -0.6
    seen[12:15] = 0.0, 0.5, 0.0
    pilot.act({"observation": seen})
    told = motors.told[0]
    assert told[:3] == pytest.approx([0.0, -0.2, 0.0])
    assert told[3:12].reshape(3, 3) == pytest.approx(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    )
    assert told[15:18] == pytest.approx([0.5, 0.0, 0.0])


def test_velocities_are_those_from_the_goal(motors):
    pilot = Raptor(spec_of("crazyflie2", "rotorgram/Tracking-v0"))
    numbers = np.zeros(31, np.float32)
    numbers[:19] = LEVEL
    numbers[3:6] = 1.0, 0.5, 0.0
    numbers[19:22] = 0.4, 0.0, 0.1  # of the reference
    pilot.act({"observation": numbers})
    assert motors.told[0][12:15] == pytest.approx([0.6, 0.5, -0.1])


@pytest.mark.parametrize(
    ("effects", "share"), [({}, 0.425175490 / 2 + 0.574824510 / 4), ({"thrust_curve": True}, 0.5)]
)
def test_half_a_throttle_is_the_thrust_of_the_curve(motors, effects, share):
    """The effect has the curve where it is on."""
    pilot = Raptor(spec_of("crazyflie2", effects=effects))
    thrust = share * 0.15916628
    hover = 0.027 * 9.81 / 4
    span = 0.15916628 - hover if thrust > hover else hover
    action = pilot.act({"observation": LEVEL})
    assert action == pytest.approx([(thrust - hover) / span] * 4, rel=1e-3)


def test_without_a_nose_its_heading_is_0(motors):
    pilot = Raptor(spec_of("crazyflie2", "rotorgram/Recovery-v0"))
    numbers = np.zeros(16, np.float32)
    numbers[:3] = 0.2, 0.0, 0.0  # goal - position, seen from the body
    numbers[6:9] = 0.6, 0.0, 0.8  # up: the nose points up
    pilot.act({"observation": numbers})
    told = motors.told[0]
    axes = told[3:12].reshape(3, 3)
    assert axes == pytest.approx(np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]]), abs=1e-5)
    assert told[:3] == pytest.approx([-0.16, 0.0, -0.12], abs=1e-5)


@pytest.mark.parametrize(
    ("vehicle", "env_id", "settings", "sentence"),
    [
        ("heavy_hexa", HOVER, {}, "raptor: expected four rotors, one in each corner, .* got 6"),
        ("crazyflie2", "rotorgram/Forest-v0", {}, "the observation 'goal - position x'"),
        ("crazyflie2", HOVER, {"control_period": 0.02}, "--control-period 0.01, got .* and 0.02"),
        (
            "crazyflie2",
            HOVER,
            {"action": "position"},
            "expected one vehicle, --action rotors and .* offset x",
        ),
        (
            "crazyflie2,hummingbird",
            "rotorgram/Formation-v0",
            {"drones": 2},
            "got Crazyflie 2.x, AscTec Hummingbird, F1",
        ),
    ],
)
def test_what_it_cannot_fly_is_refused(motors, vehicle, env_id, settings, sentence):
    with pytest.raises(InputError, match=sentence):
        Raptor(spec_of(vehicle, env_id, **settings))


def test_neighbours_that_turn_alike_are_refused(motors, tmp_path):
    turns = ("ccw", "ccw", "cw", "cw")
    rotors = [
        (name, (x, y, turn)) for (name, (x, y, _)), turn in zip(CROSS.items(), turns, strict=True)
    ]
    with pytest.raises(InputError, match="neighbours of which turn against each other"):
        Raptor(spec_of(written(tmp_path, rotors)))


def test_a_task_without_rotors_is_refused(capsys):
    assert "raptor: expected a task flown by rotors, got" in refused(capsys, "evaluate", "raptor")


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "foundation_policy", None)
    with pytest.raises(MissingPackage, match=r"pip install 'rotorgram\[raptor\]'"):
        Raptor(spec_of("crazyflie2"))


# ---- the policy itself


@pytest.mark.parametrize("vehicle", ["crazyflie2", "hummingbird", "skydio_x2"])
def test_it_hovers(vehicle):
    pytest.importorskip("foundation_policy")
    effects = {} if vehicle == "skydio_x2" else {"motor_lag": True}
    config = EnvConfig.from_keywords(HOVER, vehicle=vehicle, effects=effects, **Raptor.options)
    for flight in flown_trajectories(Raptor(env_spec(config)), config, range(3), "final"):
        assert flight.ending == "truncated"
        assert flight.headline[-1] < 0.1


@pytest.mark.parametrize(
    ("task", "best"), [("Waypoints", 0), ("Racing", 0), ("Landing", 1), ("Recovery", 1)]
)
def test_it_flies_courses_lands_and_recovers(task, best):
    pytest.importorskip("foundation_policy")
    settings = {"vehicle": "crazyflie2", "effects": {"motor_lag": True}, "episode_length": 2000}
    config = EnvConfig.from_keywords(f"rotorgram/{task}-v0", **settings, **Raptor.options)
    (flight,) = flown_trajectories(Raptor(env_spec(config)), config, [0], "final")
    assert flight.headline[-1] == best


def test_a_file_of_a_user_flies_over_the_wire(tmp_path, capsys):
    pytest.importorskip("foundation_policy")
    assert find_controller("raptor") is Raptor
    file = written(tmp_path, PLUS.items())
    words = ("--env", HOVER, "--vehicle", file, "--episodes", 2)
    assert "episodes   2, 0 terminated" in output(capsys, "evaluate", "raptor", *words)
