"""`rotorgram export`: a trained policy as a file, or an app, that flies without rotorgram."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from ..models.files import check_new_file, write_whole
from ._flags import ModuleFlag

if TYPE_CHECKING:
    from ..agents import Checkpoint


class Export(ModuleFlag):
    """Write a trained policy as one file that flies without rotorgram, or as an app of a
    firmware.
    """

    policy: Positional[Annotated[str, arg(metavar="CHECKPOINT")]]
    """Checkpoint, or folder of a training."""
    to: Literal["onnx", "c", "crazyflie"]
    """Kind of file; or a folder that builds to the Crazyflie's firmware with the policy in it."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """File or folder to write, a new one. Default: policy.onnx, rotorgram_policy.h or
    crazyflie_policy in the working directory."""

    def run(self) -> None:
        """Write it."""
        from ..agents.export import TARGETS, export
        from ._env import trained

        checkpoint = trained(self.policy)
        if self.to == "crazyflie":
            _write_app(checkpoint, self.out)
            return
        out = self.out or Path(TARGETS[self.to])
        check_new_file(out, out.suffix)
        content = export(checkpoint, self.to)
        write_whole(out, content)
        print(f"policy: {out} ({len(content):,} bytes)")


def _write_app(checkpoint: "Checkpoint", out: Path | None) -> None:
    from ..agents.export.crazyflie import app
    from ..flights.folders import new_folder

    files = app(checkpoint)
    folder = new_folder(out or Path("crazyflie_policy"), "")
    for name, content in files.items():
        write_whole(folder / name, content)
    print(f"app: {folder} ({len(files)} files)")
