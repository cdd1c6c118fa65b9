"""An agent of an algorithm's name, new or from a checkpoint."""

from ..envs.spec import EnvSpec, options_difference
from ..models.errors import InputError, one_line
from .checkpoints import Checkpoint, CheckpointError
from .config import Config
from .episodes import EpisodeRecorder, ResumeError
from .learner import Learner
from .registry import Agent, find_algorithm


def make_agent(algorithm: str, log: EpisodeRecorder, config: Config, seed: int) -> Agent:
    """A new agent of a name in `ALGORITHMS`, for the env of a log.

    Raises:
        InputError: No such algorithm, or a config of another one.
        MissingPackage: SB3 is not installed.
    """
    row = find_algorithm(algorithm)
    if type(config) is not row.config:
        raise InputError(
            f"algorithm: expected {algorithm} with its {row.config.__name__}, "
            f"got {type(config).__name__}"
        )
    agent: Agent = row.agent(log, config, seed)
    return agent


def resume_agent(kept: Checkpoint, log: EpisodeRecorder) -> Agent:
    """The agent of a checkpoint; the log, a new one of as many drones, resumes where it was.

    An agent that cannot resume starts anew, and the log with it.

    Raises:
        CheckpointError: The parts of the checkpoint do not fit together.
        ResumeError: It has a policy alone, or the env is another one, or does not repeat the
            interrupted episodes.
        MissingPackage: SB3 is not installed.
    """
    kept.check_resumable()
    _check_same_env(kept.spec, log.spec)
    try:
        kept.policy()  # its networks are those of the config
        agent = make_agent(kept.algorithm, log, kept.hyperparameters, kept.seed)
        if isinstance(agent, Learner):
            log.resume(kept.position)
            agent.set_state(kept.state)
    except ResumeError:
        raise
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"checkpoint: its parts do not fit together: {one_line(error):.300}"
        ) from None
    return agent


def _check_same_env(then: EnvSpec, now: EnvSpec) -> None:
    """Raises `ResumeError` unless a training can go on in this env."""
    if then.config_digest and then.config_digest == now.config_digest:
        return  # only names of files may differ
    for name in ("env_id", "options", "agents", "vehicle_hash", "observation", "action"):
        expected = getattr(then, name)
        got = getattr(now, name)
        if expected == got or got == "0" * 32:  # the hash of a peer that gives none
            continue
        if name == "vehicle_hash":
            raise ResumeError(
                f"resume: expected {then.vehicle_text}, got {now.vehicle_text}; "
                "name the vehicle with --vehicle"
            )
        if name == "options":
            raise ResumeError(
                "resume: expected an env with options of the training: "
                f"{options_difference(expected, got):.600}"
            )
        raise ResumeError(
            f"resume: expected an env with {name} {expected!s:.300}, got {got!s:.300}"
        )
