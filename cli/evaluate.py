"""`rotorgram evaluate`: fly episodes without exploration, print the means."""

from typing import Annotated

from tyro.conf import Positional, arg

from ._flags import AgentFlags, BackendFlags, Count


class Evaluate(AgentFlags, BackendFlags):
    """Measure a trained policy or a controller over episodes without exploration."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """Checkpoint, folder of a training, pid, geometric, orca or vfh."""
    episodes: Count = 20
    """Episodes to fly, from seeds that no training uses."""

    def run(self) -> None:
        """Fly and print the means."""
        import pandas as pd

        from ..flights.surroundings import Passage
        from ..flights.trajectories import fly_episodes
        from ..training.metrics import Headline, measure_episode
        from ._env import fitted, in_unseen, load_checkpoint, policy_for, remote_env

        checkpoint = load_checkpoint(self.policy)
        command = in_unseen(fitted(self, checkpoint))
        with remote_env(command, num_envs=command.drones, backend=self.backend) as env:
            headline = Headline.of(env.env_spec)
            policy = policy_for(command, checkpoint, env.env_spec)
            trajectories = fly_episodes(env, policy, self.episodes, "final")
        rows = pd.DataFrame([measure_episode(trajectory, headline) for trajectory in trajectories])
        mean = rows.mean()
        measures = [f"{mean[name]:.4f}" for name in ("steady", "overshoot")]
        steady, overshoot = map(headline.amount, measures)
        print(f"policy     {self.policy} on {trajectories[0].spec.env_id}")
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
        passage = Passage.of(trajectories)
        if passage:
            print(f"touched    {passage.touched:.1%}")
            print(f"time       {passage.time:.2f} s")
            print(f"speed      mean {passage.mean_speed:.2f} m/s, top {passage.top_speed:.2f} m/s")
            print(f"clearance  at least {passage.least_clearance:.2f} m in the mean of flights")
            print(f"scene      traversability {passage.traversability:.1f}")
