"""Windows of `rotorgram view`, and of `rotorgram sim --view` while an agent flies."""

import logging
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, cast

import numpy as np

from ..envs.loop import Loop
from ..envs.rendering import moments
from ..flights import filming
from ..flights.trajectories import Flights
from ..rendering.live import LiveView, Pace
from ..rendering.stage import Stage
from ..scenes import SceneConfig, parse_scene
from ..udp.protocol.messages import Command
from ..udp.transport.simulator import Simulator
from ._env import print_episode
from ._flags import EnvFlags

if TYPE_CHECKING:
    from ..autopilots.mavlink import MavlinkOut

_log = logging.getLogger(__name__)


class Watcher:
    """Passes States of a simulator to a live view of its first world, as often as it draws.

    Lock-step never waits for it. A pause freezes the picture alone: an agent that got no answer
    would take the simulator for lost. If the view is closed or fails, the simulator goes on.
    """

    def __init__(self, live: LiveView, simulator: Simulator) -> None:
        self._live: LiveView | None = live
        self._loop = cast(Loop, simulator.stepped)  # the command flies registered tasks alone
        self._steps = np.zeros(live.stage.drones, np.int64)
        self._episodes = np.zeros(live.stage.drones, np.int64)

    def __call__(self, cause: Command) -> None:
        """See what moved the drones; episodes count in which something was flown."""
        count = len(self._steps)
        live = self._live
        self._episodes += cause.resets[:count] & (self._steps > 0)
        self._steps = self._loop.steps[:count]
        if live is None or not live.wants or not self._is_open(live):
            return
        now = time.monotonic()
        if live.pace.wait(now) is not None:
            live.draw(*moments(self._loop, self._episodes.tolist()))
            live.pace.stepped(now)

    def _is_open(self, live: LiveView) -> bool:
        try:
            if live.is_running:
                return True
            _log.info("the view was closed; the simulator goes on")
        except Exception as error:  # no error of drawing stops a training
            _log.warning("the view failed, the simulator goes on: %s", error)
        self._live = None
        return False


def open_view(command: EnvFlags, drones: int, flown: SceneConfig, pace: Pace) -> closing[LiveView]:
    """A window with the drones of a world in a scene; it is open within a `with` block.

    Raises `InputError` for a scene of several layouts.
    """
    scene = parse_scene(command.shown_scene or flown.shown)
    return closing(LiveView(Stage(scene, drones, vehicle=command.vehicle), pace))


def show(
    command: EnvFlags,
    flights: Iterable[Flights],
    speed: float = 1.0,
    out: "MavlinkOut | None" = None,
) -> None:
    """Show flights in a window at a speed, one after the other, each of all drones of a world; with
    the same pace as MAVLink.
    """
    with ExitStack() as opened:
        scene = None
        for flight in flights:
            first = flight[0]
            if first.scene != scene:
                scene = first.scene
                opened.close()
                pace = Pace(first.spec.control_period, speed)
                live = opened.enter_context(open_view(command, len(flight), scene, pace))
            shown = [filming.moments(one) for one in flight]
            longest = max(map(len, shown))
            # A drone whose episode has ended stays as it ended.
            padded = [own + [own[-1]] * (longest - len(own)) for own in shown]
            frames = zip(*padded, strict=True)
            drawn = frames if out is None else out.along(frames, flight)
            if not all(live.draw_in_time(*frame) for frame in drawn):
                break
            for one in flight:
                print_episode(one)
        while live.is_running and not live.wants:  # the last picture is still to come
            time.sleep(0.02)
