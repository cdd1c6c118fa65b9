"""Write the pages of the library of vehicles, from its files, and draw its pictures.

`python studies/vehicle_pages.py` writes `README.md` and `picture.png` in each folder of
`models/vehicles`, and the table of `docs/library.md`; `--no-pictures` leaves the pictures, which
need OpenGL.

It takes about a minute on two cores.
"""

import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from measuring import options, table
from PIL import Image
from rotorgram.models import InputError, Vehicle
from rotorgram.models.checks import examine
from rotorgram.models.vehicle_file import Number, read_vehicle_file
from rotorgram.rendering.gl import offscreen_context
from rotorgram.scenes import build_scene
from rotorgram.sim.effects import EffectOptions, Effects
from rotorgram.sim.sensors import SENSOR_TYPES

ROOT: Final = Path(__file__).parents[1]
FOLDER: Final = ROOT / "models" / "vehicles"
PAGE: Final = ROOT / "docs" / "library.md"
LIBRARY: Final = tomllib.loads((FOLDER / "library.toml").read_text(encoding="utf-8"))
"""Tables `vehicles` and `works`; see the file."""

WIDTH = 960
HEIGHT = 540
OVERSAMPLING = 2  # drawn larger and reduced: smooth edges
SWITCHES: Final = (
    "motor_lag",
    "thrust_curve",
    "battery",
    "body_drag",
    "rotor_drag",
    "ground_effect",
)
BEGIN = "<!-- written by studies/vehicle_pages.py -->"
END = "<!-- end -->"


def path_of(name: str) -> Path:
    """File of a vehicle of the library."""
    return FOLDER / name / "vehicle.toml"


def readme(name: str) -> str:
    """The page of a vehicle."""
    about = LIBRARY["vehicles"][name]
    path = path_of(name)
    vehicle, numbers = Vehicle.load(path), read_vehicle_file(path).numbers
    works = sorted({work for one in numbers for text in sources(one) for work in works_of(text)})
    parts = [
        f"# {about['title']}",
        f"{about['about']}\n\n![{about['title']}](picture.png)",
        f"`python studies/vehicle_pages.py` wrote this page from [vehicle.toml](vehicle.toml).\n"
        f"Fly it with `--vehicle {name}`.",
        "## What follows from the numbers",
        _derived(vehicle),
        f"## Rotors\n\n{about['numbering']} Body frame: x forward, y left, z up.",
        _rotors(vehicle),
        "## Every number and its source",
        table(("number", "value", "unit", "source"), _sourced(numbers)),
        "## Where sources differ, and why these are used",
        "All published values that we found. Bold: the one that is used.",
        _choices(numbers),
        "## Examination",
        _examination(vehicle),
        "## Works and licences",
        "Numbers only: no code or text of these works is here.",
        table(("work", "version", "licence"), map(_work, works)),
    ]
    return "\n\n".join(parts) + "\n"


def overview() -> str:
    """The table of `docs/library.md`."""
    rows = []
    for name, about in LIBRARY["vehicles"].items():
        vehicle = Vehicle.load(path_of(name))
        file = read_vehicle_file(path_of(name))
        numbers = file.numbers
        checks = examine(vehicle)
        rows.append(
            (
                f"[{about['title']}](../models/vehicles/{name}/README.md)",
                f"`{name}`",
                f"{vehicle.mass:.4g}",
                f"{vehicle.num_rotors}",
                f"{thrust_to_weight(vehicle):.2f}",
                file.real_flights or "–",
                ", ".join(effects(vehicle)).replace("_", " "),
                ", ".join(sensors(vehicle)) or "–",
                f"{len(numbers)}, {sum(bool(one.others) for one in numbers)}",
                f"{sum(check.passed for check in checks)} of {len(checks)}",
            )
        )
    head = (
        "vehicle",
        "`--vehicle`",
        "kg",
        "rotors",
        "thrust / weight",
        "error after 0.5 s of real flights",
        "effects with coefficients",
        "sensors with coefficients",
        "numbers, of which sources differ",
        "checks passed",
    )
    return table(head, rows)


def thrust_to_weight(vehicle: Vehicle) -> float:
    """Largest thrust along body z over the weight."""
    most = float(vehicle.allocation[0] @ vehicle.thrust_high)
    return most / (vehicle.mass * vehicle.gravity)


def effects(vehicle: Vehicle) -> list[str]:
    """Effects whose coefficients a vehicle has."""
    able = []
    for name in SWITCHES:
        try:
            Effects(vehicle, EffectOptions(**{name: True}), _no_noise)
        except InputError:
            continue
        able.append(name)
    return able


def sensors(vehicle: Vehicle) -> list[str]:
    """Sensors whose coefficients a vehicle has."""
    able = []
    for name, kind in SENSOR_TYPES.items():
        settings = [one for one in kind.about.settings.values() if one.default is None]
        needs = [vehicle.coefficients[one.coefficient] for one in settings if one.coefficient]
        if needs and None not in needs:
            able.append(name)
    return able


def _no_noise(numbers: int, stream: int) -> Any:
    raise NotImplementedError("expected effects without noise")


def sources(number: Number) -> list[str]:
    """That of its value, and those of the other values."""
    return [number.source, *(other.source for other in number.others)]


def works_of(source: str) -> list[str]:
    """Works that a source names; it begins with one. Raises `ValueError` for any other source."""
    first = [work for work in LIBRARY["works"] if source.startswith(work)]
    if not first:
        raise ValueError(f"expected a source that begins with a work of library.toml: {source!r}")
    cited = [work for work in LIBRARY["works"] if work in source and work[-4:].isdecimal()]
    return [max(first, key=len), *cited]


