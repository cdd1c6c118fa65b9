"""`rotorgram view`: flies a policy in process, for those who look."""

import time
from collections.abc import Iterator
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs import ElevationConfig
from ..rendering.live import LiveView, open_surface
from ..rendering.pace import Pace
from ..rendering.stage import Stage
from .inputs import load_policy

if TYPE_CHECKING:
    from ..experiments.flights import Track
    from .looking import View

__all__ = ["view"]


def view(command: "View") -> int:
    """Show episode after episode; the exit status."""
    if command.episodes is not None and command.episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {command.episodes}")
    tracks = islice(_tracks(command), command.episodes)
    first = next(tracks)
    pace, stage = Pace(first.control_period, command.speed), Stage(command.world)
    surface = open_surface("web" if command.web else "window", stage, pace, command.port)
    with LiveView(stage, surface, pace) as live:
        print(f"showing {command.what} {surface.where} (Ctrl-C ends)", flush=True)
        while live.is_running and not live.is_watched:
            time.sleep(0.02)
        for track in chain((first,), tracks):
            if not all(live.draw_in_time(moment) for moment in track.moments):
                break
            last = track.moments[-1]
            total = sum(moment.reward for moment in track.moments)
            print(
                f"episode {last.episode}: return {total:.1f}, last |E| {abs(last.error):.3f} m",
                flush=True,
            )
        while live.is_running and not live.wants:  # the last picture is still to come
            time.sleep(0.02)
    return 0


def _tracks(command: "View") -> Iterator["Track"]:
    """Episode after episode, as long as there are any."""
    from ..experiments.flights import flown_tracks, recorded_tracks

    config = command.env.checked()
    if (path := Path(command.what)).suffix == ".mcap":
        if config != ElevationConfig():
            raise ValueError("env: expected no options with a journal, which has its own")
        yield from recorded_tracks(path)
        return
    policy = None
    if command.what != "random":
        policy, config = load_policy(command.what, config)
    for episode in count():
        yield flown_tracks(policy, config, [episode])[0]
