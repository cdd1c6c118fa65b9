"""Accuracy and speed of the backend `rigid`.

    python studies/rigid.py accuracy
    python studies/rigid.py speed
    python studies/rigid.py sizes

Accuracy: the largest distance to `mujoco` after 5 s of tumbling flight at random thrusts, of every
vehicle of the library and of the tests. float64 and float32 begin 1000 m up for `mujoco`, where
nothing is touched, and at the origin for `rigid`, which has no contact: so the figure of float32 is
of a flight near the origin.

Speed: control steps of 4,096 drones, per second and per second of a processor (which a busy machine
disturbs less), in turn, medians: of the world alone for `mujoco` and `rigid`; the same for one env,
`Loop.advance` of Hover.

Sizes: the processor's time of `Loop.advance` of Hover with 64 to 4,096 drones.
Writes docs/results/rigid/{accuracy,speed,sizes}.json.

It takes about two minutes each on two cores.
"""

import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.envs import EnvConfig
from rotorgram.envs.compiled import make_loop
from rotorgram.models import QUAD_XML, Backend, Vehicle
from rotorgram.sim import InitialState, make_world

OUT = RESULTS / "rigid"
FILES = [*sorted(Path("tests/data").glob("*.xml")), *sorted(Path("tests/data").glob("*.toml"))]
FILES += sorted(QUAD_XML.parent.glob("vehicles/*/vehicle.toml"))
FILES.remove(Path("tests/data/small.xml"))  # in a fluid
PERIOD = 0.02
HOVER = "rotorgram/Hover-v0"


def accuracy() -> None:
    rows = []
    for file in FILES:
        name = file.parent.name if file.stem == "vehicle" else file.stem
        row = {"vehicle": name}
        for dtype in ("float64", "float32"):
            row[dtype] = distances(file, dtype)
        print(row, flush=True)
        rows.append(row)
    write(OUT / "accuracy.json", {"seconds": 5.0, "drones": 32, "rows": rows})


def distances(file: Path, dtype: str, drones: int = 32) -> dict[str, float]:
    vehicle = Vehicle.load(file)
    dice = np.random.default_rng(0)
    ours = make_world(vehicle, drones, "rigid", dtype=dtype)
    theirs = make_world(vehicle, drones, num_threads=1)
    turned = dice.normal(size=(drones, 1, 4))
    pose = {
        "position": np.zeros((drones, 1, 3)),
        "quaternion": turned / np.linalg.norm(turned, axis=-1, keepdims=True),
        "velocity": dice.normal(size=(drones, 1, 3)),
        "body_rates": dice.normal(size=(drones, 1, 3)),
    }
    every = np.ones((drones, 1), bool)
    ours.reset(every, InitialState(**pose))
    height = np.array((0.0, 0.0, 1000.0))
    theirs.reset(every, InitialState(**pose | {"position": pose["position"] + height}))
    for _ in range(round(5 / PERIOD)):
        thrust = vehicle.hover_thrust * dice.uniform(0.9, 1.1, (drones, 1, vehicle.num_rotors))
        ours.step(thrust, vehicle.substeps(PERIOD))
        theirs.step(thrust, vehicle.substeps(PERIOD))
    q, p = ours.state.quaternion.astype(np.float64), theirs.state.quaternion
    apart = np.minimum(np.linalg.norm(q - p, axis=-1), np.linalg.norm(q + p, axis=-1))
    away = ours.state.position.astype(np.float64) + height - theirs.state.position
    return {
        "position_m": float(np.linalg.norm(away, axis=-1).max()),
        "attitude_rad": float(4 * np.arcsin(apart / 2).max()),
        "flown_m": float(np.linalg.norm(theirs.state.position - height, axis=-1).max()),
        "rate_rad_s": float(abs(theirs.state.body_rates).max()),
    }


