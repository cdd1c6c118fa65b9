"""RAPTOR: what the policy is told, and which rotor each of its motors is."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from raptor import CORNERS, Raptor
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.models import InputError, Vehicle


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


def spec_of(vehicle, env_id="rotorgram/Hover-v0", **settings):
    config = EnvConfig.from_keywords(env_id, vehicle=vehicle, **settings, **Raptor.options)
    return env_spec(config)


@pytest.mark.parametrize("vehicle", ["crazyflie2", "hummingbird", "skydio_x2"])
@pytest.mark.parametrize("motor", range(4))
def test_each_motor_is_the_rotor_in_its_corner(motors, vehicle, motor):
    pilot = Raptor(spec_of(vehicle))
    motors.command = np.full(4, -1.0)
    motors.command[motor] = 3.0  # clipped
    action = pilot.act({"observation": np.zeros(19)})
    rotors = Vehicle.load(vehicle).rotors
    x, y, _ = rotors[int(action.argmax())].position
    assert (np.sign(x), np.sign(y)) == CORNERS[motor]
    assert sorted(action) == pytest.approx([-1.0, -1.0, -1.0, 1.0])
    pilot.act({"observation": np.zeros(19)})
    assert motors.told[1][18:] == pytest.approx(np.clip(motors.command, -1, 1))


def test_it_is_told_the_state_about_the_goal(motors):
    pilot = Raptor(spec_of("crazyflie2"))
    seen = np.zeros(19)
    seen[:3] = 0.2, -0.3, 4.0  # goal - position
    seen[3:6] = 0.5, 0.0, -9.0
    seen[6:9] = 0.0, 1.0, 0.0  # the nose to the left
    seen[9:12] = 0.0, 0.0, 1.0
    seen[12:15] = 0.1, 0.2, 0.3
    pilot.act({"observation": seen})
    told = motors.told[0]
    assert told[:3] == pytest.approx([-0.2, 0.3, -1.0])
    assert told[3:12].reshape(3, 3) == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert told[12:15] == pytest.approx([0.5, 0.0, -2.0])
    assert told[15:18] == pytest.approx([0.1, 0.2, 0.3])


def test_what_it_cannot_fly_is_refused(motors):
    with pytest.raises(InputError, match="expected a rotor in each corner, got"):
        Raptor(spec_of("heavy_hexa"))
    with pytest.raises(InputError, match="expected the observation 'thrust axis x', got none"):
        Raptor(spec_of("crazyflie2", "rotorgram/Recovery-v0"))


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "foundation_policy", None)
    with pytest.raises(InputError, match="pip install foundation-policy h5py"):
        Raptor(spec_of("crazyflie2"))


@pytest.mark.parametrize("vehicle", ["crazyflie2", "hummingbird"])
def test_the_policy_itself_hovers(vehicle):
    pytest.importorskip("foundation_policy")
    effects = {"motor_lag": True}
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", vehicle=vehicle, effects=effects, **Raptor.options
    )
    for flight in flown_trajectories(Raptor(env_spec(config)), config, range(3), "final"):
        assert flight.ending == "truncated"
        assert flight.headline[-1] < 0.1
