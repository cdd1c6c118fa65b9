"""Learning algorithms, their policies and files, and a PID controller.

Policies, the PID and the reading of checkpoints need neither torch nor SB3: `make_agent` and
`resume_agent` import them.
"""

from typing import TYPE_CHECKING

from ..models.errors import InputError
from .checkpoints import Checkpoint, CheckpointError, load, store
from .episodes import Episode, EpisodeLog, ResumeError, episode_seed
from .pid import PID
from .policies import NetworkPolicy, Policy
from .presets import PRESETS, A2CConfig, AlgorithmName, VPGConfig, preset

if TYPE_CHECKING:
    from .learner import Learner
    from .sb3 import SB3A2C

    Agent = Learner | SB3A2C

__all__ = [
    "PID", "PRESETS", "A2CConfig", "AlgorithmName", "Checkpoint", "CheckpointError", "Episode",
    "EpisodeLog", "NetworkPolicy", "Policy", "ResumeError", "VPGConfig", "episode_seed", "load",
    "make_agent", "preset", "resume_agent", "store",
]  # fmt: skip


def make_agent(
    algorithm: str, log: EpisodeLog, config: VPGConfig | A2CConfig, seed: int
) -> "Agent":
    """A new agent, `vpg`, `a2c` or `sb3-a2c`, for the env of a log.

    Raises:
        InputError: No such algorithm, or a config of another one.
        MissingPackage: torch or SB3 is not installed.
    """
    match algorithm, config:
        case "vpg", VPGConfig():
            from .vpg import VPG

            return VPG(log, config, seed)
        case "a2c", A2CConfig():
            from .a2c import A2C

            return A2C(log, config, seed)
        case "sb3-a2c", A2CConfig():
            from .sb3 import SB3A2C

            return SB3A2C(log, config, seed)
    raise InputError(
        f"algorithm: expected one of {sorted(PRESETS)} with its config, got {algorithm!r} "
        f"with {type(config).__name__}"
    )


def resume_agent(kept: Checkpoint, log: EpisodeLog) -> "Agent":
    """The agent of a checkpoint; the log, a new one of as many drones, resumes where it was.

    Raises:
        CheckpointError: The parts of the checkpoint do not fit together.
        ResumeError: It has a policy alone, or the env is another one, or does not repeat the
            interrupted episodes.
        MissingPackage: torch or SB3 is not installed.
    """
    kept.check_resumable()
    for name in ("env_id", "options", "vehicle_hash", "observation", "action"):
        expected, got = getattr(kept.spec, name), getattr(log.spec, name)
        if expected != got and got != "0" * 32:  # the hash of a peer that tells none
            raise ResumeError(f"resume: expected an env with {name} {expected}, got {got}")
    try:
        config = preset(kept.algorithm, "paper", **kept.config)
        if config.hidden != len(kept.actor["hidden.bias"]):
            raise InputError(f"hidden: expected that of the policy, got {config.hidden}")
        agent = make_agent(kept.algorithm, log, config, kept.seed)
        agent.set_state(kept.state)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(f"checkpoint: its parts do not fit together: {reason:.300}") from None
    log.resume(kept.position)
    return agent
