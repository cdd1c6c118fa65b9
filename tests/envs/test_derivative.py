"""The derivative of a step: against torch's gradients, and against differences of NumPy's env."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.agents.policies import flat
from rotorgram.envs import LocalVectorEnv, Outcome, register
from rotorgram.envs.compiled import CompiledLoop
from rotorgram.envs.state import State
from rotorgram.envs.tasks.hover import Hover
from rotorgram.sim.snapshots import Snapshot

FLIGHTS = json.loads((Path(__file__).parents[1] / "data/gradients.json").read_text())["flights"]
DRAWN = {"landing": "the place of the pad is drawn, and the file has none"}
MOTION = ("position", "quaternion", "velocity", "body_rates")
NEAR = "test/Near-v0"
SLAB = """
[[obstacle]]
kind = "box"
position = [0.0, 0.0, 12.0]
size = [20.0, 20.0, 1.0]
"""
PHASES = [[398.0], [267.0]]  # rows of the circle at which the file's drones begin


class Near(Hover):
    """Its reward is the clearance, m."""

    def outcome(self, state: State) -> Outcome:
        return replace(super().outcome(state), reward={"room": state.clearance})


def env_of(env_id: str, count: int, **keywords: Any) -> LocalVectorEnv:
    compiled = keywords.pop("compiled", True)
    backend = {"name": "rigid", "dtype": "float64", "compiled": compiled}
    env = LocalVectorEnv(env_id, count, backend=backend, autoreset_mode="Disabled", **keywords)
    env.reset(seed=7)
    return env


def started(env: LocalVectorEnv, start: dict[str, Any]) -> Snapshot:
    """The snapshot of an env at other starts."""
    snapshot = env.snapshot()
    parts = [np.array(start[name]) for name in MOTION]
    snapshot["Flight/motion"] = np.concatenate(parts, axis=-1)
    for name in ("position", "behind"):
        if f"record/memory/{name}" in snapshot:
            snapshot[f"record/memory/{name}"] = parts[0]
    if "record/memory/index" in snapshot:
        snapshot["record/memory/index"] = np.array(PHASES)
    return snapshot


def derivatives(
    env: LocalVectorEnv,
    actions: np.ndarray,
    by_reward: np.ndarray,
    by_last: np.ndarray,
    last: int | None = None,
) -> np.ndarray:
    """By actions (T, N, k), of rewards (T, N) and of the last observations (N, n).

    After the step `last` nothing counts, whatever the derivatives are.
    """
    assert isinstance(env.loop, CompiledLoop)
    machine = env.loop.machine()
    assert machine is not None
    machine.tape = []
    for row in actions:
        env.advance(row)
    derivative = machine.derivative()
    found = np.zeros_like(actions)
    by_observation = by_last
    for step in reversed(range(len(actions))):
        before = machine.tape[step]
        ended = np.full(env.num_envs // env.config.drones, step == last)
        found[step] = derivative.back(before, actions[step], by_reward[step], by_observation, ended)
        by_observation = np.zeros_like(by_last)
    return found


@pytest.mark.parametrize("name", sorted(FLIGHTS.keys() - DRAWN.keys()))
def test_the_gradients_of_torch(name: str) -> None:
    """Of minus the sum of the rewards of 8 steps. Ours are rounded to float32."""
    flight = FLIGHTS[name]
    env = env_of(flight["env_id"], 2, vehicle=flight["vehicle"], **flight["options"])
    env.restore(started(env, flight["start"]))
    actions = np.array(flight["actions"], np.float32)
    before = env.snapshot()
    rewards = []
    for row in actions:
        env.advance(row)
        rewards.append(env.rewards)
    assert np.array(rewards) == pytest.approx(np.array(flight["rewards"]), abs=1e-13)
    env.restore(before)
    nothing = np.zeros_like(flat(env.observations, env.env_spec, 2))
    found = derivatives(env, actions, -np.ones((8, 2)), nothing)
    expected = np.array(flight["gradient"])
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-8)


def anywhere(count: int) -> dict[str, np.ndarray]:
    """Random states about Hover's goal, tilted by less than 60 degrees, (W, 1, ...)."""
    draw = np.random.default_rng(3)
    turn = draw.normal(scale=0.15, size=(count, 1, 4))
    turn[..., 0] = 1.0
    place = draw.normal(scale=0.5, size=(count, 1, 3))
    place[..., 2] += 5.0
    velocity, rates = draw.normal(size=(2, count, 1, 3))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    return dict(zip(MOTION, (place, turn, velocity, rates), strict=True))


