"""The contract of every task: levels, backends, features and vehicles are those of contracts.py.

What a task or a backend promises beyond this has tests of its own.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import contracts
import gymnasium as gym
import numpy as np
import pytest
from contracts import (
    CASES,
    ELEVATION,
    FEATURES,
    FILES,
    HOVER,
    LENGTH,
    STEPS,
    VEHICLES,
    WORLDS,
    Case,
    bits,
    flight,
    results,
)
from gymnasium.utils.env_checker import check_env
from remotes import flying
from rotorgram.agents import PID
from rotorgram.envs import Loop, SingleEnv
from rotorgram.models import InputError, Vehicle

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@every_case
def test_a_batch_has_the_bits_of_single_worlds(case: Case) -> None:
    """Also when some worlds are reset or rest while others fly (fault 38)."""
    steps = flight(Loop(case.config(), WORLDS), range(STEPS))
    for world in range(WORLDS):
        single = Loop(case.config())
        rows = slice(world * case.drones, (world + 1) * case.drones)
        for step in steps:
            single.advance(*(array[rows] for array in step[:4]))
            assert bits(results(single)) == bits({k: x[rows] for k, x in step.results.items()})
            assert single.done.tolist() == step.done[rows].tolist()
            assert single.steps.tolist() == step.steps[rows].tolist()


@every_case
def test_results_keep_to_the_spec(case: Case) -> None:
    """Types, bounds, ends, and arrays that are nobody else's memory."""
    loop = Loop(case.config(), WORLDS)
    kept = []
    for step in flight(loop, range(STEPS)):
        result = step.results
        rewards = result["0 rewards"]
        ends = result["0 terminated"] | result["0 truncated"]
        rests = step.resets | step.frozen
        assert rewards.dtype == np.float64
        assert not (result["0 terminated"] & result["0 truncated"]).any()
        assert not rewards[rests].any()
        assert not ends[rests].any()
        assert (result["0 truncated"] <= (step.steps == LENGTH)).all()
        assert (step.done | (step.steps < LENGTH)).all()
        for array in loop.spec.observation:
            values = result[f"1 {array.name}"]
            low, high = (bound.astype(array.dtype) for bound in array.bounds())
            assert values.shape == (loop.num_envs, *array.shape)
            assert values.dtype == array.dtype
            assert (np.isfinite(values) & (values >= low) & (values <= high)).all()
        kept.append((result, bits(result)))
    for result, before in kept:
        assert bits(result) == before
    for name in ("position", "velocity", "thrust"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(loop.record.state, name)[...] = 0.0


@every_case
def test_no_later_bit_differs_after_a_restore(case: Case) -> None:
    loop = Loop(case.config(), WORLDS)
    flight(loop, range(10))
    snapshot = loop.snapshot()
    kept = bits(snapshot)
    later = [bits(step.results) for step in flight(loop, range(10, STEPS))]
    fresh = Loop(case.config(), WORLDS)
    for other in (loop, fresh):
        other.restore(snapshot)
        assert [bits(step.results) for step in flight(other, range(10, STEPS))] == later
    assert bits(snapshot) == kept


@every_case
def test_what_is_refused_changes_nothing(case: Case) -> None:
    loop = Loop(case.config(), WORLDS)
    flight(loop, range(1))
    before = bits(loop.snapshot())
    rows = loop.num_envs
    good = next(contracts.actions_of(loop))
    wrong = [
        ((np.full_like(good, np.nan),), "actions: expected"),
        ((np.full_like(good, np.inf),), "actions: expected"),
        ((good[:-1],), "actions: expected shape"),
        ((good.astype(complex),), "actions: expected real numbers"),
        ((good, np.ones(rows + 1, bool)), "resets, frozen: expected bool of shape"),
        ((good, None, None, np.ones(rows)), "resets, frozen: expected bool of shape"),
        ((good, np.ones(rows, bool), [-1] * rows), "seed: expected"),
        ((good, np.ones(rows, bool), [1] * (rows + 1)), "seed: expected"),
    ]
    for arguments, sentence in wrong:
        with pytest.raises(InputError, match=f"^{sentence}"):
            loop.advance(*arguments)
    assert bits(loop.snapshot()) == before


@every_case
def test_numbers_change_on_purpose_alone(case: Case, request: pytest.FixtureRequest) -> None:
    """`python tests/contracts.py` writes the numbers anew."""
    name = request.node.callspec.id
    expected = json.loads(contracts.ORACLE.read_text())[name]
    assert contracts.measured(case) == pytest.approx(expected, rel=2e-3, abs=1e-3)


ALONE = {name: case for name, case in (FEATURES | VEHICLES).items() if case.drones == 1}


@pytest.mark.parametrize("case", ALONE.values(), ids=ALONE)
def test_gymnasium_accepts_single_envs(case: Case) -> None:
    env = gym.make(case.env_id, disable_env_checker=True, **case.options).unwrapped
    assert isinstance(env, SingleEnv)
    check_env(env, skip_render_check=True)
    names = [name for array in env.env_spec.telemetry for name in array.components]
    for observation, reward, terminated, truncated, info in flown(env, 3):
        assert env.observation_space.contains(observation)
        assert list(map(type, (reward, terminated, truncated))) == [float, bool, bool]
        assert list(info)[: len(names)] == names
        assert set(map(type, info.values())) == {float}
        terms = [value for name, value in info.items() if name.startswith("reward_")]
        assert reward in (0.0, pytest.approx(sum(terms), abs=1e-7))
    env.close()


def flown(env: Any, seed: int, steps: int = STEPS) -> Iterator[tuple[Any, ...]]:
    """What a reset and the steps of an episode give."""
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    env.action_space.seed(seed)
    for _ in range(steps):
        result = env.step(env.action_space.sample())
        yield result
        if result[2] or result[3]:
            return


@pytest.mark.parametrize("case", ALONE.values(), ids=ALONE)
def test_over_udp(case: Case) -> None:
    local = gym.make(case.env_id, **case.options)
    names = [name for array in local.unwrapped.env_spec.telemetry for name in array.components]
    with flying(case.env_id, **case.options) as pair:
        pair.remote.connect()
        assert pair.remote.observation_space == local.observation_space
        assert pair.remote.action_space == local.action_space
        for here, there in zip(flown(pair.remote, 11), flown(local, 11), strict=True):
            assert bits(here[0]) == bits(there[0])
            assert here[1:4] == there[1:4]
            assert here[4] == {name: there[4][name] for name in names}


# --- do the tasks suit vehicles of any size? ------------------------------------------------------


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_the_pid_of_the_paper_holds_every_vehicle(file: Path) -> None:
    """From 1 m off it stays within 5 cm of the target after 4 s, be the craft 27 g or 20 kg."""
    env = gym.make(ELEVATION, vehicle=file)
    pid = PID(env.unwrapped.env_spec)
    observation, _ = env.reset(seed=0)
    errors = []
    truncated = False
    while not truncated:
        observation, _, terminated, truncated, info = env.step(pid.act(observation))
        assert not terminated
        errors.append(abs(info["elevation_error"]))
    assert errors[0] > 0.2
    assert max(errors[200:]) < 0.05


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_one_cascade_with_the_same_gains_hovers_with_every_vehicle(file: Path) -> None:
    """From 30° of tilt and metres off, within 5 s: the tasks' bands suit 27 g and 20 kg alike."""
    vehicle, env = Vehicle.load(file), gym.make(HOVER, vehicle=file)
    up = vehicle.thrust_high - vehicle.hover_thrust
    down = vehicle.hover_thrust - vehicle.thrust_low
    mix = np.linalg.pinv(vehicle.allocation)
    observation, _ = env.reset(seed=1)
    errors = []
    truncated = False
    while not truncated:
        offset, velocity, nose, axis, rates = observation[:15].astype(np.float64).reshape(5, 3)
        to_world = np.stack((nose, np.cross(axis, nose), axis), axis=1)
        wanted = np.clip(4 * offset - 4 * velocity, -3, 3) + np.array((0, 0, vehicle.gravity))
        tilt = np.cross(axis, wanted / np.linalg.norm(wanted)) @ to_world
        turn = 49 * tilt - 14 * rates - (0, 0, 5 * nose[1])
        force = vehicle.mass * float(wanted @ axis)
        thrust = mix @ np.concatenate(((force,), vehicle.inertia @ turn))
        extra = thrust - vehicle.hover_thrust
        action = np.clip(np.where(extra > 0, extra / up, extra / down), -1, 1)
        observation, _, terminated, truncated, info = env.step(action.astype(np.float32))
        assert not terminated
        errors.append(info["position_error"])
    assert errors[0] > 0.3
    assert max(errors[200:]) < 0.05
    assert abs(info["heading_error"]) < 15


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_storm_clips_the_observations_of_the_elevation_task(up: float) -> None:
    """Wind of 60 m/s accelerates beyond what rotors and gravity can: the bounds are clipped at."""
    effects = {"body_drag": True, "wind": (0.0, 0.0, 60.0 * up)}
    env = gym.make(ELEVATION, vehicle=FILES["racer"], effects=effects, flight_band=1.5)
    low = env.observation_space.low
    high = env.observation_space.high
    observation, _ = env.reset(seed=4)  # a start far from the goal
    seen = [observation]
    terminated = False
    while not terminated:
        observation, _, terminated, _, info = env.step(np.array((up,), np.float32))
        assert env.observation_space.contains(observation)
        seen.append(observation)
    assert abs(info["elevation_error"]) > high[0]  # the metric is not clipped
    assert seen[-1][0] == (low[0] if up > 0 else high[0])
    assert seen[-1][1] == (low[1] if up > 0 else high[1])
