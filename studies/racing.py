"""Racing, waypoints and solid gates: flights that leave one out, and laps over the least time.

    pip install casadi
    OMP_NUM_THREADS=1 python studies/racing.py [--tasks Racing Waypoints] [--seeds 20]
        [--first-seed 9340] [--flights 1000] [--again] [--out docs/results/racing.json]

Each seed is a training by `rotorgram train ppo` with `WORDS`, from process start to its end. Its
policy, and `geometric`, fly `--flights` starts of the set `final`, on `rigid`: the same starts for
all, of no training. Seeds 9100 to 9102 and 9400 to 9411 chose the words, on starts of the set
`tuning`. Seeds 9320 to 9339 tried words that were given up, on starts of the set `final`; those of
Waypoints are before `FIRST`. No test trains any of these. `--tasks Gates` flies through solid
gates.

A lap is the time from the start, at rest, to the end of the control step that passes the last gate
or point. The bound of each flight is the least time of a point mass through the same openings or
balls in their order, from the same start: see `least_time.py`. There, the least time of the craft
itself is found from flights of the first training. A crash is an end with gates or points
left before the time is up.

Rows of all flights are kept in the file beside the result, `racing_flights.npz`. Seeds that it has
by the same words, starts and number of flights are not trained again. `--again` computes the
figures from the rows and flies nothing.

It takes about an hour of one core for both courses in the air.
"""

import statistics
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from least_time import of_craft, of_point_mass
from measuring import RESULTS, options, write
from rotorgram.agents import find_controller, load
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.tasks.racing import read_track
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.models.vehicle import Vehicle
from rotorgram.training.statistics import share_interval
from seconds import train

WORDS: Final = {
    "Racing": ["--env-steps", "10000000", "--set", "squashed=true", "log_std=-0.5",
               "target_kl=0.05"],
    "Waypoints": ["--env-steps", "20000000", "--set", "squashed=true", "log_std=-0.3",
                  "target_kl=0.05", "activation=relu", "reach=3", "minibatches=32"],
    "Gates": ["--scene", "gates:0-63"],
}  # fmt: skip
"""Words of `rotorgram train` by task, beside its preset, which is for a shorter training. Solid
gates are flown in layouts that no training has seen.
"""
FIRST: Final = {"Waypoints": 2000}
"""Number of the first start: those before it chose the words of Waypoints."""
FLOWN: Final = {"Gates": {"scene": "gates:unseen"}}
TIMED: Final = 40
"""Flights of which the least time of the craft is found."""

Floats = npt.NDArray[np.float64]
Rows = dict[str, np.ndarray]


# ---- flights


def made(task: str, flights: int, **keywords: object) -> tuple[LocalVectorEnv, list[int]]:
    """An env for so many flights, and the seeds of their starts."""
    given = {"backend": "rigid", **FLOWN.get(task, {}), **keywords}
    config = EnvConfig.from_keywords(f"rotorgram/{task}-v0", **given)
    env = LocalVectorEnv(config, flights, autoreset_mode="Disabled")
    first = FIRST.get(task, 0)
    return env, [evaluation_seed(first + flight, "final") for flight in range(flights)]


def courses_of(env: LocalVectorEnv, task: str) -> Floats:
    """The gates or points of each flight, as `least_time` has them, shape (flights, goals, ...)."""
    options = env.config.task
    if task == "Racing":
        track, _ = read_track(options["track"])
        turns = np.radians([gate.heading for gate in track])
        centers = np.array([gate.position for gate in track])
        halves = np.array([gate.size / 2 for gate in track])
        course = np.column_stack((centers, np.cos(turns), np.sin(turns), halves))
        return np.broadcast_to(course, (env.num_envs, *course.shape))
    kept = env.snapshot()
    if task == "Gates":
        return kept["record/memory/track"][:, 0].astype(float)
    points = kept["record/memory/points"][:, 0]
    radii = np.full((*points.shape[:2], 1), options["radius"])
    return np.concatenate((points, radii), axis=2).astype(float)


def bounds_of(task: str, flights: int) -> Floats:
    """The bound of each flight, s."""
    env, seeds = made(task, flights)
    env.reset(seed=seeds)
    starts = env.telemetry["position"]
    courses = courses_of(env, task)
    vehicle = Vehicle.load(*env.config.vehicle)
    env.close()
    lift = float(vehicle.thrust_high @ vehicle.allocation[0]) / vehicle.mass
    least = of_point_mass(*courses.shape[1:], lift, vehicle.gravity)
    return np.array([least(*one) for one in zip(starts, courses, strict=True)])


