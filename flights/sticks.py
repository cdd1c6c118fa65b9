"""Flying by hand: what two sticks ask of the craft at each action level, in real time."""

import json
import time
from collections.abc import Callable, Mapping

import numpy as np

from ..envs.autoreset import AdvancingVectorEnv
from ..envs.failsafe import Failsafe, state_of
from ..envs.tasks.task import Task
from ..models.errors import InputError
from ..models.fields import Limits, check
from ..models.files import read_own_toml
from ..rendering.live import Pace
from ..sim import Array, Wrench, make_controller
from ..sim.control import RotorThrust
from .stick_page import StickPage

SILENCE = 0.5
"""Time without sticks after which the craft hovers, s."""
PATIENCE = 5.0
"""Time for which it hovers before it lands, s."""
_SIGNS = read_own_toml(__file__, "sticks")
_STICKS = Limits(-1.0, 1.0, count=4)
_SHOWN = ("position", "attitude", "velocity", "goal")
_NAP = 0.005  # s, at most


class HandPilot:
    """Turns sticks into actions of one drone; without sticks it hovers, and then lands.

    At the level `rotors` the sticks set collective thrust and body rates, which our rate loop
    mixes.

    Raises `InputError` for drones that `Failsafe` refuses, and for the level `wrench`.

    Attributes:
        silence: Time since the last sticks, s.
        flies: What flew last: `hand`, `hover` or `land`.
    """

    def __init__(self, task: Task, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.flies = "hover"
        self._failsafes = {"hover": Failsafe(task, "hover"), "land": Failsafe(task, "land")}
        self._controller = controller = task.controller
        names = controller.components
        if isinstance(controller, Wrench):
            raise InputError("teleop: expected a level that sticks command, as rates, got wrench")
        if isinstance(controller, RotorThrust):
            period = task.control_period
            self._mixer = make_controller("rates", task.vehicle, period, task.config.effects)
            names = self._mixer.components
        elif controller.choices:
            names = ("collective",)
        self._signs = np.array([_SIGNS[name] for name in names])
        self._sticks = np.zeros(4)
        self._heard = -np.inf

    def steer(self, text: bytes) -> None:
        """Take sticks: a JSON list of roll, pitch, throttle and yaw. Raises `InputError`."""
        try:
            sticks = json.loads(text)
        except (ValueError, RecursionError):
            sticks = text
        self._sticks = np.array(check("sticks", _STICKS, sticks))
        self._heard = self._clock()

    @property
    def silence(self) -> float:
        return self._clock() - self._heard

    def action(self, telemetry: Mapping[str, Array]) -> Array:
        """The next action, shape (1, k), or (1,) of choices; telemetry as of `Failsafe`."""
        lost = self.silence - SILENCE
        if lost > 0.0:
            self.flies = "land" if lost > PATIENCE else "hover"
            return self._failsafes[self.flies].actions(telemetry)
        self.flies = "hand"
        asked = (self._signs @ self._sticks)[None]
        controller = self._controller
        if isinstance(controller, RotorThrust):
            return controller.action(self._mixer.thrust(asked, state_of(telemetry)))
        return np.rint(asked[0]) + 1.0 if controller.choices else asked


def fly_by_hand(
    env: AdvancingVectorEnv, pilot: HandPilot, page: StickPage, pace: Pace, seed: int
) -> float:
    """Fly an episode of one drone in real time, from the first sticks on; its duration, s."""
    while pilot.silence > SILENCE:
        time.sleep(_NAP)
    env.reset(seed=seed)
    seconds = 0.0
    while not env.done[0]:
        while wait := pace.wait(time.monotonic()):
            time.sleep(min(wait, _NAP))
        env.advance(pilot.action(env.telemetry))
        pace.stepped(time.monotonic())
        seconds += env.control_period
        told = env.telemetry
        shown = {name: told[name][0].tolist() for name in _SHOWN if name in told}
        shown |= {"flies": pilot.flies, "time": seconds}
        page.shown = json.dumps(shown).encode()
    return seconds
