"""Racing, waypoints and solid gates: flights that leave one out, and laps over the least time.

    pip install casadi
    OMP_NUM_THREADS=1 python studies/racing.py [--tasks Racing Waypoints Gates] [--seeds 20]
        [--first-seed 9320] [--flights 1000] [--again] [--out docs/results/racing.json]

Each seed is a training by `rotorgram train ppo`, from process start to its end, with the preset
`tuned`. Its policy, and `geometric`, fly `--flights` starts of the set `final`, on `rigid`: the
same starts for all, of no training. Seeds 9100 to 9102 chose the preset, with starts of the set
`tuning`; tests train none. Seeds 5000 to 5009 of the file are the policies of the board, which
`rotorgram benchmark` trained alike: their time of training is not known.

A lap is the time from the start, at rest, to the end of the control step that passes the last gate
or point. The bound of each flight is the least time of a point mass through the same openings or
balls in their order, from the same start: see `least_time`. A crash is an end with gates or points
left before the time is up.

Rows of all flights are kept in the file beside the result, `racing_flights.npz`. Seeds that it has
with as many flights are not trained again. `--again` computes the figures from the rows and flies
nothing.

It takes about an hour of one core for both courses in the air.
"""

import statistics
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
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
    "Racing": [],
    "Waypoints": [],
    "Gates": ["--scene", "gates:0-63"],
}
"""Words of `rotorgram train` by task. Solid gates are flown in layouts that no training has seen.
"""
FLOWN: Final = {"Gates": {"scene": "gates:unseen"}}
NODES: Final = 10
"""Times in which the thrust may change on the way to each gate or point. 40 lower the bound of a
track of ours by at most 0.1 %.
"""
SHORTEST: Final = 0.01  # s: of the way to a gate or point
LONGEST: Final = 20.0
ASIDE: Final = 0.1  # m/s²: of the first thrusts, since upright is a saddle of some courses
GUESSES: Final = 8.0, 4.0, 16.0  # m/s²: accelerations with which IPOPT begins, until one leads on

Floats = npt.NDArray[np.float64]
Rows = dict[str, np.ndarray]
LeastTime = Callable[[Floats, Floats], float]


# ---- the bound


def least_time(
    goals: int, gates: bool, lift: float, gravity: float, nodes: int = NODES
) -> LeastTime:
    """The least time of a point mass from rest through some goals, in their order, s.

    The function takes the start, m, shape (3,), and the goals. A gate is its center, x and y of its
    direction and half its size, shape (goals, 6): it is passed anywhere in its opening, not against
    its direction. A point is its place and its radius, shape (goals, 4). Thrust over mass has any
    direction and at most the size `lift`, m/s². It changes `nodes` times on the way to each goal,
    at even times. Speed is free at the end, and nothing turns. IPOPT, by casadi, finds the times,
    the thrusts and the states at the goals; raises `RuntimeError` if it does not.
    """
    import casadi as ca

    width = 6 if gates else 4
    course = ca.MX.sym("course", 3 + goals * width)
    position = course[:3]
    velocity = ca.MX.zeros(3)
    falls = ca.DM([0.0, 0.0, -gravity])
    left = ca.DM(np.arange(nodes, 0, -1) - 0.5)  # of the way, in parts, after a part's middle
    unknown, low, high = [], [], []
    terms, least, most = [], [], []
    total = 0.0
    for goal in range(goals):
        time = ca.MX.sym(f"time {goal}")
        thrust = ca.MX.sym(f"thrust {goal}", 3, nodes)
        state = ca.MX.sym(f"state {goal}", 6)
        unknown += [time, ca.vec(thrust), state]
        low += [[SHORTEST], np.full(3 * nodes, -lift), np.full(6, -np.inf)]
        high += [[LONGEST], np.full(3 * nodes, lift), np.full(6, np.inf)]
        part = time / nodes
        arrives = position + time * velocity + time**2 / 2 * falls
        arrives += part**2 * ca.mtimes(thrust, left)
        speed = velocity + time * falls + part * ca.sum2(thrust)
        terms += [ca.sum1(thrust**2).T / lift**2, ca.vertcat(arrives, speed) - state]
        least += [np.zeros(nodes), np.zeros(6)]
        most += [np.ones(nodes), np.zeros(6)]
        position, velocity = state[:3], state[3:]
        target = course[3 + goal * width :][:width]
        away = position - target[:3]
        if gates:
            c, s, half = target[3], target[4], target[5]
            ahead = c * away[0] + s * away[1]
            aside = c * away[1] - s * away[0]
            forward = c * velocity[0] + s * velocity[1]
            terms += [ahead, aside / half, away[2] / half, forward]
            least += [[0.0, -1.0, -1.0, 0.0]]
            most += [[0.0, 1.0, 1.0, np.inf]]
        else:
            terms.append(ca.sumsqr(away) / target[3] ** 2)
            least.append([0.0])
            most.append([1.0])
        total += time
    problem = {"x": ca.vertcat(*unknown), "p": course, "f": total, "g": ca.vertcat(*terms)}
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("least_time", "ipopt", problem, quiet)
    bounds = dict(
        zip(
            ("lbx", "ubx", "lbg", "ubg"), map(np.concatenate, (low, high, least, most)), strict=True
        )
    )

    def solve(start: Floats, targets: Floats) -> float:
        for acceleration in GUESSES:
            guess = first_guess(start, targets[:, :3], nodes, acceleration, gravity)
            found = solver(x0=guess, p=np.concatenate((start, targets.ravel())), **bounds)
            if solver.stats()["success"]:
                return float(found["f"])
        raise RuntimeError(f"least_time: {solver.stats()['return_status']} from {start}")

    return solve


