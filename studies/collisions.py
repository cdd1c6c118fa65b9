"""How many flights of a swarm end in a collision, with four drones and with eight.

    python studies/collisions.py [--tasks Formation Crossing Escort] [--drones 4 8] [--seeds 5]
        [--first-seed 800] [--flights 1000] [--orca-flights 200] [--only-sums]

For each task, number of drones and seed `rotorgram train ippo --env.neighbours 3` trains a policy
with the preset of the task, with as many drones as fly, each for 9,000,000 steps. Crossing trains
once with eight drones, for the preset's steps, whatever number flies. The clock runs from before
the process starts to after it has ended. The policies fly whole episodes of the task, from starts
that no training has seen, on `mujoco`. ORCA flies some starts of that kind. Seeds 100 to 102 and
860 to 866 chose the presets. Formation of eight has seeds from 805 on (`--tasks Formation --drones
8 --first-seed 805`), Escort from 810 on (`--tasks Escort --first-seed 810`): those before first
flew with earlier presets. `docs/results/collisions_flights.npz` gets the steady error of every
flight in millimetres, 65535 of one that crashed, from which `--only-sums` computes
`docs/results/collisions.json` again. Flights of other tasks stay in it.

It takes about two hours.
"""

import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, options, table, write_sums
from rotorgram.agents import find_controller, load
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.crowd import fly_crowd
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.training.statistics import share_interval

FILE = RESULTS / "collisions.json"
FLIGHTS = RESULTS / "collisions_flights.npz"
ORCA = str(Path(__file__).parents[1] / "examples" / "orca.py") + ":Orca"
NEIGHBOURS = 3
TRAINED = {"Crossing": 8}
"""Drones of a world in training, by task; of other tasks as many as fly."""
STEPS = 9_000_000
"""Env steps of each drone; where `TRAINED` has the task, those of the preset in all."""
CRASHED = 65535


def trained(task: str, drones: int, seed: int, folder: Path) -> float:
    """Train; wall time of the process, s."""
    words = ["train", "ippo", "--env", f"rotorgram/{task}-v0", "--vehicle", "crazyflie2"]
    numbers = f"--drones {drones} --env.neighbours {NEIGHBOURS} --seed {seed}"
    words += numbers.split()
    if task not in TRAINED:
        words += ["--env-steps", str(STEPS * drones)]
    command = [sys.executable, "-m", "rotorgram.cli", *words, "--out", str(folder)]
    began = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return round(time.perf_counter() - began, 2)


def flown(pilot: str, task: str, drones: int, flights: int, seed: int) -> np.ndarray:
    """Steady errors of the flights of one policy, or of ORCA, mm, uint16, shape (flights,)."""
    config = EnvConfig.from_keywords(
        f"rotorgram/{task}-v0",
        vehicle="crazyflie2",
        drones=drones,
        backend="mujoco",
        neighbours=NEIGHBOURS,
    )
    worlds = flights // drones
    seeds = [evaluation_seed(number, "final", seed) for number in range(worlds)]
    with closing(LocalVectorEnv(config, worlds * drones, autoreset_mode="Disabled")) as env:
        spec = env.env_spec
        trained = ":" not in pilot
        policy = load(Path(pilot)).policy(spec) if trained else find_controller(pilot)(spec)
        columns = fly_crowd(env, policy, seeds)
    steady = np.minimum(np.rint(1000 * columns["steady"]), CRASHED - 1)
    return np.where(columns["terminated"], CRASHED, steady).astype(np.uint16)


def measure(args: Any) -> None:
    """Train and fly; write every flight."""
    arrays: dict[str, np.ndarray] = {}
    if FLIGHTS.exists():
        with np.load(FLIGHTS) as kept:
            arrays = dict(kept)
    for task in args.tasks:
        seconds: dict[int, list[float]] = {drones: [] for drones in args.drones}
        found: dict[int, list[np.ndarray]] = {drones: [] for drones in args.drones}
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            with tempfile.TemporaryDirectory() as folder:
                for drones in args.drones:
                    own = TRAINED.get(task, drones)
                    run = Path(folder) / str(own)
                    if not run.exists():
                        took = trained(task, own, seed, run)
                    seconds[drones].append(took)
                    checkpoint = str(run / "checkpoint.safetensors")
                    errors = flown(checkpoint, task, drones, args.flights, seed)
                    found[drones].append(errors)
                    crashes = (errors == CRASHED).sum()
                    print(task, seed, took, drones, crashes, len(errors), flush=True)
            for drones in args.drones:
                arrays[f"{task}/{drones}/ippo"] = np.array(found[drones])
                arrays[f"{task}/{drones}/seconds"] = np.array(seconds[drones])
            np.savez_compressed(FLIGHTS, **arrays)
        for drones in args.drones:
            errors = flown(ORCA, task, drones, args.orca_flights, args.first_seed)
            arrays[f"{task}/{drones}/orca"] = errors[None]
            np.savez_compressed(FLIGHTS, **arrays)


def sums() -> dict[str, Any]:
    """Of each task, number of drones and pilot, from the flights."""
    result: dict[str, Any] = {}
    with np.load(FLIGHTS) as arrays:
        for name in arrays:
            task, drones, what = name.split("/")
            own = result.setdefault(task, {}).setdefault(drones, {})
            rows = arrays[name]
            if what == "seconds":
                own[what] = {"median": float(np.median(rows)), "most": float(rows.max())}
            else:
                own[what] = row_of(rows)
    return result


def row_of(errors: np.ndarray) -> dict[str, Any]:
    """Of errors of shape (seeds, flights): crashes of all flights with Wilson's interval, those of
    the worst seed, and the median error of the others, m.
    """
    crashed = errors == CRASHED
    low, high = share_interval(int(crashed.sum()), errors.size)
    return {
        "flights": errors.size,
        "crashes": int(crashed.sum()),
        "low": round(low, 5),
        "high": round(high, 5),
        "worst_seed": int(crashed.sum(axis=1).max()),
        "median": round(float(np.median(errors[~crashed])) / 1000, 4),
    }


def page(result: dict[str, Any]) -> str:
    """The table of docs/swarms.md: flights with a collision, and the median error."""
    rows = []
    for task, own in result.items():
        for drones in sorted(own):
            seconds = own[drones]["seconds"]["median"]
            cells = [_shown(own[drones].get(pilot)) for pilot in ("ippo", "orca")]
            rows.append([f"{task}, {drones} drones", *cells, f"{seconds:.0f}"])
    return table(("", "IPPO", "ORCA", "training, s"), rows)


def _shown(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "–"
    share, low, high = (100 * value for value in (cell["crashes"] / cell["flights"], cell["low"],
                                                  cell["high"]))  # fmt: skip
    worst = f"{cell['worst_seed']} in the worst seed"
    return f"{share:.2g} % ({low:.2g} to {high:.2g}; {worst}); {100 * cell['median']:.2g} cm"


def main() -> None:
    tasks = ["Formation", "Crossing", "Escort"]
    args = options(
        __doc__,
        tasks=tasks,
        drones=[4, 8],
        seeds=5,
        first_seed=800,
        flights=1000,
        orca_flights=200,
        only_sums=False,
    ).parse_args()
    write_sums(args, FILE, measure, sums, page)


if __name__ == "__main__":
    main()
