"""`rotorgram render`: flights as films and pictures."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional

from ..agents import is_controller
from ..flights.palette import agent_label
from ..flights.recorded import recorded_trajectories
from ..flights.trajectories import flown_trajectories
from ..models import InputError
from ..models.fields import NonNegativeInt
from ..scenes.returns import RANGES
from ._flags import Count, EnvFlags, OneOrMore, Words

if TYPE_CHECKING:
    from ..flights.filming import FilmTrack


class Render(EnvFlags):
    """Film flights: a policy's, or those of a journal; several side by side.

    Needs no display. Exit status 2 where there is no OpenGL.
    """

    what: Positional[Annotated[Words, OneOrMore()]]
    """Checkpoint, folder of a training, universal, pid, geometric, raptor, FILE.py:CLASS of a
    controller, random, or a journal (.mcap). Policies fly evaluation episodes without
    exploration."""
    out: Path
    """film.mp4, picture.png, or a folder for pictures 0001.png and so on. It must not
    exist."""
    camera: Literal["chase", "front", "side", "top", "onboard"] = "chase"
    """Front and side stand still, the others follow."""
    episode: NonNegativeInt = 0
    """The first episode, from 0: of an evaluation, or of those in the journal."""
    episodes: Count = 1
    """Number of episodes."""
    size: str = "1280x720"
    """WIDTHxHEIGHT of the picture with all its panes, pixels."""
    fps: float = 25.0
    """Pictures per second."""
    speed: float = 1.0
    """Seconds of flight per second of film: 0.25 is slow motion."""
    at: float | None = None
    """With a .png: the time of the picture in the first episode, s. Default: its end."""
    overlay: bool = True
    """Whether time and numbers are on the picture. Of several flights the names of their files
    always are."""
    rays: bool = True
    """Whether readings of sensors with rays are drawn: points in the scene, depth beside it."""
    fast: bool = False
    """Without shadows and smooth edges: several times as fast where software draws."""
    session: int | None = None
    """With a journal: which session, from 1, as rotorgram replay counts. Default: the first that
    flew."""
    drone: int = 0
    """With a journal: which drone of the session, from 0."""

    def run(self) -> None:
        """Fly or read, draw, and say where."""
        from ..flights.filming import Film, film
        from ..models.cameras import read_size
        from ..rendering.film import check_film
        from ..rendering.gl import offscreen_context
        from ..udp.journal.reader import count_of
        from ._progress import bars

        width, height = read_size("size", self.size, 16, 8192)
        settings = self.settings(Film) | {"scene": self.shown_scene}
        config = Film(width=width, height=height, **settings)
        check_film(self.out, width, height, self.fps)
        self._check()
        offscreen_context(16, 16).free()  # flying takes longer than finding no OpenGL
        found = [self._find(what) for what in self.what]
        vehicles = [vehicle for _, vehicle in found if vehicle]
        config = replace(config, vehicle=next(iter(vehicles), None))
        tracks = [track for track, _ in found]
        longest = max(track.trajectories[0].seconds for track in tracks)
        if self.at is not None and self.at > longest:
            raise InputError(f"at: expected 0 to {longest:g} s, the flight's end, got {self.at:g}")
        with bars() as progress:
            frames = film(self.out, tracks, config, partial(progress, self.out.name))
        print(f"film: {self.out} ({count_of(frames, 'picture')} of {width}x{height})")

    def _check(self) -> None:
        """Refuse flags that contradict each other."""
        if self.at is not None and self.out.suffix.lower() != ".png":
            raise InputError(f"at: expected it with a picture, --out NAME.png, got {self.out}")
        journals = [Path(words).suffix == ".mcap" for words in self.what]
        if not any(journals) and (self.session is not None or self.drone):
            raise InputError("session, drone: expected them with a journal (.mcap), got none")
        if self.options.keys() - {"scene"} and all(journals):
            raise InputError("env: expected no options with a journal, which has its own")

    def _find(self, what: str) -> "tuple[FilmTrack, str | None]":
        """Flights of a policy or a journal, and the vehicle."""
        from ..flights.filming import FilmTrack
        from ._env import pilot_of

        episodes = range(self.episode, self.episode + self.episodes)
        rays = RANGES if self.rays else ()
        path = Path(what)
        name = what
        if not is_controller(what):
            name = path.stem if path.suffix in (".mcap", ".safetensors") else path.name
        name = agent_label(name)
        if path.suffix == ".mcap":
            recorded = recorded_trajectories(
                path, episodes, session=self.session, drone=self.drone, observations=rays
            )
            return FilmTrack(name=name, trajectories=recorded), self.vehicle
        command, policy = pilot_of(self, what)
        config = command.env_config()
        flown = flown_trajectories(policy, config, episodes, "final", observations=rays)
        track = FilmTrack(name=name, trajectories=flown, drones=command.drones)
        return track, command.vehicle
