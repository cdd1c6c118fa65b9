"""`rotorgram capture`: labelled pictures of drones, as a data set."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ..flights.executors import WorkersConfig
from ._flags import Command


@dataclass(frozen=True, kw_only=True)
class Capture(Command, WorkersConfig):
    """Take the pictures of a plan, with depth, objects, boxes and poses, and write a data set.

    Interrupted by Ctrl-C, or by a disk that is full, it keeps what it has: the same line again goes
    on. Exit status 2 where there is no OpenGL.
    """

    plan: Positional[Path]
    """TOML file: cameras, scene, where to take pictures from. docs/capture.md has its fields."""
    out: Path
    """Folder to write to: a new one, or one of the same plan to go on with."""

    def run(self) -> int:
        """Take them; say where and how many."""
        from ..flights.capture import capture
        from ..flights.viewpoints import Plan
        from ..models.errors import InputError
        from ..rendering.gl import offscreen_context
        from ._progress import bars

        if not self.out.name:
            raise InputError(f"out: expected the name of a folder, got '{self.out}'")
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"out: expected a folder, or a new name, got the file {self.out}")
        plan = Plan.read(self.plan)
        config = WorkersConfig(**self.settings(WorkersConfig))
        offscreen_context(16, 16).free()
        self.out.mkdir(parents=True, exist_ok=True)
        with bars() as progress:
            frames = capture(plan, self.out, config, progress)
        print(f"{self.out}: {frames} frames of {len(plan.views())} pictures a drone")
        return 0
