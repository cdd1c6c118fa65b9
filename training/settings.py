"""Settings of a run, a comparison and a sweep: checked on construction, before anything flies.

Imports neither torch nor pandas.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import blake2b
from itertools import product
from typing import Any, Final

from ..agents import CONTROLLERS
from ..agents.presets import (
    PRESETS,
    A2CConfig,
    Config,
    PresetName,
    SACConfig,
    find_preset,
    preset,
)  # fmt: skip
from ..envs import config as envs
from ..envs.registry import env_spec, is_known, task_type
from ..flights.executors import WorkersConfig
from ..models import BACKENDS, Backend
from ..models.errors import InputError, expect

_LONGEST_WORD: Final = 60  # characters of an option's value in a name


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The env that is flown."""

    env_id: str = "rotorgram/Elevation-v0"
    """Id of a registered task."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the env by name. Those that are not given have their defaults."""
    vehicle: str | None = None
    """File or name of the vehicle; None: the paper's."""
    backend: Backend = "mujoco"
    """What steps it in training. A trained policy is always evaluated on `mujoco`."""
    drones: int = 1
    """Drones of each world, for a task of several."""

    def __post_init__(self) -> None:
        expect(self.backend in BACKENDS, "backend", " or ".join(BACKENDS), repr(self.backend))
        expect(self.drones >= 1, "drones", "1 or more", str(self.drones))
        options: dict[str, Any] = dict(self.options)
        if is_known(self.env_id):
            options = envs.EnvConfig.from_keywords(self.env_id, **options).flat_options()
        object.__setattr__(self, "options", json.loads(json.dumps(options)))

    @property
    def env(self) -> dict[str, Any]:
        """Keyword arguments of `EnvConfig` and `pairs.socket_pair`, on `mujoco`."""
        env = {"env_id": self.env_id, "options": self.options, "vehicle": self.vehicle}
        return {**env, "drones": self.drones}

    @property
    def flown(self) -> envs.EnvConfig:
        """The same as the config of an env, on `mujoco`."""
        keywords = {"vehicle": self.vehicle, "drones": self.drones, **self.options}
        return envs.EnvConfig.from_keywords(self.env_id, **keywords)

    @property
    def training_env(self) -> dict[str, Any]:
        """The same on the backend of the training."""
        return self.env | {"backend": self.backend}

    @property
    def module(self) -> str | None:
        """Module that another process must import to know the task; None for ours."""
        name = task_type(self.env_id).__module__ if is_known(self.env_id) else "__main__"
        return None if name.startswith("rotorgram.") or name == "__main__" else name

    @property
    def own_task(self) -> str | None:
        """`module:id` of a user's task; None for ours."""
        return f"{self.module}:{self.env_id}" if self.module else None


@dataclass(frozen=True, kw_only=True)
class Run(EnvConfig):
    """Settings of one training: all that its numbers depend on but the software."""

    algorithm: str
    config: Config
    seed: int
    env_steps: int
    """Of all drones together."""
    num_envs: int = 1
    """Drones that train it at the same time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self.seed >= 0, "seed", "0 or more", str(self.seed))
        expect(self.num_envs >= 1, "num_envs", "1 or more", str(self.num_envs))
        whole = self.num_envs % self.drones == 0
        expect(whole, "num_envs", f"a multiple of drones = {self.drones}", str(self.num_envs))
        least = 1
        if isinstance(self.config, A2CConfig | SACConfig):
            least = self.config.rollout_size(self.num_envs)
        elif self.num_envs > 1:  # a whole episode of each
            least = self.num_envs * int(self.options.get("episode_length", 1))
        expect(self.env_steps >= least, "env_steps", f"at least {least}", str(self.env_steps))


@dataclass(frozen=True, kw_only=True)
class RunsConfig(WorkersConfig):
    """Settings that comparisons and sweeps share, besides the env; flags of their commands."""

    preset: PresetName = "tuned"
    """Hyperparameters: the paper's, or ours."""
    env_steps: int = 200_000
    """Env steps of each training, of all its drones together; a learning rate that falls, falls
    over all of them."""
    num_envs: int = 1
    """Drones that fly at the same time, in lock-step, in each training; by default one, or those of
    one world."""
    episodes: int = 20
    """Evaluation episodes of each final policy."""
    seeds: int = 5
    """Number of seeds, the same for every agent or point."""
    first_seed: int = 0
    """The first of them."""


