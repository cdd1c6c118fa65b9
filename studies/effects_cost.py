"""Control steps per second of a world with each effect, as a ratio to none.

    python studies/effects_cost.py [--seconds 0.1] [--repeats 25] [--out FILE.json]

A control step is 0.02 s of the vehicle in `tests/data/racer.xml`, which has every coefficient: four
physics steps, without a task; a reset every 50 steps counts too. The cases take turns within a
repeat; the medians over the repeats are compared. It takes two minutes.
"""

import itertools
from pathlib import Path

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.models import Vehicle
from rotorgram.sim import EffectOptions, InitialState, Randomization, World, make_world

ROOT = Path(__file__).parent.parent
CASES: dict[str, dict[str, object]] = {
    "none": {},
    "motor_lag": {"motor_lag": True},
    "thrust_curve": {"thrust_curve": True},
    "battery": {"battery": True},
    "efficiency": {"efficiency": (1.0, 0.9, 1.0, 1.0)},
    "body_drag": {"body_drag": True},
    "rotor_drag": {"rotor_drag": True},
    "ground_effect": {"ground_effect": True},
    "body_drag, wind": {"body_drag": True, "wind": (3.0, 0.0, 0.0)},
    "body_drag, gusts": {"body_drag": True, "gusts": 5.0},
    "payload": {"payload": 0.1, "cable": 0.5},
}
CASES["all"] = {name: value for case in CASES.values() for name, value in case.items()}
DRAWN = {"mass": "uniform(0.9, 1.1)", "thrust": "uniform(0.9, 1.1)"}
EPISODE = 50  # control steps between two resets


def steps_per_second(world: World, seconds: float) -> float:
    """Control steps of all drones per second."""
    every = np.ones(world.shape, bool)
    pose = InitialState(position=np.broadcast_to((0.0, 0.0, 30.0), (*world.shape, 3)))
    commands = np.broadcast_to(world.vehicle.hover_thrust, (*world.shape, world.vehicle.num_rotors))
    substeps = world.vehicle.substeps(0.02)
    step = itertools.count()

    def advance() -> None:
        if next(step) % EPISODE == 0:
            world.reset(every, pose)
        world.step(commands, substeps)

    wall, _ = timed(advance, seconds)
    return round(every.size / wall, 1)


def measure(num_drones: int, seconds: float, repeats: int) -> dict[str, object]:
    vehicle = Vehicle.load(ROOT / "tests" / "data" / "racer.xml")
    worlds = {}
    for name, case in [*CASES.items(), ("randomize", {})]:
        effects = EffectOptions(**case)
        drawn = Randomization(DRAWN if name == "randomize" else {}, effects)
        worlds[name] = make_world(vehicle, num_drones, effects=effects, randomize=drawn)
    rates = in_turns(worlds, repeats, lambda world: steps_per_second(world, seconds))
    middle = medians(rates)
    ratios = {name: round(median / middle["none"], 3) for name, median in middle.items()}
    for name, median in middle.items():
        print(f"{num_drones:5} {name:18} {median:10,.0f} steps/s {ratios[name]:6.2f}", flush=True)
    for world in worlds.values():
        world.close()
    return {"steps_per_second": middle, "ratio_to_none": ratios, "repeats": rates}


def main() -> None:
    out = ROOT / RESULTS / "effects" / "cost.json"
    args = options(__doc__, seconds=0.1, repeats=25, out=out).parse_args()
    drones = {str(n): measure(n, args.seconds, args.repeats) for n in (1, 1024)}
    write(args.out, {"seconds": args.seconds, "drones": drones})


if __name__ == "__main__":
    main()
