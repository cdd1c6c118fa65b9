"""Settings of a run and of a study: checked on construction, before anything flies.

Imports neither torch nor pandas.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Any, Literal

from ..agents import (
    ALGORITHMS,
    CONTROLLERS,
    Config,
    find_controller,
    find_preset,
    is_controller,
    preset,
)
from ..agents.presets import PresetName
from ..envs.config import DEFAULT_ENV, EnvConfig, read_keywords, source_hash
from ..envs.perturbations import for_training
from ..envs.registry import env_spec, load
from ..envs.spec import json_values
from ..flights.trajectories import EpisodeSet
from ..models import Backend
from ..models.errors import InputError, shortened
from ..models.fields import (
    NonNegativeInt,
    PositiveInt,
    check_fields,
    immutable,
    mapping,
    read_table,
    set_fields,
)

MIN_FLIGHTS = 200
"""Evaluation flights of each row of a study, over all its seeds."""
BOARD = Path(__file__).parent / "assets" / "baselines.toml"
"""The rows of our own board."""
_LONGEST_WORD = 60  # characters of an option's value in a name


@immutable
class Run:
    """Settings of one training: all that its numbers depend on but the software."""

    env: EnvConfig = field(default_factory=EnvConfig)
    """Of the training, with its backend."""
    algorithm: str
    config: Config
    seed: NonNegativeInt
    env_steps: int
    """Of all drones together."""
    num_envs: PositiveInt = 1
    """Drones that train it at the same time."""

    def __post_init__(self) -> None:
        check_fields(self)
        drones = self.env.drones
        if self.num_envs % drones != 0:
            raise InputError(
                f"num_envs: expected a multiple of drones = {drones}, got {self.num_envs}"
            )
        # That of a task that is not known here is among the options.
        episode_length = self.env.episode_length or self.env.task.get("episode_length", 1)
        least = self.config.least_steps(self.num_envs, int(episode_length))
        if self.env_steps < least:
            raise InputError(f"env_steps: expected at least {least}, got {self.env_steps}")

    def to_dict(self) -> dict[str, object]:
        """All settings as JSON values."""
        return {**vars(self), "env": self.env.to_dict(), "config": asdict(self.config)}


@immutable
class Row:
    """A row of a study: an agent on an env. A row of an algorithm has a training for each seed."""

    agent: str
    """An algorithm, or a controller, which is not trained: `CONTROLLERS`, or FILE.py:CLASS."""
    name: str = ""
    """Unique in the study. Default: agent, preset, changes and env in words."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """It is evaluated on its backend: `mujoco` or the task's."""
    backend: Backend | None = None
    """What steps the drones in training; None: as the preset says."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's, or ours."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Hyperparameters that differ from the preset's."""
    env_steps: NonNegativeInt = 0
    """Env steps of each training, of all its drones together; 0: those of the preset."""
    num_envs: NonNegativeInt = 0
    """Drones that fly at the same time in each training; 0: those of the preset."""
    brought: Mapping[str, object] | None = None
    """Options of the env that a controller needs; None: those of its class. To report a study runs
    no file of a controller."""

    def __post_init__(self) -> None:
        if not (self.controller or self.agent in ALGORITHMS):
            known = ", ".join((*CONTROLLERS, *ALGORITHMS))
            raise InputError(
                f"agent: expected one of {known}, or FILE.py:CLASS of a controller, "
                f"got {self.agent}"
            )
        if self.brought is None:
            needed = find_controller(self.agent).options if self.controller else {}
            set_fields(self, brought=dict(needed))
        check_fields(self)
        of_task = EnvConfig(env_id=self.env.env_id)
        backend = self.env.backend.name
        if backend not in ("mujoco", of_task.backend.name):
            raise InputError(f"env: expected the backend mujoco, for evaluation, got {backend}")
        usual = of_task.flat_options()
        given = self.env.flat_options()
        brought = {k: v for k, v in (self.brought or {}).items() if given.get(k) == usual.get(k)}
        if brought:
            set_fields(self, env=self.env.changed(**brought))
        set_fields(self, name=self.name or self.default_name)
        if env_spec(self.env).headline is None:
            raise InputError(f"env_id: expected one that names a metric, got {self.env.env_id}")
        if self.controller:
            return
        found = find_preset(self.agent, self.preset, self.env.env_id)
        set_fields(
            self,
            env_steps=self.env_steps or found.env_steps,
            num_envs=self.num_envs or found.whole_worlds(self.env.drones),
            backend=self.backend or found.backend or backend,
            set=json_values(self.set),
        )
        try:
            self.run(0)
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None

    @property
    def default_name(self) -> str:
        """Name of a row that is given none."""
        words = [short_name(self.agent)]
        if not self.controller:
            words.append(self.preset)
        words += [f"{name}={_word(value)}" for name, value in self.set.items()]
        return " ".join([*words, self.task])

    @property
    def task(self) -> str:
        """The env in words: its name, options that are neither the task's defaults nor a
        controller's, the vehicle.
        """
        env = self.env
        usual = {**EnvConfig(env_id=env.env_id).flat_options(), **(self.brought or {})}
        words = [env.env_id.rpartition("/")[2]]
        for name, value in env.flat_options().items():
            if value != usual.get(name):
                words.append(f"{name}={_word(value)}")
        if env.drones > 1:
            words.append(f"of {env.drones}")
        if env.vehicle:
            words.append(f"with {','.join(env.vehicle)}")
        return " ".join(words)

    @property
    def controller(self) -> bool:
        """Whether the agent is not trained."""
        return is_controller(self.agent)

    @property
    def source_hash(self) -> str:
        """Hash of the source of a controller in a file; empty for an agent of ours."""
        return source_hash(find_controller(self.agent)) if self.controller else ""

    @property
    def config(self) -> Config:
        """Hyperparameters of an algorithm."""
        return preset(self.agent, self.preset, self.env.env_id, **self.set)

    def run(self, seed: int) -> Run:
        """The training of a seed."""
        backend = replace(self.env.backend, name=self.backend or self.env.backend.name)
        env = replace(self.env, backend=backend)
        found = find_preset(self.agent, self.preset, self.env.env_id)
        usual = EnvConfig(env_id=env.env_id).episode_length
        if found.episode_length and env.episode_length == usual:
            env = env.changed(episode_length=found.episode_length)
        if found.perturbations:
            env, _ = for_training(env, found.perturbations)
        return Run(
            env=env,
            algorithm=self.agent,
            config=self.config,
            seed=seed,
            env_steps=self.env_steps,
            num_envs=self.num_envs,
        )

    def to_dict(self) -> dict[str, object]:
        """JSON values that `from_dict` reads."""
        return {**vars(self), "env": self.env.keywords()}

    @classmethod
    def from_dict(cls, where: str, table: object, env: Mapping[str, object] | None = None) -> "Row":
        """A row from a table of TOML or JSON, whose `env` adds to the given keywords.

        Raises `InputError`, whose sentence begins with `where`.
        """
        try:
            given = mapping(table, "row")
            given["set"] = mapping(given.get("set", {}), "set")
            own = mapping(given.get("env", {}), "env")
            keywords = {"env_id": DEFAULT_ENV, **(env or {}), **own}
            env_id = load(keywords.pop("env_id"))
            given["env"] = EnvConfig.from_keywords(env_id, **keywords)
            return read_table(cls, given, "row")
        except InputError as error:
            raise InputError(f"{where}: {error}") from None


