"""Sessions of flight stacks, and the flights that they flew, for tests without their programs.

    python tests/sessions.py betaflight=PROGRAM crazyflie=PROGRAM

writes tests/data/sessions: what each program sent, checksums of what it got, and the hash of the
poses. `tests/player.py` plays them back.
"""

import json
import sys
from contextlib import closing
from hashlib import blake2b
from pathlib import Path

from player import write_session
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.programs import Program
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes

SESSIONS = Path(__file__).parent / "data" / "sessions"
HASHES = SESSIONS / "hashes.json"
VEHICLES = {"betaflight": "hummingbird", "crazyflie": "crazyflie2"}
SECONDS = 1.5


def flown(stack_name, program, **settings):
    """The flight of a session, by a program; the seat has a tally of it."""
    stack = find_stack(stack_name)
    effects = {"motor_lag": True}
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", vehicle=VEHICLES[stack_name], effects=effects, backend="rigid"
    )
    config = seated(config, stack.rate)
    config = config.changed(episode_length=round(SECONDS * stack.rate), **settings)
    start = Start(config, config.load_vehicle(), stack.modes[0], program)
    with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, stack.make)
        (flight,) = fly_episodes(env, seat, 1, "final")
    return flight, seat.tally


def hash_of(flight):
    return blake2b(flight.pose.tobytes(), digest_size=8).hexdigest()


def record(stack_name, program):
    """Fly, and write what was said. Returns the hash of the flight."""
    events = []
    send, receive, meet, start = Program.send, Program.receive, Program.meet, Program.start

    def sent(self, datagram, port=None):
        events.append((port or 0, datagram))
        send(self, datagram, port)

    def received(self, *arguments, **keywords):
        datagram = receive(self, *arguments, **keywords)
        events.append((None, datagram))
        return datagram

    def met(self, read):
        datagram = meet(self, read)
        events.append((None, datagram))
        return datagram

    def started(self, *arguments, **keywords):
        events.clear()  # what came before configured it
        start(self, *arguments, **keywords)

    Program.send, Program.receive, Program.meet, Program.start = sent, received, met, started
    flight, tally = flown(stack_name, program)
    assert not tally.faults, tally.faults
    SESSIONS.mkdir(exist_ok=True)
    write_session(SESSIONS / f"{stack_name}.xz", events)
    return hash_of(flight)


def main():
    hashes = json.loads(HASHES.read_text()) if HASHES.exists() else {}
    for words in sys.argv[1:]:
        name, _, program = words.partition("=")
        hashes[name] = record(name, Path(program).absolute())
        print(name, hashes[name])
    HASHES.write_text(json.dumps(hashes, indent=1) + "\n")


if __name__ == "__main__":
    main()
