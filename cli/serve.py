"""`rotorgram serve`: a policy as a UDP server, for simulators that come."""

import math
from typing import Annotated

from tyro.conf import Positional, Suppress, arg

from ..models import Backend
from ._flags import AgentFlags, Count


class Serve(AgentFlags):
    """Fly each simulator that connects, one after the other, with a trained policy or a controller.

    The first decides the number of drones: each flies an episode of its own at the same time.
    """

    policy: Positional[str]
    """Checkpoint, folder of a training, universal, pid, geometric, raptor, or a controller:
    FILE.py:CLASS."""
    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = "127.0.0.1:8001"
    """Address to wait at."""
    backend: Suppress[Backend | None] = None
    """Refused: the simulators that come have theirs."""
    episodes: Count | None = None
    """End after so many episodes. Default: go on until Ctrl-C."""

    def run(self) -> None:
        """Fly episode after episode."""
        from ..flights.trajectories import fly_episodes
        from ..scenes import SceneConfig
        from ..udp import LinkError
        from ._env import fitted, in_unseen, load_pilot, policy_for, print_episode, remote_env

        if self.options.get("scene"):
            SceneConfig.parse(self.options["scene"]).embedded()  # before anyone waits
        checkpoint = load_pilot(self.policy)
        episode = 0
        with remote_env(in_unseen(fitted(self, checkpoint)), num_envs=None) as env:
            policy = policy_for(self, checkpoint, env.env_spec)
            worlds = env.num_envs // len(env.env_spec.agents)
            while self.episodes is None or episode < self.episodes:
                count = int(min(worlds, (self.episodes or math.inf) - episode))
                try:
                    for flown in fly_episodes(env, policy, count, first=episode):
                        print_episode(flown)
                    episode += count
                except LinkError as error:  # one that leaves is no error: another may come
                    print(error)
