"""The film of a comparison: what its agents fly, side by side."""

import logging
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np

from ..agents.checkpoints import load
from ..agents.pid import PID
from ..agents.policies import Policy
from ..envs import ElevationConfig, ElevationEnv
from ..rendering import NoOpenGL, World
from .evaluate import evaluation_seed
from .figures import agent_color, agent_label
from .filming import Film, OnFrame, Shot, film
from .flights import flown_tracks
from .metrics import final_per_run
from .records import read_config, read_evaluations, sort_agents
from .runs import config_env

__all__ = ["film_comparison"]

_SIZE: Final = (1280, 400)
_QUALITY: Final = 27
"""Small enough for a page that holds the film in itself."""


def film_comparison(
    folder: Path, out: Path, on_frame: OnFrame | None = None, *, world: World = "airport"
) -> bool:
    """Film what a comparison trained: each agent and the PID, the same episode side by side.

    Of an agent's seeds the middle one flies, by steady |E| in the final evaluation (of an even
    number the better of the two in the middle). Of the episodes of that evaluation they fly the one
    that starts furthest from its target. It is filmed without shadows: a few seconds where software
    draws.

    Args:
        folder: Where `rotorgram compare` wrote.
        out: The film; one that is there is replaced.
        on_frame: Told how far it is.
        world: Where.

    Returns:
        Whether there is a film. Without OpenGL there is none, and a line in the log says why.

    Raises:
        ValueError: The folder is not a comparison's.
        OSError: The film cannot be written.
    """
    width, height = _SIZE
    config = Film(
        width=width,
        height=height,
        camera="front",
        world=world,
        fast=True,
        quality=_QUALITY,
    )
    fresh = out.with_name(f".fresh-{out.name}")
    fresh.unlink(missing_ok=True)
    try:
        film(fresh, _shots(folder), config, on_frame)
    except NoOpenGL as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)
        return False
    fresh.replace(out)
    return True


def _shots(folder: Path) -> list[Shot]:
    env = config_env(read_config(folder))
    final = final_per_run(read_evaluations(folder))
    episode = _furthest_start(env, int(final["episodes"].max()))
    shots = []
    for agent in sort_agents(final["agent"]):
        runs = final[final["agent"] == agent].sort_values("steady_error", kind="stable")
        seed = int(runs["seed"].iloc[(len(runs) - 1) // 2])
        name = agent_label(agent)
        policy: Policy
        if agent == "pid":
            policy = PID(env)
        else:
            policy = load(folder / "checkpoints" / f"{agent}-seed{seed}.safetensors").policy()
            name += f", seed {seed}" if len(runs) > 1 else ""
        color = agent_color(agent, dark=True)
        shots.append(Shot(name=name, color=color, tracks=flown_tracks(policy, env, [episode])))
    return shots


def _furthest_start(config: ElevationConfig, episodes: int) -> int:
    """Of so many evaluation episodes the one with the largest |E| at its start."""
    with closing(ElevationEnv(**asdict(config))) as env:
        starts = [abs(env.reset(seed=evaluation_seed(k))[0][0]) for k in range(episodes)]
    return int(np.argmax(starts))
