"""Base of all commands, and the parser of their flags: tyro, plus the options of any task."""

import json
import re
import shlex
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro
from tyro.conf import Fixed, Suppress, arg

from ..flights.folders import LOCK, new_folder
from ..models import Backend
from ..models.errors import InputError, shortened

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DEFAULT_ENV: Final = "rotorgram/Elevation-v0"
_PLAIN_FLAGS: Final = ("action", "control_period", "episode_length", "history", "scene", "cameras")
_WORLD_FLAGS: Final = ("effects", "randomize", "sensors")
Options = dict[str, Any]
"""Options of a task and its env by name, values as of JSON."""
_NO_FLAG: object = Suppress[Fixed[dict]]  # type: ignore[type-arg]


@dataclass(frozen=True, kw_only=True)
class Command:
    """Base of all commands: the fields are the flags, their docstrings the help."""

    given: Suppress[Fixed[frozenset]] = frozenset()  # type: ignore[type-arg]
    """Names of the fields that the user set, if only to their default; those of options of the
    task begin with `env.`."""

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
    cameras: tuple[str, ...] = ()
    """Pictures that are observed: cameras of the vehicle, each NAME, NAME_KIND or
    NAME@WIDTHxHEIGHT."""
    effects: tuple[str, ...] = ()
    """Effects on the vehicle, each NAME or NAME=VALUE: motor_lag wind=3,0,0. `none` switches off
    those of a checkpoint. docs/effects.md lists them."""
    randomize: tuple[str, ...] = ()
    """Parameters that are drawn for each episode, each NAME=DISTRIBUTION: mass=uniform(0.8,1.2)."""
    sensors: tuple[str, ...] = ()
    """Sensors whose readings are observed, each NAME or NAME=SETTINGS: imu gps={"rate":10}, and
    observe=estimate. docs/sensors.md lists them."""
    drones: int = 1
    """Drones of each world, for a task of several."""
    options: Suppress[Fixed[dict]] = field(default_factory=dict)  # type: ignore[type-arg]
    """Keywords of `EnvConfig` that were given, but for the vehicle, the drones and the backend. A
    checkpoint brings those that it was trained with."""

    @property
    def env_id(self) -> str:
        """The task without its module."""
        return self.env.rpartition(":")[2]

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
class AgentFlags(EnvFlags):
    """A command that flies over the wire: the UDP server."""

    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Wait here for a simulator instead of starting one."""
    key_file: Path | None = None
    """Key that the simulator has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow an address beyond this machine without a key: anyone who reaches it may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""


C = TypeVar("C", bound=Command)


def parse(kind: type[C], prog: str, words: Sequence[str]) -> C:
    """A command from its words. A wrong flag exits with status 2, `--help` with 0.

    Raises `InputError` if the task or one of its options is not what it should be.
    """
    given = _given(words)
    plain = _for_tyro(kind)
    if not issubclass(kind, EnvFlags):
        return cast(C, replace(tyro.cli(plain, prog=prog, args=words), given=given))
    from ..envs import registry
    from ..envs.config import KEYWORDS, EnvConfig
    from ..envs.spec import canonical_id

    parser = ArgumentParser(prog, add_help=False, allow_abbrev=False)
    parser.add_argument("--env")
    parser.add_argument("--config")
    early = parser.parse_known_args(words)[0]
    file = _file_values(kind, early.config) if early.config else {}
    env_id = early.env or file.get("env") or DEFAULT_ENV
    of_file = canonical_id(file.get("env", env_id))
    own_options = [name for name in file.get("options", {}) if name not in KEYWORDS]
    if own_options and canonical_id(env_id) != of_file:
        got = ", ".join(own_options)
        raise InputError(f"config: expected no options of {of_file} with --env {env_id}, got {got}")
    listens = "listen" in given or getattr(kind, "listen", None) is not None
    if listens and ":" not in env_id and not registry.is_known(env_id):
        words, required = _without_requirements(words)
        command = tyro.cli(plain, prog=prog, args=words)
        options = required | _world_options(command, given)
        return cast(C, _with_file(command, given, options, file))
    env_id = registry.load(env_id)
    options_type = registry.task_type(env_id).Options
    raw = _for_tyro(options_type, __doc__=f"Options of {env_id}.")
    typed = make_dataclass(
        kind.__name__,
        [("options", Annotated[raw, arg(name="env")], field(default_factory=raw))],
        bases=(plain,),
        namespace={"__doc__": kind.__doc__},
        frozen=True,
        kw_only=True,
    )
    command = tyro.cli(typed, prog=prog, args=words)
    names = sorted(name.removeprefix("env.") for name in given if name.startswith("env."))
    own = {name: getattr(command.options, name) for name in names}
    clashing = {name: own.pop(name) for name in names if name in KEYWORDS}
    options = own | _world_options(command, given) | ({"task": clashing} if clashing else {})
    command = _with_file(command, given, options, file)
    checked = EnvConfig.from_keywords(env_id, **command.options).flat_options()
    chosen = {name: checked.get(name, value) for name, value in command.options.items()}
    return cast(C, replace(command, options=chosen))


def _file_values(kind: type[EnvFlags], path: str) -> Options:
    """Values of a config's file by the names of fields. Raises `InputError`."""
    from ..envs.config import BackendConfig, read_toml

    options = read_toml(Path(path))
    values: Options = {}
    for name in ("env", "env_id"):
        if name in options:
            values["env"] = options.pop(name)
    if "vehicle" in options:
        values["vehicle"] = ",".join(options.pop("vehicle"))
    if "drones" in options:
        values["drones"] = options.pop("drones")
    backend = BackendConfig.parse(options.pop("backend", "mujoco"))
    if issubclass(kind, BackendFlags):
        values["backend"] = backend.name
    elif backend.name != "mujoco":
        raise InputError(f"backend: expected mujoco with this command, got {backend.name}")
    return {**values, "options": {**backend.settings, **options}}


