"""`rotorgram compare`: the paper's comparison over UDP, or rows of TOML files."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..agents import CONTROLLERS
from ..envs.registry import env_spec
from ..models import InputError
from ..training.settings import Kind, Row, Study, short_name
from ._flags import DEFAULT_ENV
from ._study import StudyFlags


class Compare(StudyFlags):
    """Train several agents over the same seeds, and report: VPG, A2C and SB3's A2C, or your files.

    Without files it is the paper's comparison: each agent flies over its own pair of sockets, or
    with --no-udp in this process.
    """

    kinds = ("paper", "compare")

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="FILE")]] = ()
    """TOML files: of one row (agent, env, set, …), named by its file, or of [[row]] tables. They
    train in this process, unless --udp is given."""
    agents: tuple[str, ...] = ("vpg", "a2c", "sb3-a2c")
    """Algorithms to train without files, and controllers: geometric, raptor, FILE.py:CLASS. The PID
    flies beside them where it can."""
    udp: bool = True
    """Whether each of them trains over UDP, with a simulator process of its own. The numbers are
    the same without, but for the times."""

    def study(self) -> Study:
        """The study of the files, or of the agents."""
        return self._of_files() if self.files else self._of_agents()

    def _of_files(self) -> Study:
        studies = [Study.from_toml(path) for path in self.files]
        rows = [self.changed(row) for study in studies for row in study.rows]
        settings = self.given_of_study()
        if "udp" in self.given:
            settings["wire"] = self.udp
        shared = vars(studies[0]).keys() - {"rows", "kind"}
        for name in sorted(shared):
            values = {getattr(study, name): None for study in studies}
            if len(values) > 1 and name not in settings:
                raise InputError(
                    f"{name}: expected the same in all files, got {' and '.join(map(str, values))}"
                )
        return replace(studies[0], rows=tuple(rows), kind="compare", **settings)

    def _of_agents(self) -> Study:
        env = self.env_config(backend=None)
        changes = self.changes()
        if not self.agents:
            raise InputError("agents: expected at least one, got none")
        paper = env.env_id == DEFAULT_ENV
        rows = [self.new_row(agent, short_name(agent), changes, env) for agent in self.agents]
        if "pid" not in self.agents:
            with suppress(InputError):  # it flies one task
                CONTROLLERS["pid"](env_spec(env))
                rows.append(Row(agent="pid", name="pid", env=env))
        kind: Kind = "paper" if paper else "compare"
        return Study(
            rows=tuple(rows), kind=kind, wire=self.udp, keep_steps=paper, **self.given_of_study()
        )
