"""What was tried for an algorithm on a task: points, each some changes to one base, on a few seeds.

    OMP_NUM_THREADS=1 python studies/tuning.py Hover-v0 [--points 0 3] [--seeds 0 1]

Training flies in this process, on `mujoco` unless a point names another backend. Each policy then
flies 50 episodes on `mujoco`, of starts that no training has seen. The headline metric of an
episode is its mean over the last quarter, or its last value where that is what counts; after a
crash an error is infinite, and a metric that is to be high is 0. A row a seed is added to
docs/results/tuning/ALGORITHM_TASK.csv, or to `--out`. Seconds are of processor time, for the
machine was busy; early rows have none.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from measuring import RESULTS, add_row, options
from rotorgram.agents import EpisodeRecorder, find_algorithm, make_agent
from rotorgram.envs import LocalVectorEnv
from rotorgram.flights.trajectories import Trajectory, fly_episodes
from rotorgram.training.metrics import Headline, steady_state

EPISODES: Final = 50
PPO: Final[dict[str, Any]] = {
    "action": "rotors", "drones": 64, "env_steps": 250_000, "steps_per_update": 2048,
    "hidden": (64, 64), "activation": "tanh", "learning_rate": 0.003, "anneal": True, "epochs": 4,
    "minibatches": 8, "gamma": 0.98, "gae_lambda": 0.95, "log_std": -1.0,
    "normalize_observations": False,
}  # fmt: skip
_MORE: Final = {"env_steps": 300_000, "steps_per_update": 1024}
_FAST: Final = {**_MORE, "learning_rate": 0.005}
_WIDE: Final = {"drones": 128, "steps_per_update": 4096, "minibatches": 16}
_LARGE: Final = {**_WIDE, "backend": "rigid", "drones": 512, "steps_per_update": 16_384,
                 "minibatches": 32, "env_steps": 1_000_000}  # fmt: skip
_HALF: Final = {**_LARGE, "drones": 256, "steps_per_update": 8192, "env_steps": 600_000}
_FAR: Final = {**_LARGE, "gamma": 0.99}
_THROWN: Final = {**_LARGE, "log_std": 0.0, "normalize_observations": True}
_COURSE: Final = {"options": "", **_LARGE}
_IN_WORLD: Final[list[dict[str, Any]]] = [
    {**_WIDE, "env_steps": 300_000},
    {**_HALF, "env_steps": 300_000, "minibatches": 16},
    {**_HALF, "normalize_observations": True},
    {**_HALF, "normalize_observations": True, "gamma": 0.99},
    {**_HALF, "log_std": 0.0},
    {**_HALF, "log_std": 0.0, "normalize_observations": True},
    _THROWN,
    {**_THROWN, "learning_rate": 0.005},
    {**_THROWN, "gamma": 0.97},
    {**_THROWN, "gamma": 0.99},
    {**_THROWN, "env_steps": 1_500_000},
    {**_THROWN, "env_steps": 1_500_000, "vf_coef": 0.005},
    {**_THROWN, "env_steps": 2_500_000},
    {**_THROWN, "env_steps": 2_500_000, "activation": "relu"},
    {**_THROWN, "env_steps": 3_000_000},
    {**_THROWN, "env_steps": 3_000_000, "gamma": 0.99},
    {**_THROWN, "env_steps": 5_000_000},
]
"""Of Recovery-v0, with its observation in the world frame."""
POINTS: Final[dict[tuple[str, str], list[dict[str, Any]]]] = {
    ("ppo", "Hover-v0"): [
        {},
        {"learning_rate": 0.005},
        {"epochs": 8},
        {"hidden": (32, 32)},
        {"activation": "relu"},
        {"gae_lambda": 0.9},
        {"steps_per_update": 1024},
        {"log_std": -0.5},
        {"log_std": -1.5},
        {"gamma": 0.97},
        {"hidden": (64,)},
        _FAST,
        _MORE,
        {**_FAST, "epochs": 8},
        {**_WIDE, "env_steps": 600_000},
        {**_WIDE, "env_steps": 1_000_000},
    ],
    ("ppo", "Waypoints-v0"): [{**_LARGE, "env_steps": 2_000_000}],
    ("ppo", "Tracking-v0"): [_COURSE, {**_COURSE, "options": "trajectory=lemniscate"}],
    ("ppo", "Racing-v0"): [
        {**_COURSE, "env_steps": 1_500_000},
        {**_COURSE, "env_steps": 1_500_000, "options": "track=dive"},
    ],
    ("ppo", "Landing-v0"): [
        _FAR,
        _LARGE,
        {**_FAR, "env_steps": 2_500_000},
        {**_FAR, "env_steps": 3_000_000},
        {**_FAR, "env_steps": 1_500_000, "vf_coef": 0.02},
        {**_FAR, "env_steps": 1_500_000, "vf_coef": 0.02, "normalize_observations": True},
    ],
    ("ppo", "Recovery-v0"): [
        *({"options": "frame=world", **point} for point in _IN_WORLD),
        {**_COURSE, "env_steps": 2_000_000, "log_std": -0.5, "gae_lambda": 0.97},
        {**_COURSE, **_THROWN, "env_steps": 3_000_000},
    ],
    ("ppo", "PayloadHover-v0"): [
        {**_WIDE, "env_steps": 300_000},
        {**_WIDE, "env_steps": 600_000},
        {**_WIDE, "env_steps": 600_000, "gamma": 0.99},
        {**_WIDE, "env_steps": 600_000, "normalize_observations": True},
    ],
}
"""Changes to `PPO`, by algorithm and task."""
WITHIN: Final = {"Hover-v0": 0.05, "Tracking-v0": 0.05}
"""Headline metric below which an episode is good, where it is not the task's own bound, or 0.5."""


