"""Base of all commands, and the parser of their flags: tyro, plus the options of any task."""

import json
import re
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    TypeVar,
    Union,
    cast,
    get_args,
    get_type_hints,
)

import tyro
from tyro.conf import Fixed, Suppress, arg
from tyro.constructors import PrimitiveConstructorSpec

from ..models import Backend
from ..models.errors import InputError, shortened

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

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

DEFAULT_ENV = "rotorgram/Elevation-v0"
_PLAIN_FLAGS = ("action", "control_period", "episode_length", "history", "scene", "cameras")
_NAMED_FLAGS = ("effects", "randomize", "sensors")
Options = dict[str, Any]
"""Options of a task and its env by name, values as of JSON."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Base of all commands: the fields are the flags, their docstrings the help."""

    given: Suppress[Fixed[frozenset]] = frozenset()  # type: ignore[type-arg]
    """Names of the fields that flags or a config's file set, even to their default; those of a
    task's flags begin with `env.`."""

    def run(self) -> int:
        """Do it; the exit status."""
        raise NotImplementedError

    def settings(self, kind: type["DataclassInstance"]) -> Options:
        """Values of the flags that are fields of a class of settings."""
        return {f.name: getattr(self, f.name) for f in fields(kind) if hasattr(self, f.name)}


@dataclass(frozen=True, kw_only=True)
class EnvFlags(Command):
    """A command that takes any task."""

    env: str = DEFAULT_ENV
    """Task by its id, or module:Name-v0 for one that a module of the working directory registers.
    Its options are flags --env.NAME."""
    vehicle: Annotated[str | None, arg(metavar="FILE")] = None
    """TOML or MJCF file of a multirotor, or the name of one of the library; several with commas
    between them, for the drones of a world in turn. Default: the paper's quadcopter."""
    config_file: Annotated[Path | None, arg(name="config", metavar="FILE")] = None
    """TOML file with the env and everything that it is flown with, by the names of these flags and
    of the task's options. Flags win."""
    action: str | None = None
    """Action level: rotors, rates, attitude, velocity, position, offset or increment. Default: the
    task's."""
    control_period: float | None = None
    """Seconds between two actions: a multiple of the physics step. Default: the task's."""
    episode_length: int | None = None
    """Control steps after which an episode is truncated. Default: the task's."""
    history: int = 1
    """Number of the last observations that are observed side by side."""
    scene: str = "plain"
    """Ground and obstacles: plain, airport, forest, warehouse or gates; the last three from a
    seed, as forest:3, or from one of several for each episode, as forest:0-7. Films and views
    show one scene; their default is the airport."""
    cameras: Words = ()
    """Pictures that are observed: cameras of the vehicle, each NAME, NAME_KIND or
    NAME@WIDTHxHEIGHT."""
    effects: Words = ()
    """Effects on the vehicle, each NAME or NAME=VALUE: motor_lag wind=3,0,0. `none` switches off
    those of a checkpoint. docs/effects.md lists them."""
    randomize: Words = ()
    """Parameters that are drawn for each episode, each NAME=DISTRIBUTION: mass=uniform(0.8,1.2)."""
    sensors: Words = ()
    """Sensors whose readings are observed, each NAME or NAME=SETTINGS: imu gps={"rate":10}, and
    observe=estimate. docs/sensors.md lists them."""
    drones: int = 1
    """Drones of each world, for a task of several."""
    options: Suppress[Fixed[dict]] = field(default_factory=dict)  # type: ignore[type-arg]
    """Options of the task that --env names. A checkpoint brings those that it was trained with."""

    @property
    def env_id(self) -> str:
        """The task without its module."""
        return self.env.rpartition(":")[2]

    def env_config(self, **settings: Any) -> "EnvConfig":
        """The env of the flags."""
        from ..envs.config import EnvConfig

        env = {"vehicle": self.vehicle, "drones": self.drones, **self.options}
        return EnvConfig.from_keywords(self.env_id, **env, **settings)

    @property
    def shown_scene(self) -> str:
        """The scene of films and views."""
        return str(self.options.get("scene", "airport"))