def short_name(agent: str) -> str:
    """An agent in one word: of a controller in a file, its class."""
    return agent.rpartition(":")[2].lower()


def file_words(text: str) -> str:
    """A text as part of a file's name."""
    letters = (letter if letter.isalnum() or letter in ".=+_" else "-" for letter in text)
    return "".join(letters).strip("-").lower()


def _word(value: object) -> str:
    """A value for a name: without quotes, and of a long one, as a track, its beginning."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text.replace('"', "")[:_LONGEST_WORD]


Kind = Literal["paper", "compare", "sweep", "benchmark"]


@immutable
class Study:
    """Many runs: every row with every seed."""

    rows: tuple[Row, ...]
    kind: Kind = "compare"
    """paper: the paper's comparison, with its figures and verdicts. sweep: rows are ranked."""
    seeds: PositiveInt = 5
    first_seed: NonNegativeInt = 0
    snapshots: PositiveInt = 10
    """Policies kept during each training, for the learning curves."""
    curve_episodes: PositiveInt = 10
    """Evaluation episodes of each of them."""
    episodes: NonNegativeInt = 0
    """Evaluation episodes of each final policy; 0: as many as make `MIN_FLIGHTS` of a row."""
    evaluation: EpisodeSet = "final"
    """Set of the episodes of the final evaluation."""
    wire: bool = False
    """Whether agents fly over UDP, each with a simulator process, or in process."""
    keep_steps: bool = False
    """Whether the results hold every step of training and final evaluation."""

    def __post_init__(self) -> None:
        if not self.rows:
            raise InputError("row: expected at least one, got none")
        check_fields(self)
        files = [file_words(row.name) for row in self.rows]
        for file in files:
            if files.count(file) > 1:
                raise InputError(f"row: expected each row once, got {file} twice as a file's name")
        if not self.episodes:
            set_fields(self, episodes=max(20, -(-MIN_FLIGHTS // self.seeds)))

    def runs(self) -> dict[str, tuple[Row, int]]:
        """Every run by name, a row and a seed: all rows with one seed, then with the next.

        So a study that is stopped has seen every row.
        """
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return {f"{row.name} seed {seed}": (row, seed) for seed in seeds for row in self.rows}

    def to_dict(self) -> dict[str, object]:
        """JSON values that `from_dict` reads."""
        settings = dict(vars(self))
        del settings["rows"]
        return {**settings, "row": [row.to_dict() for row in self.rows]}

    @classmethod
    def from_dict(cls, where: str, content: object) -> "Study":
        """A study from settings and a list `row` of tables; a table `env` is of all rows.

        Raises `InputError`, whose sentence begins with `where`.
        """
        given = mapping(content, where)
        env = mapping(given.pop("env", {}), f"{where}: env")
        tables = given.pop("row", [])
        if "rows" in given:
            raise InputError(f"{where}: rows: expected [[row]] tables, got the name rows")
        if type(tables) is not list:
            raise InputError(f"{where}: row: expected [[row]] tables, got {shortened(tables)}")
        rows = [
            Row.from_dict(f"{where}: row {place}", table, env)
            for place, table in enumerate(tables, 1)
        ]
        return read_table(cls, {**given, "rows": tuple(rows)}, where)

    @classmethod
    def from_toml(cls, path: Path, defaults: Mapping[str, object] | None = None) -> "Study":
        """A study from a TOML file, as of `from_dict`.

        A file without `[[row]]` is one row, named as the file. Raises `InputError`.
        """
        content = read_keywords(path)
        if "row" not in content:
            content = {"row": [{"name": path.stem, **content}]}
        return cls.from_dict(f"{path}", {**(defaults or {}), **content})
