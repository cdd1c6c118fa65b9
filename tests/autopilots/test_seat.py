"""The seat of an autopilot: what a program is told, the stand, and what happens when it fails."""

import math
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
import pytest
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.reading import Propellers, exact
from rotorgram.autopilots.seat import LONGEST_STAND, Seat, Start, seated
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models import InputError
from rotorgram.udp.protocol.errors import PeerClosed

RATE = 100.0


@dataclass
class Hovering:
    """A program that holds the throttle of hovering, once it has booted; it keeps what it saw."""

    start: Start
    boot: float = 0.5
    fails_at: float = math.inf
    fault: float = math.nan
    """The throttle from then on; without one it ends."""
    late_every: int = 0
    ready: bool = False
    why: str = "it boots"
    late: int = 0
    takes_order: bool = True
    seen: list = field(default_factory=list)
    told: list = field(default_factory=list)
    closed: int = 0

    def step(self, reading, order, observation):
        self.seen.append((reading, order))
        self.told.append(observation["observation"])
        self.ready = reading.time >= self.boot
        if self.late_every and len(self.seen) % self.late_every == 0:
            self.late += 1
        if reading.time >= self.fails_at:
            if math.isnan(self.fault):
                raise PeerClosed("hovering: ended with status 1: it said nothing")
            return np.full(4, self.fault)
        hover = Propellers(self.start.config, self.start.vehicle).hover
        return np.full(4, hover if order else 0.0)

    def close(self):
        self.closed += 1


