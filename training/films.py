"""The film of a comparison: one flight of each agent, side by side."""

import logging
from pathlib import Path

from ..agents import CONTROLLERS
from ..agents.checkpoints import load
from ..agents.policies import Policy
from ..flights.filming import Film, OnFrame, Shot, film
from ..flights.palette import agent_color
from ..flights.trajectories import flown_trajectories
from ..rendering import Camera, NoOpenGL
from .metrics import run_label, shown_runs
from .results import Results, read_results


def film_comparison(
    folder: Path, out: Path, on_frame: OnFrame = lambda *_: None, *, world: str = "airport"
) -> bool:
    """Film a comparison: each agent and the controller, the same episode side by side.

    `metrics.shown_runs` says which seeds and which episode.

    The folder is one that `rotorgram compare` wrote; a film that exists is replaced. Returns
    whether there is a film: without OpenGL there is none, and a line in the log says why.

    Raises:
        InputError: The folder is not a comparison's.
        OSError: The film cannot be written.
    """
    results = read_results(folder)
    vehicle = results.config["vehicle"]
    # Small enough for a page that holds the film in itself.
    camera: Camera = "top" if len(results.spec.agents) > 1 else "front"  # no craft hides another
    config = Film(height=400, camera=camera, fast=True, quality=27, world=world, vehicle=vehicle)
    fresh = out.with_name(f".fresh-{out.name}")
    fresh.unlink(missing_ok=True)
    try:
        film(fresh, _comparison_shots(folder, results), config, on_frame)
    except NoOpenGL as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)
        return False
    fresh.replace(out)
    return True


def _comparison_shots(folder: Path, results: Results) -> list[Shot]:
    spec, vehicle = results.spec, results.config["vehicle"]
    seeds, episode = shown_runs(results.evaluations, results.headline)
    shots, drones = [], len(spec.agents)
    for agent, seed in seeds.items():
        name = run_label(results.evaluations, agent, seed)
        file = folder / "checkpoints" / f"{agent}-seed{seed}.safetensors"
        controller = CONTROLLERS.get(agent)
        policy: Policy = controller(spec) if controller else load(file).policy()
        flown = flown_trajectories(
            policy, spec.env_id, spec.options, [episode],
            vehicle=vehicle, of="final", drones=drones,
        )  # fmt: skip
        color = agent_color(agent, dark=True)
        shots.append(Shot(name=name, color=color, trajectories=flown, drones=drones))
    return shots
