"""Envs of every task at every level, on every backend and with every feature, and a flight of them.

`python tests/contracts.py` writes `data/oracle.json` and `data/hashes.json` anew, after a change of
numbers that is meant: the commit says why.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from numpy.typing import NDArray
from rotorgram.envs import Loop, registry
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import EnvSpec
from rotorgram.models import QUAD_XML, Vehicle

DATA = Path(__file__).parent / "data"
ORACLE = DATA / "oracle.json"
HASHES = DATA / "hashes.json"
"""Of flights on `rigid`, which have the same bits on every processor."""
TABLES: dict[str, Any] = json.loads((DATA / "envs.json").read_text())
"""Rows of the parametrized tests of envs/, by the tests' names."""
TASKS = sorted(name for name in gym.registry if name.startswith("rotorgram/"))
for name in ("Forest", "Warehouse", "Gates", "Dodge"):  # others keep their vehicles
    TASKS.append(TASKS.pop(TASKS.index(f"rotorgram/{name}-v0")))
HOVER = "rotorgram/Hover-v0"
ELEVATION = "rotorgram/Elevation-v0"
GOAL_OFFSET = ("goal - position x", "goal - position y", "goal - position z")
on_both_tasks = pytest.mark.parametrize("env_id", [ELEVATION, HOVER])
FILES = {"quad": QUAD_XML}
FILES |= {path.stem: path for path in sorted(DATA.glob("*.xml"))}
FILES |= {path.parent.name: path for path in sorted(QUAD_XML.parent.glob("*/*/vehicle.toml"))}
STORM = {"wind": (4.0, -3.0, 6.0), "gusts": 8.0}
WORLDS = 3
STEPS = 24
LENGTH = 9
"""Control steps of an episode."""
RESET = {(7, 1), (8, 2), (16, 0)}
"""Steps at which a world is reset in mid-flight."""
FROZEN = {(3, 2), (4, 2), (8, 0), (11, 0), (12, 1)}
"""Steps at which a world rests; at one of them its episode is over."""


def rows_of(table: str, names: str, **options: Any) -> pytest.MarkDecorator:
    """A test's parameters, by comma and name: the rows of a table."""
    return pytest.mark.parametrize(names, TABLES[table], **options)


def spec_with(env_id: str, **options: Any) -> EnvSpec:
    return env_spec(EnvConfig.from_keywords(env_id, **options))


def loop_of(env_id: str, num_envs: int = 1, **options: Any) -> Loop:
    return Loop(EnvConfig.from_keywords(env_id, **options), num_envs)


def zero_actions(drones: int, size: int = 1) -> NDArray[np.float32]:
    """Actions of 0."""
    return np.zeros((drones, size), np.float32)


def everyone(drones: int) -> NDArray[np.bool_]:
    """A mask of all drones."""
    return np.ones(drones, bool)


def observed(task: Any, state: Any) -> Any:
    """The array of a task that observes a single one."""
    return task.observe(state)["observation"]


def check_outcome(outcome: Any, terms: dict[str, float], terminated: bool) -> None:
    for name, value in terms.items():
        assert outcome.reward[name] == pytest.approx(value, abs=1e-12)
    assert outcome.terminated == terminated


@dataclass(frozen=True)
class Case:
    """An env: a task and keywords of its config."""

    env_id: str
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def drones(self) -> int:
        """Of one world."""
        task = registry.task_type(self.env_id)
        return int(self.options.get("drones", task.min_drones))

    def config(self, **more: Any) -> EnvConfig:
        """Of short episodes."""
        options = {"episode_length": LENGTH, "drones": self.drones, **self.options, **more}
        return EnvConfig.from_keywords(self.env_id, **options)

    def on_rigid(self, **more: Any) -> "Case":
        """The same on the backend `rigid`."""
        return replace(self, options={**self.options, "backend": "rigid", **more})


