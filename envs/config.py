"""The configuration of an env: one immutable record of everything that its numbers depend on.

Defaults come from the task, then from a file, then from flags or keyword arguments.
"""

import inspect
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, field, fields, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from ..models import BACKENDS, MAX_DRONES, Backend
from ..models.errors import InputError, shortened
from ..models.fields import (
    Choice,
    Limits,
    check,
    check_fields,
    check_names,
    immutable,
    mapping,
    read_table,
    set_fields,
)
from ..models.files import read_toml
from ..models.library import is_of_the_library, is_pool, words_of
from ..scenes import SceneConfig
from ..scenes.config import is_scene_file, refuse_hidden
from ..scenes.returns import RANGES
from ..sim import EffectOptions, Randomization
from ..sim.effects import NO_EFFECTS
from . import registry
from .events import changes_of, check_events, read_events
from .spec import Values, canonical_id, json_values

if TYPE_CHECKING:
    from ..models.vehicle import Vehicle

Options = Mapping[str, Any]
VERSION = 1
"""Version of a config's JSON."""
DEFAULT_ENV = "rotorgram/Elevation-v0"
MAX_CONTROL_PERIOD = 1.0  # s
MAX_EPISODE_LENGTH = 1 << 31  # control steps
MAX_HISTORY = 1000  # observations side by side


@immutable
class BackendConfig:
    """What steps the drones."""

    name: Backend = "mujoco"
    num_threads: Annotated[int | None, Limits(0, whole=True)] = None
    """Threads of `mujoco`; 0: one for each processor; None: as the backend chooses."""
    dtype: Literal["float32", "float64"] | None = None
    """Of `rigid`: `float32`, the default, or `float64`."""
    compiled: bool | None = None
    """None compiles where llvmlite is installed. It changes no number."""

    def __post_init__(self) -> None:
        check("backend", Choice(BACKENDS), self.name)
        check_fields(self)

    @classmethod
    def parse(cls, backend: Any) -> Self:
        """A backend from its name, or from its fields by name. Raises `InputError`."""
        if isinstance(backend, cls):
            return backend
        if isinstance(backend, Mapping):
            return read_table(cls, backend, "backend")
        return cls(name=backend)

    @property
    def settings(self) -> Values:
        """Settings that are not None, as keyword arguments of `sim.make_world`."""
        values = {name: getattr(self, name) for name in BACKEND_KEYWORDS}
        return {name: value for name, value in values.items() if value is not None}


