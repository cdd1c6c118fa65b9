"""`rotorgram render`: flights as films and pictures."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from tyro.conf import Positional

from ..flights.palette import DARK_COLORS, agent_color, agent_label
from ..flights.recorded import recorded_trajectories
from ..flights.trajectories import Trajectory, flown_trajectories
from ..models.errors import expect
from ._flags import EnvFlags, check_count

_ALIKE: Final = ("pid", "geometric", "orca", "random")  # their words tell no two of them apart


@dataclass(frozen=True, kw_only=True)
class Render(EnvFlags):
    """Film flights: a policy's, or those of a journal; several side by side.

    Needs no display. Exit status 2 where there is no OpenGL.
    """

    what: Positional[tuple[str, ...]]
    """Checkpoint, folder of a training, pid, geometric, orca, random, or a journal (.mcap).
    Policies fly evaluation episodes without exploration."""
    out: Path
    """film.mp4, film.gif, picture.png, or a folder for pictures 0001.png and so on. It must not
    exist."""
    camera: Literal["chase", "front", "side", "top", "onboard"] = "chase"
    """Front and side stand still, the others follow."""
    episode: int = 0
    """The first episode, from 0: of an evaluation, or of those in the journal."""
    episodes: int = 1
    """Number of episodes."""
    size: str = "1280x720"
    """WIDTHxHEIGHT of the picture with all its panes, pixels."""
    fps: float = 25.0
    """Pictures per second."""
    speed: float = 1.0
    """Seconds of flight per second of film: 0.25 is slow motion."""
    at: float | None = None
    """With a .png: the time of the picture in the first episode, s. Default: its end."""
    world: str = "airport"
    """Surroundings of the drones in the picture; they change no flight:
    plain, airport, forest, warehouse or gates; the last three from a seed, as forest:3."""
    overlay: bool = True
    """Whether numbers and curves are on the picture. Of several flights the names always are."""
    fast: bool = False
    """Without shadows and smooth edges: several times as fast where software draws."""
    names: tuple[str, ...] = ()
    """Titles, one for each flight. Default: the policies."""
    session: int | None = None
    """With a journal: which session, from 1, as rotorgram replay counts. Default: the first that
    flew."""
    drone: int = 0
    """With a journal: which drone of the session, from 0."""

    def run(self) -> int:
        """Fly or read, draw, and say where."""
        from ..flights.filming import Film, FilmTrack, film
        from ..rendering.film import check_film
        from ..rendering.gl import offscreen_context
        from ._progress import frame_bar

        width, height = parse_size(self.size)
        config = Film(width=width, height=height, **self.settings(Film))
        check_film(self.out, width, height, self.fps)
        self._check()
        offscreen_context(16, 16).free()  # flying takes longer than finding no OpenGL
        found = [self._find(what) for what in self.what]
        names = self.names or _told_apart([name for _, name, *_ in found], self.what)
        colors = _colors([agent for agent, *_ in found])
        tracks = [
            FilmTrack(name=name, color=color, trajectories=flown, drones=drones)
            for name, color, (_, _, flown, drones) in zip(names, colors, found, strict=True)
        ]
        longest = max(track.trajectories[0].seconds for track in tracks)
        right, end = self.at is None or self.at <= longest, f"{longest:g} s, the flight's end"
        expect(right, "at", f"0 to {end}", f"{self.at or 0:g}")
        with frame_bar(self.out.name) as on_frame:
            frames = film(self.out, tracks, config, on_frame)
        pictures = "1 picture" if frames == 1 else f"{frames} pictures"
        print(f"film: {self.out} ({pictures} of {width}x{height})")
        return 0

    def _check(self) -> None:
        right, flights = self.at is None or self.out.suffix.lower() == ".png", len(self.what)
        expect(right, "at", "it with a picture, --out NAME.png", str(self.out))
        expect(self.what, "what", "a checkpoint, pid, geometric, random or a journal", "nothing")
        right = len(self.names) in (0, flights)
        expect(right, "names", f"one for each of {flights} flights", str(len(self.names)))
        expect(self.episode >= 0, "episode", "0 or more", str(self.episode))
        check_count("episodes", self.episodes)
        journals = [Path(words).suffix == ".mcap" for words in self.what]
        right = any(journals) or (self.session is None and not self.drone)
        expect(right, "session, drone", "them with a journal (.mcap)", "none")
        right = not (self.options and all(journals))
        expect(right, "env", "no options with a journal, which has its own")

    def _find(self, what: str) -> tuple[str, str, list[Trajectory], int]:
        """Agent, name, trajectories and drones of a world, of a policy or journal."""
        from ._env import chosen_drones, pilot_of

        episodes = range(self.episode, self.episode + self.episodes)
        path = Path(what)
        if path.suffix == ".mcap":
            recorded = recorded_trajectories(path, episodes, session=self.session, drone=self.drone)
            return path.stem, path.stem, recorded, 1
        checkpoint, policy, env = pilot_of(self, what)
        drones = chosen_drones(self, checkpoint)
        agent = checkpoint.algorithm if checkpoint else what
        flown = flown_trajectories(
            policy, *env, episodes, vehicle=self.vehicle, of="final", drones=drones
        )
        return agent, what if what == "random" else agent_label(agent), flown, drones


def parse_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT as a pair. Raises `InputError`."""
    match = re.fullmatch(r"([0-9]{2,4})x([0-9]{2,4})", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    right = min(width, height) >= 16 and max(width, height) <= 8192
    expect(right, "size", "WIDTHxHEIGHT of 16 to 8192 pixels each", repr(text))
    return width, height


def _told_apart(names: Sequence[str], what: Sequence[str]) -> list[str]:
    """The names; of those that are the same, what the user typed besides, then a number."""
    longer = [
        f"{name}, {Path(words).stem}" if names.count(name) > 1 and words not in _ALIKE else name
        for name, words in zip(names, what, strict=True)
    ]
    return [
        name if longer.count(name) == 1 else f"{name} {longer[: place + 1].count(name)}"
        for place, name in enumerate(longer)
    ]


def _colors(agents: Sequence[str]) -> list[str]:
    """Each agent's own; where that is taken, one that is free."""
    colors: list[str] = []
    for agent in agents:
        own = agent_color(agent, dark=True)
        free = [color for color in DARK_COLORS if color not in colors]
        colors.append(own if own not in colors or not free else free[-1])
    return colors