def rate(fly: Callable[[], None], drones: int, seconds: float) -> tuple[float, float]:
    """Control steps of all drones per second, and per second of a processor."""
    wall, used = timed(fly, seconds)
    return round(drones / wall), round(drones / used)


def world(backend: Backend, drones: int, steps: int = 2, **settings: object) -> Callable[[], None]:
    """A control step of the world of the paper's vehicle, by default two physics steps."""
    vehicle = Vehicle.load()
    dice = np.random.default_rng(0)
    made = make_world(vehicle, drones, backend, **settings)
    thrust = vehicle.hover_thrust * dice.uniform(0.999, 1.001, (drones, 1, vehicle.num_rotors))
    place = np.broadcast_to((0.0, 0.0, 2000.0), (drones, 1, 3))
    made.reset(np.ones((drones, 1), bool), InitialState(position=place))
    return lambda: made.step(thrust, steps)


def env(backend: Backend, drones: int, **settings: object) -> Callable[[], None]:
    """A step of Hover: controller, world, observation, reward, ends and resets."""
    loop = make_loop(EnvConfig.from_keywords(HOVER, backend=backend, **settings), drones)
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (drones, 4)).astype(np.float32)
    loop.advance(actions, np.ones(drones, bool), range(drones))

    def fly() -> None:
        loop.advance(actions, loop.done if loop.done.any() else None)

    return fly


def sizes(args: Namespace) -> None:
    """Processor microseconds of `Loop.advance` of Hover, by the number of drones."""
    ways: dict[str, tuple[Backend, dict[str, object]]] = {
        "mujoco": ("mujoco", {}),
        "rigid, arrays": ("rigid", {}),
        "rigid, arrays by NumPy": ("rigid", {"compiled": False}),
    }
    table = {}
    for drones in (64, 128, 1024, 4096):
        flights = {name: env(kind, drones, **given) for name, (kind, given) in ways.items()}
        rates = in_turns(flights, args.repeats, lambda fly, n=drones: rate(fly, n, args.seconds)[1])
        row = {name: round(drones / median * 1e6) for name, median in medians(rates).items()}
        print(drones, row, flush=True)
        table[str(drones)] = row
    write(OUT / "sizes.json", {"processor_microseconds": table, "repeats": args.repeats})


def speed(args: Namespace) -> None:
    """Rates of the world alone and of `Loop.advance` of Hover, by backend."""
    ways: dict[str, Callable[[], None]] = {}
    firsts = {}
    for name, (make, backend, settings) in {
        "world mujoco": (world, "mujoco", {}),
        "world rigid": (world, "rigid", {}),
        "world rigid, one physics step": (world, "rigid", {"steps": 1}),
        "env mujoco": (env, "mujoco", {}),
        "env rigid": (env, "rigid", {}),
    }.items():
        start = time.perf_counter()
        ways[name] = make(backend, args.drones, **settings)
        ways[name]()
        firsts[name] = round(time.perf_counter() - start, 2)
    rates = in_turns(ways, args.repeats, lambda fly: rate(fly, args.drones, args.seconds))
    clock = medians({name: [wall for wall, _ in pairs] for name, pairs in rates.items()})
    processor = medians({name: [used for _, used in pairs] for name, pairs in rates.items()})
    for name, median in clock.items():
        print(f"{name:32} {median:14,.0f} control steps/s, {processor[name]:14,.0f} of a processor")
    write(OUT / "speed.json", {
        "drones": args.drones, "repeats": args.repeats,
        "medians": clock, "medians_per_processor_second": processor, "first_step_s": firsts,
    })  # fmt: skip


def main() -> None:
    parser = options(__doc__, drones=4096, repeats=5, seconds=1.0)
    parser.add_argument("what", choices=("accuracy", "speed", "sizes"))
    args = parser.parse_args()
    {"accuracy": lambda _: accuracy(), "speed": speed, "sizes": sizes}[args.what](args)


if __name__ == "__main__":
    main()
