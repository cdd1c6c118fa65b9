"""The Crazyflie's firmware as a pilot: errors of its controllers, repeated flights, speed.

    python studies/crazyflie.py --program PATH [--episodes 5] [--seconds 20] [--out FILE.json]

The program is the firmware's SITL. Each controller flies `rotorgram/Hover-v0` with lagging rotors
in lock-step, from tilted starts of the final set, up to 0.5 m from the goal along each axis. The
error is the mean distance in the last quarter of a flight: until then the firmware's integrals
settle. `settling` is the time after which it stays within 10 cm. `repeated` are the hashes of one
flight, of a process each. `times_real_time` counts the time on the stand too. `mutated` counts what
became of damaged datagrams of motors.

It takes ten minutes on two cores.
"""

import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.protocol import crazyflie as protocol
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.training.metrics import settling_time, steady_state

STACK = find_stack("crazyflie")
ENV = "rotorgram/Hover-v0"
MODES = ("pid", "mellinger", "indi", "brescianini")
BOOT = 4.0  # s: about what it stands


def fly(program: Path, mode: str, seconds: float, episodes: int) -> Mapping[str, object]:
    """Figures of a controller's flights."""
    steps = round(50 * seconds)
    settings = {"vehicle": "crazyflie2", "effects": {"motor_lag": True}, "start_band": 0.5,
                "episode_length": steps}  # fmt: skip
    config = seated(EnvConfig.from_keywords(ENV, **settings), STACK.rate)
    start = Start(config, config.load_vehicle(), mode, program)
    began = time.perf_counter()
    with closing(LocalVectorEnv(config, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, STACK.make)
        flown = fly_episodes(env, seat, episodes, "final")
    wall = time.perf_counter() - began
    clock = sum(one.seconds for one in flown) + BOOT * episodes
    errors = [np.linalg.norm(one.pose[1:, :3] - one.telemetry["goal"][1:, :3], axis=1)
              for one in flown]  # fmt: skip
    steady = [steady_state(error) for error in errors]
    settled = [settling_time(error, config.control_period or 0.0, 0.1) for error in errors]
    return {
        "error": round(statistics.mean(steady), 5),
        "worst": round(max(steady), 5),
        "settling": round(statistics.mean(settled), 2),
        "crashes": sum(one.terminated for one in flown),
        "late_steps": seat.tally.late,
        "steps": sum(map(len, flown)),
        "faults": seat.tally.faults,
        "times_real_time": round(clock / wall, 2),
        "load_average": round(os.getloadavg()[0], 1),
    }


def hash_of(program: Path) -> str:
    """Of a flight of 5 s by the command."""
    words = ["fly", "crazyflie", "--program", str(program), "--vehicle", "crazyflie2"]
    words += ["--env", ENV, "--effects", "motor_lag"]
    command = [sys.executable, "-m", "rotorgram.cli", *words]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = re.search(r"^hash +(\w+)$", printed, re.MULTILINE)
    assert found is not None
    return found[1]


def mutated(count: int) -> Mapping[str, int]:
    """What became of motors with a byte changed and some cut off or added."""
    rng = np.random.default_rng(0)
    whole = bytes.fromhex("90cc8ecc8ecc8ecc8e00")
    found = {"datagrams": count, "read": 0, "refused": 0, "wrong": 0}
    places = rng.integers(0, 10, count).tolist()
    values = rng.integers(0, 256, count).tolist()
    lengths = rng.integers(0, 11, count).tolist()
    for place, value, length in zip(places, values, lengths, strict=True):
        packet = whole[:place] + bytes((value,)) + whole[place + 1 :]
        throttles = protocol.throttles(packet[:length])
        if throttles is None:
            found["refused"] += 1
        elif throttles.shape == (4,) and throttles.min() >= 0.0 and throttles.max() <= 1.0:
            found["read"] += 1
        else:
            found["wrong"] += 1
    return found


def main() -> None:
    parser = options(
        __doc__, "program", program=Path, episodes=5, seconds=20.0, out=RESULTS / "crazyflie.json"
    )
    args = parser.parse_args()
    program = args.program.absolute()
    controllers = {}
    for mode in MODES:
        controllers[mode] = fly(program, mode, args.seconds, args.episodes)
        print(mode, controllers[mode], flush=True)
    result = {
        "vehicle": "crazyflie2",
        "seconds": args.seconds,
        "episodes": args.episodes,
        "controllers": controllers,
        "repeated": [hash_of(program) for _ in range(3)],
        "mutated": mutated(1_000_000),
    }
    print(result)
    write(args.out, result)


if __name__ == "__main__":
    main()
