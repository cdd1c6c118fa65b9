"""One policy for every craft: how it is trained, and what it flies.

    python studies/universal.py [--seeds 5] [--first-seed 900] [--flights 1000]
        [--env-steps 40000000] [--peers 100] [--only-sums]

Each seed trains by `rotorgram train shac --config studies/universal.toml`; the clock runs from
before the process starts to after it has ended. The policy flies craft that no training saw,
`drawn:100000-104095`, and each craft of the library, with the lag of its rotors where its file has
one: in Hover-v0, and thrown, in Recovery-v0. `raptor` flies the quadcopters of the library and
`--peers` drawn ones from the same starts, ten flights each, beside the policy of the first seed.
That one becomes `agents/universal.safetensors`.

`docs/results/universal_flights.npz` gets the steady error of every flight in millimetres, 65535 of
one that crashed or was not recovered at its end, and the craft of each, from which `--only-sums`
computes `docs/results/universal.json` again.
"""

import subprocess
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, options, table, write_sums
from rotorgram.agents import find_controller, load
from rotorgram.agents.checkpoints import store
from rotorgram.cli._env import CHECKPOINT, UNIVERSAL
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import task_type
from rotorgram.flights.crowd import fly_crowd
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.models import Vehicle
from rotorgram.models.drawn import GRAVITY, columns, drawn_craft, range_of, table_of
from rotorgram.models.library import vehicle_names
from rotorgram.training.statistics import share_interval

CONFIG = Path(__file__).with_suffix(".toml")
FILE = RESULTS / "universal.json"
FLIGHTS = RESULTS / "universal_flights.npz"
UNSEEN = "drawn:100000-104095"
UNSEEN_RANGE = range_of(UNSEEN)
NAMES = {UNSEEN: "unseen drawn craft", "peers": "drawn quadcopters, ten flights each"}
CRASHED = 65535
SETTINGS = (
    "hidden=[64,64]", "activation=tanh", "reach=3", "learning_rate=0.003", "anneal=true",
    "reward_scale=0.15", "reward_clip=8", "log_std=-3", "most_of_one=30",
)  # fmt: skip
STARTS = {"hover": "rotorgram/Hover-v0", "throws": "rotorgram/Recovery-v0"}


def trained(seed: int, env_steps: int, folder: Path) -> float:
    """Train; wall time of the process, s."""
    words = ["train", "shac", "--config", str(CONFIG), "--num-envs", "512", "--set", *SETTINGS]
    words += ["--env-steps", str(env_steps), "--seed", str(seed)]
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "rotorgram.cli", *words, "--out", str(folder)],
                   check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    return round(time.perf_counter() - began, 1)


def publish(file: Path) -> None:
    """Keep the policy alone, in Hover-v0 as it is, with nothing drawn but the craft."""
    plain = EnvConfig.from_keywords(
        STARTS["hover"], vehicle="drawn", action="wrench", frame="body", backend="rigid"
    )
    with closing(LocalVectorEnv(plain, 1, autoreset_mode="Disabled")) as env:
        alone = replace(load(file).policy_alone(), spec=env.env_spec, env=plain.resolve())
    store(alone, UNIVERSAL)


def flown(pilot: Any, vehicle: str, starts: str, flights: int) -> np.ndarray:
    """Steady errors of flights, mm, uint16, from starts that no training has; of a throw, which has
    to be `recovered` at its end, none.

    Rotors lag where the vehicle's file says by how much; half of the craft of a pool get their
    actions a control step late.
    """
    keywords: dict[str, Any] = {"backend": "rigid"}
    if vehicle == UNSEEN:
        keywords["randomize"] = {"action_delay": "uniform(0, 1)"}
    if vehicle == UNSEEN or Vehicle.load(vehicle).coefficients["rotors.time_constant"]:
        keywords["effects"] = {"motor_lag": True}
    if isinstance(pilot, Path):
        keywords |= {"action": "wrench", "frame": "body"}
        if starts == "throws":
            keywords["heading"] = 0.0
    else:
        keywords |= pilot.options
        length = task_type(STARTS[starts]).episode_length
        keywords["episode_length"] = round(length * 0.02 / keywords["control_period"])
    if flights < 100:
        keywords["compiled"] = False
    config = EnvConfig.from_keywords(STARTS[starts], vehicle=vehicle, **keywords)
    with closing(LocalVectorEnv(config, flights, autoreset_mode="Disabled")) as env:
        policy = load(pilot).policy() if isinstance(pilot, Path) else pilot(env.env_spec)
        flight = fly_crowd(env, policy, seeds_of(flights))
    failed = flight["terminated"]
    errors = flight["steady"]
    if starts == "throws":
        failed = failed | (flight["last"] < 0.5)
        errors = 0 * errors
    steady = np.minimum(np.rint(1000 * errors), CRASHED - 1)
    return np.where(failed, CRASHED, steady).astype(np.uint16)


def seeds_of(flights: int) -> list[int]:
    """Of episodes that no training flies."""
    return [evaluation_seed(number, "final") for number in range(flights)]


def craft_of(flights: int) -> np.ndarray:
    """Place in the pool of the craft of each flight."""
    config = EnvConfig.from_keywords(
        STARTS["hover"],
        vehicle=UNSEEN,
        action="wrench",
        backend="rigid",
        compiled=False,
        dtype="float64",
    )
    with closing(LocalVectorEnv(config, flights, autoreset_mode="Disabled")) as env:
        env.reset(seed=seeds_of(flights))
        rows = env.loop.world.state.craft[:, 0]
    places = {row.tobytes(): place for place, row in enumerate(table_of(drawn_craft(UNSEEN_RANGE)))}
    return np.array([places[row.tobytes()] for row in rows], np.uint16)


