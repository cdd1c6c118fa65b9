"""Flags that commands share: each is a field of a class, and its docstring the help."""

import json
import re
from dataclasses import field, fields
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    dataclass_transform,
)

from tyro.conf import Fixed, Suppress, arg
from tyro.constructors import PrimitiveConstructorSpec

from ..models import Backend
from ..models.errors import InputError, shortened
from ..models.fields import PositiveInt, immutable

if TYPE_CHECKING:
    from ..envs.config import EnvConfig

    Words = tuple[str, ...]
    NamedValues = tuple[Words, ...]
else:  # tyro imports typeguard, slowly, for a tuple of a stated type
    Words = tuple
    NamedValues = Annotated[
        tuple,
        PrimitiveConstructorSpec(
            nargs="*",
            metavar="NAME=VALUE …",
            instance_from_str=tuple,
            is_instance=lambda _: True,
            str_from_instance=list,
            _action="append",
        ),
    ]

Count = PositiveInt
DEFAULT_ENV = "rotorgram/Elevation-v0"
Options = dict[str, Any]
"""Options of a task and its env by name, values as of JSON."""


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(field,))
@immutable
class Command:
    """Base of all commands: the fields are the flags, their docstrings the help.

    Every class derived from it is a dataclass, as this one.
    """

    given: Suppress[Fixed[frozenset]] = frozenset()  # type: ignore[type-arg]
    """Names of the fields that flags or a config's file set, even to their default; those of a
    task's flags begin with `env.`."""

    def __init_subclass__(cls) -> None:
        immutable(cls)

    def run(self) -> int | None:
        """Do it; the exit status, where it is not 0."""
        raise NotImplementedError

    def settings(self, kind: type[Any]) -> Options:
        """Values of the flags that are fields of a class of settings."""
        return {f.name: getattr(self, f.name) for f in fields(kind) if hasattr(self, f.name)}


class OneOrMore:
    """A rule for words and files."""

    expected = "one or more"

    def read(self, value: object) -> object:
        if not value:
            raise ValueError
        return value


Files = Annotated[tuple[Path, ...], OneOrMore()]


class ModuleFlag(Command):
    """A command on files, which may be of a task or a scene of the user's own."""

    env: str | None = None
    """module:Name-v0 to import a module of the working directory that registers the task, or its
    scene. An id in a file is never imported."""


class EnvFlags(Command):
    """A command that takes any task."""

    env: str = DEFAULT_ENV
    """Task by its id, or module:Name-v0 for one that a module of the working directory registers.
    Its options are flags --env.NAME."""
    vehicle: Annotated[str | None, arg(metavar="FILE")] = None
    """TOML or MJCF file of a multirotor, or the name of one of the library; several with commas
    between them, for the drones of a world in turn. drawn:7 is a drawn craft, drawn another one in
    each episode. Default: the paper's quadcopter."""
    config_file: Annotated[Path | None, arg(name="config", metavar="FILE")] = None
    """TOML file with the env and everything that it is flown with, by the names of these flags and
    of the task's options. Flags win."""
    action: str | None = None
    """Action level: rotors, wrench, rates, attitude, velocity, position, offset or increment.
    Default: the task's."""
    control_period: float | None = None
    """Seconds between two actions: a multiple of the physics step. Default: the task's."""
    episode_length: int | None = None
    """Control steps after which an episode is truncated. Default: the task's."""
    history: int = 1
    """Number of the last observations that are observed side by side."""
    scene: str | None = None
    """Ground and obstacles: plain, airport, a TOML or MJCF file, or forest, warehouse, gates, maze,
    aisles, hills, traffic from a seed, as forest:3, from one of several for each episode, as
    forest:0-7, or new in each, as forest:new,density=0.01,size=60x60. Films and views show it, and
    the airport in place of bare ground. Default: the task's."""
    cameras: Words = ()
    """Pictures that are observed: cameras of the vehicle, each NAME, NAME_KIND or
    NAME@WIDTHxHEIGHT."""
    effects: Words = ()
    """Effects on the vehicle, each NAME or NAME=VALUE: motor_lag wind=3,0,0. `none` switches off
    those of a checkpoint. docs/effects.md lists them."""
    randomize: Words = ()
    """Parameters that are drawn for each episode, each NAME=DISTRIBUTION: mass=uniform(0.8,1.2)."""
    observe_drawn: bool = False
    """Observe what is drawn too, in an array for the critic of a training alone."""
    sensors: Words = ()
    """Sensors whose readings are observed, each NAME or NAME=SETTINGS: imu gps={"rate":10}, and
    observe=estimate. docs/sensors.md lists them."""
    events: Annotated[str | None, arg(metavar="FILE")] = None
    """TOML file of what happens in flight: a gust, a kick, a rotor that fails. docs/events.md has
    the kinds."""
    drones: Count = 1
    """Drones of each world, for a task of several."""
    backend: Backend | None = None
    """What steps the drones: mujoco, or rigid (without contact, fast). Default: the task's."""
    options: Suppress[Fixed[dict]] = field(default_factory=dict)  # type: ignore[type-arg]
    """Options of the task that --env names."""

    @property
    def env_id(self) -> str:
        """The task without its module."""
        return self.env.rpartition(":")[2]

    def env_config(self, **settings: object) -> "EnvConfig":
        """The env of the flags."""
        from ..envs.config import EnvConfig

        env = {"vehicle": self.vehicle, "drones": self.drones, "backend": self.backend}
        return EnvConfig.from_keywords(self.env_id, **{**env, **self.options, **settings})

    @property
    def shown_scene(self) -> str | None:
        """The scene that the user wants to see, if it is a single one."""
        from ..scenes import SceneConfig

        scene = self.options.get("scene")
        return str(scene) if scene and len(SceneConfig.parse(scene).given_scenes) == 1 else None


BackendOfPreset = Annotated[Backend | None, arg(help_behavior_hint="(default: the preset's)")]
"""Type of the flag where a preset names the default."""


class WireFlags(EnvFlags):
    """One side of the wire."""

    key_file: Path | None = None
    """Key that the other side has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow an address beyond this machine without a key: anyone who reaches it may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""


class MavlinkFlags(Command):
    """A command that flies, or shows a flight."""

    mavlink: Annotated[str | None, arg(metavar="udp:HOST:PORT")] = None
    """Send the flight of the first world there as MAVLink, for a ground station:
    udp:127.0.0.1:14550."""


class AgentFlags(WireFlags):
    """A command that flies over the wire: the UDP server."""

    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Wait here for a simulator instead of starting one."""


def parse_value(text: str) -> object:
    """A value as JSON, else the text itself. Python's True, False and None are taken too."""
    try:
        return json.loads({"True": "true", "False": "false", "None": "null"}.get(text, text))
    except (ValueError, RecursionError):
        return text


def parse_address(text: str) -> tuple[str, int]:
    """HOST:PORT as a pair. Raises `InputError`."""
    parts = re.fullmatch(r"(.+):([0-9]{1,5})", text)
    if not parts or int(parts[2]) > 65535:
        raise InputError(
            f"address: expected HOST:PORT with a port up to 65535, got {shortened(text)}"
        )
    return parts[1], int(parts[2])