def first_guess(
    start: Floats, places: Floats, nodes: int, acceleration: float, gravity: float
) -> Floats:
    """Where IPOPT begins: along straight lines, with this acceleration to the middle of each."""
    course = np.vstack((start, places))
    parts = []
    for goal, way in enumerate(np.diff(course, axis=0), 1):
        far = float(np.linalg.norm(way)) + 1e-3
        seconds = 2 * np.sqrt(far / acceleration)
        ahead = course[min(goal + 1, len(places))] - course[goal - 1]
        velocity = ahead / (np.linalg.norm(ahead) + 1e-3) * far / seconds
        halves = np.where(np.arange(nodes) < nodes / 2, 1.0, -1.0)[:, np.newaxis]
        thrust = halves * way / far * acceleration + np.array((ASIDE, ASIDE, gravity))
        parts += [[seconds], thrust.ravel(), course[goal], velocity]
    return np.concatenate(parts)


# ---- flights


def made(task: str, flights: int, **keywords: object) -> tuple[LocalVectorEnv, list[int]]:
    """An env for so many flights, and the seeds of their starts."""
    given = {"backend": "rigid", **FLOWN.get(task, {}), **keywords}
    config = EnvConfig.from_keywords(f"rotorgram/{task}-v0", **given)
    env = LocalVectorEnv(config, flights, autoreset_mode="Disabled")
    return env, [evaluation_seed(flight, "final") for flight in range(flights)]


def bounds_of(task: str, flights: int) -> Floats:
    """The bound of each flight, s."""
    env, seeds = made(task, flights)
    env.reset(seed=seeds)
    starts = env.telemetry["position"]
    kept = env.snapshot()
    options = env.config.task
    if task == "Racing":
        track, _ = read_track(options["track"])
        turns = np.radians([gate.heading for gate in track])
        centers = np.array([gate.position for gate in track])
        halves = np.array([gate.size / 2 for gate in track])
        courses = np.column_stack((centers, np.cos(turns), np.sin(turns), halves))[np.newaxis]
    elif task == "Gates":
        courses = kept["record/memory/track"][:, 0]
    else:
        points = kept["record/memory/points"][:, 0]
        radii = np.full((*points.shape[:2], 1), options["radius"])
        courses = np.concatenate((points, radii), axis=2)
    env.close()
    vehicle = Vehicle.load(*env.config.vehicle)
    lift = float(vehicle.thrust_high @ vehicle.allocation[0]) / vehicle.mass
    least = least_time(courses.shape[1], task != "Waypoints", lift, vehicle.gravity)
    every = np.broadcast_to(courses, (flights, *courses.shape[1:]))
    return np.array([least(*one) for one in zip(starts, every.astype(float), strict=True)])


def fly(task: str, agent: Any, flights: int) -> Rows:
    """What each flight leaves out, its control steps, and whether it crashes, shape (flights,).

    `agent` is a `Checkpoint`, or the name of a controller.
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
    while not done.all():
        seen = env.observations
        if isinstance(agent, str):
            actions = np.array([pilot.act(own) for pilot, own in zip(pilots, seen, strict=True)])
        else:
            actions = policy.actions.to_envs(policy.outputs(seen))
        env.advance(actions, frozen=done)
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
    return {
        "command": " ".join(["rotorgram train ppo --env", f"rotorgram/{task}-v0", *WORDS[task]]),
        "seeds_without_a_miss": sum(one["left"] == 0 for one in of_seeds),
        "of": len(seeds),
        "bound": round(float(bound.mean()), 3),
        "processor_seconds": round(float(np.nanmedian(kept[f"{task}/seconds"])), 1),
        "all": figures(together, period),
        "lap_over_bound": {"best": min(ratios), "median": statistics.median(ratios),
                           "worst": max(ratios)},
        "geometric": figures(rows(-1), period),
        "seeds": of_seeds,
    }  # fmt: skip


def time_of(seconds: float) -> dict[str, float]:
    """Of a training, where it is known."""
    return {} if np.isnan(seconds) else {"seconds": round(float(seconds), 1)}


def main() -> None:
    parser = options(__doc__, tasks=list(WORDS), seeds=20, first_seed=9320, flights=1000,
                     again=False, out=RESULTS / "racing.json")  # fmt: skip
    args = parser.parse_args()
    path = args.out.with_name(args.out.stem + "_flights.npz")
    kept: Rows = dict(np.load(path)) if path.exists() else {}
    tasks = [] if args.again else args.tasks
    for task in tasks:
        if len(kept.get(f"{task}/bound", ())) != args.flights:
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


def begin(kept: Rows, task: str, flights: int) -> None:
    """Rows of a task without seeds: the bounds, and the flights of `geometric`."""
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
        flown = fly(task, load(run / "checkpoint.safetensors"), flights)
    kept[f"{task}/seeds"] = np.append(kept[f"{task}/seeds"], seed)
    kept[f"{task}/seconds"] = np.append(kept[f"{task}/seconds"], seconds)
    for name, column in flown.items():
        before = kept[f"{task}/{name}"]
        kept[f"{task}/{name}"] = np.vstack((before[:-1], column, before[-1]))


if __name__ == "__main__":
    main()