def _features() -> dict[str, Case]:
    """Cases of a file; a vehicle's file is beside it."""
    cases = {}
    rows = json.loads((DATA / "features.json").read_text())
    for name, (env_id, options) in rows.items():
        vehicle = str(options.get("vehicle"))
        if (DATA / vehicle).is_file():
            options["vehicle"] = DATA / vehicle
        cases[name] = Case(env_id, options)
    return cases


def short(env_id: str) -> str:
    """Name of a task, without namespace and version."""
    return env_id.removeprefix("rotorgram/").removesuffix("-v0")


def _levels() -> dict[str, Case]:
    """Each task at each of its levels; on `rigid` two levels of all tasks, and all of Hover."""
    cases = {}
    for env_id in TASKS:
        task = registry.task_type(env_id)
        name = short(env_id)
        for level in task.actions:
            cases[f"{name}, {level}"] = Case(env_id, {"action": level, "backend": "mujoco"})
            on_rigid = env_id == HOVER or level in (*task.actions[:1], task.action)
            if on_rigid and name not in ("Cable", "PayloadHover"):
                options = {"action": level, "backend": "rigid"}
                cases[f"{name}, {level}, rigid"] = Case(env_id, options)
    return cases


def effects_of(file: Path) -> dict[str, Any]:
    """All effects that a vehicle has coefficients for; in a storm, if it feels air."""
    vehicle = Vehicle.load(file)
    own = vehicle.coefficients
    on_rotors = own["rotors.drag"] or own["rotors.inflow"] or own["rotors.lift"]
    known = {
        "motor_lag": own["rotors.time_constant"],
        "thrust_curve": own["rotors.curve"],
        "battery": own["battery.full"] and own["battery.capacity"] and own["rotors.power"],
        "body_drag": own["drag.linear"] or own["drag.quadratic"],
        "rotor_drag": own["rotors.thrust_coefficient"] and on_rotors,
        "ground_effect": own["rotors.radius"],
    }
    effects: dict[str, Any] = {name: True for name, value in known.items() if value}
    if effects.keys() & {"body_drag", "rotor_drag"}:
        effects |= STORM
    share = (0.9, *(1.0 for _ in vehicle.rotors[1:]))
    return {**effects, "efficiency": share, "payload": 0.1 * vehicle.mass, "cable": 0.5}


def stormy(env_id: str, file: Path, *, hangs: bool = True) -> Case:
    """A vehicle with all its effects and a mass that is drawn."""
    effects = effects_of(file)
    own = "Payload" in env_id or registry.task_type(env_id).max_drones > 1
    if own or not hangs:
        del effects["payload"], effects["cable"]
    drawn = {"mass": "uniform(0.9, 1.1)"}
    options = {"vehicle": file, "effects": effects, "randomize": drawn, "backend": "mujoco"}
    return Case(env_id, options)


def _vehicles() -> dict[str, Case]:
    """Each task with a third of the vehicles, each vehicle with a third of the tasks."""
    cases = {}
    for row, env_id in enumerate(name for name in TASKS if "Cable" not in name):
        for column, (name, file) in enumerate(FILES.items()):
            if (row + column) % 3 == 0:
                cases[f"{short(env_id)}, {name}"] = stormy(env_id, file)
    return cases


LEVELS = _levels()
VEHICLES = _vehicles()
FEATURES = _features()
CASES = LEVELS | FEATURES | VEHICLES


def _rigid() -> dict[str, Case]:
    """Tasks, levels, features that `rigid` flies, a part of them in float64; vehicles by NumPy."""
    cases = {}
    for name, case in CASES.items():
        if case.options.get("backend") == "rigid" and "dtype" not in case.options:
            cases[name] = case
    for name in ("all, attitude", "estimate", "discrete", "late", "line", "two laps"):
        cases[f"{name}, rigid"] = FEATURES[name].on_rigid()
    for name, case in [*cases.items()]:
        if any(kind in name for kind in ("rotors", "increment", "rich", "all")):
            cases[name.replace("rigid", "float64")] = case.on_rigid(dtype="float64")
    for name, file in FILES.items():
        if name != "small":  # in a fluid
            case = stormy(HOVER, file, hangs=False)
            cases[f"{name}, float64"] = case.on_rigid(dtype="float64", compiled=False)
    return cases


