"""The recovery task against values worked out by hand, and the moments of its starts."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from bounds import least_height_lost, recovery_bounds
from contracts import (
    TABLES,
    check_outcome,
    everyone,
    loop_of,
    observed,
    rows_of,
    spec_with,
    zero_actions,
)
from pilot import Pilot, fly, limited
from rotorgram.envs.tasks.recovery import RecoveryOptions
from rotorgram.models import Vehicle
from rotorgram.models.errors import InputError
from scipy.special import fresnel

from flights import Shares, state_of, task_of

ID = "rotorgram/Recovery-v0"
COUNT = 4000
LARGE = 1.95 / math.sqrt(COUNT)  # distance of Kolmogorov and Smirnov that one in a thousand exceeds


def begun(**options: Any) -> Any:
    task = task_of(ID, **options)
    task.begin(Shares(*[0.5] * 7))
    return task


def test_a_start_by_hand() -> None:
    """The quaternion of Shoemake for (1/4, a = 90°, b = 180°), thrown up and along y."""
    task = task_of(ID, goal=(1.0, 2.0, 30.0))
    shares = Shares(0.25, 0.75, 1.0, 1.0, 0.8, 0.75, (1.0, 0.5, 0.0))
    pose = task.begin(shares)
    assert pose.position.tolist() == [1.0, 2.0, 30.0]
    root = math.sqrt(0.75)
    assert pose.quaternion == pytest.approx([-0.5, root, 0.0, 0.0], abs=1e-12)
    assert pose.velocity == pytest.approx([0.0, 2.4, 1.8])  # 3 m/s at a sine of 0.6
    assert pose.body_rates == pytest.approx([10.0, 0.0, -task.spin[2]])


def test_a_slow_turner_spins_slower() -> None:
    """What the largest torque stops in 0.5 s: of the paper's 100 N at arms of 1 m, 200 N·m."""
    vehicle = Vehicle.load()
    task = task_of(ID)
    about_x, _, about_z = np.diag(vehicle.inertia)
    turning = vehicle.turning((1.0, 0.0, 0.0))
    assert turning == pytest.approx(200.0 / about_x)
    reaction = vehicle.rotors[0].reaction[2]
    yaw = 200.0 * abs(reaction) / about_z
    assert task.spin == pytest.approx([10.0, 10.0, 0.5 * yaw])
    slow = task_of(ID, spin=0.1)
    assert slow.spin.tolist() == [0.1, 0.1, 0.1]
    tiny = task_of(ID, spin=100.0, vehicle="crazyflie2")
    assert tiny.spin[:2].tolist() == [100.0, 100.0]
    assert 25.0 < tiny.spin[2] < 35.0


@pytest.fixture(scope="module")
def starts() -> Any:
    loop = loop_of(ID, COUNT, spin=5.0)
    loop.advance(zero_actions(COUNT, 4), everyone(COUNT), list(range(COUNT)))
    state = loop.world.state
    arrays = {}
    for name in ("position", "quaternion", "velocity", "body_rates"):
        values = getattr(state, name)
        arrays[name] = values[:, 0].copy()
    loop.close()
    return arrays


def even(values: np.ndarray, low: float, high: float) -> bool:
    """Whether values pass for uniform ones."""
    share = np.sort((values - low) / (high - low))
    distance = abs(share - np.linspace(0, 1, COUNT))
    return bool(distance.max() < LARGE)


def test_attitudes_are_uniform(starts: Any) -> None:
    """Over rotations: the mean matrix is 0, each axis is uniform on the sphere, and the density of
    the angle θ is (1 - cos θ) / π."""
    w, x, y, z = starts["quaternion"].T
    squares = np.square(starts["quaternion"])
    assert squares.sum(axis=1) == pytest.approx(1.0)
    # Fourth moments of a uniform unit quaternion: E[w²] = 1/4, E[w⁴] = 1/8, E[w² x²] = 1/24.
    assert squares.mean(axis=0) == pytest.approx(0.25, abs=0.015)
    assert (w**4).mean() == pytest.approx(1 / 8, abs=0.01)
    assert (w * w * x * x).mean() == pytest.approx(1 / 24, abs=0.003)
    pairs = [w * x, w * y, w * z, x * y, y * z, z * x]
    assert np.mean(pairs, axis=1) == pytest.approx(0.0, abs=0.015)
    body_x = [1 - 2 * (y * y + z * z)]
    body_x.append(2 * (x * y + w * z))
    body_x.append(2 * (x * z - w * y))
    body_z = [2 * (x * z + w * y)]
    body_z.append(2 * (y * z - w * x))
    body_z.append(1 - 2 * (x * x + y * y))
    for cosines in (*body_x, *body_z):
        assert even(cosines, -1.0, 1.0)
    angle = 2 * np.arccos(np.minimum(abs(w), 1.0))
    share = (angle - np.sin(angle)) / math.pi
    assert even(share, 0.0, 1.0)


