"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

from typing import Annotated

from tyro.conf import Positional, arg

from ..agents.registry import AlgorithmName
from ..models.fields import Limits
from ._flags import AgentFlags, BackendOfPreset, MavlinkFlags
from ._training import TrainingFlags


class Train(AgentFlags, TrainingFlags, MavlinkFlags):
    """Train an agent, in this process or over UDP.

    vpg, a2c and sb3-a2c learn Elevation-v0 over UDP, as in the paper. All agents do with --udp,
    with --record or --listen: from a simulator process of their own or those that come to --listen.
    The others, and all with --no-udp, fly in this process. The numbers are the same. Ctrl-C stops
    at the next update with everything written; --resume goes on to the same numbers (sb3-… start
    anew), or to more env steps, by --env-steps.
    """

    algorithm: Positional[AlgorithmName]
    """What learns: docs/algorithms/ has a page on each."""
    backend: BackendOfPreset = None
    """What steps the drones: mujoco, or rigid (without contact, fast)."""
    preset_of: str | None = None
    """Id of the task with the preset. Default: the one that is trained, or that it derives from."""
    udp: Annotated[bool, arg(help_behavior_hint="(default: as above)")] = False
    """Fly over UDP, or in this process."""
    seed: int = 0
    """Seed of weights, actions and episodes."""
    num_simulators: int = 1
    """With --listen: simulators to wait for, each with its share of the drones."""
    store_every: Annotated[float, Limits(0, unit="s", above=True)] = 10.0
    """Seconds between two checkpoints; a resumed training flies again from the last one."""

    def run(self) -> int:
        """Train by these settings, or by those of the folder to resume."""
        from . import _trainer

        return _trainer.resume(self, self.resume) if self.resume else _trainer.begin(self)