RIGID = _rigid()


def actions_of(loop: Loop, seed: int = 7) -> Iterator[NDArray[np.float32]]:
    """Random actions, shape (N, k), sometimes at their bounds."""
    dice = np.random.default_rng(seed)
    controller = loop.task.controller
    shape = (loop.num_envs, len(controller.low))
    while True:
        if controller.choices:
            yield dice.integers(0, controller.choices, shape).astype(np.float32)
        else:
            yield (0.5 * dice.normal(size=shape)).clip(-1, 1).astype(np.float32)


def bits(values: Any) -> Any:
    """Values in which each bit counts."""
    if isinstance(values, dict):
        return {name: bits(value) for name, value in values.items()}
    if isinstance(values, tuple):
        return [bits(value) for value in values]
    array = np.asarray(values)
    return array.dtype.str, array.shape, array.tobytes()


def results(loop: Loop, rows: Any = ...) -> dict[str, Any]:
    """What a step gave to some drones."""
    flags = {name: getattr(loop, name) for name in ("rewards", "terminated", "truncated", "out")}
    groups = (flags, loop.observations, loop.telemetry, loop.metrics, loop.told()()[1])
    return {f"{i} {name}": x[rows] for i, group in enumerate(groups) for name, x in group.items()}


class Step(NamedTuple):
    """What a step got and what it gave, a row for each drone."""

    actions: Any
    resets: Any
    seeds: Any
    frozen: Any
    results: dict[str, Any]
    done: Any
    steps: Any


def flight(loop: Loop, steps: range = range(STEPS)) -> list[Step]:
    """Worlds whose episode has ended begin the next; others are reset in mid-flight, or rest."""
    rows = loop.num_envs // WORLDS
    actions = actions_of(loop)
    sent = [next(actions) for _ in range(STEPS)]
    flown = []
    for step in steps:
        begins = [step == 0 or (step, world) in RESET for world in range(WORLDS)]
        rests = [(step, world) in FROZEN for world in range(WORLDS)]
        frozen = np.repeat(rests, rows)
        resets = (loop.done | np.repeat(begins, rows)) & ~frozen
        sent[step][resets | frozen] = np.nan  # ignored
        seeds = np.arange(loop.num_envs) + 100 * step
        loop.advance(sent[step], resets, seeds, frozen)
        flown.append(Step(sent[step], resets, seeds, frozen, results(loop), loop.done, loop.steps))
    return flown


def hash_of(steps: list[Step]) -> str:
    """Of all bits of the results of a flight."""
    flown = repr([bits(step.results) for step in steps])
    return blake2b(flown.encode(), digest_size=8).hexdigest()


def measured(case: Case) -> dict[str, float]:
    """A few numbers of a flight: sums of observations and rewards."""
    loop = Loop(case.config(cameras=()), WORLDS)  # no driver's pictures
    rows = loop.num_envs
    actions = actions_of(loop)
    loop.advance(next(actions), np.ones(rows, bool), range(rows))
    seen = total = 0.0
    for _ in range(12):
        loop.advance(next(actions), loop.done if loop.done.any() else None)
        seen += sum(float(np.abs(array).sum()) for array in loop.observations.values())
        total += float(loop.rewards.sum())
    loop.close()
    return {"observations": float(f"{seen:.4g}"), "rewards": float(f"{total:.4g}")}


def write(path: Path, rows: dict[str, Any]) -> None:
    """A line for each case."""
    lines = [f"{json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    write(ORACLE, {name: measured(case) for name, case in CASES.items()})
    flights = {name: flight(Loop(case.config(), WORLDS)) for name, case in RIGID.items()}
    write(HASHES, {name: hash_of(steps) for name, steps in flights.items()})
