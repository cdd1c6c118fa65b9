"""`rotorgram replay`: contents of a journal, and whether it simulates to the same bits."""

from pathlib import Path

from tyro.conf import Positional

from ..models import Backend
from ._flags import ModuleFlag


class Replay(ModuleFlag):
    """Summarize a journal, and simulate it again."""

    file: Positional[Path]
    """MCAP file that --record wrote; after a crash it is read up to where it was cut."""
    verify: bool = False
    """Simulate every session again and compare every bit; exit status 1 if one differs, or the file
    is damaged."""
    vehicle: str | None = None
    """TOML or MJCF file that was flown, or its name. Default: the paper's quadcopter."""
    backend: Backend | None = None
    """What stepped the drones. Default: what the journal says; an agent's journal does not know it,
    and mujoco is taken."""

    def run(self) -> int:
        """Print the summary and the verdict."""
        from ..udp.journal.reader import Summary
        from ..udp.journal.replay import Verification

        print(Summary(self.file))
        if not self.verify:
            return 0
        verdict = Verification(self.file, vehicle=self.vehicle, backend=self.backend)
        print(verdict)
        return 0 if verdict.identical and not verdict.ending.startswith("damaged") else 1