def test_throws_fill_their_ranges(starts: Any) -> None:
    velocity = starts["velocity"]
    speed = np.linalg.norm(velocity, axis=1)
    assert even(speed, 0.0, 3.0)
    for component in velocity.T:
        assert even(component / speed, -1.0, 1.0)
    limits = task_of(ID, spin=5.0).spin
    for rates, limit in zip(starts["body_rates"].T, limits, strict=True):
        assert even(rates, -limit, limit)
    assert (starts["position"] == (0.0, 0.0, 20.0)).all()


def test_observation_by_hand() -> None:
    state = state_of(**TABLES["recovery: observation by hand, state"])
    seen = observed(begun(frame="world"), state)
    expected = TABLES["recovery: observation by hand, expected"]
    assert seen == pytest.approx(expected, abs=1e-12)


def test_observation_in_the_body_frame_by_hand() -> None:
    """Turned left by 90° and then rolled by 90°, right side down: body x is world y, body y is
    world z, and body z is world x."""
    state = state_of(**TABLES["recovery: observation in the body frame by hand, state"])
    seen = observed(begun(), state)
    expected = TABLES["recovery: observation in the body frame by hand, expected"]
    assert seen == pytest.approx(expected, abs=1e-12)
    (spec,) = task_of(ID).observation
    assert spec.components[5:8] == ("velocity z", "up x", "up y")
    assert spec.frame == "body"


@pytest.mark.parametrize("name", ["Recovery", "Waypoints", "Racing", "Gates"])
@rows_of("the frame is by default that of the action", "action, frame")
def test_the_frame_is_by_default_that_of_the_action(action: str, frame: str, name: str) -> None:
    env_id = f"rotorgram/{name}-v0"
    assert task_of(env_id, action=action).body == (frame == "body")
    for chosen in ("body", "world"):
        assert task_of(env_id, action=action, frame=chosen).body == (chosen == "body")
    with pytest.raises(
        InputError, match=r"^frame: expected 'body' or 'world', or none, got 'nose'"
    ):
        spec_with(env_id, frame="nose")


PLACE = {"position": (0.0, 0.0, 20.0)}


@rows_of("recovery: outcome by hand", "change, terms, terminated", ids=str)
def test_outcome_by_hand(change: dict[str, Any], terms: dict[str, float], terminated: bool) -> None:
    state = state_of(**{**PLACE, **change})
    outcome = begun().outcome(state)
    check_outcome(outcome, terms, terminated)


@rows_of("what is recovered", "change, recovered", ids=str)
def test_what_is_recovered(change: dict[str, Any], recovered: bool) -> None:
    state = state_of(**{**PLACE, **change})
    outcome = begun().outcome(state)
    assert outcome.metrics["recovered"] == recovered


def test_time_and_height_lost_by_hand() -> None:
    """Steps of 0.02 s: it is away, back, away again, and then back for good."""
    task = begun()
    heights = TABLES["recovery: time and height lost by hand, heights"]
    told = []
    for step, height in enumerate(heights, start=1):
        state = state_of(position=(0.0, 0.0, height), time=0.02 * step)
        task.update_memory(state)
        metrics = task.outcome(state).metrics
        row = [metrics[name] for name in ("recovered", "recovery_time", "height_lost")]
        told.append(row)
    expected = TABLES["recovery: time and height lost by hand, expected"]
    np.testing.assert_allclose(told, expected, atol=1e-12)
    task.begin(Shares(*[0.5] * 7))
    metrics = task.outcome(state_of(**PLACE)).metrics
    assert metrics["recovery_time"] == 0.0
    assert metrics["height_lost"] == 0.0