def flown(
    made, env_id="rotorgram/Hover-v0", steps=40, drones=1, episodes=1, sensors=None, **settings
):
    """Flights by programs of `settings`, one for each drone in turn, and the seat.

    Settings that are tuples go to programs in turn. `made` gets the programs.
    """
    config = EnvConfig.from_keywords(
        env_id, vehicle="hummingbird", drones=drones, sensors=sensors or {}
    )
    config = seated(config, RATE).changed(episode_length=steps)

    def make(start):
        number = len(made)
        own = {k: v[number] if isinstance(v, tuple) else v for k, v in settings.items()}
        made.append(Hovering(start, **own))
        return made[-1]

    start = Start(config, config.load_vehicle(), "hover", None)
    with closing(LocalVectorEnv(config, drones, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, make)
        return fly_episodes(env, seat, episodes, "final"), seat


def test_a_program_is_told_what_sensors_read_and_where_to_fly():
    made = []
    (flight,), _ = flown(made)
    in_flight = made[0].seen[-len(flight) :]
    for step in (0, 7, 20):
        reading, order = in_flight[step]
        row = {name: array[step] for name, array in flight.telemetry.items()}
        assert reading.position == pytest.approx(row["position"], abs=1e-5)
        assert abs(reading.quaternion @ row["attitude"]) == pytest.approx(1.0, abs=1e-6)
        assert reading.velocity == pytest.approx(row["velocity"], abs=1e-5)
        assert order.goal == pytest.approx([0.0, 0.0, order.goal[2]], abs=1e-4)
        assert order.goal == pytest.approx(in_flight[0][1].goal, abs=1e-4)
        assert not order.stands
    times = np.diff([reading.time for reading, _ in made[0].seen])
    assert times == pytest.approx(1 / RATE)


def test_errors_of_gps_are_the_pilot_s_and_no_error_of_the_goal():
    made = []
    gps = {"noise": 0.2, "vertical_noise": 0.2, "velocity_noise": 0.1}
    (flight,), _ = flown(made, steps=200, sensors={"gps": gps})
    errors = []
    for step, (reading, order) in enumerate(made[0].seen[-len(flight) :]):
        told = made[0].told[step - len(flight)]
        away = reading.position - flight.telemetry["position"][step]
        faster = reading.velocity - flight.telemetry["velocity"][step]
        errors.append((*away, *faster))
        assert order.goal == pytest.approx(made[0].seen[-1][1].goal, abs=1e-4)
        turned = math.cos(order.heading), math.sin(order.heading)
        x, y, z = order.goal - reading.position
        c, s = turned
        assert told[:3] == pytest.approx([c * x + s * y, c * y - s * x, z], abs=1e-5)
        x, y, z = reading.velocity
        assert told[3:6] == pytest.approx([c * x + s * y, c * y - s * x, z], abs=1e-5)
    spread = np.std(errors, axis=0)
    assert spread == pytest.approx([0.2] * 3 + [0.1] * 3, rel=0.2)


def test_it_stands_as_it_starts_until_the_rotors_carry_it():
    made = []
    (flight,), _ = flown(made)
    on_stand = made[0].seen[: -len(flight)]
    assert len(on_stand) == round(0.5 * RATE) + 2  # boots, is told, lifts
    assert [order is None for _, order in on_stand[-2:]] == [True, False]
    assert on_stand[-1][1].stands
    first = flight.pose[0]
    for reading, _ in on_stand:
        assert np.concatenate((reading.position, reading.quaternion)) == pytest.approx(
            first, abs=1e-5
        )
        assert not reading.velocity.any()
        assert not reading.rates.any()
        assert np.linalg.norm(reading.specific_force) == pytest.approx(9.8, abs=0.02)
    assert flight.telemetry["velocity"][0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_what_never_lifts_is_refused():
    with pytest.raises(InputError, match=rf"lifts the craft within {LONGEST_STAND:g} s .*it boots"):
        flown([], boot=math.inf)


def test_without_its_outputs_the_motors_stop():
    made = []
    (flight,), seat = flown(made, fails_at=0.6)
    failed = sum(reading.time < 0.6 for reading, _ in made[0].seen[-len(flight) :])
    speeds = flight.telemetry["velocity"][failed:, 2]
    falls = np.diff(speeds) * RATE
    assert falls[:5] == pytest.approx(-9.8, abs=0.15)  # with drag
    (fault,) = seat.tally.faults
    assert fault.startswith("hovering: ended with status 1: it said nothing; after 0.0")
    assert made[0].closed == 1


@pytest.mark.parametrize("fault", [math.inf, -0.1, 1.5])
def test_a_throttle_that_no_motor_has_is_a_failure(fault):
    _, seat = flown([], fails_at=0.6, fault=fault)
    assert f"expected throttles from 0 to 1, got [{fault}" in seat.tally.faults[0]


def test_others_of_a_swarm_fly_on():
    made = []
    flights, seat = flown(made, "rotorgram/Formation-v0", drones=2, fails_at=(0.6, math.inf))
    first, second = (one.telemetry["velocity"][-1, 2] for one in flights)
    assert first < -0.5
    assert abs(second) < 0.3
    assert len(seat.tally.faults) == 1


def test_late_steps_are_counted_and_each_episode_has_a_program():
    made = []
    flights, seat = flown(made, episodes=2, late_every=10)
    assert len(made) == 2
    assert [one.closed for one in made] in ([0, 0], [1, 1])
    assert seat.tally.steps == sum(len(one.seen) for one in made)
    assert seat.tally.late == sum(len(one.seen) // 10 for one in made)
    assert len(flights) == 2


def test_a_flight_lasts_as_long_as_the_task_and_reads_exactly():
    config = EnvConfig.from_keywords("rotorgram/Hover-v0")
    flight = seated(config, 400.0)
    seconds = config.control_period * config.episode_length
    assert flight.episode_length / 400.0 == pytest.approx(seconds)
    assert flight.action == "rotors"
    own = exact({"gps": {"rate": 10}})
    assert own["gps"] == {"rate": 10}
    assert set(own["imu"].values()) == {0.0}


@pytest.mark.parametrize("name", ["ardupilot", "px4"])
def test_a_stack_without_a_clock_of_its_own_is_refused_in_real_time(name):
    config = EnvConfig.from_keywords("rotorgram/Hover-v0")
    stack = find_stack(name)
    start = Start(config, config.load_vehicle(), stack.modes[0], None, real_time=True)
    sentence = f"^real_time: expected betaflight or crazyflie, got {name}$"
    with pytest.raises(InputError, match=sentence):
        stack.make(start)


def test_a_mode_of_another_stack_is_refused():
    config = EnvConfig.from_keywords("rotorgram/Hover-v0")
    start = Start(config, config.load_vehicle(), "angle", None)
    with pytest.raises(InputError, match=r"^mode: expected offboard with px4, got angle$"):
        find_stack("px4").make(start)


@pytest.mark.parametrize("name", ["Waypoints", "Racing", "Gates", "Recovery"])
def test_tasks_in_the_body_frame_are_flown_in_that_of_the_world(name):
    made = []
    (flight,), _ = flown(made, f"rotorgram/{name}-v0", steps=5)
    orders = [order.goal for _, order in made[0].seen[-len(flight) :]]
    assert np.ptp(orders, axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)
    if name in ("Racing", "Recovery"):
        goal = {"Racing": (6.0, 0.0, 5.0), "Recovery": (0.0, 0.0, 20.0)}[name]
        assert orders[0] == pytest.approx(goal, abs=1e-4)


def test_the_body_frame_is_refused():
    config = EnvConfig.from_keywords("rotorgram/Waypoints-v0", frame="body")
    flight = seated(config, RATE)
    start = Start(flight, flight.load_vehicle(), "hover", None)
    with pytest.raises(InputError, match="the observation 'nose x', got rotorgram/Waypoints-v0"):
        Seat(env_spec(flight), start, Hovering)
