"""Commands that fly a policy over the wire: for simulators that come, and to measure it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import Positional, arg

from .base import AgentCommand, EnvOptions
from .inputs import load_policy, remote_env

__all__ = ["Evaluate", "Serve"]


@dataclass(frozen=True, kw_only=True)
class Serve(AgentCommand):
    """Fly simulators that come, one after the other, with a trained policy or the PID."""

    policy: Positional[str]
    """Checkpoint, folder of a training, or pid."""
    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = "127.0.0.1:8001"
    """Address to wait at."""
    episodes: int | None = None
    """End after so many episodes. Default: go on until Ctrl-C."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Fly episode after episode."""
        from ..experiments.evaluate import evaluation_seed, fly

        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"episodes: expected at least 1, got {self.episodes}")
        policy, config = load_policy(self.policy, self.env.checked())
        episode = 0
        with remote_env(config, self) as env:
            while self.episodes is None or episode < self.episodes:
                with _until_it_leaves():
                    flight = fly(env, policy, evaluation_seed(episode))
                    print(
                        f"episode {episode}: return {flight.rewards.sum():.1f}, "
                        f"last |E| {abs(flight.errors[-1]):.3f} m",
                        flush=True,
                    )
                    episode += 1
        return 0


@contextmanager
def _until_it_leaves() -> Iterator[None]:
    """A simulator that leaves is no error to an agent that waits for the next."""
    from ..udp import LinkError

    try:
        yield
    except LinkError as error:
        print(error, flush=True)


@dataclass(frozen=True, kw_only=True)
class Evaluate(AgentCommand):
    """Measure a trained policy or the PID over episodes without exploration."""

    policy: Positional[str]
    """Checkpoint, folder of a training, or pid."""
    episodes: int = 20
    """Episodes to fly, from seeds that no training uses."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with."""

    def run(self) -> int:
        """Fly and print the means."""
        from .evaluate import evaluate

        return evaluate(self)
