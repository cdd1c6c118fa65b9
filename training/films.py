"""Films of a study: each row flies the same episode, side by side."""

from pathlib import Path

from ..agents import CONTROLLERS
from ..agents.checkpoints import load
from ..agents.policies import Policy
from ..flights.filming import Film, FilmTrack, OnFrame, film
from ..flights.trajectories import flown_trajectories
from ..models.errors import InputError
from ..rendering import Camera
from .metrics import shown_runs
from .results import Results, checkpoint_file
from .settings import Row
from .tables import row_label


def film_study(results: Results, out: Path, on_frame: OnFrame = lambda *_: None) -> None:
    """Film the rows of a study of one task: the same episode, side by side.

    `metrics.shown_runs` says which seeds and which episode.

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
    seeds, episode = shown_runs(results.runs, results.evaluations, results.headline(rows[0]))
    tracks = [_track(results, row, seeds[row.name], episode) for row in rows if row.name in seeds]
    film(out, tracks, config, on_frame)


def _track(results: Results, row: Row, seed: int, episode: int) -> FilmTrack:
    policy: Policy
    name = row_label(row)
    if row.controller:
        policy = CONTROLLERS[row.agent](results.specs[row.name])
    else:
        policy = load(checkpoint_file(results.folder, row, seed)).policy()
        name += f", seed {seed}"
    flown = flown_trajectories(policy, row.env, [episode], results.study.evaluation, seed)
    return FilmTrack(name=name, trajectories=flown, drones=row.env.drones)
