"""Commands to look at flights: live, and as films or pictures."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from .base import Command, EnvOptions

__all__ = ["Render", "View"]


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Look at flights, in real time or slower: in a window, or on a page for browsers.

    Keys: space pauses, the arrow to the right takes one step, - and + change the speed.
    """

    what: Positional[str]
    """Checkpoint, folder of a training, pid, random, or a journal (.mcap)."""
    web: bool = False
    """Serve a page for browsers, for a machine without a display."""
    port: int = 8080
    """TCP port of the page, on this machine's loopback; 0 takes the first free one."""
    world: Literal["airport", "plain"] = "airport"
    """What is around the drone."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    episodes: int | None = None
    """End after so many episodes. Default: go on until it is closed."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with."""

    def run(self) -> int:
        """Fly and show, episode after episode."""
        from .view import view

        return view(self)


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Film flights: a policy's, or those of a journal; several side by side.

    Needs no display. Exit status 2 where there is no OpenGL.
    """

    what: Positional[tuple[str, ...]]
    """Checkpoint, folder of a training, pid, random, or a journal (.mcap). Policies fly evaluation
    episodes without exploration."""
    out: Path
    """film.mp4, film.gif, picture.png, or a folder for pictures 0001.png and so on. It must not
    exist."""
    camera: Literal["chase", "front", "side", "top", "onboard"] = "chase"
    """From where. Front and side stand still, the others follow."""
    episode: int = 0
    """The first episode, from 0: of an evaluation, or of those in the journal."""
    episodes: int = 1
    """How many."""
    size: str = "1280x720"
    """WIDTHxHEIGHT of the picture with all its panes, pixels."""
    fps: float = 25.0
    """Pictures per second."""
    speed: float = 1.0
    """Seconds of flight per second of film: 0.25 is slow motion."""
    at: float | None = None
    """With a .png: the time of the picture in the first episode, s. Default: its end."""
    world: Literal["airport", "plain"] = "airport"
    """Where it flies, to look at; what is flown is the same."""
    overlay: bool = True
    """Whether numbers and error curves are on the picture. Of several flights the names always
    are."""
    fast: bool = False
    """Without shadows and smooth edges: several times as fast where software draws."""
    names: tuple[str, ...] = ()
    """Titles, once for each flight. Default: what it is."""
    session: int | None = None
    """With a journal: which session, from 1, as rotorgram replay counts. Default: the first that
    flew."""
    drone: int = 0
    """With a journal: which drone of the session, from 0."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with. No use to a journal."""

    def run(self) -> int:
        """Fly or read, draw, and say where."""
        from .render import render

        return render(self)