@immutable
class EnvConfig:
    """The task, and everything that it is flown with.

    Where the env id is registered here, fields that are None take the task's defaults, and `task`
    holds all of its options. Another env of Gymnasium keeps its keyword arguments in `task`.

    Raises `InputError` for a field of a wrong type or out of its range.
    """

    env_id: str = DEFAULT_ENV
    """Id of a registered task, without a module."""
    task: Options = field(default_factory=dict, hash=False)
    """Options of the task by name."""
    vehicle: tuple[str, ...] = ()
    """Names of the library, or files; several for the drones of a world in turn. None given: the
    paper's quadcopter."""
    drones: Annotated[int, Limits(1, MAX_DRONES, whole=True)] = 1
    """Drones of each world."""
    scene: SceneConfig = None  # type: ignore[assignment]  # that of the task until it is known
    """What surrounds the drones; as a text too, see there."""
    action: str | None = None
    """What an action sets: one of `sim.LEVELS`."""
    control_period: Annotated[float | None, Limits(1e-6, MAX_CONTROL_PERIOD, "s")] = None
    """Time between two actions, s: a multiple of the physics step, at most 1 s."""
    episode_length: Annotated[
        int | None, Limits(1, MAX_EPISODE_LENGTH, "control steps", whole=True)
    ] = None
    """Control steps after which an episode is truncated."""
    history: Annotated[int, Limits(1, MAX_HISTORY, "observations", whole=True)] = 1
    """Number of the last observations that are observed side by side, the oldest first. A reset
    fills them with the first observation."""
    effects: EffectOptions = NO_EFFECTS
    randomize: Options = field(default_factory=dict, hash=False)
    """Distributions of what is drawn for each episode: names of `sim.PARAMETERS` to texts."""
    observe_drawn: bool = False
    """Observe what is drawn too, in an array for the critic of a training alone."""
    sensors: Options = field(default=None, hash=False)  # type: ignore[arg-type]  # as the scene
    """Settings by sensor, or true; see `sim/sensors`. None given: the task's."""
    cameras: tuple[str, ...] = ()
    """Pictures that are observed: cameras of the vehicle as NAME, NAME_KIND or
    NAME@WIDTHxHEIGHT."""
    backend: BackendConfig = None  # type: ignore[assignment]  # as the scene
    """None given: the task's, `mujoco` for most."""
    events: tuple[Values, ...] = field(default=(), hash=False)
    """What happens in flight: a table for each event, as of `events.toml`; or a TOML file."""
    files: Options = field(default_factory=dict, hash=False, repr=False)
    """Content of the files of `vehicle` by their names, as `models/bundle` has it; set by
    `resolve`, which needs the files themselves no more."""
    vehicle_hash: str = ""
    """Hash of the vehicle's model; set by `resolve`."""
    task_hash: str = ""
    """Hash of the source of a task and a scene that are not ours; set by `resolve`."""

    def __post_init__(self) -> None:
        check_fields(self)
        set_fields(
            self,
            env_id=canonical_id(self.env_id),
            vehicle=self.vehicle or (),
            cameras=self.cameras or (),
        )
        task = registry.task_type(self.env_id) if registry.is_known(self.env_id) else None
        defaults: Values = {"sensors": {}, "backend": BackendConfig()}
        if task:
            check_names(task.defaults, _DEFAULTS, f"{self.env_id}: defaults")
            defaults |= {name: getattr(task, name) for name in _FROM_TASK}
            defaults |= task.defaults
        if any(map(is_pool, words_of("vehicle", self.vehicle))):
            fits = task is None or "wrench" in task.actions
            defaults |= _OF_POOLS if fits else {"backend": _OF_POOLS["backend"]}
        missing = [name for name in defaults if getattr(self, name) in (None, ())]
        set_fields(self, **{name: defaults[name] for name in missing})
        set_fields(
            self,
            backend=BackendConfig.parse(self.backend),
            vehicle=words_of("vehicle", self.vehicle),
            cameras=words_of("cameras", self.cameras),
            randomize=Randomization(self.randomize, None).to_options(),
            events=read_events(self.events),
        )
        if self.files:
            from ..models.bundle import checked_bundles

            set_fields(self, files=checked_bundles(self.files))
        if self.sensors != {}:
            from ..sim.sensors import checked_sensors

            set_fields(self, sensors=checked_sensors(self.sensors))
        if not isinstance(self.effects, EffectOptions):
            set_fields(self, effects=read_table(EffectOptions, self.effects, "effects"))
        if "battery" in self.sensors and not self.effects.battery:
            raise InputError("sensors.battery: expected the effect battery, got none")
        options: Options = mapping(self.task, "task", "options by name")
        usual = SceneConfig()
        if task:
            check("action", Choice(task.actions), self.action)
            chosen = task.Options.from_options(options, KEYWORDS)
            options = chosen.to_options()
            usual = task.scene(chosen)
        scene = usual if self.scene is None else SceneConfig.parse(self.scene).filled(usual)
        scene.check_most()
        set_fields(self, task=json_values(options), scene=scene)

    # ---- other forms

    @classmethod
    def from_keywords(cls, env_id: "str | EnvConfig" = DEFAULT_ENV, **keywords: Any) -> "EnvConfig":
        """A config from the flat keyword arguments of `gym.make`; or a config itself.

        A keyword that is a field, or a setting of the backend, is that; any other is an option of
        the task. `task={...}` holds options of the task whatever their names are. Raises
        `InputError`, which is a `TypeError` too for a name that is not known.
        """
        if isinstance(env_id, EnvConfig):
            if keywords:
                got = ", ".join(keywords)
                raise InputError(f"env: expected a config without keywords, got {got}")
            return env_id
        options = {name: value for name, value in keywords.items() if name not in KEYWORDS}
        nested = options.pop("task", {})
        given = {name: keywords[name] for name in KEYWORDS if keywords.get(name) is not None}
        settings = {name: given.pop(name) for name in BACKEND_KEYWORDS if name in given}
        if isinstance(nested, Mapping):
            nested = {**options, **nested}
        config = cls(env_id=env_id, task=nested, **given)
        if settings:
            config = replace(config, backend=replace(config.backend, **settings))
        return config

    def flat_options(self) -> Values:
        """Keywords of everything but the vehicle, the drones and the backend, as JSON values.

        Every option of the task, and every other field that is not empty, or that of the task.
        """
        values: Values = {name: getattr(self, name) for name in _OPTIONS}
        values["effects"] = self.effects.to_options()
        usual = self._usual()
        scene = self.scene
        if (
            scene.name == usual.scene.name and usual.scene.options
        ):  # its options follow from the task's
            scene = replace(scene, options={})
        values["scene"] = None if self.scene == usual.scene else str(scene)
        values["task"] = {name: value for name, value in self.task.items() if name in KEYWORDS}
        values = {
            name: value for name, value in values.items() if value not in (None, (), {}, False)
        }
        if self.sensors != usual.sensors:
            values["sensors"] = self.sensors
        shown = {name: value for name, value in self.task.items() if name not in KEYWORDS}
        return json_values(values | shown)

    def keywords(self) -> Values:
        """Keywords of `from_keywords` that make the same config, as JSON values."""
        values: Values = {"env_id": self.own_task or self.env_id}
        if self.vehicle:
            values["vehicle"] = list(self.vehicle)
        if self.backend != self._usual().backend:
            values["backend"] = asdict(self.backend)
        return {**values, "drones": self.drones, **self.flat_options()}

    def _usual(self) -> Self:
        """The same with what the task says of scene, sensors and backend."""
        own: Any = dict.fromkeys(("scene", "sensors", "backend"))
        return replace(self, **own)

    def unseen(self) -> Self:
        """The same for tests: in layouts that no training has seen."""
        return replace(self, scene=self.scene.unseen())

    def changed(self, **keywords: Any) -> "EnvConfig":
        """The same with other keywords. Raises `InputError`."""
        given = {**self.keywords(), "env_id": self.env_id, **keywords}
        other = EnvConfig.from_keywords(**given)
        if other.vehicle == self.vehicle:
            other = replace(other, files=self.files)
        same = str(other.scene) == str(self.scene)
        return replace(other, scene=self.scene) if same else other

    def to_dict(self) -> Values:
        """All fields as JSON values, with the version."""
        content = {"version": VERSION, **vars(self), "effects": self.effects.to_options()}
        content |= {"scene": asdict(self.scene), "backend": asdict(self.backend)}
        for name in ("events", "observe_drawn"):
            if not content[name]:
                content.pop(name)
        return json_values(content)

    @classmethod
    def from_dict(cls, content: object) -> Self:
        """The reverse of `to_dict`. Raises `InputError`."""
        given = mapping(content, "config", "an object")
        version = given.pop("version", None)
        if version != VERSION:
            raise InputError(f"config: expected version {VERSION}, got {shortened(version)}")
        check_names(given, [one.name for one in fields(cls)], "config")
        return cls(**given)

    # ---- checks that need more than one field, and the files

    @property
    def module(self) -> str | None:
        """Module that another process imports to know the task and the scene; None for ours."""
        known = registry.is_known(self.env_id)
        names = [registry.task_type(self.env_id).__module__] if known else []
        names.append(getattr(self.scene.type.draw, "__module__", "__main__"))
        ours = ("rotorgram", "__main__")
        return next((name for name in names if name.partition(".")[0] not in ours), None)

    @property
    def own_task(self) -> str | None:
        """`module:id` of a user's task, or of a task in a user's scene; None for ours."""
        return f"{self.module}:{self.env_id}" if self.module else None

    @property
    def has_rays(self) -> bool:
        """Whether there are sensors with rays, to which a vehicle's file may add settings."""
        return not self.sensors.keys().isdisjoint(RANGES)

    @property
    def estimated(self) -> bool:
        """Whether controller and observation get the onboard estimate, once a control step."""
        return self.sensors.get("observe") == "estimate"

    @property
    def drawn(self) -> Randomization:
        """What is drawn for each episode, and what events change within one. Raises `InputError`
        where its effect is off.
        """
        changes = changes_of(self.events, self.control_period or 1.0)
        most = {name: float(change.sum()) for name, change in changes.items()}
        return Randomization(self.randomize, self.effects, most)

    @property
    def vehicle_paths(self) -> tuple[str, ...]:
        """Names and files of the vehicles; files that are not here are written to a folder."""
        if not self.files:
            return self.vehicle
        from ..models.bundle import unpacked

        files = {word: str(unpacked(word, bundle)) for word, bundle in self.files.items()}
        return tuple(files.get(word, word) for word in self.vehicle)

    def load_vehicle(self) -> "Vehicle":
        """The vehicle, or a `Fleet` of several. Raises `InputError`."""
        from ..models.fleet import load_vehicles

        words = self.vehicle_paths or None
        return load_vehicles(
            words,
            self.drones,
            linear_drag=self.effects.linear_drag,
            longest_step=self.control_period or math.inf,
        )

    def embedded(self) -> Self:
        """The same with the content of the files of vehicles and scene, for a process that has not
        the files.

        Raises `InputError`.
        """
        words = [word for word in self.vehicle if word not in self.files]
        words = [word for word in words if not is_of_the_library(word)]
        scene = self.scene.embedded()
        if not words:
            return self if scene == self.scene else replace(self, scene=scene)
        from ..models.bundle import read_bundle  # it imports MuJoCo

        read = {word: read_bundle(word) for word in words}
        return replace(self, scene=scene, files={**self.files, **read})

    def resolve(self) -> Self:
        """The same with its files and hashes. Refuses by name what cannot be flown together.

        Raises `InputError`.
        """
        from ..sim.scenery import solids_around
        from ..sim.sensors.range_sensors import mounted
        from ..sim.world import check_world

        task = registry.task_type(self.env_id)
        if not task.min_drones <= self.drones <= task.max_drones:
            most = f" to {task.max_drones}" if task.max_drones > task.min_drones else ""
            expected = f"{task.min_drones}{most} with {self.env_id}"
            raise InputError(f"drones: expected {expected}, got {self.drones}")
        if self.cameras and not self.scene.given_scenes:
            raise InputError(
                f"cameras: expected a scene of given seeds, as forest:0-7, got {self.scene}"
            )
        whole = self.embedded()
        vehicle = whole.load_vehicle()
        vehicle.substeps(self.control_period or 0.0)
        several = len(self.vehicle) > 1
        for name in ("sensors", "cameras"):
            used = ", ".join(getattr(self, name))
            if several and used:
                raise InputError(f"{name}: expected none with several vehicles, got {used}")
        check_events(self)
        randomize = Randomization(self.randomize, None)
        settings = self.backend.settings
        _, hidden = solids_around(vehicle, whole.scene)
        check_world(vehicle, self.backend.name, self.effects, randomize, settings, hidden)
        for sensor in RANGES:
            if sensor in self.sensors:
                refuse_hidden(hidden, f"the sensor {sensor}")
        resolved = replace(
            whole,
            sensors=mounted(self.sensors, vehicle),
            vehicle_hash=vehicle.hash,
            task_hash=source_hash(task, self.scene.type.draw),
        )
        for name in ("vehicle_hash", "task_hash"):
            was = getattr(self, name)
            now = getattr(resolved, name)
            if was and was != now:
                raise InputError(f"{name}: expected {was}, got {now}")
        return resolved

    @property
    def digest(self) -> str:
        """32 hexadecimal digits of the resolved config, without what changes no number."""
        resolved = self if self.vehicle_hash else self.resolve()
        content = resolved.to_dict()
        for name in ("vehicle", "files"):  # their hash is there
            content.pop(name)
        if resolved.scene.is_file:  # its content is there
            content["scene"].pop("name")
        if self.scene == SceneConfig():
            content.pop("scene")
        for name in ("num_threads", "compiled"):
            content["backend"].pop(name)
        return _hash_of(json.dumps(content, sort_keys=True, separators=(",", ":")))


