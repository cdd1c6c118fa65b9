"""The parser of a command's flags: tyro, plus the options of any task and a config's file."""

import re
from collections.abc import Sequence
from dataclasses import field, replace
from inspect import cleandoc
from itertools import pairwise
from types import UnionType
from typing import Annotated, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import arg

from ..models import InputError
from ..models.fields import check_fields, immutable
from ._flags import (
    DEFAULT_ENV,
    Command,
    EnvFlags,
    ModuleFlag,
    Options,
    Words,
    parse_value,
)

T = TypeVar("T")
_PLAIN_FLAGS = (
    "action",
    "control_period",
    "episode_length",
    "history",
    "observe_drawn",
    "scene",
    "cameras",
    "events",
)
_NAMED_FLAGS = ("effects", "randomize", "sensors")
_OPTIONS = (
    "Options of the task that --env names. A checkpoint brings those that it was trained with."
)


def parse(kind: type[Command], prog: str, words: Sequence[str]) -> Command:
    """A command from its words. A wrong flag exits with status 2, `--help` with 0.

    Raises `InputError` if the task, one of its options or a number is not what it should be.
    """
    flags = _flags(words)
    command: Command
    if issubclass(kind, EnvFlags):
        command = _parsed_env(kind, prog, words, flags)
    else:
        command = replace(_run_tyro(_for_tyro(kind), prog, words), given=frozenset(flags))
    if isinstance(command, ModuleFlag) and command.env:
        from ..envs import registry

        registry.task_type(registry.load(command.env))
    check_fields(command)
    return command


def _parsed_env(
    kind: type["EnvFlags"], prog: str, words: Sequence[str], flags: dict[str, str]
) -> "EnvFlags":
    from ..envs import registry
    from ..envs.config import KEYWORDS

    given = frozenset(flags)
    env = flags.get("env")
    path = flags.get("config")
    file, options = _file_values(path, env) if path else ({}, {})
    env_id = env or file.get("env", DEFAULT_ENV)
    listens = "listen" in given or getattr(kind, "listen", None) is not None
    if listens and ":" not in env_id and not registry.is_known(env_id):
        return _merged(_run_tyro(_for_tyro(kind), prog, words), given, file, options)
    env_id = registry.load(env_id)
    task = registry.task_type(env_id)
    names = [name.removeprefix("env.") for name in given if name.startswith("env.")]
    of_task = None
    if names or "help" in given or "-h" in words:  # tyro imports typeguard for some of them, slowly
        of_task = _for_tyro(task.Options)
    command = _run_tyro(_for_tyro(kind, of_task), prog, words)
    own = {name: getattr(command.options, name) for name in sorted(names)}
    clashing = {name: own.pop(name) for name in names if name in KEYWORDS}
    if clashing:
        own["task"] = clashing
    command = _merged(command, given, file, options | own)
    checked = command.env_config().flat_options()
    chosen = {name: checked.get(name, value) for name, value in command.options.items()}
    return replace(command, options=chosen)


def _file_values(path: str, env: str | None) -> tuple[Options, Options]:
    """Values of a config's file by the names of fields, and options. Raises `InputError`."""
    from ..envs.config import KEYWORDS, BackendConfig, read_keywords
    from ..envs.spec import canonical_id

    options = read_keywords(path)
    values: Options = {}
    for name, key in (("env", "env"), ("env_id", "env"), ("drones", "drones")):
        if name in options:
            values[key] = options.pop(name)
    if "vehicle" in options:
        values["vehicle"] = ",".join(options.pop("vehicle"))
    if "backend" in options:
        backend = BackendConfig.parse(options.pop("backend"))
        values["backend"] = backend.name
        options = {**backend.settings, **options}
    env_id = values.get("env", DEFAULT_ENV)
    own = [name for name in options if name not in KEYWORDS]
    if own and env and canonical_id(env) != canonical_id(env_id):
        raise InputError(
            f"config: expected no options of {env_id} with --env {env}, got {', '.join(own)}"
        )
    return values, options


def _merged(command: EnvFlags, given: frozenset[str], file: Options, options: Options) -> EnvFlags:
    """The command with the values of a file, and options, to which it adds; flags win."""
    added = {name: value for name, value in file.items() if name not in given}
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


def _run_tyro(kind: type[T], prog: str, words: Sequence[str]) -> T:
    """With what it says at once: to find a text, tyro reads source files, slowly."""
    return tyro.cli(kind, prog=prog, args=words, description=cleandoc(kind.__doc__ or ""))


def _for_tyro(kind: type[T], options: type | None = None) -> type[T]:
    """A class of flags for tyro, whose checks run later.

    `options` is the type of the field of that name. `X | Y` becomes `Union[X, Y]`: for the first,
    tyro imports typeguard before Python 3.14, which is slow.
    """
    changed: dict[str, object] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        plain, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint, None)
        if isinstance(plain, UnionType):
            changed[name] = Annotated[Union[get_args(plain)], *extras]  # noqa: UP007
    namespace: Options = {"__annotations__": changed, "__doc__": kind.__doc__}
    namespace["__post_init__"] = lambda self: None
    namespace["__module__"] = "builtins"  # tyro looks for docstrings in `kind` alone
    if options:
        changed["options"] = Annotated[options, arg(name="env", help=_OPTIONS)]
        namespace["options"] = field(default_factory=options)
    made = type(kind.__name__, (kind,), namespace)
    return made if issubclass(kind, Command) else immutable(made)


def _flags(words: Sequence[str]) -> dict[str, str]:
    """The flags among the words, named as fields are, and the word after each."""
    flags = {}
    for word, following in pairwise([*words, ""]):
        if word.startswith("--"):
            flag, equals, value = word.removeprefix("--").partition("=")
            prefix, dot, name = flag.replace("-", "_").rpartition(".")
            if not equals and not following.startswith("--"):
                value = following
            flags[prefix + dot + name.removeprefix("no_")] = value
    return flags