def craft_of(task: str, agent: Any, flights: int) -> Floats:
    """The least time of the craft, s, from each flight of a policy; nan where there is none."""
    env, seeds = made(task, flights)
    env.reset(seed=seeds)
    courses = courses_of(env, task)
    vehicle = Vehicle.load(*env.config.vehicle)
    period = env.config.control_period
    env.close()
    least = of_craft(vehicle, *courses.shape[1:])
    log: list[Rows] = []
    rows = fly(task, agent, flights, log)
    names = ("position", "velocity", "attitude", "body_rates")
    found = np.full(flights, np.nan)
    for flight in np.flatnonzero(rows["left"] == 0):
        flown = log[: int(rows["steps"][flight]) + 1]
        states = np.array([np.concatenate([row[name][flight] for name in names]) for row in flown])
        thrusts = np.array([row["thrust"][flight] for row in flown])
        left = np.array([row["left"][flight] for row in flown])
        ends = np.flatnonzero(np.diff(left)) + 1
        with suppress(RuntimeError):
            found[flight] = least(states, thrusts, ends, period, courses[flight])
    return found


def fly(task: str, agent: Any, flights: int, log: list[Rows] | None = None) -> Rows:
    """What each flight leaves out, its control steps, and whether it crashes, shape (flights,).

    `agent` is a `Checkpoint`, or the name of a controller. A `log` gets the telemetry of the start
    and of each step, and what is `left`.
    """
    options: Mapping[str, object] = {}
    if isinstance(agent, str):
        options = find_controller(agent).options
    env, seeds = made(task, flights, **options)
    if isinstance(agent, str):
        pilots = [find_controller(agent)(env.env_spec) for _ in seeds]
    else:
        policy = agent.policy(env.env_spec)
    left = np.zeros(flights, np.uint8)
    steps = np.zeros(flights, np.uint16)
    crashed = np.zeros(flights, bool)
    done = np.zeros(flights, bool)
    env.reset(seed=seeds)

    def keep() -> None:
        if log is not None:
            log.append({**env.telemetry, "left": env.headline.copy()})

    keep()
    while not done.all():
        seen = env.observations
        if isinstance(agent, str):
            actions = np.array([pilot.act(own) for pilot, own in zip(pilots, seen, strict=True)])
        else:
            actions = policy.actions.to_envs(policy.outputs(seen))
        env.advance(actions, frozen=done)
        keep()
        steps += ~done
        ended = (env.terminated | env.truncated) & ~done
        left[ended] = env.headline[ended]
        crashed |= ended & env.terminated & (left > 0)
        done |= ended
    env.close()
    return {"left": left, "steps": steps, "crashed": crashed}


# ---- figures


def figures(rows: Rows, period: float) -> dict[str, object]:
    """Of the flights of one agent, with their bounds."""
    whole = rows["left"] == 0
    flights = len(whole)
    crashes = int(rows["crashed"].sum())
    low, high = share_interval(crashes, flights)
    laps = rows["steps"][whole] * period
    found = {
        "flights": flights,
        "not_whole": int((~whole).sum()),
        "left": int(rows["left"].sum()),
        "crashes": {"crashes": crashes, "low": round(low, 5), "high": round(high, 5)},
    }
    if whole.any():
        found["lap"] = round(float(laps.mean()), 3)
        found["lap_over_bound"] = round(float(laps.mean() / rows["bound"][whole].mean()), 3)
    return found