def flown(env: LocalVectorEnv, actions: np.ndarray, by_reward: Any, by_last: Any) -> np.ndarray:
    """What `derivatives` differentiates, (N,)."""
    total = np.zeros(env.num_envs)
    for row, by in zip(actions, by_reward, strict=True):
        env.advance(row)
        total += by * env.rewards
    seen = flat(env.observations, env.env_spec, env.num_envs)
    result: np.ndarray = total + (by_last * seen).sum(axis=1, dtype=float)
    return result


@pytest.mark.parametrize(
    ("of_rewards", "size", "near"),
    [(1.0, 2.0**-12, {"rel": 1e-5, "abs": 1e-6}), (0.0, 2.0**-8, {"rel": 1e-3, "abs": 2e-4})],
    ids=["rewards", "observations"],
)
def test_three_steps_against_differences_of_numpy(
    of_rewards: float, size: float, near: dict[str, float]
) -> None:
    """From random states. Observations are rounded to float32, so their steps are larger.

    No action is near 0, where the slope of a thrust changes.
    """
    count = 12
    draw = np.random.default_rng(4)
    env = env_of("rotorgram/Hover-v0", count)
    theirs = env_of("rotorgram/Hover-v0", count, compiled=False)
    start = started(env, anywhere(count))
    env.restore(start)
    sizes = draw.uniform(0.1, 0.5, (3, count, 4))
    actions = (sizes * draw.choice((-1.0, 1.0), sizes.shape)).astype(np.float32)
    by_reward = of_rewards * draw.normal(size=(3, count))
    by_last = (1.0 - of_rewards) * draw.normal(size=(count, 19)).astype(np.float32)
    found = derivatives(env, actions, by_reward, by_last)
    for step, rotor in np.ndindex(3, 4):
        ends = []
        for move in (size, -size):
            moved = actions.copy()
            moved[step, :, rotor] += move
            theirs.restore(start)
            ends.append((flown(theirs, moved, by_reward, by_last), moved[step, :, rotor]))
        (upper, high), (lower, low) = ends
        expected = (upper - lower) / (high.astype(float) - low)
        assert found[step, :, rotor] == pytest.approx(expected, **near), (step, rotor)
    assert abs(found).max() > 0.01


def test_two_drones_of_a_world_against_differences_of_numpy() -> None:
    """What one does changes the rewards of both."""
    options: dict[str, Any] = {"drones": 2, "vehicle": "crazyflie2", "action": "rates"}
    env = env_of("rotorgram/Formation-v0", 2, **options)
    theirs = env_of("rotorgram/Formation-v0", 2, compiled=False, **options)
    start = env.snapshot()
    actions = np.full((2, 2, 4), 0.1, np.float32)
    nothing = np.zeros_like(flat(env.observations, env.env_spec, 2))
    by_reward = np.array([[1.0, -2.0], [3.0, 0.5]])
    found = derivatives(env, actions, by_reward, nothing)
    size = 2.0**-10
    for place in np.ndindex(actions.shape):
        ends = []
        for move in (size, -size):
            moved = actions.copy()
            moved[place] += move
            theirs.restore(start)
            ends.append(flown(theirs, moved, by_reward, nothing).sum())
        expected = (ends[0] - ends[1]) / (2 * size)
        assert found[place] == pytest.approx(expected, rel=1e-3, abs=1e-4), place
    assert abs(found).max() > 0.01


