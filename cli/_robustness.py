"""What `rotorgram evaluate --robustness` flies, prints and writes."""

import json
import shlex
import sys
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any

from ..agents import CONTROLLERS, find_controller, is_controller
from ..envs.config import EnvConfig
from ..envs.perturbations import PERTURBATIONS, check
from ..envs.spec import EnvSpec
from ..envs.vector import LocalVectorEnv
from ..flights.executors import ALL_JOBS, WorkersConfig
from ..models.errors import InputError, MissingPackage, require
from ..training import robustness
from ..training.metrics import Headline
from ._env import checkpoint_file
from ._progress import bars
from ._training import flags_of, folder_to_write

if TYPE_CHECKING:
    from .evaluate import Evaluate

_OF_WIRE = ("listen", "record", "key_file", "insecure", "mavlink")


def measure_robustness(command: "Evaluate", flights: int) -> None:
    """Fly the cells of a command's env by its policy, and by the controllers that can beside it;
    print the table, and write it, a figure, and every flight.
    """
    if unused := sorted(command.given.intersection(_OF_WIRE)):
        raise InputError(f"robustness: expected flights in this process, got {flags_of(unused)}")
    require("matplotlib", "report", "a figure")
    config = _quickest(command)
    own = command.policy
    own = own if is_controller(own) else str(checkpoint_file(own))
    cells, refused = robustness.cells_of(config)
    jobs = []
    specs = {}
    for pilot in dict.fromkeys((own, *CONTROLLERS)):
        flown = cells
        try:
            if pilot != own:
                flown, _ = robustness.cells_of(_flown_by(pilot, config))
            specs[pilot] = _spec(pilot, flown[0].config)
        except (InputError, MissingPackage) as error:
            if pilot == own:
                raise
            print(f"not beside: {pilot}: {error}")
            continue
        jobs += robustness.jobs_of(pilot, flown, flights)
    with folder_to_write(command.out, "robustness") as folder:
        with bars() as progress:

            def on_progress(name: str, *now: Any) -> None:
                if name == ALL_JOBS:  # not each env
                    progress(name, *now)

            rows = robustness.fly(jobs, WorkersConfig(jobs=command.jobs), on_progress)
        rows["pilot"] = rows["pilot"].replace(own, command.policy)
        table = robustness.table_of(rows, cells)
        headline = Headline.of(specs[own])
        spec = specs[own]
        title = f"{command.policy} on {spec.env_id}, {spec.vehicle_text}, {config.backend.name}"
        print(robustness.text_of(table, title, headline))
        for name, sentence in refused.items():
            print(f"not flown: {PERTURBATIONS[name]['label']}: {sentence}")
        rows.to_csv(folder / "flights.csv.gz", index=False)
        content = {
            "command": shlex.join(["rotorgram", *sys.argv[1:]]),
            "env": config.to_dict(),
            "not_flown": refused,
            "cells": json.loads(table.to_json(orient="records")),
        }
        (folder / "robustness.json").write_text(json.dumps(content, indent=1) + "\n")
        robustness.draw(table, title).savefig(folder / "robustness.png")
        print(f"{folder}: robustness.json, robustness.png, flights.csv.gz")


def _quickest(command: "Evaluate") -> EnvConfig:
    """The env, without what a training draws, on the backend `rigid` where that flies it, unless
    the user names others.
    """
    config = command.env_config()
    if "randomize" not in command.given:
        config = config.changed(randomize={}, observe_drawn=False)
    if "backend" not in command.given:
        with suppress(InputError):
            rigid = config.changed(backend="rigid")
            check(rigid)
            return rigid
    return config


def _flown_by(controller: str, config: EnvConfig) -> EnvConfig:
    """The env with what a controller needs, and episodes that last as long. Raises `InputError`."""
    options = find_controller(controller).options
    changed = config.changed(history=1, **options)
    assert config.episode_length
    assert config.control_period
    assert changed.control_period
    steps = round(config.episode_length * config.control_period / changed.control_period)
    return changed.changed(episode_length=steps)


def _spec(pilot: str, config: EnvConfig) -> EnvSpec:
    """Of an env that a pilot can fly. Raises `InputError`."""
    with closing(LocalVectorEnv(config, config.drones)) as env:
        robustness.policy_of(pilot, env)
        return env.env_spec
