"""`rotorgram evaluate`: fly episodes without exploration, print the means."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from ..models.errors import InputError
from ._flags import AgentFlags, Count, MavlinkFlags

if TYPE_CHECKING:
    from ..flights.trajectories import Flights


class Evaluate(AgentFlags, MavlinkFlags):
    """Measure a trained policy or a controller over episodes without exploration."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """Checkpoint, folder of a training, universal, pid, geometric, raptor, or a controller:
    FILE.py:CLASS."""
    episodes: Count | None = None
    """Episodes to fly, from seeds that no training uses. Default: 20; of each cell of the table of
    --robustness 1,000."""
    robustness: bool = False
    """Fly under every perturbation that docs/robustness.md lists, beside the controllers that can:
    a table, a figure and every flight."""
    out: Path | None = None
    """With --robustness: folder to write; it must not exist. Default: one in runs/."""
    jobs: Count | None = None
    """With --robustness: envs at a time. Default: one for each core."""

    def run(self) -> None:
        """Fly and print the means."""
        from ..flights.trajectories import fly_episodes
        from ..training.metrics import Headline
        from ._env import fitted, in_unseen, load_pilot, policy_for, remote_env
        from ._mavlink import mavlink_out

        checkpoint = load_pilot(self.policy)
        command = in_unseen(fitted(self, checkpoint))
        if self.robustness:
            from ._robustness import measure_robustness

            measure_robustness(command, self.episodes or 1000)
            return
        if self.out or self.jobs:
            raise InputError("out, jobs: expected them with --robustness, got it off")
        with remote_env(command, num_envs=command.drones) as env:
            Headline.of(env.env_spec)  # an env without one is refused before it is flown
            policy = policy_for(command, checkpoint, env.env_spec)
            with mavlink_out(self, env.env_spec) as env.observer:
                trajectories = fly_episodes(env, policy, self.episodes or 20, "final")
        print_means(self.policy, trajectories)


def print_means(policy: str, trajectories: "Flights") -> None:
    """Print the means of a policy's flights."""
    import numpy as np
    import pandas as pd

    from ..flights.trajectories import mean_traversability
    from ..training.metrics import Headline, measure_episode

    headline = Headline.of(trajectories[0].spec)
    rows = pd.DataFrame([measure_episode(trajectory, headline) for trajectory in trajectories])
    mean = rows.mean()
    measures = [f"{mean[name]:.4f}" for name in ("steady", "overshoot")]
    steady, overshoot = map(headline.amount, measures)
    print(f"policy     {policy} on {trajectories[0].spec.env_id}")
    crashed = f", {headline.crashed(rows).sum()} crashed" if headline.final else ""
    print(f"episodes   {len(rows)}, {rows['terminated'].sum()} terminated{crashed}")
    print(f"return     {mean['return']:.1f}")
    print(f"steady     {headline.size_symbol} {steady}")
    if headline.settles:
        count = rows["settling_time"].count()
        when = f"{mean['settling_time']:.2f} s" if count else "never"
        bound = f"{headline.size_symbol} to {headline.amount(f'{headline.settled:g}')}"
        print(f"settling   {bound}: {when} ({count} of {len(rows)} episodes)")
    if headline.signed:
        print(f"overshoot  {overshoot}")
    ends = np.mean([one.telemetry["metrics"][-1] for one in trajectories], axis=0)
    for metric, mean_end in zip(trajectories[0].spec.metrics[1:], ends[1:], strict=True):
        if metric.final:
            name = metric.name.replace("_", " ")
            print(f"{name:10} {mean_end:.3g} {metric.unit}".rstrip())
    hard = mean_traversability(trajectories)
    if hard == hard:  # no nan
        print(f"scene      traversability {hard:.1f} radii")