@dataclass(frozen=True, kw_only=True)
class BackendFlags(EnvFlags):
    """A command that chooses what steps the drones."""

    backend: Backend = "mujoco"
    """What steps the drones: mujoco, or rigid (without contact, fast)."""


BackendOfPreset = Annotated[Backend, arg(help_behavior_hint="(default: the preset's)")]
"""Type of the flag where a preset names the default."""


@dataclass(frozen=True, kw_only=True)
class WireFlags(EnvFlags):
    """One side of the wire."""

    key_file: Path | None = None
    """Key that the other side has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow an address beyond this machine without a key: anyone who reaches it may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""


@dataclass(frozen=True, kw_only=True)
class AgentFlags(WireFlags):
    """A command that flies over the wire: the UDP server."""

    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Wait here for a simulator instead of starting one."""


C = TypeVar("C", bound=Command)


def parse(kind: type[C], prog: str, words: Sequence[str]) -> C:
    """A command from its words. A wrong flag exits with status 2, `--help` with 0.

    Raises `InputError` if the task or one of its options is not what it should be.
    """
    given = _given(words)
    if not issubclass(kind, EnvFlags):
        return cast(C, replace(tyro.cli(_for_tyro(kind), prog=prog, args=words), given=given))
    return cast(C, _parsed_env(kind, prog, words, given))


def _parsed_env(
    kind: type["EnvFlags"], prog: str, words: Sequence[str], given: frozenset[str]
) -> "EnvFlags":
    from ..envs import registry
    from ..envs.config import KEYWORDS

    first_pass = ArgumentParser(prog, add_help=False, allow_abbrev=False)
    first_pass.add_argument("--env")
    first_pass.add_argument("--config")
    found = first_pass.parse_known_args(words)[0]
    file = _file_values(kind, found.config, found.env) if found.config else {}
    env_id = found.env or file.get("env", DEFAULT_ENV)
    listens = "listen" in given or getattr(kind, "listen", None) is not None
    if listens and ":" not in env_id and not registry.is_known(env_id):
        command = tyro.cli(_for_tyro(kind), prog=prog, args=words)
        check_count("drones", command.drones)
        return _merged(command, given, {}, file)
    env_id = registry.load(env_id)
    options = _for_tyro(registry.task_type(env_id).Options, f"Options of {env_id}.")
    command = tyro.cli(_for_tyro(kind, options=options), prog=prog, args=words)
    names = [name.removeprefix("env.") for name in given if name.startswith("env.")]
    own = {name: getattr(command.options, name) for name in sorted(names)}
    clashing = {name: own.pop(name) for name in names if name in KEYWORDS}
    if clashing:
        own["task"] = clashing
    command = _merged(command, given, own, file)
    checked = command.env_config().flat_options()
    chosen = {name: checked.get(name, value) for name, value in command.options.items()}
    return replace(command, options=chosen)


def _file_values(kind: type[EnvFlags], path: str, env: str | None) -> Options:
    """Values of a config's file by the names of fields. Raises `InputError`."""
    from ..envs.config import KEYWORDS, BackendConfig, read_keywords
    from ..envs.spec import canonical_id

    options = read_keywords(path)
    values: Options = {}
    for name, key in (("env", "env"), ("env_id", "env"), ("drones", "drones")):
        if name in options:
            values[key] = options.pop(name)
    if "vehicle" in options:
        values["vehicle"] = ",".join(options.pop("vehicle"))
    backend = BackendConfig.parse(options.pop("backend", "mujoco"))
    if issubclass(kind, BackendFlags):
        values["backend"] = backend.name
    elif backend.name != "mujoco":
        raise InputError(f"backend: expected mujoco with this command, got {backend.name}")
    env_id = values.get("env", DEFAULT_ENV)
    own = [name for name in options if name not in KEYWORDS]
    if own and env and canonical_id(env) != canonical_id(env_id):
        got = ", ".join(own)
        raise InputError(f"config: expected no options of {env_id} with --env {env}, got {got}")
    return {**values, "options": {**backend.settings, **options}}


