"""Flight by sight through woods that no training has seen: PPO on Forest-v0, over several seeds.

    python studies/forest.py [--seeds 5] [--first-seed 4100] [--flights 1000] [--out FILE.json]
    python studies/forest.py --beside    # flights of controllers anew, the policies' stay
    python studies/forest.py --set network=cnn "filters=[8, 16]" --out docs/results/forest_cnn.json
    python studies/forest.py --set memory=64 "hidden=[64]" --out docs/results/forest_gru.json

A training is `rotorgram train ppo --env rotorgram/Forest-v0` with its tuned preset, motor lag, the
noise of the depth camera, 1 tree per 8 m², and a speed from 2.5 to 5.5 m/s drawn for each episode;
the clock runs from before its process starts to its end. Each policy then flies `--flights` unseen
layouts at 3 and at 5 m/s, with 1 tree per 10 m² and per 8 m². In the layouts of the first policy
`straight` flies at the goal and looks at nothing, and `vfh` (VFH+) steers by a level lidar of 360
rays at 10 Hz. Intervals are Wilson's, at 95 %, of all flights of a row. Traversability is that of
`--hard` of these layouts.

It takes about 40 minutes on two cores. Other settings than the preset's are given by `--set`, as
to `rotorgram train`; `straight` and `vfh` do not fly beside them.
"""

import json
import shlex
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import find_controller, load
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spec import EnvSpec
from rotorgram.flights.trajectories import (
    Flights,
    evaluation_seed,
    fly_episodes,
    mean_traversability,
)
from rotorgram.training.statistics import share_interval

WORDS = ("ppo", "--env", "rotorgram/Forest-v0", "--effects", "motor_lag", "--env.density", "0.125",
         "--env.speed", "2.5", "5.5")  # fmt: skip
CASES = [(density, speed) for density in (0.1, 0.125) for speed in (3.0, 5.0)]
Flown = tuple[dict[str, Any], Flights]
MEANS = ("mean_speed", "top_speed", "least_clearance", "flight_time")


class Straight:
    """Flies at the goal, for all drones of a batch."""

    options: ClassVar[dict[str, object]] = {}

    def __init__(self, spec: EnvSpec) -> None:
        self._scale = spec.action_scale

    def actions(self, observations: Any) -> np.ndarray:
        """Of the level `velocity`."""
        x, y, height, *_ = observations["observation"].T
        wanted = np.stack((x, y, height, 0.0 * x), axis=-1)
        return np.clip(wanted / self._scale, -1.0, 1.0).astype(np.float32)


def train(words: Sequence[str], seed: int, folder: Path) -> float:
    """Wall time of a training, s."""
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words, "--seed", str(seed)]
    began = time.perf_counter()
    subprocess.run([*command, "--out", str(folder)], check=True, stdout=subprocess.DEVNULL)
    return round(time.perf_counter() - began, 1)


def woods(flights: int, density: float, speed: float, **more: Any) -> LocalVectorEnv:
    """So many unseen layouts."""
    config = EnvConfig.from_keywords(
        "rotorgram/Forest-v0", backend="rigid", effects={"motor_lag": True}, density=density,
        speed=speed, **more,
    ).unseen()  # fmt: skip
    return LocalVectorEnv(config, flights, autoreset_mode="Disabled")


def fly(policy: Any, flights: int, density: float, speed: float, seed: int) -> Flown:
    """Flights of a policy in unseen layouts, and their trajectories."""
    env = woods(flights, density, speed)
    flown = fly_episodes(env, policy(env.env_spec), flights, "final", training_seed=seed)
    env.close()
    return counted(env, np.array([one.telemetry["metrics"][-1] for one in flown])), flown


