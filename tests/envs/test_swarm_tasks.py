"""Tasks for several drones: who hears whom, what is observed, and that each can be done."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from contracts import spec_with, zero_actions
from pettingzoo.test import parallel_api_test, parallel_seed_test
from rotorgram.agents import Orca
from rotorgram.agents.orca import avoiding, nearest
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.memory import Memory
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.envs.stages.radio import Radio
from rotorgram.envs.stages.record import Record
from rotorgram.envs.state import State
from rotorgram.envs.tasks.swarm import SwarmOptions, grid, line, ring
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models import InputError, Vehicle
from rotorgram.sim import Draw, InitialState

TASKS = ("rotorgram/Formation-v0", "rotorgram/Crossing-v0", "rotorgram/Escort-v0")
ALL_TASKS = (*TASKS, "rotorgram/Cable-v0")
PERIOD = 0.02


class Heard:
    """The radio of one world with three drones, which hears what is written out."""

    def __init__(self, **options: Any) -> None:
        self.silent = SPEAKING
        self.stage = Radio(SwarmOptions(**options), PERIOD, 3, lambda state: self.silent)
        self.record: Any = Record((1, 3), Memory())

    def begin(self, position: np.ndarray) -> None:
        self.record.start = InitialState(position=position)
        self.record.draw = Lots()
        self.stage.begin(self.record)
        self.record.flown = np.zeros((1, 3), bool)
        self._observe(position, STILL)

    def step(self, position: np.ndarray, velocity: np.ndarray) -> None:
        self.record.flown = None
        self.record.steps = self.record.steps + 1
        self._observe(position, velocity)

    def _observe(self, position: np.ndarray, velocity: np.ndarray) -> None:
        none = np.zeros((1, 3, 4))
        state = State(
            position=position, velocity=velocity, quaternion=none, body_rates=none, command=none,
            thrust=none, touching=SPEAKING, action=none, steps=0, time=0.0,
        )  # fmt: skip
        self.record.state = self.record.measured = state
        self.stage.step(self.record)

    @property
    def neighbours(self) -> np.ndarray:
        """Of each drone, shape (3, count, 7)."""
        return self.record.measured.neighbours[0]


class Lots(Draw):
    def __init__(self) -> None:
        """It draws the same numbers for every world."""

    def uniform(self, low: Any, high: Any, size: Any = (), *, name: str = "") -> Any:
        return LOTS


PLACES = np.array([[[0.0, 0.0, 5.0], [3.0, 0.0, 5.0], [0.0, 40.0, 5.0]]])
STILL = np.zeros((1, 3, 3))
LOTS = np.array([[0.1, 0.2, 0.3]])
SPEAKING = np.zeros((1, 3), bool)


def test_neighbours_are_the_nearest_in_range_by_hand() -> None:
    heard = Heard(radio_range=10.0, neighbours=2)
    heard.begin(PLACES)
    found = heard.neighbours
    assert found[0].tolist() == [[3, 0, 0, 0, 0, 0, 1], [0] * 7]
    assert found[1].tolist() == [[-3, 0, 0, 0, 0, 0, 1], [0] * 7]
    assert found[2].tolist() == [[0] * 7, [0] * 7]  # out of range
    wide = Heard(radio_range=50.0, neighbours=1)
    wide.begin(PLACES)
    assert wide.neighbours[2, 0].tolist() == [0, -40, 0, 0, 0, 0, 1]  # not that 40.1 away
    more = Heard(radio_range=50.0, neighbours=4)
    more.begin(PLACES)
    assert more.neighbours[0, 2:].tolist() == [[0] * 7] * 2


def test_what_is_heard_late_flies_on_straight() -> None:
    heard = Heard(radio_range=10.0, radio_delay=2)
    heard.begin(PLACES)
    moves = STILL.copy()
    moves[0, 1] = 1.0, 0.0, 0.0
    now = PLACES.copy()
    for step in range(1, 5):
        now = now + PERIOD * moves
        heard.step(now, moves)
        found = heard.neighbours[0, 0]
        # Two steps late it hears of the start at rest, then of the flight.
        velocity = 0.0 if step < 3 else 1.0
        ahead = step * PERIOD if velocity else 0.0
        assert found[:4] == pytest.approx([3.0 + ahead, 0, 0, velocity])


@pytest.mark.parametrize(("loss", "silent"), [(1.0, False), (0.0, True)])
def test_one_that_is_silent_or_lost_is_forgotten_after_a_second(loss: float, silent: bool) -> None:
    heard = Heard(radio_range=10.0, radio_loss=loss)
    heard.begin(PLACES)
    heard.silent = np.full((1, 3), silent)
    for step in range(52):
        assert heard.neighbours[0, 0, 6] == (step <= 50)
        heard.step(PLACES, STILL)


def test_so_many_messages_are_lost_and_each_for_itself() -> None:
    heard = Heard(radio_range=100.0, radio_loss=0.3, neighbours=2)
    heard.begin(PLACES)
    arrived = np.zeros((3, 2, 2000))
    for step in range(2000):  # positions tell which step a message is of
        now = PLACES + np.array((0.0, 0.0, 0.01 * step))
        heard.step(now, STILL)
        arrived[..., step] = np.abs(heard.neighbours[..., 2]) < 1e-9
    assert arrived.mean(axis=-1) == pytest.approx(0.7, abs=0.05)
    pairs = arrived.reshape(6, -1)
    assert np.abs(np.corrcoef(pairs) - np.eye(6)).max() < 0.1


def test_places_by_hand() -> None:
    assert ring(4) == pytest.approx(
        np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]) / 2**0.5
    )
    assert ring(1).tolist() == [[0, 0, 0]]
    assert line(3).tolist() == [[0, -1, 0], [0, 0, 0], [0, 1, 0]]
    assert grid(4).tolist() == [[-0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0]]
    for count in range(2, 30):
        for places in (ring(count), line(count), grid(count)):
            apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(count) * 9
            assert apart.min() == pytest.approx(1.0)


@pytest.mark.parametrize("vehicle", [None, "crazyflie2"])
def test_the_radius_holds_all_that_collides(vehicle: str | None) -> None:
    """Two crafts whose spheres do not overlap cannot touch; the sphere is not much too large."""
    radius = Vehicle.load(vehicle).radius
    assert (
        {None: 1.0, "crazyflie2": 0.03}[vehicle] < radius < {None: 2.0, "crazyflie2": 0.1}[vehicle]
    )
    env = LocalVectorEnv(TASKS[0], 2, drones=2, vehicle=vehicle)
    env.reset(seed=0)
    state = env.loop.world.state
    distance = np.linalg.norm(state.position[0, 0] - state.position[0, 1])
    assert env.loop.metrics["clearance"] == pytest.approx([distance - 2 * radius] * 2)


def test_a_lossy_radio_moves_no_start() -> None:
    starts = []
    for loss in (0.0, 0.9):
        env = LocalVectorEnv(TASKS[2], 4, drones=4, radio_loss=loss)
        for seed in (1, None):  # the second episode goes on in the stream
            env.reset(seed=seed)
        starts.append(env.loop.world.state.position.tobytes())
    assert starts[0] == starts[1]


@pytest.mark.parametrize("env_id", ALL_TASKS)
def test_pettingzoos_own_tests(env_id: str) -> None:
    parallel_api_test(LocalParallelEnv(env_id, 3, episode_length=50), num_cycles=120)
    parallel_seed_test(lambda: LocalParallelEnv(env_id, 2, episode_length=30))


def test_a_crash_ends_the_episode_of_those_that_touch_and_they_fall_silent() -> None:
    env = LocalVectorEnv(TASKS[1], 3, drones=3, autoreset_mode="Disabled", spacing=2.0)
    env.reset(seed=4)
    state = env.loop.world.state
    state.position[0, 1] = state.position[0, 0] + (0.3, 0.0, 0.1)  # one in the other
    env.advance(zero_actions(3, 4))
    assert env.terminated.tolist() == [True, True, False]
    assert env.done.tolist() == [False] * 3
    assert env.loop.reward_terms["termination"] == pytest.approx([-240, -240, 0])
    for _ in range(60):  # longer than a second
        env.advance(zero_actions(3, 4))
    there = env.observations.reshape(3, -1)[2, 19:].reshape(7, 7)[:, 6]
    assert not there.any()


def test_the_target_moves_no_faster_than_it_may_and_its_velocity_is_told() -> None:
    env = LocalVectorEnv(TASKS[2], 2, drones=2, target_speed=3.0, target_path=4.0)
    env.reset(seed=1)
    task: Any = env.loop.task
    before = task.target()[0]
    speeds = []
    for _ in range(400):
        seen, *_ = env.step(zero_actions(2, 4))
        now, velocity = task.target()
        speeds.append(np.linalg.norm(velocity, axis=-1).max())
        assert (now - before) / PERIOD == pytest.approx(velocity, abs=0.1)
        assert seen[0, 19:22] == pytest.approx(velocity[0, 0], abs=1e-6)
        assert np.abs(now).max() <= 4.0
        before = now
    assert 2.0 < max(speeds) <= 3.0


# ---- ORCA


def test_the_plane_of_a_head_on_meeting_by_hand() -> None:
    """At each other at 1 m/s, 8 m apart: in 3 s they are at the 2 m that they have to keep.

    A little faster, and half of what is too much is braked.
    """
    slow = avoiding((8.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0, PERIOD)
    assert slow[0] == pytest.approx((-1.0, 0.0, 0.0))
    assert slow[1] == pytest.approx(-1.0)  # v_x <= 1 m/s: as it is
    free = nearest((1.0, 0.0, 0.0), [slow], 5.0)
    assert free == pytest.approx((1.0, 0.0, 0.0))
    fast = avoiding((8.0, 0.0, 0.0), (-2.2, 0.0, 0.0), (1.1, 0.0, 0.0), 2.0, PERIOD)
    assert nearest((1.1, 0.0, 0.0), [fast], 5.0) == pytest.approx((1.0, 0.0, 0.0), abs=1e-6)


def test_a_near_neighbour_is_passed_at_its_side() -> None:
    """At 3 m, 2 m to keep, the cone is asin(2/3) wide; a velocity in it is turned out of it."""
    normal, least = avoiding((3.0, 0.0, 0.0), (-3.0, 0.3, 0.0), (3.0, 0.0, 0.0), 2.0, PERIOD)
    # Relative velocity (3, -0.3): the nearer side is that of -y, whose edge is at -asin(2/3).
    leg = (5**0.5 / 3, -2 / 3)
    assert normal == pytest.approx((-2 / 3, -(5**0.5) / 3, 0.0), abs=1e-6)
    assert normal[0] * leg[0] + normal[1] * leg[1] == pytest.approx(0.0, abs=1e-6)
    outside = 2 / 3 * 3.0 - 5**0.5 / 3 * 0.3  # distance of the velocity from that edge
    assert least == pytest.approx(-2 / 3 * 3.0 + outside / 2, abs=1e-6)


def test_the_nearest_velocity_in_a_corner() -> None:
    planes = [((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 2.0)]
    assert nearest((0.0, 0.0, 0.5), planes, 9.0) == pytest.approx((1.0, 2.0, 0.5), abs=1e-5)
    assert nearest((9.0, 9.0, 0.0), [], 1.0) == pytest.approx((0.5**0.5, 0.5**0.5, 0.0))


@pytest.fixture(params=[None, "crazyflie2"])
def crossing(request: pytest.FixtureRequest) -> Iterator[LocalVectorEnv]:
    env = LocalVectorEnv(TASKS[1], 32, drones=8, vehicle=request.param, autoreset_mode="Disabled")
    yield env
    env.close()


def test_eight_drones_cross_without_touching(crossing: LocalVectorEnv) -> None:
    flown = fly_episodes(crossing, Orca(crossing.env_spec), 4)
    assert len(flown) == 32
    assert {one.ending for one in flown} == {"truncated"}
    assert [one.episode for one in flown] == [episode for episode in range(4) for _ in range(8)]
    metrics = np.array([one.telemetry["metrics"] for one in flown])
    assert metrics[:, :, 1].min() > -0.1  # spheres hold more than what touches
    assert metrics[:, -1, 0].max() < 0.01


def test_what_orca_cannot_fly_is_one_sentence() -> None:
    with pytest.raises(InputError, match="orca: expected a task for several drones, got"):
        Orca(spec_with("rotorgram/Hover-v0", action="velocity"))
    with pytest.raises(InputError, match=r"orca: expected actions of the level velocity"):
        Orca(spec_with(TASKS[0], action="position"))


@pytest.mark.parametrize("height", [4.0, -4.0])
def test_two_that_meet_straight_above_each_other_go_to_opposite_sides(height: float) -> None:
    """The side step of each is half of the distance to keep; none of it is vertical."""
    closing = (0.0, 0.0, -height)
    one, least = avoiding((0.0, 0.0, height), closing, (0.0, 0.0, 0.0), 1.0, PERIOD)
    other, _ = avoiding((0.0, 0.0, -height), (0.0, 0.0, height), (0.0, 0.0, 0.0), 1.0, PERIOD)
    assert one == (height / 4, 0.0, 0.0)
    assert other == (-height / 4, 0.0, 0.0)
    assert least == pytest.approx(0.5)  # at 4 m/s the middles meet in 1 s: R / 1 s, by halves
