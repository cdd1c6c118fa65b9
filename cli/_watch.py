"""`rotorgram sim --view`: looking on while an agent flies."""

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Literal

import numpy as np

from ..rendering.live import MOST_DRONES, LiveView, open_surface
from ..rendering.moment import Moment
from ..rendering.pace import Pace
from ..rendering.stage import Stage, World
from ..udp.messages import Command, Hello, Message, State
from ..udp.simulator import Observer, Simulator

__all__ = ["Onlooker", "Realtime", "watched"]

_log = logging.getLogger(__name__)


class Onlooker:
    """Hands what a simulator steps over to a live view, as often as that one draws: an observer.

    Lock-step never waits for it. A pause freezes the picture alone: an agent that got no answer
    would take the simulator for lost. If the view is closed or fails, the simulator goes on.

    Args:
        live: Shows the first so many drones.
        hello: Of the simulator.
    """

    def __init__(self, live: LiveView, hello: Hello) -> None:
        self._live: LiveView | None = live
        self._names, self._count = hello.telemetry_names, live.stage.drones
        self._steps = np.zeros(self._count, np.int64)
        self._episodes = np.zeros(self._count, np.int64)

    def __call__(self, cause: Message | None, state: State) -> None:
        """See one State, and what led to it."""
        self._keep_count(cause)
        live = self._live
        if live is None or not live.wants or not self._is_open(live):
            return
        now = time.monotonic()
        if live.pace.wait(now) is not None:
            live.draw(*self._moments(state))
            live.pace.stepped(now)

    def _keep_count(self, cause: Message | None) -> None:
        """Steps since each drone's reset; episodes in which something was flown."""
        steps, resets = self._steps, np.ones(self._count, bool)
        if isinstance(cause, Command):
            resets = cause.resets[: self._count]
            steps += ~resets if cause.holds is None else ~(resets | cause.holds[: self._count])
        self._episodes += resets & (steps > 0)
        steps[resets] = 0

    def _moments(self, state: State) -> Iterator[Moment]:
        for drone in range(self._count):
            telemetry = dict(zip(self._names, state.telemetry[drone].tolist(), strict=True))
            step = int(self._steps[drone])
            yield Moment.of(
                telemetry,
                state.observations[drone, 0],
                reward=float(state.rewards[drone]) if step else 0.0,
                step=step,
                episode=int(self._episodes[drone]),
            )

    def _is_open(self, live: LiveView) -> bool:
        try:
            if live.is_running:
                return True
            _log.info("the view was closed; the simulator goes on")
        except Exception as error:  # whatever drawing raises is no reason to stop a training
            _log.warning("the view failed, the simulator goes on: %s", error)
        self._live = None
        return False


class Realtime:
    """Holds lock-step to real time, by sleeping while the agent thinks: an observer."""

    def __init__(self, control_period: float) -> None:
        self._pace = Pace(control_period)

    def __call__(self, cause: Message | None, state: State) -> None:
        """Wait until the next step may be taken."""
        time.sleep(self._pace.wait(time.monotonic()) or 0.0)
        self._pace.stepped(time.monotonic())


@contextmanager
def watched(
    simulator: Simulator,
    kind: Literal["window", "web"] | None,
    port: int,
    world: World,
    *,
    realtime: bool,
) -> Iterator[None]:
    """Look on at a simulator during the block."""
    hello = simulator.fleet.hello
    observers: list[Observer] = []
    with ExitStack() as opened:
        if kind is not None:
            pace = Pace(0.0)
            stage = Stage(world, min(hello.num_drones, MOST_DRONES))
            surface = open_surface(kind, stage, pace, port)
            live = opened.enter_context(LiveView(stage, surface, pace, of=hello.num_drones))
            print(f"to be seen {surface.where}", flush=True)
            observers.append(Onlooker(live, hello))
        if realtime:
            observers.append(Realtime(hello.control_period))

        def observe(cause: Message | None, state: State) -> None:
            for observer in observers:
                observer(cause, state)

        simulator.observer = observe if observers else None
        yield
