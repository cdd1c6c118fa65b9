"""`rotorgram report`: draw the results in a folder."""

from pathlib import Path

from tyro.conf import Positional

from ._flags import Command


class Report(Command):
    """Draw figures, tables and page of a study again from its files."""

    folder: Positional[Path]
    """Folder that `rotorgram compare`, `sweep` or `benchmark` wrote."""
    film: bool = True
    """Whether the agents are filmed, if there is no film yet, where there is OpenGL."""

    def run(self) -> None:
        """Write figures and report from the files, and print the tables."""
        from ._study import report

        report(self.folder, self.film)
