"""Policies of a training, evaluated without exploration: what comparison, sweep and board share."""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from ..agents.policies import Policy
from ..envs.spec import EnvSpec
from ..flights.trajectories import EpisodeSet, Trajectory, fly_episodes
from . import results
from .metrics import Headline
from .pairs import shared_pair
from .settings import EnvConfig
from .training import Snapshot

MAX_BATCH: Final = 64
"""Most evaluation episodes that are flown at a time."""


class Stage(NamedTuple):
    """A policy, and the training behind it."""

    policy: Callable[[EnvSpec], Policy]
    env_steps: int = 0
    seconds: float = 0.0


def stages_of(taken: Sequence[Snapshot]) -> list[Stage]:
    """The snapshots of a training."""

    def kept(policy: Policy) -> Callable[[EnvSpec], Policy]:
        return lambda spec: policy

    return [Stage(kept(one.policy), one.env_steps, one.seconds) for one in taken]


def evaluate_stages(
    config: EnvConfig,
    stages: Sequence[Stage],
    episodes: int,
    curve_episodes: int = 0,
    of: EpisodeSet = "final",
) -> tuple[list[dict[str, Any]], list[Trajectory]]:
    """Rows of `evaluations.csv` but for agent and seed, and the trajectories of the last stage.

    The last stage flies so many `episodes` of a set, each before it `curve_episodes` of the set
    `curve`.
    """
    rows: list[dict[str, Any]] = []
    flown: list[Trajectory] = []
    most = max(curve_episodes, episodes) if len(stages) > 1 else episodes
    worlds = min(most, max(MAX_BATCH // config.drones, 1))
    with shared_pair(**config.env, num_envs=worlds * config.drones) as env:
        spec = env.env_spec
        headline = Headline.of(spec)
        for stage in stages:
            last = stage is stages[-1]
            count, which = (episodes, of) if last else (curve_episodes, "curve")
            flown = fly_episodes(env, stage.policy(spec), count, which)
            label = {"env_steps": stage.env_steps, "seconds": stage.seconds}
            rows += [label | results.evaluation_row(one, headline) for one in flown]
    return rows, flown
