"""Windows of `rotorgram view`, and of `rotorgram sim --view` while an agent flies."""

import logging
import time
from contextlib import closing
from typing import cast

import numpy as np

from ..envs.loop import Loop
from ..envs.rendering import moments
from ..rendering.live import LiveView, Pace
from ..rendering.stage import Stage
from ..scenes import SceneConfig, parse_scene
from ..udp.protocol.messages import Command
from ..udp.transport.simulator import Simulator
from ._flags import EnvFlags

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
