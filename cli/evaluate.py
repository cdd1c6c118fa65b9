"""`rotorgram evaluate`: fly episodes without exploration, print the means."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from ._flags import AgentFlags
from ._inputs import check_count

__all__ = ["Evaluate"]


@dataclass(frozen=True, kw_only=True)
class Evaluate(AgentFlags):
    """Measure a trained policy or the PID over episodes without exploration."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """Checkpoint, folder of a training, or pid."""
    episodes: int = 20
    """Episodes to fly, from seeds that no training uses."""

    def run(self) -> int:
        """Fly and print the means."""
        import numpy as np

        from ..experiments.metrics import Headline
        from ..experiments.trajectories import evaluation_row, fly_episodes
        from ._env import chosen_env, load_checkpoint, policy_for, remote_env

        check_count("episodes", self.episodes)
        checkpoint = load_checkpoint(self.policy)
        required = checkpoint is not None or bool(self.options) or "env" in self.given
        with remote_env(self, *chosen_env(self, checkpoint), required=required) as env:
            policy = policy_for(self.policy, checkpoint, env.env_spec)
            trajectories = fly_episodes(env, policy, self.episodes, "final")
        headline = Headline.of(trajectories[0].spec)
        rows = [evaluation_row(trajectory) for trajectory in trajectories]
        means = {name: np.mean([row[name] for row in rows]) for name in ("return", "steady")}
        terminated = sum(row["terminated"] for row in rows)
        print(f"policy      {self.policy} on {trajectories[0].spec.env_id}")
        print(f"episodes    {len(rows)}, {terminated} terminated")
        print(f"return      {means['return']:.1f}")
        print(f"steady      {headline.size_symbol} {headline.amount(f'{means['steady']:.4f}')}")
        return 0