def decide(flown: Trajectory, headline: Headline) -> float:
    """Size of the headline metric of an episode; the worst there is after a crash."""
    size = steady_state(headline.size(flown.headline[1:]), final=headline.final)
    crashed = flown.terminated and not (headline.final and headline.holds(size))
    return (0.0 if headline.high else np.inf) if crashed else size


def measure(algorithm: str, task: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """Train with the settings on a seed; the columns of the result."""
    config = dict(settings)
    drones = config.pop("drones")
    env_steps = config.pop("env_steps")
    options = {"action": config.pop("action")}
    backend = config.pop("backend", "mujoco")
    options |= dict(word.split("=") for word in config.pop("options", "").split())

    def make(count: int, backend: str = "mujoco") -> Any:
        settings = {"num_threads": 1} if backend == "mujoco" else {"backend": backend}
        settings |= options
        return LocalVectorEnv(f"rotorgram/{task}", count, autoreset_mode="Disabled", **settings)

    log = EpisodeRecorder(make(drones, backend), seed)
    agent = make_agent(algorithm, log, find_algorithm(algorithm).config(**config), seed)
    began = time.process_time()
    agent.train(log, env_steps, lambda: True)
    seconds = time.process_time() - began
    flown = fly_episodes(make(EPISODES), agent.policy(), EPISODES, "tuning")
    headline = Headline.of(log.spec)
    headline = replace(headline, held=WITHIN.get(task, headline.held or 0.5))
    sizes = np.array([decide(one, headline) for one in flown])
    good = headline.holds(sizes)
    row: dict[str, Any] = {
        "seed": seed, "median": round(float(np.median(sizes)), 4),
        "worst": round(float(min(sizes) if headline.high else max(sizes)), 4),
        "good": int(good.sum()), "episodes": EPISODES,
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 1),
    }  # fmt: skip
    if headline.final:
        times = [one.seconds for one, is_good in zip(flown, good, strict=True) if is_good]
        row["seconds_of_good"] = round(float(np.median(times)), 2) if times else None
    return row | {"processor_seconds": round(seconds, 1)}


def main() -> None:
    parser = options(__doc__, algorithm="ppo", seeds=(0, 1), out=Path)
    parser.add_argument("task", choices=sorted({task for _, task in POINTS}))
    parser.add_argument("--points", type=int, nargs="+")
    args = parser.parse_args()
    points = POINTS[args.algorithm, args.task]
    names = dict.fromkeys(name for point in points for name in (*PPO, *point))
    name = f"{args.algorithm}_{args.task.split('-')[0].lower()}.csv"
    out = args.out or RESULTS / "tuning" / name
    for point in range(len(points)) if args.points is None else args.points:
        for seed in args.seeds:
            settings = {**PPO, **points[point]}
            layers = " ".join(map(str, settings["hidden"]))
            result = measure(args.algorithm, args.task, settings, seed)
            row = {"point": point, **names, **settings, "hidden": layers, **result}
            print(row, flush=True)
            add_row(out, row)


if __name__ == "__main__":
    main()