def test_a_flight_in_a_wood_against_differences() -> None:
    """Six steps of Forest-v0. Where a limit lies between the ends of a difference, both are wrong.

    Actions are given: what the depth camera shows changes nothing.
    """
    draw = np.random.default_rng(1)
    count, steps, size = 16, 6, 2.0**-9
    options: dict[str, Any] = {"density": 0.2, "effects": {"motor_lag": True}}
    env = env_of("rotorgram/Forest-v0", count, **options)
    ahead = np.zeros((count, 4), np.float32)
    ahead[:, 0] = 0.15
    for _ in range(40):
        env.advance(ahead)
    start = env.snapshot()
    actions = draw.uniform(-0.4, 0.4, (steps, count, 4)).astype(np.float32)
    by_reward = draw.normal(size=(steps, count))
    nothing = np.zeros_like(flat(env.observations, env.env_spec, count))
    found = derivatives(env, actions, by_reward, nothing)
    errors = []
    for step, number in np.ndindex(steps, 4):
        ends = []
        for move in (size, -size):
            moved = actions.copy()
            moved[step, :, number] += move
            env.restore(start)
            ends.append((flown(env, moved, by_reward, nothing), moved[step, :, number]))
        (upper, high), (lower, low) = ends
        expected = (upper - lower) / (high.astype(float) - low)
        errors.append(abs(found[step, :, number] - expected))
    assert np.median(errors) < 1e-6
    assert np.mean(np.array(errors) < 1e-4) > 0.9
    assert np.median(abs(found)) > 1e-3


def test_a_distance_to_a_solid_has_a_derivative(tmp_path: Path) -> None:
    """Under a slab a rotor's output of 1 lifts 20 kg by 51 N: 0.051 m/s after a step of 0.02 s.

    So in its own step the craft comes 0.51 mm nearer, and 1.02 mm in each later one.
    """
    register(NEAR, Near)
    scene = tmp_path / "slab.toml"
    scene.write_text(SLAB)
    level = {"start_tilt": 0.0, "start_heading": 0.0, "scene": str(scene)}
    env = env_of(NEAR, 3, **level)
    actions = np.full((4, 3, 4), 0.1, np.float32)
    nothing = np.zeros_like(flat(env.observations, env.env_spec, 3))
    found = derivatives(env, actions, np.ones((4, 3)), nothing)
    ways = [0.51 + 1.53 + 2.55 + 3.57, 0.51 + 1.53 + 2.55, 0.51 + 1.53, 0.51]
    expected = -1e-3 * np.array(ways)[:, None, None] * np.ones((4, 3, 4))
    assert found == pytest.approx(expected, rel=1e-2)


def test_a_derivative_knows_the_solids_of_its_step() -> None:
    """Later steps begin episodes among other trees, in the same memory."""
    register(NEAR, Near)
    env = env_of(NEAR, 4, scene="forest:new,density=0.1,size=40x40", episode_length=3)
    for seed in range(30):  # until there is room for the largest layout
        env.reset(seed=seed)
    machine = env.loop.machine()
    machine.tape = []
    actions = np.full((4, 4), 0.1, np.float32)
    tables = env.loop.world.scenery.layouts.tables
    for _ in range(3):
        env.advance(actions)
    derivative = machine.derivative()
    nothing = np.zeros_like(flat(env.observations, env.env_spec, 4))
    ended = np.ones(4, bool)
    before = derivative.back(machine.tape[0], actions, np.ones(4), nothing, ended)
    layouts = env.loop.world.scenery.seeds.copy()
    env.advance(actions, env.loop.done)
    env.advance(actions)
    assert (env.loop.world.scenery.seeds != layouts).all()
    assert env.loop.world.scenery.layouts.tables is tables
    after = derivative.back(machine.tape[0], actions, np.ones(4), nothing, ended)
    assert before.tobytes() == after.tobytes()
    other = derivative.back(machine.tape[3], actions, np.ones(4), nothing, ended)
    assert abs(before).min() > 0.0
    assert (before != other).any(axis=1).all()


def test_after_an_end_nothing_counts() -> None:
    """Three steps of which the loss has the first two: as two steps alone."""
    draw = np.random.default_rng(5)
    actions = draw.uniform(-0.5, 0.5, (3, 4, 4)).astype(np.float32)
    by_reward = draw.normal(size=(3, 4))
    by_last = np.full((4, 19), np.nan, np.float32)
    ours = derivatives(env_of("rotorgram/Hover-v0", 4), actions, by_reward, by_last, last=1)
    nothing = np.zeros((4, 19), np.float32)
    short = env_of("rotorgram/Hover-v0", 4)
    alone = derivatives(short, actions[:2], by_reward[:2], nothing)
    assert ours[:2].tobytes() == alone.tobytes()