@dataclass(frozen=True, kw_only=True)
class _ManyRuns(RunsConfig, EnvConfig):
    """Base of comparisons and sweeps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        EnvConfig.__post_init__(self)
        self._check_counts("seeds", "env_steps", "episodes")
        expect(self.first_seed >= 0, "first_seed", "0 or more", str(self.first_seed))
        expect(env_spec(self.flown).headline, "env", "one that names a metric", self.env_id)

    def _check_counts(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            expect(value >= 1, name, "at least 1", str(value))

    @property
    def all_seeds(self) -> range:
        """The seeds."""
        return range(self.first_seed, self.first_seed + self.seeds)

    def content(self, *algorithms: str) -> dict[str, Any]:
        """What `config.json` has of it, but for the env; `read_content` reads it."""
        names = ("preset", "env_steps", "num_envs", "backend")
        content = {name: getattr(self, name) for name in names}
        agents = {name: asdict(preset(name, self.preset, self.env_id)) for name in algorithms}
        return {**content, "seeds": list(self.all_seeds), "agents": agents}

    @staticmethod
    def read_content(content: Mapping[str, Any]) -> dict[str, Any]:
        """The settings that all have, from the content of a `config.json`."""
        seeds, spec = content["seeds"], content["spec"]
        kept = {name: content[name] for name in ("preset", "env_steps", "num_envs", "vehicle")}
        kept |= {name: spec[name] for name in ("env_id", "options")}
        kept |= {"backend": content.get("backend", "mujoco"), "drones": len(spec["agents"])}
        return kept | {"seeds": len(seeds), "first_seed": seeds[0]}

    def _run(self, algorithm: str, seed: int, **changes: Any) -> Run:
        shared = {"env_steps": self.env_steps, "num_envs": self.num_envs, **self.training_env}
        config = preset(algorithm, self.preset, self.env_id, **changes)
        return Run(algorithm=algorithm, config=config, seed=seed, **shared)


@dataclass(frozen=True, kw_only=True)
class CompareConfig(_ManyRuns):
    """Settings of a comparison and its workers."""

    agents: tuple[str, ...] = ("vpg", "a2c", "sb3-a2c")
    """Agents to train. The PID, or ORCA, is evaluated beside them where it can fly the env."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    curve_episodes: int = 10
    """Evaluation episodes of each of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_counts("snapshots", "curve_episodes")
        expect(self.agents, "agents", "at least one")
        once = len(set(self.agents)) == len(self.agents)
        expect(once, "agents", "each once", ", ".join(self.agents))
        self.runs()  # wrong names and numbers are told before anything is trained

    def runs(self) -> list[Run]:
        """Every training, in the order in which they start: SB3's first, which take longest."""
        return [
            self._run(agent, seed)
            for agent in sorted(self.agents, key=lambda agent: not agent.startswith("sb3-"))
            for seed in self.all_seeds
        ]


@dataclass(frozen=True, kw_only=True)
class BoardRow(EnvConfig):
    """A row of the baselines board: an agent on a task with a vehicle."""

    agent: str
    """An algorithm, or a controller, which needs no training and has no seeds."""
    backend: Backend | None = None  # type: ignore[assignment]  # never None once made
    """What steps it in training; None: what the preset says. Flown and evaluated on `mujoco`."""
    preset: PresetName = "tuned"
    """Hyperparameters of an algorithm."""
    env_steps: int = 0
    """Env steps of each training, of all its drones together; 0: those of the preset."""
    num_envs: int = 0
    """Drones that fly at the same time in each training; 0: those of the preset."""

    def __post_init__(self) -> None:
        known = (*CONTROLLERS, *PRESETS)
        expect(self.agent in known, "agent", f"one of {', '.join(known)}", self.agent)
        if self.controller:
            usual: Any = {"options": {**self.brought, **self.options}, "backend": "mujoco"}
        else:
            found = find_preset(self.agent, self.preset, self.env_id)
            names = ("env_steps", "num_envs", "backend")
            usual = {name: getattr(self, name) or getattr(found, name) for name in names}
        for name, value in usual.items():
            object.__setattr__(self, name, value)
        super().__post_init__()
        expect(is_known(self.env_id), "env_id", "a registered id", self.env_id)
        expect(env_spec(self.flown).headline, "env_id", "one that names a metric", self.env_id)
        if not self.controller:
            try:  # wrong names and numbers are told before anything is trained
                self.run(0)
            except InputError as error:
                raise InputError(f"{self.name}: {error}") from None

    @property
    def controller(self) -> bool:
        """Whether there is nothing to train."""
        return self.agent in CONTROLLERS

    @property
    def brought(self) -> Mapping[str, Any]:
        """Options that a controller brings along."""
        return CONTROLLERS[self.agent].options if self.controller else {}

    @property
    def task(self) -> str:
        """The env in words: its name, the options that are not the default nor a controller's, the
        vehicle.
        """
        usual = envs.EnvConfig(env_id=self.env_id).flat_options()
        usual |= self.brought
        other = {name: value for name, value in self.options.items() if value != usual.get(name)}
        words = [self.env_id.rpartition("/")[2]]
        words += [f"{name}={_word(json.dumps(value))}" for name, value in other.items()]
        words += [f"of {self.drones}"] if self.drones > 1 else []
        words += [f"with {self.vehicle}"] if self.vehicle else []
        return " ".join(words)

    @property
    def name(self) -> str:
        """Of the row: agent, preset where there is one, and task."""
        return " ".join([self.agent, *([] if self.controller else [self.preset]), self.task])

    def run(self, seed: int) -> Run:
        """The training of a seed."""
        names = ("env_steps", "num_envs", "backend")
        shared = {**{name: getattr(self, name) for name in names}, **self.env}
        config = preset(self.agent, self.preset, self.env_id)
        return Run(algorithm=self.agent, config=config, seed=seed, **shared)


