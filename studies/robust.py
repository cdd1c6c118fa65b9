"""What a robust training is worth, and what it costs: crashes and errors under each perturbation.

    python studies/robust.py [--vehicles crazyflie2 hummingbird paper] [--seeds 5]
        [--first-seed 700] [--flights 1000] [--pilots robust tuned geometric universal]
        [--only-sums]

For each vehicle and seed `rotorgram train ppo --env rotorgram/Hover-v0` trains with the presets
robust and tuned; the clock runs from before the process starts to after it has ended. Both then fly
the perturbations for which the first was trained, alone and all together, and so do `geometric` and
the policy `universal`, with a flight band of 8 m, from starts that no training has seen.
`docs/results/robust_flights.npz` gets the steady error of every flight in millimetres, 65535 of one
that crashed, from which `--only-sums` computes `docs/results/robust.json` again. Flights of pilots
that are not named stay in it.

It takes some ten minutes on two cores.
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, options, table, write_sums
from rotorgram.agents import find_preset
from rotorgram.cli._env import UNIVERSAL
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.perturbations import perturbed, together
from rotorgram.flights.executors import WorkersConfig
from rotorgram.models import InputError
from rotorgram.training.robustness import NOMINAL, TOGETHER, Cell, fly, jobs_of
from rotorgram.training.statistics import share_interval

TASK = "rotorgram/Hover-v0"
FILE = RESULTS / "robust.json"
FLIGHTS = RESULTS / "robust_flights.npz"
CRASHED = 65535
BAND = 8.0  # m from the goal, of every flight
PRESETS = ("robust", "tuned")
OPTIONS: dict[str, dict[str, object]] = {
    "geometric": {"action": "position"},
    "universal": {"action": "wrench", "frame": "body"},
}
"""Of the env, of pilots that need no training."""
PILOTS = (*PRESETS, *OPTIONS)


def cells_of(vehicle: str) -> list[Cell]:
    """Without a perturbation, with each that the vehicle can have, and with all. Flights end 8 m
    from the goal.
    """
    sizes = dict(find_preset("ppo", "robust", TASK).perturbations)
    config = EnvConfig.from_keywords(TASK, vehicle=vehicle, backend="rigid")
    widest, drawn, refused = together(config, sizes)
    # Nominal is the craft with its own lag and drag.
    nominal = config.changed(effects=widest.effects.to_options())
    cells = [Cell(row=NOMINAL, size=0.0, config=nominal, drawn={})]
    for name, size in {**sizes, "heavier": sizes["lighter"]}.items():
        if name not in refused:
            changed, own = perturbed(nominal, name, size)
            cells.append(Cell(row=name, size=size, config=changed, drawn=own))
    cells.append(Cell(row=TOGETHER, size=1, config=widest, drawn=drawn))
    return [
        replace(cell, config=cell.config.changed(task={**cell.config.task, "flight_band": BAND}))
        for cell in cells
    ]


def trained(vehicle: str, preset: str, seed: int, folder: Path) -> float:
    """Train; wall time of the process, s."""
    words = ["train", "ppo", "--env", TASK, "--vehicle", vehicle, "--preset", preset]
    if preset == "tuned":
        nominal = cells_of(vehicle)[0].config.effects.to_options()
        words += ["--effects", *(nominal or ["none"])]
    command = [sys.executable, "-m", "rotorgram.cli", *words]
    began = time.perf_counter()
    subprocess.run([*command, "--seed", str(seed), "--out", str(folder)],
                   check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    return round(time.perf_counter() - began, 2)


def flown(pilot: str, cells: list[Cell], flights: int, **options: object) -> np.ndarray:
    """Steady errors of the flights of each cell, mm, uint16, shape (cells, flights).

    As many others are flown first and left out: their starts chose the preset.
    """
    changed = [Cell(**{**vars(cell), "config": cell.config.changed(**options)}) for cell in cells]
    file = str(UNIVERSAL) if pilot == "universal" else pilot
    rows = fly(jobs_of(file, changed, 2 * flights), WorkersConfig(), lambda *_: None)
    found = []
    for cell in cells:
        own = rows[(rows["row"] == cell.row) & (rows["size"] == cell.size)]
        own = own.tail(flights)
        steady = np.minimum(np.rint(1000 * own["steady"].to_numpy()), CRASHED - 1)
        found.append(np.where(own["crashed"], CRASHED, steady).astype(np.uint16))
    return np.array(found)


def measure(args: Any) -> None:
    """Train and fly; write every flight."""
    arrays: dict[str, np.ndarray] = {}
    if FLIGHTS.is_file():
        with np.load(FLIGHTS) as kept:
            arrays.update(kept)
    for vehicle in args.vehicles:
        cells = cells_of(vehicle)
        labels = ["all together" if cell.row == TOGETHER else cell.label for cell in cells]
        kept_labels = arrays.setdefault(f"{vehicle}/cells", np.array(labels)).tolist()
        if kept_labels != labels:
            raise InputError(f"robust: expected the cells of {FLIGHTS}, got {labels}; remove it")
        for pilot in args.pilots:
            if pilot in OPTIONS:
                errors = flown(pilot, cells, args.flights, **OPTIONS[pilot])
                arrays[f"{vehicle}/{pilot}"] = errors[None]
                np.savez_compressed(FLIGHTS, **arrays)
                continue
            seconds = []
            of_seeds = []
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    run = Path(folder) / "run"
                    seconds.append(trained(vehicle, pilot, seed, run))
                    checkpoint = str(run / "checkpoint.safetensors")
                    of_seeds.append(flown(checkpoint, cells, args.flights))
                print(vehicle, pilot, seed, seconds[-1], flush=True)
            arrays[f"{vehicle}/{pilot}"] = np.array(of_seeds)
            arrays[f"{vehicle}/{pilot}/seconds"] = np.array(seconds)
            np.savez_compressed(FLIGHTS, **arrays)


def sums() -> dict[str, Any]:
    """Of each vehicle, pilot and cell, from the flights."""
    result: dict[str, Any] = {}
    with np.load(FLIGHTS) as arrays:
        vehicles = [name.partition("/")[0] for name in arrays if name.endswith("/cells")]
        for vehicle in vehicles:
            labels = arrays[f"{vehicle}/cells"].tolist()
            result[vehicle] = {}
            for pilot in [one for one in PILOTS if f"{vehicle}/{one}" in arrays]:
                errors = arrays[f"{vehicle}/{pilot}"]
                rows = {label: row_of(errors[:, place]) for place, label in enumerate(labels)}
                result[vehicle][pilot] = {"cells": rows}
                if pilot not in OPTIONS:
                    seconds = arrays[f"{vehicle}/{pilot}/seconds"]
                    result[vehicle][pilot]["seconds"] = {
                        "median": float(np.median(seconds)), "most": float(seconds.max()),
                    }  # fmt: skip
    return result


def row_of(errors: np.ndarray) -> dict[str, Any]:
    """Of one cell, errors of shape (seeds, flights): crashes of all flights with Wilson's interval,
    those of the worst seed, and of whole flights the median error and the 95th percentile, m; the
    interval of the median over the seeds is their range.
    """
    crashed = errors == CRASHED
    low, high = share_interval(int(crashed.sum()), errors.size)
    whole = errors[~crashed] / 1000
    medians = [float(np.median(own[own != CRASHED])) / 1000 for own in errors
               if (own != CRASHED).any()]  # fmt: skip
    if not len(whole):
        raise InputError("robust: expected a flight without a crash, got none")
    return {
        "flights": errors.size,
        "crashes": int(crashed.sum()),
        "low": round(low, 5),
        "high": round(high, 5),
        "worst_seed": int(crashed.sum(axis=1).max()),
        "median": round(float(np.median(whole)), 4),
        "medians": [round(min(medians), 4), round(max(medians), 4)],
        "p95": round(float(np.quantile(whole, 0.95)), 4),
    }


def page(result: dict[str, Any]) -> str:
    """The table of docs/robustness.md: crashes in %, and the median error in cm."""
    labels = list(
        dict.fromkeys(label for own in result.values() for label in own["tuned"]["cells"])
    )
    head = ["", *(f"{vehicle}: {pilot}" for vehicle in result for pilot in PILOTS)]
    rows = []
    for label in labels:
        cells = [own[pilot]["cells"].get(label) for own in result.values() for pilot in PILOTS]
        rows.append([label, *map(_shown, cells)])
    times = [own[pilot].get("seconds") for own in result.values() for pilot in PILOTS]
    rows.append(["training, s", *(f"{time['median']:.1f}" if time else "–" for time in times)])
    return table(head, rows)


def _shown(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "–"
    share = 100 * cell["crashes"] / cell["flights"]
    crashes, error = (float(f"{number:.2g}") for number in (share, 100 * cell["median"]))
    return f"{crashes:g} %; {error:g}"


def main() -> None:
    vehicles = ["crazyflie2", "hummingbird", "paper"]
    args = options(__doc__, vehicles=vehicles, seeds=5, first_seed=700, flights=1000,
                   pilots=list(PILOTS), only_sums=False).parse_args()  # fmt: skip
    write_sums(args, FILE, measure, sums, page)


if __name__ == "__main__":
    main()
