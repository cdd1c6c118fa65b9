"""The rules of a simulator that keeps time, and flies on while its agent is silent."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, Literal

import numpy as np

from ...models.fields import Limits, check_fields, immutable
from .client import Seconds
from .layout import Array
from .messages import FLY, FREEZE, Command
from .party import OneAgent, neutral

_CATCH_UP = 0.1  # longest delay that later steps make up for, s
_SUMMED = ("rewards", "terminated", "truncated")


@immutable
class FreeRun:
    """The clock of a simulator, and what its drones do while the agent is silent."""

    rate: Annotated[float, Limits(0.01, 100.0)] = 1.0
    """1 is real time."""
    silence: Seconds = 0.5
    """Simulated time without a Command, s, from which on `after` flies; before it the last actions
    do."""
    after: Literal["hover", "land", "off", "hold"] = "hover"
    """The drones hover, land, have their rotors at the least thrust, or hold the last action."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(eq=False)
class FreeRunning(OneAgent):
    """One agent, and a world that takes a step in each period of a clock.

    A Command that comes before its step is due is flown as in lock-step. One that comes later is
    late: the drones have flown on without it. Its State has the sum of the rewards since the last
    State, and every end. A drone whose episode has ended waits for its reset; a late action for it
    is ignored.

    Statistics of the link count steps that were `held`, which no Command asked for, `late`
    Commands, and `overrun`, delays of this side that were not made up for. The telemetry gets the
    age of the Command: the time from the State that it answers to the step that flew it, s; 0 if it
    came in time.
    """

    run: FreeRun
    failsafe: Callable[[], Array] | None
    """Gives actions of all drones after a silence; None: the last ones are held."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.counters = self._client.statistics.counters
        self.counters.update(held=0, late=0, overrun=0)
        self._due_at = inf
        self._held = 0  # steps since the last Command
        self._actions = neutral(self.layout)
        self._sums: dict[str, Array] = {}  # since the last State

    def next_timer(self) -> float:
        """As `WorldRules.next_timer`, and when a step is due."""
        return min(super().next_timer(), self._due_at)

    def step(self, now: float) -> bool:
        """Take the step that is due, by the Command that has come, or without one."""
        command = self._to_follow
        if self._due_at == inf and command is not None:
            self._due_at = now  # the first episode begins
        if now < self._due_at:
            return False
        if command is None:
            self._hold()
        else:
            self._follow(command, now)
        self._due_at += self.period / self.run.rate
        if self._due_at < now - _CATCH_UP:
            self.counters["overrun"] += 1
            self._due_at = now
        return False

    def _follow(self, command: Command, now: float) -> None:
        flies = command.orders == FLY
        if self._held:
            self.counters["late"] += 1
            ended = flies & self.world.done
            self._to_follow = replace(
                command, orders=np.where(ended, np.uint8(FREEZE), command.orders)
            )
        super().step(now)
        self._sum(~command.resets)
        self._sums = {}
        self.more = (np.full(self.layout.drones, self._held * self.period),)
        self._held = 0
        self._actions = neutral(self.layout)
        self._actions[flies] = command.actions[flies]

    def _hold(self) -> None:
        """Step without a Command."""
        world = self.world
        self._held += 1
        self.unasked += 1
        self.counters["held"] += 1
        done = world.done
        actions = self._actions
        if self.failsafe is not None and self._held * self.period > self.run.silence:
            actions = self.failsafe().astype(actions.dtype)
        orders = done * np.uint8(FREEZE)
        self.cause = Command(session=0, sequence=0, actions=actions, orders=orders)
        world.advance(actions, None, None, done)
        self._sum(True)

    def _sum(self, goes_on: Array | bool) -> None:
        """Add up what the next State tells."""
        for name in _SUMMED:
            value = getattr(self.world, name)
            if name in self._sums:
                value = value + self._sums[name] * goes_on
            self._sums[name] = value
            setattr(self.world, name, value)