def peers_of(count: int) -> list[str]:
    """Drawn quadcopters, which `raptor` flies, from the first of the unseen craft on."""
    turns = drawn_craft(UNSEEN_RANGE[: 4 * count]).turn
    fours = np.flatnonzero(abs(turns).sum(axis=1) == 4)[:count]
    return [f"drawn:{UNSEEN_RANGE[place]}" for place in fours.tolist()]


def measure(args: Any) -> None:
    """Train and fly; write every flight."""
    arrays: dict[str, np.ndarray] = {"craft": craft_of(args.flights)}
    raptor = find_controller("raptor")
    fours = [name for name in vehicle_names() if Vehicle.load(name).num_rotors == 4]
    peers = peers_of(args.peers)
    for starts in STARTS:
        for name in fours:
            arrays[f"raptor/{starts}/{name}"] = flown(raptor, name, starts, args.flights)[None]
        drawn = [flown(raptor, name, starts, 10) for name in peers]
        arrays[f"raptor/{starts}/peers"] = np.concatenate(drawn)[None]
        print("raptor", starts, flush=True)
    found: dict[str, list[np.ndarray]] = {}
    seconds = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            seconds.append(trained(seed, args.env_steps, run))
            file = run / CHECKPOINT
            if seed == args.first_seed:
                publish(file)
            for starts in STARTS:
                for name in (UNSEEN, *vehicle_names()):
                    errors = flown(file, name, starts, args.flights)
                    found.setdefault(f"universal/{starts}/{name}", []).append(errors)
                if seed == args.first_seed:
                    drawn = [flown(file, name, starts, 10) for name in peers]
                    arrays[f"universal/{starts}/peers"] = np.concatenate(drawn)[None]
        print(seed, seconds[-1], flush=True)
        own = {name: np.array(errors) for name, errors in found.items()}
        np.savez_compressed(FLIGHTS, **arrays, **own, seconds=np.array(seconds))


def sums() -> dict[str, Any]:
    """Of each pilot, kind of starts and craft, from the flights."""
    result: dict[str, Any] = {}
    with np.load(FLIGHTS) as arrays:
        for name in arrays:
            pilot, *cell = name.split("/")
            if cell:
                rows = result.setdefault(pilot, {}).setdefault(cell[0], {})
                rows[cell[1]] = row_of(arrays[name])
        seconds = arrays["seconds"]
        result["seconds"] = {"median": float(np.median(seconds)), "most": float(seconds.max())}
        crashed = {
            starts: (arrays[f"universal/{starts}/{UNSEEN}"] == CRASHED).mean(axis=0)
            for starts in STARTS
        }
        result["edges"] = edges_of(arrays["craft"].astype(int), crashed)
    return result


def edges_of(craft: np.ndarray, crashed: dict[str, np.ndarray]) -> dict[str, Any]:
    """Share of crashes of the flights whose craft are at an edge of what is drawn."""
    drawn = drawn_craft(UNSEEN_RANGE)
    row = columns(table_of(drawn))
    room = np.minimum(GRAVITY, row["highest"][:, 0] - GRAVITY)
    mix = row["mix"].reshape(len(room), -1, 3)[..., :2]
    needs = abs(mix * row["inertia"][:, None, :2]).max(axis=(1, 2))
    numbers = {
        "thrust-to-weight": drawn.thrust_to_weight, "mass": drawn.mass, "lag": drawn.lag,
        "authority": room / needs,
    }  # fmt: skip
    found: dict[str, Any] = {}
    for name, values in numbers.items():
        low, high = np.quantile(values, (0.05, 0.95))
        own = values[craft]
        for edge, mask in (("lowest", own <= low), ("highest", own >= high)):
            shares = {starts: round(float(one[mask].mean()), 4) for starts, one in crashed.items()}
            bound = round(float(low if edge == "lowest" else high), 4)
            found[f"{edge} 5 % of {name}"] = {"bound": bound, **shares}
    return found


def row_of(errors: np.ndarray) -> dict[str, Any]:
    """Of errors of shape (seeds, flights): crashes of all flights with Wilson's interval, those of
    the worst seed, and of whole flights the median error and the 95th percentile, m.
    """
    crashed = errors == CRASHED
    low, high = share_interval(int(crashed.sum()), errors.size)
    whole = errors[~crashed] / 1000
    middle, most = np.quantile(whole, (0.5, 0.95)).tolist() if len(whole) else (None, None)
    return {
        "flights": errors.size,
        "crashes": int(crashed.sum()),
        "low": round(low, 5),
        "high": round(high, 5),
        "worst_seed": int(crashed.sum(axis=1).max()),
        "median": middle,
        "p95": most,
    }


def page(result: dict[str, Any]) -> str:
    """The table of docs/robustness.md: crashes in %, and the median error in cm."""
    head = ["", *(f"{pilot}: {starts}" for pilot in ("universal", "raptor") for starts in STARTS)]
    rows = []
    for name in result["universal"]["hover"]:
        cells = [
            result[pilot][starts].get(name)
            for pilot in ("universal", "raptor")
            for starts in STARTS
        ]
        rows.append([NAMES.get(name, f"`{name}`"), *map(_shown, cells)])
    return table(head, rows)


def _shown(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "–"
    share = f"{100 * cell['crashes'] / cell['flights']:.2g} %"
    return f"{share}; {100 * cell['median']:.2g}" if cell["median"] else share


def main() -> None:
    args = options(__doc__, seeds=5, first_seed=900, flights=1000, env_steps=40_000_000, peers=100,
                   only_sums=False).parse_args()  # fmt: skip
    write_sums(args, FILE, measure, sums, page)


if __name__ == "__main__":
    main()
