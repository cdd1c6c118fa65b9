"""What commands have in common."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from ..envs import ElevationConfig

__all__ = ["AgentCommand", "Command", "EnvOptions"]


class EnvOptions(ElevationConfig):
    """Options of the task: see `docs/task.md`."""

    def __post_init__(self) -> None:
        """Take anything, so that a wrong option is told like every other wrong input."""

    def checked(self) -> ElevationConfig:
        """The options, if they can be. Raises `ValueError`."""
        return ElevationConfig(**vars(self))


class Command:
    """What every command is."""

    def run(self) -> int:
        """Do it; the exit status."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class AgentCommand(Command):
    """A command that flies: the UDP server."""

    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Wait here for a simulator instead of starting one."""
    key_file: Path | None = None
    """Key that the simulator has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow an address beyond this machine without a key: whoever reaches it may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""
