"""The landing task against values worked out by hand."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import GOAL_OFFSET, TABLES, observed, rows_of
from pilot import Pilot, fly, limited
from rotorgram.models import Vehicle

from flights import Shares, state_of, task_of

ID = "rotorgram/Landing-v0"
REST = 0.4  # height of the paper's craft on the ground, m
MIDDLE = (0.5, 0.5, 0.5)  # of the start's band


def begun(direction: float = 0.5, phase: float = 0.5, side: float = 1.0, **options: Any) -> Any:
    """A task whose pad begins at these shares of its draws, at its largest speed."""
    task = task_of(ID, **options)
    task.begin(Shares(MIDDLE, 1.0, direction, phase, side))
    return task


def moved(task: Any, steps: int, **state: Any) -> Any:
    for _ in range(steps):
        task.update_memory(state_of(**state))
    return task


def test_a_start_is_above_the_middle_of_the_path() -> None:
    shares = Shares((0.0, 0.5, 1.0), 0.5, 0.5, 0.5, 0.5)
    pose = task_of(ID).begin(shares)
    assert pose.position == pytest.approx([-1.0, 0.0, REST + 5.0])
    assert pose.velocity is None
    assert pose.quaternion is None


def test_a_pad_on_a_circle() -> None:
    """At 1 m/s on a radius of 2 m it turns by 0.01 rad in a step of 0.02 s, to the left."""
    task = begun()  # at φ = 0
    rest = state_of()
    assert task.goal(rest) == pytest.approx([2.0, 0.0, REST])
    moved(task, 100)
    cosine = math.cos(1)
    sine = math.sin(1)
    assert task.goal(rest) == pytest.approx([2 * cosine, 2 * sine, REST])
    state = state_of(velocity=(9.0, 9.0, 9.0))
    seen = observed(task, state)
    assert seen[19:] == pytest.approx([-sine, cosine])  # after 15 and 4 rotors
    right = begun(side=0.0)
    moved(right, 100)
    assert right.goal(rest) == pytest.approx([2 * cosine, -2 * sine, REST])


def test_a_pad_on_a_line() -> None:
    """Along y (a quarter of the way round), from the middle (φ = 90°) backwards."""
    task = begun(direction=0.75, phase=0.75, motion="line", pad_path=3.0, pad_speed=1.5)
    assert task.goal(state_of()) == pytest.approx([0.0, 0.0, REST])
    seen = observed(task, state_of())
    assert seen[19:] == pytest.approx([0.0, -1.5])  # its largest speed is in the middle
    moved(task, 50)  # φ grows by 1.5 / 3 · 1 s
    assert task.goal(state_of()) == pytest.approx([0.0, -3 * math.sin(0.5), REST])


def test_observation_by_hand() -> None:
    task = begun()
    state = state_of(**TABLES["landing: observation by hand, state"])
    seen = observed(task, state)
    expected = TABLES["landing: observation by hand, expected"]
    assert seen == pytest.approx(expected, abs=1e-12)
    (spec,) = task.observation
    assert spec.shape == (21,)
    assert spec.components[:3] == GOAL_OFFSET
    assert spec.components[19:] == ("velocity of the pad x", "velocity of the pad y")
    _, high = spec.bounds()
    assert high[[0, 19]].tolist() == [20.0, 1.001]


STILL = {"motion": "line", "pad_speed": 0.0}  # a pad that rests at (2, 0)


@rows_of("what is a landing", "before, at, landed")
def test_what_is_a_landing(before: dict[str, Any], at: dict[str, Any], landed: bool) -> None:
    task = begun(**STILL)
    place = {"position": (2.0, 0.0, REST + 0.01), **before}
    moved(task, 1, **place)
    outcome = task.outcome(state_of(**place))
    assert not outcome.terminated
    assert outcome.metrics["landed"] == 0.0
    state = {"position": (2.0, 0.0, REST), "touching": True, **at}
    moved(task, 1, **state)
    outcome = task.outcome(state_of(**state))
    assert bool(outcome.terminated)
    assert outcome.metrics["landed"] == landed
    assert outcome.reward["landing"] == 20.0 * landed
    assert outcome.reward["termination"] == pytest.approx(-14.0 * (not landed))


def test_drift_is_relative_to_the_pad() -> None:
    """The pad is at (2, 0) and moves along +y at 1 m/s: who stands still drifts at 1 m/s."""
    for speed, landed in ((1.0, True), (0.6, True), (0.4, False), (0.0, False)):
        task = begun()
        before = state_of(position=(2.0, 0.0, REST + 0.01), velocity=(0.0, speed, -0.2))
        task.update_memory(before)
        state = state_of(position=(2.0, 0.0, REST), touching=True)
        task.update_memory(state)
        outcome = task.outcome(state)
        assert outcome.metrics["landed"] == landed
        relative = math.hypot(1.0 - speed, 0.2)
        assert outcome.metrics["relative_speed"] == pytest.approx(relative, abs=0.03)
        assert outcome.metrics["pad_distance"] == pytest.approx(0.04, abs=1e-3)  # in two steps


def test_progress_by_hand() -> None:
    """From 5 m away at rest to 4.5 m away at 2 m/s: -(4.5 + 0.5 · 2) + 5; then 4 m at 1 m/s."""
    task = begun(**STILL, start_height=4.0)  # start at (0, 0, 4.4), the pad at (2, 0, 0.4)
    start = math.hypot(2.0, 4.0)
    first = state_of(position=(2.0, 4.5, REST), velocity=(2.0, 0.0, 0.0))
    task.update_memory(first)
    rates = (3.0, 0, 4.0)
    state = state_of(position=(2.0, 4.0, REST), velocity=(0.0, 1.0, 0.0), body_rates=rates)
    reward = task.outcome(state).reward
    assert reward["progress"] == pytest.approx(start - 5.5)
    task.update_memory(state)
    reward = task.outcome(state).reward
    assert reward["progress"] == pytest.approx(5.5 - 4.5)
    assert reward["rates"] == pytest.approx(-0.01)
    assert reward["time"] == -0.1
    assert reward["termination"] == 0.0
    assert reward["landing"] == 0.0


@rows_of("landing: ends", "change, terminated", ids=str)
def test_ends(change: dict[str, Any], terminated: bool) -> None:
    task = begun(**STILL)
    state = state_of(**{"position": (2.0, 3.0, 3.0), **change})
    outcome = task.outcome(state)
    assert outcome.terminated == terminated
    assert outcome.reward["termination"] == pytest.approx(-14.0 * terminated)
    assert outcome.metrics["landed"] == 0.0


@rows_of("a pilot lands and a stone does not", "vehicle, motion, effects")
def test_a_pilot_lands_and_a_stone_does_not(vehicle: str, motion: str, effects: Any) -> None:
    """On either path, with a 20 kg and a 27 g craft, also in wind."""
    craft = Vehicle.load(vehicle)
    options = {"vehicle": vehicle, "motion": motion, "effects": effects}
    env: Any = gym.make_vec(ID, num_envs=16, autoreset_mode="Disabled", **options)
    metrics = fly(env, Pilot(craft), lambda seen: wanted(seen, craft.num_rotors))
    landed = metrics[-1, :, 0]
    assert landed.tolist() == [1.0] * 16
    env.reset(seed=0)
    falling = np.full(env.action_space.shape, -0.5, np.float32)
    while not env.done.all():
        env.advance(falling, None, None, env.done)
    landed = env.telemetry["metrics"][:, 0]
    assert not landed.any()


def wanted(seen: np.ndarray, rotors: int) -> np.ndarray:
    """Follow the pad; come down to 1 m above it, and on it only when right above it."""
    offset = seen[:, :3]
    pad = seen[:, 15 + rotors :]
    speed = seen[:, 3:6] - np.pad(pad, ((0, 0), (0, 1)))
    acceleration = 5 * offset - 4 * speed
    above = np.hypot(*offset.T[:2]) < 0.8
    climb = np.where(above, -0.8, np.clip(offset[:, 2] + 1, -1, 1))
    acceleration[:, 2] = 3 * (climb - speed[:, 2])
    return limited(acceleration, 4.0)
