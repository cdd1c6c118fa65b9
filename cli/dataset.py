"""`rotorgram dataset`: journals as a data set for offline reinforcement learning."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ._flags import Command, Files


class Dataset(Command):
    """Write the whole episodes of journals as a data set, for Minari or as Parquet.

    An episode that was given up, or whose end is not in the journal, is left out and counted.
    """

    journals: Positional[Files]
    """MCAP files that --record wrote, all of one env."""
    to: Literal["minari", "parquet"]
    """minari: a data set that minari.load_dataset finds. parquet: one file, one row per step."""
    out: str
    """minari: its id, as rotorgram/elevation-v0; MINARI_DATASETS_PATH is the folder of them all.
    parquet: the file to write."""
    env: str | None = None
    """module:Name-v0 to import a module of the working directory that registers the journals' task.
    An id in a journal is never imported."""
    vehicle: str | None = None
    """TOML or MJCF file that was flown, or its name. Default: the paper's quadcopter."""

    def run(self) -> None:
        """Write it; print what it holds."""
        from ..flights.datasets import RecordedEpisodes, env_of, write_minari, write_parquet
        from ..models import MAX_DRONES
        from ..models.fleet import load_vehicles
        from ..udp.journal.reader import count_of

        if self.vehicle:
            # Before a journal is read: a wrong name is no other env.
            load_vehicles(self.vehicle, MAX_DRONES)
        if self.env:
            from ..envs import registry

            registry.load(self.env)
        episodes = RecordedEpisodes(self.journals)
        if self.to == "minari":
            write_minari(episodes, self.out, self.vehicle)
        else:
            write_parquet(episodes, Path(self.out))
        print(
            f"{self.out}: {count_of(episodes.count, 'episode')}, {count_of(episodes.steps, 'step')}"
        )
        if episodes.left_out:
            print(f"left out: {count_of(episodes.left_out, 'episode')}, not recorded to the end")
        if self.to == "minari" and env_of(episodes.spec, self.vehicle) is None:
            print(
                f"recover_environment cannot make its env: {episodes.spec.env_id} with this "
                "vehicle and these options is not known here; --env MODULE:NAME registers a task, "
                "--vehicle names the vehicle"
            )
