"""`rotorgram plot`: flights over time, laid over each other, as a figure."""

from pathlib import Path

from tyro.conf import Positional

from ._flags import Count, Files, ModuleFlag


class Plot(ModuleFlag):
    """Draw what flights have over time: position, attitude, rates, rotors, battery, wind, metrics.

    Flights of several journals are laid over each other. A cross is the end of a flight that was
    terminated.
    """

    flights: Positional[Files]
    """MCAP files that --record wrote. Their names are those in the legend."""
    out: Path | None = None
    """PNG, PDF or SVG file to write. Default: the first journal's name with .png."""
    plan: bool = False
    """Draw the paths from above instead, among the solids of their layout."""
    session: int | None = None
    """Session of each journal, from 1, as rotorgram replay counts. Default: the first that flew."""
    drone: int = 0
    """Drone of each session, from 0."""
    episode: int = 0
    """The first episode, from 0."""
    episodes: Count = 1
    """Number of episodes of each journal."""

    def run(self) -> None:
        """Draw it; say where."""
        from ..flights.plots import FORMATS, plot_flights
        from ..flights.recorded import recorded_trajectories
        from ..models.files import check_new_file

        out = self.out or Path(f"{self.flights[0].stem}.png")
        check_new_file(out, *FORMATS)
        found = {}
        for path in self.flights:
            numbers = range(self.episode, self.episode + self.episodes)
            for flight in recorded_trajectories(
                path, numbers, session=self.session, drone=self.drone
            ):
                name = path.stem if self.episodes == 1 else f"{path.stem}, episode {flight.episode}"
                while name in found:
                    name += " (again)"
                found[name] = flight
        plot_flights(found, out, plan=self.plan)
        print(f"{out}: {len(found)} flights" if len(found) > 1 else out)
