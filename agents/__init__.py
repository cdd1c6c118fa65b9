"""Learning algorithms, their policies and files, and controllers: PID and geometric.

Policies, controllers and the reading of checkpoints import no algorithm: `make_agent` and
`resume_agent` do. Only SB3's needs torch.
"""

from typing import TYPE_CHECKING, Final

from ..envs.spec import Discrete, EnvSpec, component_names
from ..models.errors import InputError, expect
from .checkpoints import Checkpoint, CheckpointError, load, store
from .episodes import Episode, EpisodeLog, ResumeError, episode_seed
from .geometric import Geometric
from .orca import Orca
from .pid import PID
from .policies import NetworkPolicy, Policy
from .presets import (
    NETWORKS,
    PRESETS,
    A2CConfig,
    AlgorithmName,
    Config,
    PPOConfig,
    SACConfig,
    VPGConfig,
    config_type,
    preset,
)

if TYPE_CHECKING:
    from .learner import Learner
    from .sac import SAC
    from .sb3 import SB3Agent

    Agent = Learner | SAC | SB3Agent

CONTROLLERS: Final[dict[str, type[PID] | type[Geometric] | type[Orca]]] = {
    "pid": PID, "geometric": Geometric, "orca": Orca,
}  # fmt: skip
"""Agents that need no training, made of an env's spec."""

__all__ = [
    "CONTROLLERS",
    "PID",
    "PRESETS",
    "A2CConfig",
    "AlgorithmName",
    "Checkpoint",
    "CheckpointError",
    "Episode",
    "EpisodeLog",
    "Geometric",
    "NetworkPolicy",
    "Orca",
    "PPOConfig",
    "Policy",
    "ResumeError",
    "SACConfig",
    "VPGConfig",
    "can_resume",
    "episode_seed",
    "load",
    "make_agent",
    "preset",
    "resume_agent",
    "start_agent",
    "store",
]


def make_agent(algorithm: str, log: EpisodeLog, config: Config, seed: int) -> "Agent":
    """A new agent of a name in `PRESETS`, for the env of a log.

    Raises:
        InputError: No such algorithm, or a config of another one.
        MissingPackage: SB3 is not installed.
    """
    match algorithm, config:
        case "vpg", VPGConfig():
            from .vpg import VPG

            return VPG(log, config, seed)
        case "ppo" | "ippo", PPOConfig():
            from .ppo import PPO

            return PPO(log, config, seed)
        case "mappo", PPOConfig():
            from .mappo import MAPPO

            return MAPPO(log, config, seed)
        case "a2c", A2CConfig() if not isinstance(config, PPOConfig):
            from .a2c import A2C

            return A2C(log, config, seed)
        case "sac", SACConfig():
            from .sac import SAC

            return SAC(log, config, seed)
        case "sb3-a2c" | "sb3-ppo" | "sb3-sac", A2CConfig() | SACConfig() if type(
            config
        ) is config_type(algorithm):
            from .sb3 import SB3Agent

            return SB3Agent(log, config, seed)
    raise InputError(
        f"algorithm: expected one of {sorted(PRESETS)} with its config, got {algorithm!r} "
        f"with {type(config).__name__}"
    )


_ALIKE: Final = {"vpg", "a2c", "ppo", "ippo", "mappo"}
"""Algorithms whose policies are the same network."""


def start_agent(
    kept: Checkpoint, algorithm: str, log: EpisodeLog, config: Config, seed: int
) -> "Agent":
    """A new agent that begins with the networks of a checkpoint; all else of it is fresh.

    The checkpoint is of the same algorithm; `vpg`, `a2c`, `ppo`, `ippo` and `mappo` take each
    other's policy too, and `a2c`, `ppo` and `ippo` each other's critic. Its task, vehicle and
    effects may be others, its observation and action may not.

    Raises:
        InputError: The checkpoint has other networks, or is a policy alone.
        CheckpointError: The parts of the checkpoint do not fit together.
    """
    names = ", ".join(sorted(_ALIKE)) if algorithm in _ALIKE else algorithm
    right = kept.algorithm in (_ALIKE if algorithm in _ALIKE else {algorithm})
    expect(right, "start-from", f"a training of {names}", kept.algorithm)
    expect(kept.num_envs, "start-from", "the checkpoint of a training", "a policy alone")
    for (what, wanted), (_, got) in zip(_parts(kept.spec), _parts(log.spec), strict=True):
        fit = f"the {what} of {kept.env_id}"
        expect(len(got) == len(wanted), "start-from", f"{fit}, {len(wanted)}", f"{len(got)}")
        for one, other in zip(wanted, got, strict=True):
            expect(one == other, "start-from", f"{fit} with {one!r}", repr(other))
    begun_with = preset(kept.algorithm, "tuned", **kept.config)
    for name in NETWORKS:
        value, own = getattr(config, name), getattr(begun_with, name)
        expect(value == own, name, f"{own} of the training to start from", f"{value}")
    agent = make_agent(algorithm, log, config, seed)
    try:
        agent.start_from(kept)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise _unfit(error) from None
    return agent


def _parts(spec: EnvSpec) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Names of what an env's policy sees, and of what it sets."""
    seen = tuple(name for array in spec.observation for name in component_names(array))
    if isinstance(spec.action, Discrete):
        return ("observed numbers", seen), ("choices", tuple(map(str, range(spec.action.n))))
    return ("observed numbers", seen), ("actions", component_names(spec.action))


def _unfit(error: Exception) -> CheckpointError:
    reason = " ".join(str(error).split())
    return CheckpointError(f"checkpoint: its parts do not fit together: {reason:.300}")


def can_resume(algorithm: str) -> bool:
    """Whether a training goes on where it stopped; SB3's keep no state, and start anew."""
    return not algorithm.startswith("sb3-")


def resume_agent(kept: Checkpoint, log: EpisodeLog) -> "Agent":
    """The agent of a checkpoint; the log, a new one of as many drones, resumes where it was.

    An agent that cannot resume starts anew, and the log with it.

    Raises:
        CheckpointError: The parts of the checkpoint do not fit together.
        ResumeError: It has a policy alone, or the env is another one, or does not repeat the
            interrupted episodes.
        MissingPackage: SB3 is not installed.
    """
    kept.check_resumable()
    for name in ("env_id", "options", "agents", "vehicle_hash", "observation", "action"):
        expected, got = getattr(kept.spec, name), getattr(log.spec, name)
        if expected == got or got == "0" * 32:  # the hash of a peer that tells none
            continue
        if name == "vehicle_hash":
            then, now = (f"{s.vehicle} (model {s.vehicle_hash[:8]})" for s in (kept.spec, log.spec))
            raise ResumeError(
                f"resume: expected {then}, got {now}; name the vehicle with --vehicle"
            )
        if name == "options":  # those that differ
            names = [one for one in {**expected, **got} if expected.get(one) != got.get(one)]
            expected, got = ({one: o[one] for one in names if one in o} for o in (expected, got))
        raise ResumeError(
            f"resume: expected an env with {name} {expected!s:.300}, got {got!s:.300}"
        )
    try:
        config = preset(kept.algorithm, "tuned", **kept.config)
        layers = kept.policy().layers
        if config.hidden != tuple(len(bias) for _, bias in layers[:-1]):
            raise InputError(f"hidden: expected those of the policy, got {config.hidden}")
        agent = make_agent(kept.algorithm, log, config, kept.seed)
        if not hasattr(agent, "set_state"):  # SB3's
            return agent
        agent.set_state(kept.state)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        raise _unfit(error) from None
    log.resume(kept.position)
    return agent
