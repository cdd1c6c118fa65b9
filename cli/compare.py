"""`rotorgram compare`: train several agents over the same seeds and steps, and report."""

from dataclasses import dataclass, replace

from ..agents import AlgorithmName
from ..flights.executors import WorkersConfig
from ..models.errors import expect, require
from ..training.settings import CompareConfig
from ._flags import refuse_settings
from ._runs import RESUMED, RunsFlags, command_line, report_comparison, runs_folder


@dataclass(frozen=True, kw_only=True)
class Compare(RunsFlags):
    """Train VPG, A2C and SB3's A2C over the same seeds and steps, and report.

    Every run has a simulator process and a socket pair of its own. Writes one folder: results,
    checkpoints, figures and report.html.
    """

    agents: tuple[AlgorithmName, ...] = ("vpg", "a2c", "sb3-a2c")
    """Algorithms to train; the PID, or ORCA where a world has several drones, flies beside them."""
    seeds: int = 5
    """Number of seeds, the same for every agent. The paper's claims are decided from 30 on."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    film: bool = True
    """Whether the agents are filmed side by side for the report, where there is OpenGL."""

    def run(self) -> int:
        """Compare, report, print the table."""
        for module in ("matplotlib", "jinja2"):  # before hours of training
            require(module, "report", "a comparison's report")
        from ..training.compare import PARTS, compare, read_compare_config

        if self.resume:
            refuse_settings(self, self.resume, free=("film", *RESUMED))
            config = read_compare_config(self.resume)
            config = replace(config, **self.settings(WorkersConfig))
            advice = f"draw its report with: rotorgram report {self.resume}"
            wanted = f"an interrupted comparison, {self.resume} is finished; {advice}"
            expect((self.resume / PARTS).is_dir(), "resume", wanted)
        else:
            config = CompareConfig(**self.settings(CompareConfig))
        with runs_folder("compare", self) as (folder, progress):
            compare(config, folder, command_line(), progress)
        report_comparison(folder, film=self.film)
        return 0