def result_of(kept: Mapping[str, np.ndarray], task: str) -> dict[str, object]:
    """Figures of a task: of every seed, of all together, and of `geometric`."""
    period = 0.02  # s
    seeds = kept[f"{task}/seeds"].tolist()
    bound = kept[f"{task}/bound"].astype(float)
    columns = ("left", "steps", "crashed")

    def rows(chosen: Any) -> Rows:
        own = {name: kept[f"{task}/{name}"][chosen] for name in columns}
        return {**own, "bound": np.broadcast_to(bound, own["left"].shape)}

    of_seeds = [
        {"seed": seed, **time_of(seconds), **figures(rows(place), period)}
        for place, (seed, seconds) in enumerate(zip(seeds, kept[f"{task}/seconds"], strict=True))
    ]
    together = {name: column.ravel() for name, column in rows(slice(len(seeds))).items()}
    ratios = [one.get("lap_over_bound", np.inf) for one in of_seeds]
    least = kept[f"{task}/craft"]
    timed = (kept[f"{task}/left"][:-1, : len(least)] == 0) & np.isfinite(least)
    laps = period * kept[f"{task}/steps"][:-1, : len(least)]
    craft = np.broadcast_to(least, laps.shape)[timed].mean()
    return {
        "command": " ".join(["rotorgram train ppo --env", f"rotorgram/{task}-v0", *WORDS[task]]),
        "seeds_without_a_miss": sum(one["left"] == 0 for one in of_seeds),
        "of": len(seeds),
        "bound": round(float(bound.mean()), 3),
        "processor_seconds": round(float(np.nanmedian(kept[f"{task}/seconds"])), 1),
        "all": figures(together, period),
        "lap_over_bound": {"best": min(ratios), "median": statistics.median(ratios),
                           "worst": max(ratios)},
        "craft": {"flights": int(np.isfinite(least).sum()), "least": round(float(craft), 3),
                  "lap_over_least": round(float(laps[timed].mean() / craft), 3)},
        "geometric": figures(rows(-1), period),
        "seeds": of_seeds,
    }  # fmt: skip


def time_of(seconds: float) -> dict[str, float]:
    """Of a training, where it is known."""
    return {} if np.isnan(seconds) else {"seconds": round(float(seconds), 1)}


def main() -> None:
    parser = options(__doc__, tasks=["Racing", "Waypoints"], seeds=20, first_seed=9340,
                     flights=1000, again=False, out=RESULTS / "racing.json")  # fmt: skip
    args = parser.parse_args()
    path = args.out.with_name(args.out.stem + "_flights.npz")
    kept: Rows = dict(np.load(path)) if path.exists() else {}
    tasks = [] if args.again else args.tasks
    for task in tasks:
        if str(kept.get(f"{task}/made")) != made_by(task, args.flights):
            begin(kept, task, args.flights)
            np.savez_compressed(path, **kept)
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for task in tasks:
            if seed not in kept[f"{task}/seeds"]:
                add(kept, task, seed, args.flights)
                np.savez_compressed(path, **kept)
                print(task, result_of(kept, task)["seeds"][-1], flush=True)
    known = [task for task in WORDS if len(kept.get(f"{task}/seeds", ()))]
    write(args.out, {task: result_of(kept, task) for task in known})


def made_by(task: str, flights: int) -> str:
    """What the rows of a task are of: others do not go with them."""
    return f"{flights} flights from start {FIRST.get(task, 0)}: {' '.join(WORDS[task])}"


def begin(kept: Rows, task: str, flights: int) -> None:
    """Rows of a task without seeds: the bounds, and the flights of `geometric`."""
    kept.pop(f"{task}/craft", None)
    kept[f"{task}/made"] = np.array(made_by(task, flights))
    kept[f"{task}/bound"] = bounds_of(task, flights).astype(np.float32)
    kept[f"{task}/seeds"] = np.zeros(0, np.int64)
    kept[f"{task}/seconds"] = np.zeros(0)
    for name, column in fly(task, "geometric", flights).items():
        kept[f"{task}/{name}"] = column[np.newaxis]


def add(kept: Rows, task: str, seed: int, flights: int) -> None:
    """Train a seed and add its flights, before those of `geometric`."""
    words = ["ppo", "--env", f"rotorgram/{task}-v0", *WORDS[task]]
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        seconds = train(words, seed, run)["processor_seconds"]
        policy = load(run / "checkpoint.safetensors")
        if f"{task}/craft" not in kept:
            kept[f"{task}/craft"] = craft_of(task, policy, min(TIMED, flights))
        flown = fly(task, policy, flights)
    kept[f"{task}/seeds"] = np.append(kept[f"{task}/seeds"], seed)
    kept[f"{task}/seconds"] = np.append(kept[f"{task}/seconds"], seconds)
    for name, column in flown.items():
        before = kept[f"{task}/{name}"]
        kept[f"{task}/{name}"] = np.vstack((before[:-1], column, before[-1]))


if __name__ == "__main__":
    main()
