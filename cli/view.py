"""`rotorgram view`: flights live, flown in process or read from a journal."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ..experiments.trajectories import Trajectory, flown_trajectories, recorded_trajectories
from ..models.errors import expect
from ._flags import EnvFlags, check_count


@dataclass(frozen=True, kw_only=True)
class View(EnvFlags):
    """Show flights, in real time or slower, in a window or in a browser.

    Keys: space pauses, the arrow to the right takes one step, - and + change the speed.
    """

    what: Positional[str]
    """Checkpoint, folder of a training, pid, geometric, random, or a journal (.mcap)."""
    web: bool = False
    """Serve a page for browsers, for a machine without a display."""
    port: int = 8080
    """TCP port of the page, on this machine's loopback; 0 takes the first free one."""
    world: Literal["airport", "plain"] = "airport"
    """Surroundings of the drone."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    episodes: int | None = None
    """End after so many episodes. Default: go on until it is closed."""

    def run(self) -> int:
        """Fly and show, episode after episode."""
        from ..experiments.filming import moments
        from ..rendering.live import LiveView, Pace, open_surface
        from ..rendering.stage import Stage
        from ._env import words_of

        check_count("episodes", self.episodes)
        trajectories = islice(self._trajectories(), self.episodes)
        first = next(trajectories)
        pace = Pace(first.spec.control_period, self.speed)
        stage = Stage(self.world, vehicle=self.vehicle)
        surface = open_surface("web" if self.web else "window", stage, pace, self.port)
        with LiveView(stage, surface, pace) as live:
            print(f"showing {self.what} {surface.where} (Ctrl-C ends)", flush=True)
            while live.is_running and not live.surface.is_watched():
                time.sleep(0.02)
            for trajectory in chain((first,), trajectories):
                if not all(live.draw_in_time(moment) for moment in moments(trajectory)):
                    break
                print(f"episode {trajectory.episode}: {words_of(trajectory)}", flush=True)
            while live.is_running and not live.wants:  # the last picture is still to come
                time.sleep(0.02)
        return 0

    def _trajectories(self) -> Iterator[Trajectory]:
        """Episode after episode, as long as there are any."""
        from ._env import pilot_of

        if (path := Path(self.what)).suffix == ".mcap":
            expect(not self.options, "env", "no options with a journal, which has its own")
            yield from recorded_trajectories(path)
            return
        _, policy, env = pilot_of(self, self.what)
        for episode in count():
            yield from flown_trajectories(policy, *env, [episode], vehicle=self.vehicle, of="final")