def _word(text: str) -> str:
    """A value for a name: without quotes, and of a long one, as a track, its digest."""
    long = len(text) > _LONGEST_WORD
    return blake2b(text.encode(), digest_size=4).hexdigest() if long else text.replace('"', "")


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig(WorkersConfig):
    """Settings of the baselines board and its workers."""

    rows: tuple[BoardRow, ...]
    """What is trained and flown."""
    seeds: int = 10
    """Trainings of each row of an algorithm."""
    first_seed: int = 5000
    """The first of the seeds: by default none that a comparison or a sweep uses."""
    snapshots: int = 20
    """Policies kept during each training, for the steps and the time to the threshold."""
    curve_episodes: int = 10
    """Evaluation episodes of each of them."""
    episodes: int = 20
    """Evaluation episodes of each final policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("seeds", "snapshots", "curve_episodes", "episodes"):
            expect(getattr(self, name) >= 1, name, "at least 1", str(getattr(self, name)))
        expect(self.first_seed >= 0, "first_seed", "0 or more", str(self.first_seed))
        expect(self.rows, "row", "at least one", "none")
        names = [row.name for row in self.rows]
        twice = [name for name in names if names.count(name) > 1]
        expect(not twice, "row", "each row once", f"{(twice or [''])[0]} twice")

    def runs(self) -> dict[str, tuple[BoardRow, int]]:
        """Every run by name, a row and a seed: all rows with one seed, then with the next. A
        controller flies once.
        """
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return {
            f"{row.name} seed {seed}": (row, seed)
            for seed in seeds
            for row in self.rows
            if seed == self.first_seed or not row.controller
        }


@dataclass(frozen=True, kw_only=True)
class SweepConfig(_ManyRuns):
    """Settings of a sweep and its workers. Its seeds are not those of a comparison."""

    algorithm: str
    grid: Mapping[str, tuple[Any, ...]]
    """Values of hyperparameters, by name: every combination is a point."""
    seeds: int = 3
    first_seed: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self.grid, "grid", "at least one hyperparameter", "none")
        self.runs()  # wrong names and numbers are told before anything is trained
        for name, values in self.grid.items():
            expect(values, "grid", f"at least one value of {name}", "none")
            for place, value in enumerate(values):
                expect(value not in values[:place], "grid", f"each {name} once", f"{value!r} twice")

    def points(self) -> list[dict[str, Any]]:
        """Settings of every point; the value that is named last changes fastest."""
        names, values = self.grid.keys(), product(*self.grid.values())
        return [dict(zip(names, chosen, strict=True)) for chosen in values]

    def runs(self) -> dict[str, tuple[int, Run]]:
        """Every training by name, with its point: all points with one seed, then with the next.

        So a sweep that is stopped has seen every point.
        """
        points = self.points()
        words = [" ".join(f"{name}={value}" for name, value in one.items()) for one in points]
        return {
            f"{words[point]} seed {seed}": (point, self._run(self.algorithm, seed, **chosen))
            for seed in self.all_seeds
            for point, chosen in enumerate(points)
        }
