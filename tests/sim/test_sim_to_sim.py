"""rl-tools' simulator flies our vehicles as ours does, where it is installed."""

import numpy as np
import pytest
from rotorgram.models import Vehicle

pytest.importorskip("l2f")
pytest.importorskip("foundation_policy")

import sim_to_sim


@pytest.mark.parametrize("vehicle", ["crazyflie2", "skydio_x2"])
def test_the_same_commands_give_the_same_flight(vehicle, tmp_path):
    apart = sim_to_sim.agreement(sim_to_sim.finer(vehicle, tmp_path))
    for name in ("mujoco, 1 s", "l2f, 1 s"):
        assert apart[name]["position_m"] < 1e-4
        assert apart[name]["attitude_deg"] < 0.01


def test_rotors_that_turn_the_other_way_are_what_crashes_it():
    vehicle = Vehicle.load("skydio_x2")
    craft = sim_to_sim.Craft.of(vehicle, lag=False)
    starts = sim_to_sim.starts_of("skydio_x2", 4)
    assert all(one.crashed for one in sim_to_sim.alone(sim_to_sim.by_corners(craft), starts))
    order, turn = sim_to_sim.layout(*vehicle.allocation[1:])
    assert abs(np.angle(turn)) == pytest.approx(np.pi / 2)
    flights = sim_to_sim.alone(craft.turned(order, turn), starts, turn)
    assert not any(one.crashed for one in flights)
    assert max(one.error for one in flights) < 0.05


def test_what_is_varied_is_what_is_named():
    craft = sim_to_sim.Craft.of(Vehicle.load("crazyflie2"), lag=True)
    assert craft.varied("thrust_to_weight", 3.0).thrust_to_weight == pytest.approx(3.0)
    assert craft.varied("thrust_to_weight", 3.0).agility == pytest.approx(craft.agility)
    assert craft.varied("agility", 2.0).agility == pytest.approx(2.0 * craft.agility)
    large = craft.varied("scale", 2.0)
    assert large.mass == pytest.approx(8 * 0.027)
    assert large.thrust_to_weight == pytest.approx(craft.thrust_to_weight)
    assert large.agility == pytest.approx(craft.agility / 2.0)
    assert craft.hover == pytest.approx(np.sqrt(0.027 * 9.81 / (4 * 0.15916628)), rel=1e-6)
