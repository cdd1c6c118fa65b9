"""`rotorgram view`: flights live, flown in process or read from a journal."""

import time
from contextlib import ExitStack
from itertools import chain, count, islice
from pathlib import Path

from tyro.conf import Positional

from ..flights.recorded import recorded_trajectories
from ..flights.trajectories import flown_trajectories
from ..models import InputError
from ..scenes.returns import RANGES
from ._flags import Count, EnvFlags


class View(EnvFlags):
    """Show flights in a window: in real time, slower or faster.

    Keys: space pauses, the arrow to the right takes one step.
    """

    what: Positional[str]
    """Checkpoint, folder of a training, pid, geometric, FILE.py:CLASS of a controller, random, or a
    journal (.mcap)."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    episodes: Count | None = None
    """End after so many episodes. Default: go on until it is closed."""

    def run(self) -> None:
        """Fly and show, episode after episode."""
        from ..flights.filming import moments
        from ..rendering.live import Pace
        from ._env import pilot_of, print_episode
        from ._watch import open_view

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
        first = next(flights)
        pace = Pace(first[0].spec.control_period, self.speed)
        print(f"showing {self.what} in the window (Ctrl-C ends)")
        with ExitStack() as opened:
            scene = None
            for flight in islice(chain((first,), flights), self.episodes):
                if flight[0].scene != scene:
                    scene = flight[0].scene
                    opened.close()
                    live = opened.enter_context(open_view(shown, len(first), scene, pace))
                shown_moments = [moments(one) for one in flight]
                longest = max(map(len, shown_moments))
                # A drone whose episode has ended stays as it ended.
                padded = [own + [own[-1]] * (longest - len(own)) for own in shown_moments]
                frames = zip(*padded, strict=True)
                if not all(live.draw_in_time(*frame) for frame in frames):
                    break
                for one in flight:
                    print_episode(one)
            while live.is_running and not live.wants:  # the last picture is still to come
                time.sleep(0.02)
