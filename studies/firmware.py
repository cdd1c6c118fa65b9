"""Policies in the Crazyflie's firmware: size for the craft, and flights of its program (SITL).

`python studies/firmware.py --firmware FOLDER --sitl FOLDER` trains a policy for each seed, exports
it with `--to crazyflie`, builds `cf2.bin` without and with it, counts the instructions of a control
period by qemu-arm, builds the program with it, and flies that by `rotorgram fly crazyflie`. It
writes `docs/results/firmware.json`, which `docs/firmware.md` shows.

`--firmware` is bitcraze/crazyflie-firmware with its submodules. `--sitl` is a lock-step SITL that
compiles `src/modules/src/controller/controller_rotorgram.c` as its out-of-tree controller, already
configured: `make cf2` in `sitl_make/build` builds it. It needs gcc-arm-none-eabi,
libnewlib-arm-none-eabi and qemu-user, and takes ten minutes.
"""

import re
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from measuring import RESULTS, options, write

TASK: Final = ("--vehicle", "crazyflie2", "--env", "rotorgram/Hover-v0")
LAG: Final = ("--effects", "motor_lag")
TRAIN: Final = ("train", "ppo", "--preset", "tuned", *TASK, "--env-steps", "1000000")
FLY: Final = ("fly", "crazyflie", "--mode", "policy", *TASK, *LAG)
TRIES: Final = 20
STUB: Final = Path(__file__).parents[1] / "tests" / "data" / "crazyflie_stub"
ARM: Final = ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16")
FREE: Final = ("-mfloat-abi=hard", "-Os", "-fno-math-errno", "-ffreestanding", "-nostartfiles")
COUNTED: Final = """
#include "controller.h"
#include "rotorgram_crazyflie.h"
static control_t control;
static const state_t state = {.attitudeQuaternion = {0, 0, 0, 1}};
static const setpoint_t setpoint = {
    .position = {1, 2, 3}, .mode = {modeAbs, modeAbs, modeAbs, modeAbs}};
static const sensorData_t sensors;
void _start(void)
{
    controllerOutOfTreeInit();
    for (int i = 0; i <= ACTIONS * ROTORGRAM_CALLS; i++)
        controllerOutOfTree(&control, &setpoint, &sensors, &state, 0);
    __asm volatile("mov r7, #1\\n mov r0, #0\\n svc 0");
}
"""


def said(*words: object, cwd: Path | None = None) -> str:
    """What a command prints."""
    command = [str(word) for word in words]
    return subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True).stdout


def tried(*words: object) -> str:
    """The same of a command that may fail: this program may hang as it boots."""
    for _ in range(TRIES):
        with suppress(subprocess.CalledProcessError):
            return said(*words)
    raise SystemExit(f"failed {TRIES} times: {' '.join(map(str, words))}")


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, text
    return float(found[1])


def built(app: Path, firmware: Path) -> dict[str, float]:
    """Bytes of the image and the report of an app."""
    base = f"CRAZYFLIE_BASE={firmware}"
    said("make", base, "cf2_defconfig", cwd=app)
    said("make", "-j2", base, cwd=app)
    report = said("make", base, "report", cwd=app)
    return {
        "image, bytes": (app / "build" / "cf2.bin").stat().st_size,
        "controller, bytes": number(r"\n +([0-9]+)", report),
        "stack at most, bytes": number(r"stack: at most ([0-9]+)", report),
        "instructions": number(r"instructions: ([0-9]+)", report),
    }


def instructions(app: Path, folder: Path) -> int:
    """Of one control period, by qemu-arm: those of two less those of one."""
    for file in (*STUB.glob("*.h"), *app.glob("rotorgram_*.[hc]")):
        shutil.copy(file, folder)
    (folder / "start.c").write_text(COUNTED)
    counts = []
    for actions in (1, 2):
        files = ("-o", "counted", "start.c", "rotorgram_controller.c", "-lm")
        said(*ARM, *FREE, f"-DACTIONS={actions}", *files, cwd=folder)
        said("qemu-arm", "-singlestep", "-d", "nochain,exec", "-D", "log", "./counted", cwd=folder)
        counts.append((folder / "log").read_text().count("Trace"))
    return counts[1] - counts[0]


def exported(folder: Path, *words: object) -> tuple[Path, Path]:
    """Folders of a training and of the app of its policy."""
    run = folder / f"run{len(list(folder.iterdir()))}"
    app = run.with_suffix(".app")
    said("rotorgram", *TRAIN, *words, "--out", run)
    said("rotorgram", "export", run, "--to", "crazyflie", "-o", app)
    return run, app


def flown(run: Path, app: Path, sitl: Path, episodes: int) -> dict[str, object]:
    """Errors in the simulator, from tilted starts, and in the firmware, from level ones."""
    controllers = sitl / "src" / "modules" / "src" / "controller"
    shutil.copy(app / "rotorgram_controller.c", controllers / "controller_rotorgram.c")
    for header in app.glob("*.h"):
        shutil.copy(header, controllers)
    build = sitl / "sitl_make" / "build"
    said("make", "cf2", cwd=build)
    ours = said("rotorgram", "evaluate", run, "--episodes", 20)
    theirs = tried("rotorgram", *FLY, "--program", build / "cf2", "--episodes", episodes)
    settled = re.search(r"e to 0.1 m: ([0-9.]+) s \(([0-9]+) of", theirs)
    return {
        "simulator, m": number(r"steady +e ([0-9.]+) m", ours),
        "simulator, crashed of 20": number(r"episodes +20, ([0-9]+) terminated", ours),
        "firmware, m": number(r"steady +e ([0-9.]+) m", theirs),
        "firmware, s to 0.1 m": float(settled[1]) if settled else None,
        "firmware, crashed": number(r"episodes +[0-9]+, ([0-9]+) terminated", theirs),
        "lock-step": "lock-step  all" in theirs,
    }


def main() -> None:
    defaults = {"firmware": Path, "sitl": Path, "out": RESULTS / "firmware.json"}
    args = options(__doc__, "firmware", "sitl", seeds=range(5), episodes=3, **defaults).parse_args()
    firmware, sitl = args.firmware.resolve(), args.sitl.resolve()
    flights = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        apps = {"0, without lag": exported(folder)}
        apps |= {str(seed): exported(folder, *LAG, "--seed", seed) for seed in args.seeds}
        for seed, (run, app) in apps.items():
            flights[seed] = flown(run, app, sitl, args.episodes)
            print(seed, flights[seed], flush=True)
        said("make", "cf2_defconfig", cwd=firmware)
        said("make", "-j2", cwd=firmware)
        plain = (firmware / "build" / "cf2.bin").stat().st_size
        sizes = {"plain image, bytes": plain, **built(app, firmware)}
        sizes["instructions of a control period"] = instructions(app, folder)
    commands = {"train": " ".join((*TRAIN, *LAG)), "fly": " ".join(FLY)}
    made = {
        "gcc": said("arm-none-eabi-gcc", "-dumpversion").strip(),
        "firmware": said("git", "rev-parse", "--short=8", "HEAD", cwd=firmware).strip(),
        "sitl": said("git", "rev-parse", "--short=8", "HEAD", cwd=sitl).strip(),
    }
    about = {"commands": commands, "episodes": args.episodes, "made of": made}
    write(args.out, {**about, "seeds": flights, "sizes": sizes})


if __name__ == "__main__":
    main()