@pytest.mark.parametrize("vehicle", ["paper", "crazyflie2", "heavy_hexa"])
def test_a_pilot_recovers_and_a_stone_does_not(vehicle: str) -> None:
    """All of 32 throws, in 8 s, and it loses more height than the bound of each."""
    craft = Vehicle.load(vehicle)
    env: Any = gym.make_vec(
        ID, num_envs=32, autoreset_mode="Disabled", vehicle=vehicle, frame="world"
    )
    seen = env.reset(seed=0)[0].astype(float)
    # What the throws lose at least, by their tilts, climbs and spins about x and y.
    cosine = np.clip(seen[:, 11], -1, 1)
    tilt = np.arccos(cosine)
    spin = np.hypot(seen[:, 12], seen[:, 13])
    roll = craft.turning((1.0, 0.0, 0.0))
    pitch = craft.turning((0.0, 1.0, 0.0))
    turn = 1.01 * math.hypot(roll, pitch)
    force = craft.thrust_high @ craft.allocation[0]
    lift = float(force) / craft.mass
    least = least_height_lost(tilt, seen[:, 5], spin, turn, (0.0, lift), craft.gravity)
    pilot = Pilot(craft)

    def wanted(seen: np.ndarray) -> np.ndarray:
        acceleration = 2 * seen[:, :3] - 2.5 * seen[:, 3:6]
        return limited(acceleration, pilot.most)

    metrics = fly(env, pilot, wanted)
    assert env.truncated.all()
    recovered, time, lost, error = metrics[-1].T
    assert recovered.all()
    assert error.max() < 0.05
    assert (time < 7.0).all()
    assert (lost > least).all()
    assert least.max() > 0.2
    env.reset(seed=0)
    falling = np.full(env.action_space.shape, -1.0, np.float32)
    while not env.done.all():
        env.advance(falling, None, None, env.done)
    height_lost = env.telemetry["metrics"][:, 2]
    assert height_lost.min() > 10.0


def test_least_height_lost_by_hand() -> None:
    """Upright and falling at 6 m/s, with 5 m/s² to brake: 36 / 10 m."""
    one = np.ones(1)
    none = 0 * one
    lost = least_height_lost(none, -6 * one, none, 40.0, (0.0, 14.8), 9.8)
    assert lost == pytest.approx([3.6], rel=2e-3)
    lost = least_height_lost(none, one, none, 40.0, (0.0, 14.8), 9.8)
    assert lost.tolist() == [0.0]
    # Upside down: it falls freely until its tilt is 90°, which takes sqrt(π / a); then the cosine
    # of the tilt, -cos(a t² / 2), gives an integral of Fresnel; upright it is at sqrt(2π / a).
    turn = 40.0
    lift = 19.6
    g = 9.8
    scale = math.sqrt(math.pi / turn)
    time = np.linspace(scale, math.sqrt(2) * scale, 20001)
    _, cosines = fresnel(time / scale)
    _, at_first = fresnel(1.0)
    gained = -lift * scale * (cosines - at_first)
    speed = -g * time + gained
    means = (speed[1:] + speed[:-1]) / 2
    turned = np.sum(means * np.diff(time))
    way = -g * scale**2 / 2 + turned
    braked = speed[-1] ** 2 / (2 * (lift - g))
    by_hand = -way + braked
    lost = least_height_lost(math.pi * one, none, none, turn, (0.0, lift), g)
    assert lost == pytest.approx([by_hand], rel=5e-3)


def test_bounds_of_the_papers_vehicle() -> None:
    """2 sqrt(θ / a) for the largest torque, over tilts whose cosines are uniform."""
    vehicle = Vehicle.load()
    bounds = recovery_bounds(RecoveryOptions(), vehicle)
    cosines = np.linspace(-1, 1, 20001)
    tilts = np.arccos(cosines)
    largest = 200.0 / vehicle.inertia[0, 0]  # two rotors of 100 N at arms of 1 m
    times = 2 * np.sqrt(tilts / largest)
    assert bounds["turn_upright"] == pytest.approx(times.mean(), rel=0.02)
    assert 0.02 < bounds["height_lost"] < 0.5  # most throws spin the craft upright
