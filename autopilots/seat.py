"""The seat of an autopilot: a controller that hands observations to a program, and what its motors
do to an env of the level `rotors`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from ..agents.policies import Observation
from ..envs.config import EnvConfig
from ..envs.spec import EnvSpec
from ..models import InputError, Vehicle
from ..sim.control import RotorThrust
from ..udp.protocol.errors import PeerClosed, PeerSilent
from .programs import Program
from .reading import Floats, Instruments, Order, Propellers, Reading, exact, heading_of

if TYPE_CHECKING:
    from .sticks import Pilot

LONGEST_STAND = 120.0
"""Time on the ground after which a program that lifts nothing is given up, s of its clock."""
LIFTED = 0.9
"""Thrust over the weight at which the craft leaves its stand."""


class Stack(ABC):
    """A program that runs. A kind of it says how it starts, what it is told in a step, and what it
    answers.
    """

    boot = math.inf
    """Time from which on it takes orders, s of its clock, for one that does not say so itself."""
    ready = False
    """Whether it takes orders."""
    why: str
    """Why it is not ready, or does not lift."""
    late = 0
    """Steps that were not in lock-step: its outputs were not those of the step's reading."""
    order_every: int
    """Steps from one order to the next."""

    def __init__(self, program: Program, rotors: int) -> None:
        self._program = program
        self._steps = 0
        self._throttles: Floats = np.zeros(rotors)

    @property
    def takes_order(self) -> bool:
        """Whether one is due with the next step."""
        return self._steps % self.order_every == 0

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """Throttle of each rotor, 0 to 1, shape (R,), after one period of the program's clock.

        An order comes with each `order_every`-th step from when it is ready, and with it the
        observation as a pilot has it. Before the first its rotors stay off.
        """
        self.ready = self.ready or reading.time >= self.boot
        self._tell(reading, order, observation)
        self._steps += 1
        throttles = self._answer()
        if throttles is None:
            self.late += 1
        else:
            self._throttles = throttles
        return self._throttles

    @abstractmethod
    def _tell(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        """Send what belongs to a step."""

    def _answer(self) -> Floats | None:
        """Throttles of the step, shape (R,); None if it is late."""
        return self._program.answer(self._read)

    @abstractmethod
    def _read(self, datagram: bytes) -> Floats | None:
        """Throttles of the step in what came; None if they are not there. Raises `InputError`."""

    def close(self) -> None:
        """End the program."""
        self._program.close()


class Start(NamedTuple):
    """How a stack begins."""

    config: EnvConfig
    """Of the flight, as `seated` makes it."""
    vehicle: Vehicle
    mode: str
    """One of the stack's ways to fly."""
    program: Path | None
    """What to run; None where the user runs it."""
    real_time: bool = False
    """Whether the program keeps its own clock."""
    policy: "Pilot | None" = None
    """What moves the sticks in place of our loops."""


MakeStack = Callable[[Start], Stack]


@dataclass
class Tally:
    """Of all flights of a seat and of its copies."""

    steps: int = 0
    """Of programs, those on the stand too."""
    late: int = 0
    """Steps that were not in lock-step."""
    faults: list[str] = field(default_factory=list)
    """What programs did wrong, a sentence each."""


class Seat:
    """Flies one drone by a program of its own, which begins anew for each episode.

    The craft stands as its episode starts until the program is ready and its rotors carry it: what
    the program needs to begin is no part of the episode. Then the program steps once in each
    control step. Throttle u of a rotor asks for the thrust of the vehicle's curve at u, or u² of
    its largest.

    A program that ends, hangs or sends no number gives no thrust from then on.

    Attributes:
        lifted_after: Time on the stand, s of the program's clock.
        tally: What its copies share.
    """

    def __init__(
        self, spec: EnvSpec, start: Start, make: MakeStack, tally: Tally | None = None
    ) -> None:
        self.tally = tally or Tally()
        self._arguments = spec, start, make, self.tally
        self._instruments = Instruments(spec)
        self._vehicle = vehicle = start.vehicle
        self._period = spec.control_period
        self._rotors = RotorThrust(vehicle)
        self._propellers = Propellers(start.config, vehicle)
        self._stack: Stack | None = None
        self.lifted_after = 0.0
        self.reset()

    def __deepcopy__(self, memo: object) -> Self:
        """One for another drone, or another flight."""
        return type(self)(*self._arguments)

    def reset(self) -> None:
        """End the program: the next observation begins an episode, and a new one."""
        self.close()
        self._time = 0.0
        self._counts = not self._arguments[1].real_time  # it boots by its own clock
        self._failed = False

    def close(self) -> None:
        """End the program."""
        if self._stack is not None:
            self._stack.close()
        self._stack = None

    def act(self, observation: Observation) -> Floats:
        """The action of the level `rotors`, float32, shape (R,)."""
        seen: Any = observation
        if self._stack is None and not self._failed:
            _, start, make, _ = self._arguments
            self._stack = make(start)
            self._stand(seen)
        action = self._rotors.action(self._thrust(seen))
        flown: Floats = action.astype(np.float32)
        return flown

    def _thrust(self, seen: Any) -> Floats:
        """Of each rotor, N: what the program asks for, or none where it has failed."""
        stack = self._stack
        if stack is not None:
            reading = self._instruments.reading(seen, self._time)
            order = None
            if stack.takes_order:
                order = self._instruments.order(seen, reading)
                seen = self._instruments.seen(seen, reading, order)
            try:
                return self._propellers.commands(self._step(stack, reading, order, seen))
            except (PeerClosed, PeerSilent, InputError) as error:
                self.tally.faults.append(f"{error}; after {self._time - self.lifted_after:.3f} s")
                self._failed = True
                self.close()
        return np.zeros(self._vehicle.num_rotors)

    def _stand(self, observation: Any) -> None:
        stack = self._stack
        assert stack is not None
        weight = self._vehicle.mass * self._vehicle.gravity
        lift = 0.0
        stands = self._instruments.standing(observation, self._time)
        while lift < LIFTED * weight:
            reading = stands._replace(time=self._time)
            order = None
            if stack.ready and stack.takes_order:
                order = Order(reading.position, heading_of(reading.quaternion), stands=True)
            lift = self._propellers.lift(self._step(stack, reading, order, observation))
            if self._time > LONGEST_STAND:
                raise InputError(
                    f"autopilot: expected that it lifts the craft within {LONGEST_STAND:g} s of "
                    f"its clock, got {lift:.3g} of {weight:.3g} N: {stack.why}"
                )
        self.lifted_after = self._time
        self._counts = True

    def _step(
        self, stack: Stack, reading: Reading, order: Order | None, observation: Any
    ) -> Floats:
        """Throttle of each rotor."""
        late = stack.late
        throttle = stack.step(reading, order, observation)
        self.tally.steps += 1
        self.tally.late += (stack.late - late) * self._counts
        got = throttle.tolist()
        if not all(0.0 <= one <= 1.0 for one in got):  # nan is not
            raise InputError(f"autopilot: expected throttles from 0 to 1, got {got}")
        self._time += self._period
        return throttle


def seated(config: EnvConfig, rate: float) -> EnvConfig:
    """The config of a flight from a seat: rotors at the program's rate, in Hz, the same time in an
    episode, sensors without errors but for those that are given, and the frame of the world.
    """
    assert config.control_period is not None
    assert config.episode_length is not None
    seconds = config.control_period * config.episode_length
    frame = {"frame": "world"} if config.task.get("frame", "") is None else {}
    return config.changed(
        action="rotors",
        control_period=1.0 / rate,
        episode_length=round(seconds * rate),
        sensors=exact(config.sensors),
        **frame,
    )
