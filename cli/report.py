"""`rotorgram report`: draw the results in a folder."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ._flags import Command


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Draw a comparison's figures, table and report again, a sweep's table, or a board's page."""

    folder: Positional[Path]
    """Folder that `rotorgram compare`, `rotorgram sweep` or `rotorgram benchmark` wrote."""
    page: Path | None = None
    """Page of a board to write. Default: baselines.md in the folder."""
    film: bool = True
    """Whether a comparison's agents are filmed, if there is no film yet, where there is OpenGL."""

    def run(self) -> int:
        """Write figures and report from the files, and print the table."""
        from ..training.results import content_of, read_config
        from ._runs import report_board, report_comparison, report_sweep

        if "board" in content_of(self.folder):
            report_board(self.folder, self.page)
        elif "sweep" in read_config(self.folder):
            report_sweep(self.folder)
        else:
            report_comparison(self.folder, film=self.film)
        return 0
