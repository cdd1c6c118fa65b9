"""Tasks for several drones: who hears whom, what is observed, and that each can be done."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from contracts import TABLES, spec_with, zero_actions
from orca import Orca, avoiding, nearest
from pettingzoo.test import parallel_api_test, parallel_seed_test
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
        record = self.record
        record.start = InitialState(position=position)
        record.draw = Lots()
        self.stage.begin(record)
        record.flown = np.zeros((1, 3), bool)
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
            distance=lambda points: points[..., 0],
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

    def uniform(self, low: Any, high: Any, size: Any = ()) -> Any:
        return LOTS


PLACES = np.array([[[0.0, 0.0, 5.0], [3.0, 0.0, 5.0], [0.0, 40.0, 5.0]]])
STILL = np.zeros((1, 3, 3))
LOTS = np.array([[0.1, 0.2, 0.3]])
SPEAKING = np.zeros((1, 3), bool)


def test_neighbours_are_the_nearest_in_range_by_hand() -> None:
    heard = Heard(radio_range=10.0, neighbours=2)
    heard.begin(PLACES)
    # the third is out of range
    assert heard.neighbours.tolist() == TABLES["swarm tasks: neighbours in 10 m"]
    wide = Heard(radio_range=50.0, neighbours=1)
    wide.begin(PLACES)
    nearest_one = wide.neighbours[2, 0]
    assert nearest_one.tolist() == [0, -40, 0, 0, 0, 0, 1]  # not that 40.1 away
    more = Heard(radio_range=50.0, neighbours=4)
    more.begin(PLACES)
    nobody = more.neighbours[0, 2:]
    assert nobody.tolist() == [[0] * 7] * 2


def test_what_is_heard_late_flies_on_straight() -> None:
    heard = Heard(radio_range=10.0, radio_delay=2)
    heard.begin(PLACES)
    moves = STILL.copy()
    moves[0, 1] = along(1.0)
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
        above = heard.neighbours[..., 2]
        arrived[..., step] = np.abs(above) < 1e-9
    assert arrived.mean(axis=-1) == pytest.approx(0.7, abs=0.05)
    pairs = arrived.reshape(6, -1)
    others = np.corrcoef(pairs) - np.eye(6)
    assert np.abs(others).max() < 0.1


def test_places_by_hand() -> None:
    expected = TABLES["swarm tasks: places"]
    corners = np.array(expected["ring of 4, times root 2"])
    assert ring(4) == pytest.approx(corners / 2**0.5)
    assert line(3).tolist() == expected["line of 3"]
    assert grid(4).tolist() == expected["grid of 4"]
    for count in range(2, 30):
        itself = 9 * np.eye(count)
        for places in (ring(count), line(count), grid(count)):
            offsets = places[:, None] - places
            apart = np.linalg.norm(offsets, axis=-1) + itself
            assert apart.min() == pytest.approx(1.0)


@pytest.mark.parametrize("vehicle", [None, "crazyflie2"])
def test_the_radius_holds_all_that_collides(vehicle: str | None) -> None:
    """Two crafts whose spheres do not overlap cannot touch; the sphere is not much too large."""
    radius = Vehicle.load(vehicle).radius
    if vehicle is None:
        assert 1.0 < radius < 2.0
    else:
        assert 0.03 < radius < 0.1
    env = LocalVectorEnv(TASKS[0], 2, drones=2, vehicle=vehicle)
    env.reset(seed=0)
    state = env.loop.world.state
    one, other = state.position[0]
    distance = np.linalg.norm(one - other)
    clearance = distance - 2 * radius
    assert env.loop.metrics["clearance"] == pytest.approx([clearance] * 2)


def test_a_lossy_radio_moves_no_start() -> None:
    starts = []
    for loss in (0.0, 0.9):
        env = LocalVectorEnv(TASKS[2], 4, drones=4, radio_loss=loss)
        for seed in (1, None):  # the second episode goes on in the stream
            env.reset(seed=seed)
        position = env.loop.world.state.position
        starts.append(position.tobytes())
    assert starts[0] == starts[1]


@pytest.mark.parametrize("env_id", ALL_TASKS)
def test_pettingzoos_own_tests(env_id: str) -> None:
    env = LocalParallelEnv(env_id, 3, episode_length=50)
    parallel_api_test(env, num_cycles=120)
    parallel_seed_test(lambda: LocalParallelEnv(env_id, 2, episode_length=30))


@pytest.mark.parametrize(("env_id", "touch"), list(zip(TASKS, (-1.0, -0.5, -1.0), strict=True)))
def test_room_and_heading_cost_what_the_class_says(env_id: str, touch: float) -> None:
    env = LocalVectorEnv(env_id, 3, drones=3, vehicle="crazyflie2")
    env.reset(seed=0)
    radius = Vehicle.load("crazyflie2").radius
    task: Any = env.loop.task
    clear = -touch * 4 * radius  # a diameter or two
    room = task.proximity_penalty(np.array([[0.0, clear / 2, clear], [-clear, -1.0, 1.0]]))
    assert room[0] == pytest.approx([touch, touch / 2, 0.0])
    assert room[1] == pytest.approx([1.5 * touch, 1.5 * touch, 0.0])
    env.loop.world.state.quaternion[0] = [
        (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)) for angle in np.radians([0, 90, -180])
    ]
    env.advance(zero_actions(3, 4))
    assert env.loop.told()()[1]["heading"] == pytest.approx([0.0, -0.1, -0.2], abs=1e-3)


def test_a_crash_ends_the_episode_of_those_that_touch_and_they_fall_silent() -> None:
    env = LocalVectorEnv(TASKS[1], 3, drones=3, autoreset_mode="Disabled", spacing=2.0)
    env.reset(seed=4)
    state = env.loop.world.state
    position = state.position[0]
    position[1] = position[0] + (0.3, 0.0, 0.1)  # one in the other
    actions = zero_actions(3, 4)
    env.advance(actions)
    assert env.terminated.tolist() == [True, True, False]
    assert env.done.tolist() == [False] * 3
    assert env.loop.told()()[1]["termination"] == pytest.approx([-310, -310, 0])
    for _ in range(60):  # longer than a second
        env.advance(actions)
    third = env.observations.reshape(3, -1)[2]
    neighbours = third[19:].reshape(7, 7)
    assert not neighbours[:, 6].any()


def test_the_target_moves_no_faster_than_it_may_and_its_velocity_is_told() -> None:
    env = LocalVectorEnv(TASKS[2], 2, drones=2, target_speed=3.0, target_path=4.0)
    env.reset(seed=1)

    def target() -> Any:
        task: Any = env.loop.task
        return task.target()

    before, _ = target()
    actions = zero_actions(2, 4)
    speeds = []
    for _ in range(400):
        seen, *_ = env.step(actions)
        now, velocity = target()
        speed = np.linalg.norm(velocity, axis=-1)
        speeds.append(speed.max())
        mean = (now - before) / PERIOD
        assert mean == pytest.approx(velocity, abs=0.1)
        assert seen[0, 19:22] == pytest.approx(velocity[0, 0], abs=1e-6)
        assert np.abs(now).max() <= 4.0
        before = now
    assert 2.0 < max(speeds) <= 3.0


# ---- ORCA


def along(x: float) -> tuple[float, float, float]:
    return (x, 0.0, 0.0)


def test_the_plane_of_a_head_on_meeting_by_hand() -> None:
    """At each other at 1 m/s, 8 m apart: in 3 s they are at the 2 m that they have to keep.

    A little faster, and half of what is too much is braked.
    """
    ahead = along(8.0)
    normal, least = avoiding(ahead, along(-2.0), along(1.0), 2.0, PERIOD)
    assert normal == pytest.approx((-1.0, 0.0, 0.0))
    assert least == pytest.approx(-1.0)  # v_x <= 1 m/s: as it is
    free = nearest(along(1.0), [(normal, least)], 5.0)
    assert free == pytest.approx((1.0, 0.0, 0.0))
    fast = avoiding(ahead, along(-2.2), along(1.1), 2.0, PERIOD)
    braked = nearest(along(1.1), [fast], 5.0)
    assert braked == pytest.approx((1.0, 0.0, 0.0), abs=1e-6)


def test_a_near_neighbour_is_passed_at_its_side() -> None:
    """At 3 m, 2 m to keep, the cone is asin(2/3) wide; a velocity in it is turned out of it."""
    closing = (-3.0, 0.3, 0.0)
    normal, least = avoiding(along(3.0), closing, along(3.0), 2.0, PERIOD)
    # Relative velocity (3, -0.3): the nearer side is that of -y, whose edge is at -asin(2/3).
    sine = 2 / 3
    cosine = 5**0.5 / 3
    assert normal == pytest.approx((-sine, -cosine, 0.0), abs=1e-6)
    across = normal[0] * cosine - normal[1] * sine
    assert across == pytest.approx(0.0, abs=1e-6)
    outside = sine * 3.0 - cosine * 0.3  # distance of the velocity from that edge
    expected = -sine * 3.0 + outside / 2
    assert least == pytest.approx(expected, abs=1e-6)


def test_the_nearest_velocity_in_a_corner() -> None:
    planes = [((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 2.0)]
    corner = nearest((0.0, 0.0, 0.5), planes, 9.0)
    assert corner == pytest.approx((1.0, 2.0, 0.5), abs=1e-5)
    root = 0.5**0.5
    slower = nearest((9.0, 9.0, 0.0), [], 1.0)
    assert slower == pytest.approx((root, root, 0.0))


@pytest.fixture(params=[None, "crazyflie2"])
def crossing(request: pytest.FixtureRequest) -> Iterator[LocalVectorEnv]:
    env = LocalVectorEnv(TASKS[1], 32, drones=8, vehicle=request.param, autoreset_mode="Disabled")
    yield env
    env.close()


def test_eight_drones_cross_without_touching(crossing: LocalVectorEnv) -> None:
    flown = fly_episodes(crossing, Orca(crossing.env_spec), 4)
    assert len(flown) == 32
    endings = {one.ending for one in flown}
    assert endings == {"truncated"}
    episodes = [one.episode for one in flown]
    assert episodes == np.repeat(range(4), 8).tolist()
    metrics = np.array([one.telemetry["metrics"] for one in flown])
    clearance = metrics[:, :, 1]
    assert clearance.min() > -0.1  # spheres hold more than what touches
    last_errors = metrics[:, -1, 0]
    assert last_errors.max() < 0.01


def test_one_drone_is_no_swarm() -> None:
    with pytest.raises(InputError, match=r"drones: expected 2 to 128 with .*Formation-v0, got 1"):
        LocalVectorEnv(TASKS[0], 4)


def test_what_orca_cannot_fly_is_one_sentence() -> None:
    alone = spec_with("rotorgram/Hover-v0", action="velocity")
    with pytest.raises(InputError, match="orca: expected a task for several drones, got"):
        Orca(alone)
    positions = spec_with(TASKS[0], action="position", drones=2)
    with pytest.raises(InputError, match=r"orca: expected actions of the level velocity"):
        Orca(positions)


@pytest.mark.parametrize("height", [4.0, -4.0])
def test_two_that_meet_straight_above_each_other_go_to_opposite_sides(height: float) -> None:
    """The side step of each is half of the distance to keep; none of it is vertical."""
    above = (0.0, 0.0, height)
    below = (0.0, 0.0, -height)
    rest = along(0.0)
    one, least = avoiding(above, below, rest, 1.0, PERIOD)
    other, _ = avoiding(below, above, rest, 1.0, PERIOD)
    assert one == (height / 4, 0.0, 0.0)
    assert other == (-height / 4, 0.0, 0.0)
    assert least == pytest.approx(0.5)  # at 4 m/s the middles meet in 1 s: R / 1 s, by halves