def shown(value: float | Sequence[float]) -> str:
    """A value as the file has it, to seven digits."""
    values = [value] if isinstance(value, float) else value
    return ", ".join(f"{one:.7g}" for one in values)


def _derived(vehicle: Vehicle) -> str:
    share = vehicle.hover_thrust / vehicle.thrust_high
    flights = read_vehicle_file(vehicle.path).real_flights
    inertia = vehicle.inertia
    center = vehicle.center_of_mass
    products = [f"{inertia[i, j] + 0.0:.4g}" for i, j in ((0, 1), (0, 2), (1, 2))]
    rows = [
        ("mass", f"{vehicle.mass:.5g}", "kg"),
        ("centre of mass", ", ".join(f"{_clean(one):.4g}" for one in center), "m"),
        ("inertia Ixx, Iyy, Izz", ", ".join(f"{one:.4g}" for one in np.diag(inertia)), "kg m²"),
        ("inertia Ixy, Ixz, Iyz", ", ".join(products), "kg m²"),
        ("thrust / weight", f"{thrust_to_weight(vehicle):.2f}", ""),
        ("hover: share of the largest thrust", f"{share.min():.3f} to {share.max():.3f}", ""),
        ("rank of the allocation", f"{np.linalg.matrix_rank(vehicle.allocation, rtol=1e-6)}", ""),
        ("height at rest", f"{vehicle.rest_height:.4g}", "m"),
        ("physics step", f"{vehicle.timestep:g}", "s"),
        ("effects with coefficients", _words(effects(vehicle)), ""),
        ("sensors with coefficients", _words(sensors(vehicle)), ""),
        ("error after 0.5 s of real flights", flights or "–", ""),
    ]
    return table(("quantity", "value", "unit"), rows)


def _words(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "–"


def _clean(value: float) -> float:
    return value if abs(value) > 1e-9 else 0.0


def _rotors(vehicle: Vehicle) -> str:
    rows = []
    for rotor in vehicle.rotors:
        turn = "clockwise" if rotor.reaction[2] > 0 else "counterclockwise"
        place = (f"{_clean(one):.4g}" for one in rotor.position)
        rows.append((rotor.name, *place, turn, f"{rotor.reaction[2]:+.4g}"))
    head = ("rotor", "x, m", "y, m", "z, m", "turns, seen from above", "yaw torque, N m/N")
    return table(head, rows)


def _sourced(numbers: Iterable[Number]) -> list[tuple[str, ...]]:
    return [(f"`{one.name}`", shown(one.value), one.unit, one.source) for one in numbers]


def _choices(numbers: Iterable[Number]) -> str:
    """Table of the numbers that have other published values, or a reason."""
    rows = []
    for number in numbers:
        if not number.others and not number.why:
            continue
        unit = f", {number.unit}" if number.unit != "1" else ""
        name = f"`{number.name}`{unit}"
        rows.append((name, f"**{shown(number.value)}**", number.source, number.why))
        rows += [("", shown(other.value), other.source, "") for other in number.others]
    return table(("number", "value", "source", "remark"), rows)


def _examination(vehicle: Vehicle) -> str:
    checks = examine(vehicle)
    passed = sum(check.passed for check in checks)
    rows = [(check.name, "passed" if check.passed else "**failed**") for check in checks]
    lead = f"`rotorgram vehicle check`: {passed} of {len(checks)} checks passed."
    return f"{lead}\n\n{table(('check', 'result'), rows)}"


def _work(name: str) -> tuple[str, str, str]:
    work = LIBRARY["works"][name]
    title = f"[{work['title']}]({work['url']})" if "url" in work else work["title"]
    return f"{name}: {title}", work.get("version", "–"), work["licence"]


def draw(name: str) -> Image.Image:
    """A vehicle hovering above the floor: its front and right side, from above its level.

    Its size in the picture is the same for all; squares of the floor are as large as its arms.
    """
    vehicle = Vehicle.load(path_of(name))
    model = build_scene(path_of(name)).compile()
    data = mujoco.MjData(model)
    reach = max(float(np.hypot(*rotor.position[:2])) for rotor in vehicle.rotors)
    reach += vehicle.coefficients["rotors.radius"] or 0.4 * reach
    model.stat.extent, model.stat.meansize = 4 * reach, 0.2 * reach  # near, far, shadows
    model.mat_texrepeat[:] *= 1.5 / reach
    height = vehicle.rest_height + 0.3 * reach
    data.qpos[2] = height
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.azimuth = 158.0
    camera.elevation = -33.0
    camera.distance = 2.5 * reach
    camera.lookat[:] = (0.0, 0.0, height - 0.2 * reach)
    pixels = np.empty((HEIGHT * OVERSAMPLING, WIDTH * OVERSAMPLING, 3), np.uint8)
    frame = mujoco.MjrRect(0, 0, WIDTH * OVERSAMPLING, HEIGHT * OVERSAMPLING)
    scene = mujoco.MjvScene(model, 1000)
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    with offscreen_context(frame.width, frame.height).as_current():
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        mujoco.mjr_render(frame, scene, context)
        mujoco.mjr_readPixels(pixels, None, frame, context)
        context.free()
    return Image.fromarray(np.flipud(pixels)).reduce(OVERSAMPLING)


def main() -> None:
    pictures = not options(__doc__, no_pictures=False).parse_args().no_pictures
    for name in LIBRARY["vehicles"]:
        (FOLDER / name / "README.md").write_text(readme(name), encoding="utf-8")
        if pictures:
            file = FOLDER / name / "picture.png"
            picture = draw(name).quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
            picture.save(file, optimize=True)
            print(f"{file}: {file.stat().st_size / 1000:.0f} kB")
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    text = f"{before}{BEGIN}\n\n{overview()}\n\n{END}{after}"
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