def _with_file(
    command: EnvFlags, given: frozenset[str], options: Options, file: Options
) -> EnvFlags:
    """The command with what the file says and no flag does."""
    added = {name: value for name, value in file.items() if name not in {*given, "options"}}
    options = {**file.get("options", {}), **options}
    return replace(command, given=given | added.keys(), options=options, **added)


def _world_options(command: EnvFlags, given: frozenset[str]) -> Options:
    """Options by name of the flags whose words are NAME or NAME=VALUE. Raises `InputError`."""
    options: Options = {}
    for name in given.intersection(_PLAIN_FLAGS):
        options[name] = getattr(command, name)
    for flag in given.intersection(_WORLD_FLAGS):
        words = getattr(command, flag)
        values: Options = {}
        for word in () if words == ("none",) else words:
            name, equals, text = word.partition("=")
            several = re.fullmatch(r"[-+.\deE]+(,[-+.\deE]+)+", text)
            value = parse_value(f"[{text}]" if several else text)
            key = name.replace("-", "_")
            if key in values:
                raise InputError(f"{flag}: expected each name once, got {key!r} twice")
            values[key] = value if equals else True
        options[flag] = values
    return options


def _for_tyro(kind: type["DataclassInstance"], **namespace: object) -> Any:
    """A dataclass without checks: wrong values are refused later, as every other wrong input.

    It has `Union[X, Y]` for `X | Y`: before Python 3.14 tyro imports typeguard for that, slowly.
    """
    hints = get_type_hints(kind, include_extras=True)
    changed = {}
    for one in fields(kind):
        hint = hints[one.name]
        extras = getattr(hint, "__metadata__", ())  # of Annotated
        hint = hint.__origin__ if extras else hint
        if get_origin(hint) is Mapping:  # of words, which flags of their own give
            changed[one.name] = _NO_FLAG
            namespace[one.name] = field(default_factory=dict)
        if isinstance(hint, UnionType):
            union: object = Union[get_args(hint)]  # noqa: UP007
            changed[one.name] = Annotated[union, *extras] if extras else union
    own = {"__annotations__": changed, "__doc__": kind.__doc__, "__post_init__": lambda self: None}
    return dataclass(frozen=True, kw_only=True)(type(kind.__name__, (kind,), own | namespace))


def parse_value(text: str) -> Any:
    """A value as JSON; other words are texts. Python's True and False are taken too."""
    try:
        return json.loads({"True": "true", "False": "false", "None": "null"}.get(text, text))
    except (ValueError, RecursionError):
        return text


def named_value(flag: str, word: str) -> tuple[str, Any]:
    """NAME=VALUE, a value in JSON or a text. Raises `InputError`."""
    name, equals, value = word.partition("=")
    if not equals:
        raise InputError(f"{flag}: expected NAME=VALUE, got {word!r}")
    if name == "hidden" and "," in value and not value.startswith("["):
        raise InputError(f"{flag}: expected a list as hidden=[{value}], got {word!r}")
    return name, parse_value(value)


def _given(words: Sequence[str]) -> frozenset[str]:
    """Names of the flags among the words, as fields are named."""
    names = set()
    for word in words:
        if word.startswith("--"):
            flag = word.removeprefix("--").partition("=")[0].replace("-", "_")
            prefix, dot, name = flag.rpartition(".")
            names.add(prefix + dot + name.removeprefix("no_"))
    return frozenset(names)


def _without_requirements(words: Sequence[str]) -> tuple[list[str], Options]:
    """The words without `--env.NAME VALUE`, and these: JSON values of a task not known here."""
    kept: list[str] = []
    required: Options = {}
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if not name.startswith("--env."):
            kept.append(word)
            continue
        text = value if equals else next(rest, None)
        if text is None:
            raise InputError(f"{name}: expected a value, got none")
        required[name.removeprefix("--env.").replace("-", "_")] = parse_value(text)
    return kept, required


# ---- checks: addresses, counts, folders, and the settings that a resumed run keeps


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


@contextmanager
def folder_to_write(out: Path | None, name: str) -> Iterator[Path]:
    """A new folder, by default named by the time; removed if the block fails before it writes."""
    folder = new_folder(out, name)
    try:
        yield folder
    except BaseException:
        with suppress(OSError):  # it holds something
            if {file.name for file in folder.iterdir()} == {LOCK}:
                (folder / LOCK).unlink()
            folder.rmdir()
        raise


def refuse_settings(command: Command, folder: Path, *, free: tuple[str, ...]) -> None:
    """Raises `InputError` if a setting but the free ones was given: a resumed run keeps its own."""
    flags = ["--" + name.replace("_", "-") for name in sorted(command.given.difference(free))]
    if flags:
        raise InputError(
            f"resume: expected the settings of {folder}, got others by {', '.join(flags)}"
        )


def go_on_with(command: Command, words: str, folder: Path, *flags: str) -> str:
    """The line that tells how to resume: of the flags those that were given."""
    line: list[object] = ["rotorgram", *words.split(), "--resume", folder]
    for flag in flags:
        if flag in command.given:
            value = getattr(command, flag)
            line += [f"--{flag.replace('_', '-')}", *([] if value is True else [value])]
    return f"go on with: {shlex.join(map(str, line))}"