def _merged(command: EnvFlags, given: frozenset[str], own: Options, file: Options) -> EnvFlags:
    """The command with its options: those of the file, then `own` and the other flags."""
    added = {name: value for name, value in file.items() if name not in {*given, "options"}}
    options = {**file.get("options", {}), **own}
    for name in given.intersection(_PLAIN_FLAGS):
        options[name] = getattr(command, name)
    for name in given.intersection(_NAMED_FLAGS):
        options[name] = _named_values(name, getattr(command, name))
    return replace(command, given=given | added.keys(), options=options, **added)


def _named_values(flag: str, words: Words) -> Options:
    """Values of words NAME or NAME=VALUE by name. Raises `InputError`."""
    values: Options = {}
    if words == ("none",):
        return values
    for word in words:
        name, equals, text = word.partition("=")
        several = re.fullmatch(r"[-+.\deE]+(,[-+.\deE]+)+", text)
        key = name.replace("-", "_")
        if key in values:
            raise InputError(f"{flag}: expected each name once, got {key!r} twice")
        values[key] = True
        if equals:
            values[key] = parse_value(f"[{text}]" if several else text)
    return values


def _for_tyro(kind: type["DataclassInstance"], doc: str | None = None, options: Any = None) -> Any:
    """A class of flags for tyro, whose checks run later.

    `options` is the type of the field of that name. `X | Y` becomes `Union[X, Y]`: for the first,
    tyro imports typeguard before Python 3.14, which is slow.
    """
    changed: dict[str, object] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        extras = getattr(hint, "__metadata__", (None,))  # of Annotated
        plain = getattr(hint, "__origin__", hint) if hasattr(hint, "__metadata__") else hint
        if isinstance(plain, UnionType):
            changed[name] = Annotated[Union[get_args(plain)], *extras]  # noqa: UP007
    namespace: Options = {"__annotations__": changed, "__doc__": doc or kind.__doc__}
    namespace["__post_init__"] = lambda self: None
    if options:
        changed["options"] = Annotated[options, arg(name="env")]
        namespace["options"] = field(default_factory=options)
    return dataclass(frozen=True, kw_only=True)(type(kind.__name__, (kind,), namespace))


def parse_value(text: str) -> Any:
    """A value as JSON, else the text itself. Python's True, False and None are taken too."""
    try:
        return json.loads({"True": "true", "False": "false", "None": "null"}.get(text, text))
    except (ValueError, RecursionError):
        return text


def _given(words: Sequence[str]) -> frozenset[str]:
    """Names of the flags among the words, as fields are named."""
    names = set()
    for word in words:
        if word.startswith("--"):
            flag = word.removeprefix("--").partition("=")[0].replace("-", "_")
            prefix, dot, name = flag.rpartition(".")
            names.add(prefix + dot + name.removeprefix("no_"))
    return frozenset(names)


def parse_address(text: str) -> tuple[str, int]:
    """HOST:PORT as a pair. Raises `InputError`."""
    host, _, port = text.rpartition(":")
    is_port = re.fullmatch(r"[0-9]{1,5}", port) is not None and int(port) <= 65535
    if not host or not is_port:
        raise InputError(
            f"address: expected HOST:PORT with a port up to 65535, got {shortened(text)}"
        )
    return host, int(port)


def check_count(name: str, value: int | None) -> None:
    """Raises `InputError` for a number that is given and less than 1."""
    if value is not None and value < 1:
        raise InputError(f"{name}: expected at least 1, got {value}")
