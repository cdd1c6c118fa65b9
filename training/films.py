"""Films of a study: each row flies the same episode, side by side."""

import logging
from pathlib import Path

from ..agents import CONTROLLERS
from ..agents.checkpoints import load
from ..agents.policies import Policy
from ..envs.config import EnvConfig
from ..flights.filming import Film, FilmTrack, OnFrame, film
from ..flights.trajectories import flown_trajectories
from ..models.errors import InputError
from ..rendering import Camera, NoOpenGL
from .metrics import shown_runs
from .results import Results, checkpoint_file
from .settings import Row
from .tables import row_label


def film_study(
    results: Results, out: Path, on_frame: OnFrame = lambda *_: None, *, scene: str = "airport"
) -> bool:
    """Film the rows of a study of one task: the same episode, side by side.

    `metrics.shown_runs` says which seeds and which episode. A film that exists is replaced. Returns
    whether there is a film: without OpenGL there is none, and a line in the log says why.

    Raises:
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
    config = Film(height=400, camera=camera, fast=True, quality=27, scene=scene, vehicle=vehicle)
    fresh = out.with_name(f".fresh-{out.name}")
    fresh.unlink(missing_ok=True)
    headline = results.headline(rows[0])
    seeds, episode = shown_runs(results.runs, results.evaluations, headline)
    tracks = [_track(results, row, seeds[row.name], episode) for row in rows if row.name in seeds]
    try:
        film(fresh, tracks, config, on_frame)
    except NoOpenGL as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)
        return False
    fresh.replace(out)
    return True


def _track(results: Results, row: Row, seed: int, episode: int) -> FilmTrack:
    spec = results.specs[row.name]
    policy: Policy
    if row.controller:
        policy = CONTROLLERS[row.agent](spec)
    else:
        policy = load(checkpoint_file(results.folder, row, seed)).policy()
    drones = row.env.drones
    vehicle = row.env.vehicle
    config = EnvConfig.from_keywords(spec.env_id, vehicle=vehicle, drones=drones, **spec.options)
    flown = flown_trajectories(policy, config, [episode], results.study.evaluation, seed)
    several = not row.controller and results.study.seeds > 1
    name = row_label(row) + (f", seed {seed}" if several else "")
    return FilmTrack(name=name, trajectories=flown, drones=drones)
