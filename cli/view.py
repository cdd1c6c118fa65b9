"""`rotorgram view`: flights live, flown in process or read from a journal."""

from itertools import chain, count, islice
from pathlib import Path

from tyro.conf import Positional

from ..flights.recorded import recorded_trajectories
from ..flights.trajectories import flown_trajectories
from ..models import InputError
from ..scenes.returns import RANGES
from ._flags import Count, EnvFlags, MavlinkFlags


class View(EnvFlags, MavlinkFlags):
    """Show flights in a window: in real time, slower or faster.

    Keys: space pauses, the arrow to the right takes one step.
    """

    what: Positional[str]
    """Checkpoint, folder of a training, universal, pid, geometric, raptor, FILE.py:CLASS of a
    controller, random, or a journal (.mcap)."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    episodes: Count | None = None
    """End after so many episodes. Default: go on until it is closed."""

    def run(self) -> None:
        """Fly and show, episode after episode."""
        from ._env import pilot_of
        from ._mavlink import mavlink_out
        from ._watch import show

        path = Path(self.what)
        shown = self
        if path.suffix == ".mcap":
            if self.options.keys() - {"scene"}:
                raise InputError("env: expected no options with a journal, which has its own")
            flights = ([one] for one in recorded_trajectories(path, observations=RANGES))
        else:
            shown, policy = pilot_of(self, self.what)
            config = shown.env_config()
            flights = (flown_trajectories(policy, config, [one], "final") for one in count())
        print(f"showing {self.what} in the window (Ctrl-C ends)")
        first = next(flights)
        chosen = islice(chain((first,), flights), self.episodes)
        with mavlink_out(self, first[0].spec) as out:
            show(shown, chosen, self.speed, out)
