"""`rotorgram export`: a trained policy as a file that flies without rotorgram."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..models.files import check_new_file, write_whole
from ._flags import ModuleFlag


class Export(ModuleFlag):
    """Write a trained policy as one file that flies without rotorgram."""

    policy: Positional[Annotated[str, arg(metavar="CHECKPOINT")]]
    """Checkpoint, or folder of a training."""
    to: Literal["onnx", "c"]
    """Kind of file."""
    out: Path | None = None
    """File to write, a new one. Default: policy.onnx or rotorgram_policy.h in the working
    directory."""

    def run(self) -> None:
        """Write it."""
        from ..agents.export import TARGETS, export
        from ._env import trained

        out = self.out or Path(TARGETS[self.to])
        check_new_file(out, out.suffix)
        content = export(trained(self.policy), self.to)
        write_whole(out, content)
        print(f"policy: {out} ({len(content):,} bytes)")
