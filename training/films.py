"""Films of a study: each row flies the same episode, side by side."""

from pathlib import Path

from ..agents import find_controller
from ..agents.checkpoints import load
from ..agents.policies import Policy
from ..flights.executors import Tell
from ..flights.filming import Film, FilmTrack, film
from ..flights.trajectories import flown_trajectories
from ..models.errors import InputError
from ..rendering import Camera
from .results import Results, checkpoint_file, run_file
from .tables import row_label


def film_study(results: Results, out: Path, tell: Tell = lambda *_: None) -> None:
    """Film the rows of a study of one task: the same episode, side by side.

    It shows the first seed of each row and the first episode: none is chosen.

    Raises:
        NoOpenGL: No OpenGL works here.
        InputError: Rows fly several tasks, or their policies were not kept.
        OSError: The film cannot be written.
    """
    rows = results.study.rows
    tasks = {row.task for row in rows}
    if len(tasks) > 1:
        raise InputError(f"film: expected rows of one task, got {', '.join(sorted(tasks))}")
    env = rows[0].env
    # Small enough for a page that holds the film in itself.
    camera: Camera = "top" if env.drones > 1 else "front"  # no craft hides another
    vehicle = ",".join(env.vehicle) or None
    config = Film(height=400, camera=camera, fast=True, quality=27, vehicle=vehicle)
    seed = results.study.first_seed
    tracks = []
    for row in rows:
        if not run_file(results.folder, row, seed).exists():
            continue
        policy: Policy
        name = row_label(row)
        if row.controller:
            policy = find_controller(row.agent)(results.specs[row.name])
        else:
            policy = load(checkpoint_file(results.folder, row, seed)).policy()
            name += f", seed {seed}"
        flown = flown_trajectories(policy, row.env.unseen(), [0], results.study.evaluation, seed)
        tracks.append(FilmTrack(name=name, trajectories=flown, drones=env.drones))
    film(out, tracks, config, tell)
