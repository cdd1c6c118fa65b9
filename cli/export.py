"""`rotorgram export`: a trained policy as a file, or an app, that flies without rotorgram."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..models.files import check_new_file, write_whole
from ._flags import ModuleFlag


class Export(ModuleFlag):
    """Write a trained policy as a file, or an app of a firmware, that flies without rotorgram."""

    policy: Positional[Annotated[str, arg(metavar="CHECKPOINT")]]
    """Checkpoint, folder of a training, or `universal`."""
    to: Literal["onnx", "c", "crazyflie"]
    """Kind of file; or a folder that builds to the Crazyflie's firmware with the policy in it."""
    vehicle: str | None = None
    """Craft that a policy of the level wrench flies: a name or a file. Default: that of its
    training."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """File or folder to write, a new one. Default: policy.onnx, rotorgram_policy.h or
    crazyflie_policy in the working directory."""

    def run(self) -> None:
        """Write it."""
        from ..agents.export import TARGETS, export, on_vehicle
        from ..agents.export.crazyflie import app
        from ..flights.folders import new_folder
        from ._env import UNIVERSAL, trained

        checkpoint = trained(self.policy, UNIVERSAL.stem)
        if self.vehicle is not None:
            checkpoint = on_vehicle(checkpoint, self.vehicle)
        if self.to == "crazyflie":
            files = app(checkpoint)
            folder = new_folder(self.out or Path("crazyflie_policy"), "")
            for name, text in files.items():
                write_whole(folder / name, text)
            print(f"app: {folder} ({len(files)} files)")
            return
        out = self.out or Path(TARGETS[self.to])
        check_new_file(out, out.suffix)
        content = export(checkpoint, self.to)
        write_whole(out, content)
        print(f"policy: {out} ({len(content):,} bytes)")