_DEFAULTS = ("vehicle", "sensors", "backend")
_OF_POOLS = {"action": "wrench", "backend": BackendConfig(name="rigid")}
"""What drawn craft need."""
_FROM_TASK = ("action", "control_period", "episode_length")
_OPTIONS = (
    "episode_length", "action", "control_period", "history", "effects", "randomize",
    "observe_drawn", "sensors", "cameras", "events",
)  # fmt: skip
BACKEND_KEYWORDS = ("num_threads", "dtype", "compiled")
"""Keywords that are settings of the backend."""
KEYWORDS = (*_OPTIONS, "scene", "vehicle", "drones", "backend", *BACKEND_KEYWORDS)
"""Keywords that are not options of a task."""


def read_keywords(path: Path | str) -> Values:
    """Keywords of `EnvConfig.from_keywords` from a TOML file, `env_id` among them.

    A relative path of a vehicle or a scene is looked for beside the file first. Raises
    `InputError`.
    """
    file = Path(path)
    try:
        content = read_toml(file, "config")
    except OSError as error:
        raise InputError(f"config: cannot read {file}: {error.strerror}") from None
    if "vehicle" in content:
        words = words_of("vehicle", content["vehicle"])
        content["vehicle"] = tuple(_beside(file, word) for word in words)
    scene = content.get("scene", "")
    if is_scene_file(scene):
        content["scene"] = _beside(file, scene)
    return content


def _beside(file: Path, word: str) -> str:
    """The path of a file beside another, or the word where there is none."""
    near = file.parent / word
    return str(near) if near.is_file() else word


def source_hash(task: type, draw: object = None) -> str:
    """Hash of the source of a task, its bases and what draws its scene; empty if all are ours."""
    sources = ""
    for part in (*task.__mro__, draw):
        module = getattr(part, "__module__", "builtins")
        if module.partition(".")[0] in ("rotorgram", "abc", "builtins"):
            continue
        try:
            sources += inspect.getsource(sys.modules[module])
        except (OSError, TypeError, KeyError):
            sources += getattr(part, "__qualname__", module)  # typed into an interpreter
    return _hash_of(sources) if sources else ""


def _hash_of(text: str) -> str:
    """32 hexadecimal digits."""
    return blake2b(text.encode(), digest_size=16).hexdigest()
