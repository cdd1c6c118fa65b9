"""PPO on Hover-v0 trained with and without randomisation, flown on shifted vehicles.

    OMP_NUM_THREADS=1 python studies/transfer.py [--seeds 100 101 102 103 104]
        [--rows plain randomised …] [--env-steps 1000000] [--policies build/transfer]
        [--out docs/results/transfer] [--draw]

Every row trains on `rigid` for equally many env steps, with the preset `tuned`; policies that
`--policies` already has are not trained again. Each flies 40 episodes on every shift, on `mujoco`,
from starts of its own that no training has seen. `seeds.csv` has a line for each row, seed and
shift: the mean position error over the last quarter of the episodes that did not crash, and the
share of those that did. `summary.csv` has interquartile means over seeds with 95 % intervals,
`transfer.png` draws them, and `config.json` has the settings. `--draw` makes summary and figure
anew from `seeds.csv`.

It takes about twenty minutes on two cores.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.figure import Figure
from measuring import RESULTS, options, write
from rotorgram.agents import Geometric, load, store
from rotorgram.agents.presets import find_preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.training.metrics import steady_state
from rotorgram.training.settings import Run
from rotorgram.training.statistics import bootstrap_interval, iqm
from rotorgram.training.training import Training

from rotorgram import training

ENV: Final = "rotorgram/Hover-v0"
VEHICLE: Final = "crazyflie_brushless"
TUNED: Final = find_preset("ppo", "tuned", ENV)
LAG: Final = 50.0
"""Time constant of its rotors, ms: `models/vehicles/crazyflie_brushless`."""
EFFECTS: Final[dict[str, object]] = {"motor_lag": True, "body_drag": True}
DRAWN: Final = {
    "mass": "uniform(0.7, 1.4)", "inertia": "loguniform(0.5, 2)",
    "time_constant": "uniform(0.01, 1.6)",
    "wind_x": "uniform(-6, 6)", "wind_y": "uniform(-6, 6)",
}  # fmt: skip
ROWS: Final[dict[str, dict[str, object]]] = {
    "plain": {},
    "randomised": {"randomize": DRAWN},
    "randomised, history": {"randomize": DRAWN, "history": 4},
}
"""Options of the training by name of the row."""
EPISODES: Final = 40
_STYLE: Final = Path(training.__file__).with_name("assets") / "figures.mplstyle"
_COLORS: Final = {"plain": "#D55E00", "randomised": "#0072B2", "randomised, history": "#009E73",
                  "geometric": "#777777"}  # fmt: skip
_TITLES: Final = {
    "mass": "mass (factor)", "inertia": "inertia (factor)", "lag": "lag (ms)",
    "wind": "wind (m/s)", "all": "all together", "vehicle": "another vehicle",
}  # fmt: skip


class Shift:
    """A vehicle that is not the one of the file: `by` is the axis, `at` the place on it."""

    def __init__(
        self, by: str, at: float | str, wind: float = 0.0, vehicle: str = VEHICLE, **factors: float
    ) -> None:
        self.by = by
        self.at = at
        self.vehicle = vehicle
        self.options: dict[str, object] = {
            "effects": EFFECTS | ({"wind": (wind, 0.0, 0.0)} if wind else {}),
            "randomize": factors,
        }


def lag(milliseconds: float) -> float:
    """Factor of the time constant; of none the least there is."""
    return max(milliseconds / LAG, 0.01)


SHIFTS: Final = [
    *(Shift("mass", x, mass=x) for x in (0.7, 0.85, 1.0, 1.2, 1.4)),
    *(Shift("inertia", x, inertia=x) for x in (0.5, 0.7, 1.0, 1.4, 2.0)),
    *(Shift("lag", x, time_constant=lag(x)) for x in (0.0, 20.0, 50.0, 65.0, 80.0)),
    *(Shift("wind", x, wind=x) for x in (0.0, 2.0, 4.0, 6.0, 8.0)),
    Shift("all", "light", 8.0, mass=0.7, inertia=0.5, time_constant=lag(20)),
    Shift("all", "half", 4.0, mass=1.2, inertia=1.4, time_constant=lag(65)),
    Shift("all", "heavy", 8.0, mass=1.4, inertia=2.0, time_constant=lag(80)),
    Shift("all", "drawn", **DRAWN),
    *(Shift("vehicle", name, vehicle=name) for name in ("crazyflie2", "hummingbird")),
]


def train(row: str, seed: int, env_steps: int, path: Path) -> None:
    """Write the policy of a training."""
    options = {"effects": EFFECTS, "backend": "rigid", **ROWS[row]}
    run = Run(
        algorithm="ppo", config=TUNED.config, seed=seed, env_steps=env_steps,
        num_envs=TUNED.num_envs, env=EnvConfig.from_keywords(ENV, vehicle=VEHICLE, **options),
    )  # fmt: skip
    env = made(run.num_envs, VEHICLE, options)
    training = Training(run, env)
    began = time.process_time()
    training.train()
    path.parent.mkdir(parents=True, exist_ok=True)
    store(training.checkpoint().policy_alone(), path)
    env.close()
    print(f"{path.name}: {time.process_time() - began:.0f} s of processor time", flush=True)


def made(count: int, vehicle: str, options: Mapping[str, object]) -> LocalVectorEnv:
    """So many drones in this process."""
    return LocalVectorEnv(ENV, count, autoreset_mode="Disabled", vehicle=vehicle, **options)


def measure(shift: Shift, path: Path | None, seed: int) -> dict[str, float]:
    """Error and share of crashes of a policy's file, or of the controller without one."""
    kept = load(path) if path else None
    own = {"history": kept.spec.options["history"]} if kept else Geometric.options
    env = made(EPISODES, shift.vehicle, {**shift.options, **own})
    policy = kept.policy(env.env_spec) if kept else Geometric(env.env_spec)
    flown = fly_episodes(env, policy, EPISODES, "final", training_seed=seed)
    env.close()
    held = [steady_state(one.headline[1:]) for one in flown if not one.terminated]
    error = float(np.mean(held)) if held else math.nan
    return {"error_m": round(error, 4), "crashes": (EPISODES - len(held)) / EPISODES}