def fly_batch(kind: Any, flights: int, density: float, speed: float, seed: int) -> dict[str, Any]:
    """The same of a controller, all drones at once, in the layouts of a policy of that seed."""
    env = woods(flights, density, speed, **kind.options)
    pilot = kind(env.env_spec)
    env.reset(seed=[evaluation_seed(number, "final", seed) for number in range(flights)])
    nobody = done = np.zeros(flights, bool)
    last = env.telemetry["metrics"]
    while not done.all():
        env.advance(pilot.actions(env.observations), nobody, None, done)
        last = np.where(done[:, None], last, env.telemetry["metrics"])
        done = done | env.terminated | env.truncated
    env.close()
    return counted(env, last)


def counted(env: LocalVectorEnv, last: np.ndarray) -> dict[str, Any]:
    """Counts and means of the metrics at the ends of flights, (N, metrics)."""
    names = [metric.name for metric in env.env_spec.metrics]
    told = dict(zip(names, last.T, strict=True))
    arrived = told["success"] > 0.5
    row = {
        "flights": len(last),
        "arrived": int(arrived.sum()),
        "touched": int((told["touched"] > 0.5).sum()),
    }
    means = {name: float(told[name][arrived].mean()) if arrived.any() else 0.0 for name in MEANS}
    return row | {name: round(mean, 3) for name, mean in means.items()}


def main() -> None:
    args = options(
        __doc__, seeds=5, first_seed=4100, flights=1000, hard=30, beside=False, set=[""],
        out=RESULTS / "forest.json",
    ).parse_args()  # fmt: skip
    if args.beside:
        content = json.loads(args.out.read_text())
        for row, others in zip(content["cases"], beside(args), strict=True):
            row |= others
        write(args.out, content)
        return
    changes = [change for change in args.set if change]
    words = [*WORDS, *(["--set", *changes] if changes else [])]
    more: list[dict[str, Any]] = [{} for _ in CASES]
    seeds: list[dict[str, Any]] = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            seconds = train(words, seed, Path(folder) / "run")
            kept = load(Path(folder) / "run" / "checkpoint.safetensors")
        rows = []
        for case, others in zip(CASES, more, strict=True):
            row, flown = fly(kept.policy, args.flights, *case, seed=seed)
            rows.append(row)
            if not seeds:
                others["traversability"] = round(mean_traversability(flown[: args.hard]), 2)
        seeds.append({"seed": seed, "seconds": seconds, "cases": rows})
        print(seed, seconds, [row["arrived"] for row in rows], flush=True)
        _write(args.out, words, seeds, more)
    if not changes:
        more = [row | others for row, others in zip(more, beside(args), strict=True)]
        _write(args.out, words, seeds, more)


def beside(args: Namespace) -> list[dict[str, Any]]:
    """Flights of the controllers in each of `CASES`, in the layouts of the first policy."""
    kinds = {"straight": Straight, "vfh": find_controller("examples/vfh.py:Vfh")}
    return [
        {
            name: fly_batch(kind, args.flights, *case, args.first_seed)
            for name, kind in kinds.items()
        }
        for case in CASES
    ]


def _write(
    out: Path, words: list[str], seeds: list[dict[str, Any]], more: list[dict[str, Any]]
) -> None:
    cases = [summary(seeds, number) | row for number, row in enumerate(more)]
    command = f"rotorgram train {shlex.join(words)}"
    write(out, {"command": command, "cases": cases, "seeds": seeds})


def summary(seeds: list[dict[str, Any]], number: int) -> dict[str, Any]:
    """Of one of `CASES`, over seeds: the share that arrives with its interval, and means."""
    own = [one["cases"][number] for one in seeds]
    flights = sum(row["flights"] for row in own)
    arrived = sum(row["arrived"] for row in own)
    low, high = share_interval(arrived, flights)
    density, speed = CASES[number]
    case = {"density": density, "speed": speed, "flights": flights, "arrived": arrived}
    case |= {"share": round(arrived / flights, 4), "low": round(low, 4), "high": round(high, 4)}
    means = {name: np.mean([row[name] for row in own]) for name in MEANS}
    return case | {name: round(float(mean), 3) for name, mean in means.items()}


if __name__ == "__main__":
    main()
