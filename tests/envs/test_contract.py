"""The contract of every vehicle in every task: alone, in a batch, over UDP, on every backend.

What a task or a backend promises beyond this has tests of its own: test_env.py, test_vector.py,
test_remote.py, test_rigid.py. Here the vehicles vary: those of the tests, and those
of the library.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from gymnasium.utils.env_checker import check_env
from remotes import flying
from rotorgram.agents import PID
from rotorgram.envs import LocalVectorEnv, SingleEnv, registry
from rotorgram.envs.spec import component_names
from rotorgram.models import QUAD_XML, Vehicle

DATA = Path(__file__).parents[1] / "data"
ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
TASKS = sorted(  # that one drone can fly
    name
    for name in gym.registry
    if name.startswith("rotorgram/") and registry.task_type(name).min_drones == 1
)
FILES = {"quad": QUAD_XML}
FILES |= {path.stem: path for path in sorted(DATA.glob("*.xml"))}
FILES |= {path.parent.name: path for path in sorted(QUAD_XML.parent.glob("*/*/vehicle.toml"))}
N = 3
STEPS = 40
STORM = {"wind": (4.0, -3.0, 6.0), "gusts": 8.0}


def pairs(every: int) -> Any:
    """Tasks and vehicles: each task with one vehicle in so many, each vehicle with some tasks."""
    chosen = [
        (env_id, name)
        for row, env_id in enumerate(TASKS)
        for column, name in enumerate(FILES)
        if (row + column) % every == 0
    ]
    return pytest.mark.parametrize(
        ("env_id", "file"),
        [(env_id, FILES[name]) for env_id, name in chosen],
        ids=[f"{env_id[10:-3]}-{name}" for env_id, name in chosen],
    )


everything = pairs(1)
some = pairs(3)


@cache
def effects_of(file: Path) -> dict[str, Any]:
    """All effects that a vehicle has coefficients for; in a storm, if it feels air."""
    vehicle = Vehicle.load(file)
    told = vehicle.coefficients
    rotors = told.rotors
    drag = told.drag
    battery = told.battery
    felt = (rotors.drag, rotors.inflow, rotors.lift)
    given = {
        "motor_lag": rotors.time_constant,
        "thrust_curve": rotors.curve,
        "battery": battery.full and battery.capacity and rotors.power,
        "body_drag": drag.linear or drag.quadratic,
        "rotor_drag": rotors.thrust_coefficient and any(felt),
        "ground_effect": rotors.radius,
    }
    effects: dict[str, Any] = {name: True for name, value in given.items() if value}
    if effects.keys() & {"body_drag", "rotor_drag"}:
        effects |= STORM
    share = (0.9, *(1.0 for _ in vehicle.rotors[1:]))
    return {**effects, "efficiency": share, "payload": 0.1 * vehicle.mass, "cable": 0.5}


def options_of(env_id: str, file: Path, windy: bool = True) -> dict[str, Any]:
    effects = effects_of(file)
    if "Payload" in env_id:  # it hangs one itself
        effects = {name: x for name, x in effects.items() if name not in ("payload", "cable")}
    return {"vehicle": file, "episode_length": STEPS} | (
        {"effects": effects, "randomize": {"mass": "uniform(0.9, 1.1)"}} if windy else {}
    )


def actions_of(space: gym.Space, seed: int) -> Iterator[np.ndarray]:
    """Random, then all at one bound, then at the other: what drives a craft to its limits."""
    dice = np.random.default_rng(seed)
    box = space
    assert isinstance(box, gym.spaces.Box)
    for step in range(STEPS):
        limit = (None, box.high, box.low)[3 * step // STEPS]
        yield dice.uniform(box.low, box.high).astype(np.float32) if limit is None else limit


def names_of(env: Any) -> list[str]:
    return [name for array in env.env_spec.telemetry for name in component_names(array)]


def flown(env: gym.Env, seed: int, steps: int = STEPS) -> Iterator[tuple[Any, ...]]:
    """What a reset and the steps of an episode give, as (observation, reward, ends, info)."""
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for _, action in zip(range(steps), actions_of(env.action_space, seed), strict=False):
        yield (result := env.step(action))
        if result[2] or result[3]:
            return


@some
def test_alone_without_effects(env_id: str, file: Path) -> None:
    check_alone(env_id, file, windy=False)


@everything
def test_alone(env_id: str, file: Path) -> None:
    check_alone(env_id, file, windy=True)


def check_alone(env_id: str, file: Path, windy: bool) -> None:
    env = gym.make(env_id, disable_env_checker=True, **options_of(env_id, file, windy)).unwrapped
    assert isinstance(env, SingleEnv)
    check_env(env, skip_render_check=True)
    first = list(flown(env, 3))
    again = list(flown(env, 3))
    telemetry = names_of(env)
    for observation, reward, terminated, truncated, info in first:
        assert env.observation_space.contains(observation)  # shape, dtype, bounds
        assert np.isfinite(observation).all()
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert not (terminated and truncated)
        assert list(info)[: len(telemetry)] == telemetry
        assert set(map(type, info.values())) == {float}
        assert np.isfinite(list(info.values())).all()
    terms = [name for name in first[1][4] if name.startswith("reward_")]
    for _, reward, _, _, info in first[1:]:
        assert reward == pytest.approx(sum(info[name] for name in terms), abs=1e-12)
    assert first[-1][2] or len(first) == STEPS + 1
    assert first[-1][2] or first[-1][3]
    for one, other in zip(first, again, strict=True):
        assert one[0].tobytes() == other[0].tobytes()  # and no view: the second flight is later
        assert one[1:] == other[1:]
    assert len({one[0].tobytes() for one in first}) == len(first)
    env.close()


@some
def test_in_a_batch(env_id: str, file: Path) -> None:
    """Each drone of a batch gets the bits of a single env with its seed."""
    options = options_of(env_id, file)
    batch = gym.make_vec(env_id, num_envs=N, autoreset_mode="Disabled", **options)
    assert isinstance(batch, LocalVectorEnv)
    singles = [list(flown(gym.make(env_id, **options), 5 + i)) for i in range(N)]
    actions = [list(actions_of(batch.single_action_space, 5 + i)) for i in range(N)]
    observations, info = batch.reset(seed=5)
    told = [(observations, np.zeros(N), np.zeros(N, bool), np.zeros(N, bool), info)]
    for step in range(min(map(len, singles)) - 1):
        told.append(batch.step(np.stack([given[step] for given in actions])))
    for step, (seen, rewards, terminated, truncated, info) in enumerate(told):
        assert batch.observation_space.contains(seen)
        assert rewards.dtype == np.float64
        assert terminated.dtype == bool
        assert truncated.dtype == bool
        for i, single in enumerate(singles):
            observation, *rest, single_info = single[step]
            assert seen[i].tobytes() == observation.tobytes()
            assert [rewards[i], terminated[i], truncated[i]] == rest
            assert {name: info[name][i] for name in names_of(batch)}.items() <= single_info.items()
    batch.close()


@some
def test_over_udp(env_id: str, file: Path) -> None:
    options = options_of(env_id, file)
    local = gym.make(env_id, **options)
    with flying(env_id, **options) as pair:
        remote = list(flown(_connected(pair.remote), 11))
        assert pair.remote.observation_space == local.observation_space
        assert pair.remote.action_space == local.action_space
        names = names_of(local.unwrapped)
        for here, there in zip(remote, flown(local, 11), strict=True):
            assert here[0].tobytes() == there[0].tobytes()
            assert here[1:4] == there[1:4]
            assert here[4] == {name: there[4][name] for name in names}


def _connected(remote: Any) -> Any:
    remote.connect()
    return remote


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
    env = gym.make(ELEVATION, vehicle=DATA / "racer.xml", effects=effects, flight_band=1.5)
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
