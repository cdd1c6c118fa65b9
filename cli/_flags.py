"""What every command declares and how its flags are parsed: tyro, plus the options of any task."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import tyro
from tyro.conf import Fixed, Suppress, arg

from ..models.errors import InputError

__all__ = ["DEFAULT_ENV", "AgentFlags", "Command", "EnvFlags", "parse", "parse_value"]

DEFAULT_ENV: Final = "rotorgram/Elevation-v0"


@dataclass(frozen=True, kw_only=True)
class Command:
    """What every command is: its fields are the flags, their docstrings the help."""

    given: Suppress[Fixed[frozenset[str]]] = frozenset()
    """Names of the fields that the user set, if only to their default; those of options of the
    task begin with `env.`."""

    def run(self) -> int:
        """Do it; the exit status."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class EnvFlags(Command):
    """A command that takes any task."""

    env: str = DEFAULT_ENV
    """Task by its id, or module:Name-v0 for one that a module of the working directory registers.
    Its options are flags --env.NAME."""
    vehicle: Path | None = None
    """MJCF file of a multirotor. Default: the paper's quadcopter."""
    options: Suppress[Fixed[Any]] = field(default_factory=dict)
    """Options of the task that the user set, JSON values by name."""


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

    Raises:
        InputError: The task is not known.
    """
    words = list(words)
    given = _given(words)
    if not issubclass(kind, EnvFlags):
        return replace(tyro.cli(kind, prog=prog, args=words), given=given)
    listens = "listen" in given or _default(kind, "listen")
    env_id = _value(words, "--env") or DEFAULT_ENV
    from ..envs import registry

    if listens and ":" not in env_id and not registry.is_known(env_id):
        requirements = _take_requirements(words)
        return replace(
            tyro.cli(kind, prog=prog, args=words), given=given, options=requirements
        )
    env_id = registry.load(env_id)
    options_type = registry.options_type(env_id)
    # A wrong value is told like every other wrong input, by the options themselves, not by tyro.
    raw = type("EnvOptions", (options_type,), {"__post_init__": lambda self: None,
                                               "__doc__": f"Options of {env_id}."})  # fmt: skip
    typed = make_dataclass(
        kind.__name__,
        [("options", Annotated[raw, arg(name="env")], field(default_factory=raw))],
        bases=(kind,),
        frozen=True,
        kw_only=True,
    )
    typed.__doc__ = kind.__doc__
    command = tyro.cli(typed, prog=prog, args=words)
    values = {n.removeprefix("env."): None for n in given if n.startswith("env.")}
    chosen = {name: getattr(command.options, name) for name in values}
    options_type.from_options(_json(chosen))  # raises InputError
    return replace(command, given=given, env=env_id, options=_json(chosen))


def parse_value(text: str) -> Any:
    """A value as JSON; what is no JSON is a text. Python's True and False are taken too."""
    try:
        return json.loads({"True": "true", "False": "false", "None": "null"}.get(text, text))
    except (ValueError, RecursionError):
        return text


def _given(words: Sequence[str]) -> frozenset[str]:
    """Names of the flags among the words, as fields are named."""
    flags = (word[2:].partition("=")[0].replace("-", "_") for word in words if word[:2] == "--")
    return frozenset(
        prefix + dot + name.removeprefix("no_")
        for prefix, dot, name in (flag.rpartition(".") for flag in flags)
    )


def _value(words: Sequence[str], flag: str) -> str | None:
    """The last value of a flag, `--flag VALUE` or `--flag=VALUE`; None where it is not set."""
    found = None
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name == flag:
            found = value if equals else following
    return found


def _take_requirements(words: list[str]) -> dict[str, Any]:
    """Take `--env.NAME VALUE` out of the words: JSON values of a task that is not known here."""
    found: dict[str, Any] = {}
    kept: list[str] = []
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if not name.startswith("--env."):
            kept.append(word)
            continue
        text = value if equals else next(rest, None)
        if text is None:
            raise InputError(f"{name}: expected a value, got none")
        found[name.removeprefix("--env.").replace("-", "_")] = parse_value(text)
    words[:] = kept
    return found


def _default(kind: type[Command], name: str) -> Any:
    return next((f.default for f in fields(kind) if f.name == name), None)


def _json(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as JSON values: tuples become lists."""
    plain: dict[str, Any] = json.loads(json.dumps(dict(options)))
    return plain
