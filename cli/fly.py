"""`rotorgram fly`: an autopilot, a program of others, in the pilot's seat."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..models import InputError
from ._flags import Count, EnvFlags, MavlinkFlags

if TYPE_CHECKING:
    from ..autopilots.seat import Tally
    from ..autopilots.sticks import Pilot
    from ..envs.config import EnvConfig
    from ..flights.trajectories import Flights


class Fly(EnvFlags, MavlinkFlags):
    """Fly a task by an autopilot: its program is started, armed, and told the goals.

    The craft stands at its start until the rotors carry it. Exit status 1 if a program failed.
    """

    env: str = "rotorgram/Waypoints-v0"
    """Task by its id, or module:Name-v0 for one that a module of the working directory registers.
    Its options are flags --env.NAME."""
    autopilot: Positional[Literal["ardupilot", "betaflight", "crazyflie", "px4"]]
    """Whose program it is."""
    program: Annotated[Path | None, arg(metavar="PATH")] = None
    """The program: its SITL, built by you or by others."""
    connect: bool = False
    """Wait for a program that you start: the command is printed."""
    mode: Annotated[str | None, arg(metavar="MODE")] = None
    """How it flies: guided or auto; angle or acro; auto, pid, mellinger, indi, brescianini or
    policy."""
    policy: Annotated[str | None, arg(metavar="POLICY")] = None
    """What moves Betaflight's sticks in place of our loops: a checkpoint, the folder of a training,
    or a controller."""
    real_time: bool = False
    """Let the program of Betaflight or the Crazyflie keep its own clock. Late steps are counted."""
    seeds: Count = 1
    """Episodes to fly, each by a program that begins anew, from seeds that no training uses."""
    record: Path | None = None
    """MCAP file to write every message to: the flights go over UDP then."""
    film: Annotated[Path | None, arg(metavar="FILE")] = None
    """Film of the flights, .mp4, or .png of their end. It must not exist."""
    view: bool = False
    """Show each flight in a window after it was flown, in real time."""

    def run(self) -> int:
        """Fly, and print the means, the speed and the flights' hash."""
        from ..autopilots import find_stack
        from ..autopilots.seat import Seat, Start, seated
        from ..flights.filming import Film, FilmTrack, film
        from ..flights.trajectories import fly_episodes
        from ..rendering.film import check_film
        from ._mavlink import mavlink_out

        settings = Film(scene=self.shown_scene, vehicle=self.vehicle)
        if self.film:
            check_film(self.film, settings.width, settings.height, settings.fps)
        stack = find_stack(self.autopilot)
        mode = self.mode or stack.modes[0]
        command, pilot = self._steered()
        config = seated(command.env_config(), stack.rate)
        vehicle = config.load_vehicle()
        start = Start(config, vehicle, mode, self._program(), self.real_time, pilot)
        stack.check(start)
        flown: Flights = []

        def flights() -> "Iterator[Flights]":
            for number in range(self.seeds):
                flight = fly_episodes(env, seat, 1, "final", number)
                flown.extend(flight)
                yield flight

        with self._opened(config) as env:
            seat = Seat(env.env_spec, start, stack.make)
            began = time.perf_counter()
            with mavlink_out(self, env.env_spec) as env.observer:
                if self.view:
                    from ._watch import show

                    show(self, flights())
                else:
                    for _ in flights():
                        pass
            taken = time.perf_counter() - began
        self._report(flown, seat.tally, seat.tally.steps / stack.rate / taken)
        if self.film:
            track = FilmTrack(name=self.autopilot, trajectories=flown, drones=config.drones)
            print(f"film       {self.film} ({film(self.film, [track], settings)} pictures)")
        return int(bool(seat.tally.faults))

    def _steered(self) -> "tuple[Fly, Pilot | None]":
        """The command with the env of the policy that moves the sticks, and that policy."""
        if not self.policy:
            if self.action or self.control_period:
                raise InputError("--action, --control-period: expected them with --policy alone")
            return self, None
        from ..autopilots.sticks import Pilot
        from ..envs.registry import env_spec
        from ._env import pilot_of

        command, policy = pilot_of(self, self.policy)
        if policy is None:
            raise InputError("policy: expected a checkpoint or a controller, got random")
        return command, Pilot(policy, env_spec(command.env_config()))

    def _program(self) -> Path | None:
        if self.connect:
            if self.program:
                raise InputError("--connect: cannot be used with --program")
            return None
        if not (self.program and self.program.is_file()):
            raise InputError(f"program: expected --program PATH of a SITL, got {self.program}")
        return self.program.absolute()

    def _opened(self, config: "EnvConfig") -> AbstractContextManager[Any]:
        """The env of the flights, over UDP where they are recorded."""
        from ..envs.vector import LocalVectorEnv
        from ..udp.spawn import spawn_simulator

        if self.record:
            return spawn_simulator(config, num_envs=config.drones, record=self.record)
        return closing(LocalVectorEnv(config, config.drones, autoreset_mode="Disabled"))

    def _report(self, flown: "Flights", tally: "Tally", speed: float) -> None:
        from .evaluate import print_means

        print_means(self.autopilot, flown)
        digest = blake2b(digest_size=8)
        for one in flown:
            digest.update(one.pose.tobytes())
        steps = f"{tally.steps:,} steps"
        late = f"not lock-step: {tally.late:,} of {steps} were late"
        print(f"lock-step  {late if tally.late else f'all {steps}'}")
        print(f"speed      {speed:.1f} times real time")
        print(f"hash       {digest.hexdigest()}")
        for fault in tally.faults:
            print(f"failed     {fault}")
