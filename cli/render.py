"""`rotorgram render`: flights as films and pictures."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs import ElevationConfig
from ..experiments.figures import agent_color, agent_label
from ..experiments.filming import Film, Shot, film
from ..experiments.flights import Track, flown_tracks, recorded_tracks
from ..rendering.film import check_film
from ..rendering.gl import offscreen_context
from .inputs import CHECKPOINT, load_policy
from .progress import bars

if TYPE_CHECKING:
    from .looking import Render

__all__ = ["parse_size", "render"]


def render(command: "Render") -> int:
    """Film what the command names."""
    width, height = parse_size(command.size)
    config = Film(
        width=width,
        height=height,
        camera=command.camera,
        fps=command.fps,
        speed=command.speed,
        world=command.world,
        overlay=command.overlay,
        at=command.at,
        fast=command.fast,
    )
    check_film(command.out, width, height, command.fps)
    if command.at is not None and command.out.suffix.lower() != ".png":
        raise ValueError(f"at: expected it with a picture, --out NAME.png, got {command.out}")
    offscreen_context(16, 16).free()  # to fly takes longer than to say that there is no OpenGL
    shots = _shots(command)
    longest = max(shot.tracks[0].seconds for shot in shots)
    if command.at is not None and command.at > longest:
        raise ValueError(f"at: expected 0 to {longest:g} s, the flight's end, got {command.at:g}")
    with bars() as progress:
        frames = film(
            command.out,
            shots,
            config,
            lambda done, total: progress(
                command.out.name, done, total, "done" if done == total else "frames"
            ),
        )
    pictures = "1 picture" if frames == 1 else f"{frames} pictures"
    print(f"film: {command.out} ({pictures} of {width}x{height})")
    return 0


def parse_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT as a pair. Raises `ValueError`."""
    match = re.fullmatch(r"([0-9]{2,4})x([0-9]{2,4})", text)
    if not match or not all(16 <= int(pixels) <= 8192 for pixels in match.groups()):
        raise ValueError(f"size: expected WIDTHxHEIGHT of 16 to 8192 pixels each, got {text!r}")
    return int(match[1]), int(match[2])


def _shots(command: "Render") -> list[Shot]:
    if not command.what:
        raise ValueError("what: expected a checkpoint, pid, random or a journal, got nothing")
    if command.names and len(command.names) != len(command.what):
        raise ValueError(
            f"names: expected one for each of {len(command.what)} flights, got {len(command.names)}"
        )
    if command.episode < 0:
        raise ValueError(f"episode: expected 0 or more, got {command.episode}")
    if command.episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {command.episodes}")
    journals = [Path(words).suffix == ".mcap" for words in command.what]
    if not any(journals) and (command.session is not None or command.drone):
        raise ValueError("session, drone: expected them with a journal (.mcap), got none")
    env = command.env.checked()
    if env != ElevationConfig() and all(journals):
        raise ValueError("env: expected no options with a journal, which has its own")
    found = [_find(what, command, env) for what in command.what]
    names = command.names or _told_apart([name for _, name, _ in found], command.what)
    colors = _colors([agent for agent, _, _ in found])
    return [
        Shot(name=name, color=color, tracks=tracks)
        for name, color, (_, _, tracks) in zip(names, colors, found, strict=True)
    ]


def _find(what: str, command: "Render", env: ElevationConfig) -> tuple[str, str, list[Track]]:
    """Agent, name and flights of what the user named."""
    episodes = range(command.episode, command.episode + command.episodes)
    path = Path(what)
    if path.suffix == ".mcap":
        tracks = recorded_tracks(path, episodes, session=command.session, drone=command.drone)
        return path.stem, path.stem, tracks
    if what == "random":
        return what, what, flown_tracks(None, env, episodes)
    policy, config = load_policy(what, env)
    agent = "pid" if what == "pid" else _algorithm(path)
    return agent, agent_label(agent), flown_tracks(policy, config, episodes)


def _algorithm(path: Path) -> str:
    from ..agents.checkpoints import load

    return load(path / CHECKPOINT if path.is_dir() else path).algorithm


def _told_apart(names: Sequence[str], what: Sequence[str]) -> list[str]:
    """The names; of those that are the same, what the user typed besides."""
    return [
        name if names.count(name) == 1 else f"{name}, {Path(words).stem}"
        for name, words in zip(names, what, strict=True)
    ]


def _colors(agents: Sequence[str]) -> list[str]:
    """Each agent's own; where that is taken, one that is free."""
    colors: list[str] = []
    spare = [agent_color(name, dark=True) for name in ("vpg", "a2c", "sb3-a2c", "pid")]
    spare += ["#E29AC3", "#F0B840", "#7CC8F2", "#C9938A"]
    for agent in agents:
        own = agent_color(agent, dark=True)
        free = [color for color in spare if color not in colors]
        colors.append(own if own not in colors or not free else free[-1])
    return colors