def measured(rows: list[str], seeds: list[int], policies: Path) -> pd.DataFrame:
    """A line for each row, seed and shift."""
    agents = [(row, seed, policies / f"{row.replace(', ', '-')}-{seed}.safetensors")
              for seed in seeds for row in rows]  # fmt: skip
    lines = [
        {"row": row, "seed": seed, "by": shift.by, "at": shift.at, **measure(shift, path, seed)}
        for row, seed, path in [("geometric", 0, None), *agents]
        for shift in SHIFTS
    ]
    return pd.DataFrame(lines)


def summary_of(lines: pd.DataFrame) -> pd.DataFrame:
    """Interquartile means over seeds of both measures, and the ends of their intervals."""
    found = []
    for (row, by, at), seeds in lines.groupby(["row", "by", "at"], sort=False):
        one = {"row": row, "by": by, "at": at}
        for name in ("error_m", "crashes"):
            low, high = bootstrap_interval(seeds[name])
            one |= {name: iqm(seeds[name]), f"{name}_low": low, f"{name}_high": high}
        found.append(one)
    return pd.DataFrame(found).round(4)


def draw(summary: pd.DataFrame, path: Path) -> None:
    """Errors above, crashes below; a column for each kind of shift."""
    with style.context(_STYLE):
        figure = Figure(figsize=(12, 5.2))
        panels = figure.subplots(2, len(_TITLES), sharey="row", sharex="col")
        for column, (by, title) in enumerate(_TITLES.items()):
            words = by in ("all", "vehicle")
            for i, (row, color) in enumerate(_COLORS.items()):
                some = summary[(summary["row"] == row) & (summary["by"] == by)]
                beside = 0.12 * (i - 1.5)  # marks side by side
                x = np.arange(len(some)) + beside if words else some["at"].astype(float)
                for name, axes in zip(("error_m", "crashes"), panels[:, column], strict=True):
                    axes.plot(x, some[name], "o" if words else "o-", color=color, label=row, ms=4)
                    axes.vlines(x, some[f"{name}_low"], some[f"{name}_high"], color=color)
            if words:
                panels[1, column].set_xticks(range(len(some)), some["at"], rotation=30)
                panels[1, column].margins(x=0.2)
            panels[0, column].set_title(title)
        panels[0, 0].set_yscale("log")
        panels[0, 0].set_ylabel("position error (m)")
        panels[1, 0].set_ylabel("share of crashes")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        figure.savefig(path, dpi=110)


def main() -> None:
    args = options(
        __doc__, seeds=range(100, 105), rows=list(ROWS), env_steps=1_000_000,
        policies=Path("build/transfer"), out=RESULTS / "transfer", draw=False,
    ).parse_args()  # fmt: skip
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.draw:
        for seed in args.seeds:
            for row in args.rows:
                path = args.policies / f"{row.replace(', ', '-')}-{seed}.safetensors"
                if not path.exists():
                    train(row, seed, args.env_steps, path)
        lines = measured(args.rows, list(args.seeds), args.policies)
        lines.to_csv(args.out / "seeds.csv", index=False, lineterminator="\n")
        config = {
            "env": ENV, "vehicle": VEHICLE, "effects": EFFECTS, "rows": ROWS,
            "env_steps": args.env_steps, "ppo": asdict(TUNED.config),
            "episodes": EPISODES,
        }  # fmt: skip
        write(args.out / "config.json", config)
    summary = summary_of(pd.read_csv(args.out / "seeds.csv"))
    summary.to_csv(args.out / "summary.csv", index=False, lineterminator="\n")
    draw(summary, args.out / "transfer.png")
    print(summary.to_string(index=False))


if __name__ == "__main__":
    main()
