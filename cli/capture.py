"""`rotorgram capture`: labelled pictures of recorded flights, as a data set."""

from pathlib import Path

from tyro.conf import Positional

from ..flights.executors import WorkersConfig
from ..flights.viewpoints import CaptureConfig
from ._flags import Command, Files


class Capture(Command, CaptureConfig, WorkersConfig):
    """Take pictures of recorded flights, with depth, objects, boxes and poses, as a data set.

    Interrupted by Ctrl-C, or by a disk that is full, it keeps the frames that it has,
    without coco.json. Exit status 2 where there is no OpenGL.
    """

    journals: Positional[Files]
    """MCAP files that --record wrote."""
    out: Path
    """Folder to write to. It must not exist."""

    def run(self) -> None:
        """Take them; say where and how many."""
        from ..flights.capture import capture
        from ..models.errors import require
        from ..rendering.gl import offscreen_context
        from ._progress import bars

        require("PIL", "render", "labelled pictures")
        config = CaptureConfig(**self.settings(CaptureConfig))
        workers = WorkersConfig(**self.settings(WorkersConfig))
        offscreen_context(16, 16).free()
        with bars() as progress:
            frames = capture(self.journals, self.out, config, workers, progress)
        print(f"{self.out}: {frames} frames of {len(config.views())} pictures a drone")
