"""`rotorgram log`: a flight's numbers over time, as CSV."""

from pathlib import Path

from tyro.conf import Positional

from ._flags import Command


class Log(Command):
    """Write the telemetry, actions and rewards of a journal as CSV, the time first.

    z points up, the head has the units, which are SI; a row is a control step of one drone.
    """

    flight: Positional[Path]
    """MCAP file that --record wrote."""
    out: Path | None = None
    """File to write. Default: the journal's name with .csv, in this folder."""
    session: int | None = None
    """Session of the journal, from 1, as rotorgram replay counts. Default: the first that flew."""
    drone: int | None = None
    """Drone of the session, from 0. Default: all."""
    episode: int | None = None
    """Episode of each drone, from 0. Default: all."""

    def run(self) -> None:
        """Write it; say where."""
        from ..flights.recorded import recorded_trajectories
        from ..flights.signals import write_csv
        from ..models.files import check_new_file
        from ..udp.journal.reader import count_of

        out = self.out or Path(f"{self.flight.stem}.csv")
        check_new_file(out, ".csv")
        chosen = None if self.episode is None else [self.episode]
        flights = recorded_trajectories(self.flight, chosen, session=self.session, drone=self.drone)
        rows = write_csv(flights, out)
        print(f"{out}: {count_of(len(flights), 'episode')}, {count_of(rows, 'row')}")
