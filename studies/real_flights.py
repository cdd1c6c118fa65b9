"""Open-loop prediction error on recorded flights of a real drone, beside published rows.

`python studies/real_flights.py FOLDER [--vehicle FILE] [--out docs/results/real_flights]`

FOLDER has `train/*.csv` and `test/*.csv` of the IDSIA nano-drone benchmark (arXiv 2512.14450;
`docs/real-flights.md` says how to get them). Every sample of a test flight, or every `--stride`-th,
is a start: its measured state flies on in the simulator with the rotor speeds that were measured,
and the error after 1, 10 and 50 steps of 10 ms is the Euclidean distance (attitude: the angle),
mean over all starts. What is fitted is fitted on the training flights alone. With `--vehicle` that
vehicle flies as its file has it, with drag of its body and nothing fitted.
"""

import csv
import json
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from measuring import RESULTS, options
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim.effects import EffectOptions
from rotorgram.sim.rotations import to_body
from rotorgram.sim.state import InitialState
from rotorgram.sim.world import make_world

sys.path.append(str(Path(__file__).parents[1] / "examples" / "identification"))
from fit import Fit
from flight_logs import FlightLog, Floats, read_log
from prediction import Numbers, Windows, differences, mean_speeds, numbers_of, predict
from vehicle_text import Origin, vehicle_toml

START: Final = Path(__file__).with_name("nanodrone.toml")
HORIZONS: Final = (1, 10, 50)
MEASURES: Final = ("position_m", "attitude_rad", "velocity_m_s", "rates_rad_s")
PUBLISHED: Final[dict[str, dict[str, list[float]]]] = json.loads(
    Path(__file__).with_name("nanodrone_published.json").read_text()
)
"""Rows of the benchmark's table: position, attitude, velocity, rates at each horizon."""
_WORLDS: Final = 2048
_UP: Final = 100.0  # m: far from the ground, which no effect here feels
_UNTURNED: Final = 1e3  # kg m²: an inertia that no rotor turns
_STRIDE: Final = 50  # samples between two starts of a fit: windows do not overlap

FORCES: Final = ("rotors.thrust_coefficient", *(f"drag.linear.{axis}" for axis in "xyz"))
K: Final = ("rotors.thrust_coefficient",)
DRAG: Final = (("drag.linear.x", "drag.linear.y"), ("drag.linear.z",))
ROTOR_DRAG: Final = (("rotors.drag",), ("rotors.inflow",))
INERTIA: Final = (("body.inertia.x", "body.inertia.y"), ("body.inertia.z",))
MOMENT: Final = (("drag.moment.x", "drag.moment.y"),)
DAMPING: Final = (("drag.angular.x", "drag.angular.y"), ("drag.angular.z",))


@dataclass(frozen=True)
class Variant:
    """A model: which numbers are fitted, and whether rotors turn the craft."""

    name: str
    groups: tuple[tuple[str, ...], ...] = ()
    turns: bool = True
    regressed: bool = False
    """Whether thrust and drag are those of a regression of accelerations, and not fitted too."""

    @property
    def names(self) -> list[str]:
        """Numbers that the flights decide."""
        fitted = [name for group in self.groups for name in group]
        return [*FORCES, *fitted] if self.regressed else fitted


VARIANTS: Final = (
    Variant("rates constant, published thrust coefficient", (), False),
    Variant("+ thrust coefficient fitted", (K,), False),
    Variant("+ drag of the body", (K, *DRAG), False),
    Variant("or drag and inflow of the rotors instead", (K, *ROTOR_DRAG), False),
    Variant("rates decay, no torques", (K, *DRAG, *DAMPING), False),
    Variant("rotors turn the craft, published inertia", (K, *DRAG)),
    Variant("+ inertia fitted", (K, *DRAG, *INERTIA)),
    Variant("+ moment of the air", (K, *DRAG, *INERTIA, *MOMENT)),
    Variant("+ damping of the rates", (K, *DRAG, *INERTIA, *MOMENT, *DAMPING)),
    Variant("the same, thrust and drag by regression", (*INERTIA, *MOMENT, *DAMPING),
            regressed=True),
    Variant("the same with the published inertia", (K, *DRAG, *MOMENT, *DAMPING)),
    Variant("the same with each axis apart",
            (K, *((name,) for kind in ("drag.linear.", "body.inertia.", "drag.angular.")
                  for name in (kind + "x", kind + "y", kind + "z")),
             ("drag.moment.x",), ("drag.moment.y",))),
)  # fmt: skip


def main() -> int:
    parser = options(__doc__, out=RESULTS / "real_flights", stride=1, vehicle=str)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    base = Vehicle.load(START)
    if given.vehicle:
        return _measure(given, Vehicle.load(given.vehicle))
    train, test = (_flights(given.folder / kind, base) for kind in ("train", "test"))
    windows = Windows.cut(test, HORIZONS[-1], given.stride, HORIZONS)
    print(f"{len(train)} training flights; {len(test)} test flights, {len(windows.index)} starts")
    held = numbers_of(base)
    rows = [_row("state held", _held(windows), windows, test)]
    _show(rows[-1], "ours")
    cut = Windows.cut(train, HORIZONS[-1], _STRIDE, (10, 25, 50))
    for variant in VARIANTS:
        begun = time.monotonic()
        numbers = _fitted(variant, base, held, cut, train)
        text, vehicle = _vehicle(base, numbers, variant)
        row = _row(variant.name, simulated(vehicle, windows), windows, test)
        row["unseen_kinds"] = _unseen(variant, base, held, train)
        reference = rows[1] if len(rows) > 1 else row
        ratios = np.divide(row["unseen_kinds"], reference["unseen_kinds"])
        row["unseen_score"] = float(ratios[:3].mean())  # 1: as the published physics
        row["numbers"] = {name: numbers[name] for name in variant.names}
        row["file"] = text
        row["fit_s"] = round(time.monotonic() - begun, 1)
        rows.append(row)
        _show(row, "ours")
    for name, errors in PUBLISHED.items():
        theirs = {int(h): numbers for h, numbers in errors.items()}
        _show({"name": name, "published_formula": theirs}, "theirs")
    _write(given.out, rows, len(windows.index), given.stride)
    return 0


def _measure(given: Namespace, vehicle: Vehicle) -> int:
    """Print and write the errors of a vehicle as its file has it."""
    test = _flights(given.folder / "test", vehicle)
    windows = Windows.cut(test, HORIZONS[-1], given.stride, HORIZONS)
    row = _row(vehicle.name, simulated(vehicle, windows, rotors=False), windows, test)
    result = {
        "vehicle": vehicle.name,
        "vehicle_hash": vehicle.hash,
        "numbers": moving_numbers(vehicle),
        "starts": len(windows.index),
        "measures": MEASURES,
        "errors": row["errors"],
    }
    text = json.dumps(result, indent=1, ensure_ascii=False)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / f"{Path(given.vehicle).stem}.json").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


def moving_numbers(vehicle: Vehicle) -> dict[str, object]:
    """Numbers of a vehicle that its motion in this study depends on, SI.

    Its hash changes with others too, such as those of sensors; as long as these are the same, the
    errors are those of the vehicle.
    """
    return {
        "mass": vehicle.mass,
        "gravity": vehicle.gravity,
        "center_of_mass": vehicle.center_of_mass.tolist(),
        "inertia": vehicle.inertia.tolist(),
        "allocation": vehicle.allocation.tolist(),
        **numbers_of(vehicle),
    }


def simulated(vehicle: Vehicle, windows: Windows, *, rotors: bool = True) -> Floats:
    """States at each horizon, (M, H, 13), flown by the simulator."""
    told = vehicle.coefficients
    of_body = [told[f"drag.{name}"] for name in ("linear", "angular", "moment")]
    of_rotors = [told[f"rotors.{name}"] for name in ("drag", "inflow")]
    body = any(x is not None for x in of_body)
    rotor = any(x is not None for x in of_rotors)
    effects = EffectOptions(body_drag=body, rotor_drag=rotor and rotors)
    (coefficient,) = told.need("rotors.thrust_coefficient", "a flight from rotor speeds")
    lift = np.array((0.0, 0.0, _UP))
    substeps = vehicle.substeps(windows.period)
    states = np.empty((len(windows.start), len(HORIZONS), 13))
    for first in range(0, len(states), _WORLDS):
        some = slice(first, first + _WORLDS)
        speeds = windows.speeds[some]
        thrust = [coefficient * mean_speeds(speeds, step) ** 2 for step in range(HORIZONS[-1])]
        start = windows.start[some, None]
        world = make_world(vehicle, len(start), effects=effects, num_threads=1)
        initial = InitialState(
            position=start[..., :3] + lift,
            quaternion=start[..., 3:7],
            velocity=start[..., 7:10],
            body_rates=start[..., 10:],
            thrust=thrust[0][:, None],
        )
        world.reset(np.ones((len(start), 1), bool), initial)
        for step in range(HORIZONS[-1]):
            world.step(thrust[step][:, None], substeps)
            if step + 1 in HORIZONS:
                s = world.state
                motion = (s.position - lift, s.quaternion, s.velocity, s.body_rates)
                here = np.concatenate(motion, axis=-1)[:, 0]
                states[some, HORIZONS.index(step + 1)] = here
        world.close()
    return states


def regressed(vehicle: Vehicle, flights: Sequence[FlightLog]) -> dict[str, float]:
    """Thrust coefficient and linear drag by a regression of accelerations, in body axes."""
    axes = np.array([rotor.axis for rotor in vehicle.rotors])
    forces = []
    axials = []
    velocities = []
    for flight in flights:
        inner = slice(2, -2)
        quaternion = flight.states[inner, 3:7]
        velocity = flight.states[:, 7:10]
        near = velocity[3:-1] - velocity[1:-3]
        far = velocity[4:] - velocity[:-4]
        slope = (8 * near - far) / (12 * flight.period)
        up = np.array([0.0, 0.0, vehicle.gravity])
        forces.append(to_body(quaternion, slope + up))
        velocities.append(to_body(quaternion, velocity[inner]))
        axials.append(flight.speeds[inner] ** 2 @ axes)
    force, axial, velocity = (np.concatenate(parts) for parts in (forces, axials, velocities))
    coefficient = vehicle.mass * float((axial * force).sum() / (axial * axial).sum())
    rest = vehicle.mass * force - coefficient * axial
    drag = -(velocity * rest).sum(axis=0) / (velocity**2).sum(axis=0)
    return dict(zip(FORCES, (coefficient, *np.maximum(drag, 0.0).tolist()), strict=True))


def _flights(folder: Path, vehicle: Vehicle) -> list[FlightLog]:
    files = sorted(folder.glob("*.csv"))
    if not files:
        sys.exit(f"{folder}: expected CSV files of flights, got none")
    return [read_log(file, vehicle) for file in files]


@dataclass(eq=False)
class TiedFit(Fit):
    """A fit in which the numbers of a group stay equal to its first, which is fitted."""

    groups: Sequence[tuple[str, ...]] = ()

    def numbers_at(self, x: Floats) -> dict[str, float]:
        """All numbers at a point."""
        numbers = super().numbers_at(x)
        for first, *others in self.groups:
            numbers |= dict.fromkeys(others, numbers[first])
        return numbers


def _fitted(
    variant: Variant,
    base: Vehicle,
    held: Numbers,
    windows: Windows,
    flights: Sequence[FlightLog],
) -> Numbers:
    """The numbers of a variant; where rates are constant, forces are fitted with them constant."""
    begun = regressed(base, flights) if variant.regressed else {}
    if not variant.groups:
        return held
    start = _flown(variant, {**held, **begun})
    if not variant.turns:
        decaying = [name for group in DAMPING if group in variant.groups for name in group]
        start = {**start, **dict.fromkeys(decaying, _UNTURNED / 0.5)}  # time constant: 0.5 s
    names = [group[0] for group in variant.groups]
    found = TiedFit(base, windows, start, names, groups=variant.groups).solve()
    if variant.turns:
        return found
    return found | {name: held[name] for name in held if name.startswith("body.inertia")}


def _flown(variant: Variant, numbers: Numbers) -> Numbers:
    """Without torques of the rotors: an inertia that they cannot turn, and damping in its ratio."""
    if variant.turns:
        return numbers
    return {**numbers, **{f"body.inertia.{axis}": _UNTURNED for axis in "xyz"}}


def _vehicle(base: Vehicle, numbers: Numbers, variant: Variant) -> tuple[str, Vehicle]:
    """The text of a vehicle file that says these numbers, and its vehicle."""
    said = {name.rpartition(".")[0] if name.count(".") > 1 else name for name in variant.names}
    source = "studies/real_flights.py: fitted on the training flights of arXiv 2512.14450"
    origins = dict.fromkeys(said, Origin(source))
    text = vehicle_toml(base, _flown(variant, numbers), origins)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "vehicle.toml")
        file.write_text(text, encoding="utf-8")
        return text, Vehicle.load(file)


def _held(windows: Windows) -> Floats:
    """Predictions of a craft that stays as it is."""
    return np.repeat(windows.start[:, None], len(windows.horizons), axis=1)


def _sizes(predicted: Floats, truth: Floats) -> Floats:
    return np.linalg.norm(differences(predicted, truth), axis=-1)


def _row(name: str, predicted: Floats, windows: Windows, flights: Sequence[FlightLog]) -> dict:
    """Mean errors: over all starts, by the formula of the published rows, and of each flight."""
    row: dict = {"name": name, "errors": {}, "published_formula": {}, "flights": {}}
    for index, h in enumerate(HORIZONS):
        sizes = _sizes(predicted[:, index], windows.truth[:, index])
        row["errors"][h] = sizes.mean(axis=0).tolist()
        row["published_formula"][h] = published_formula(predicted[:, index], windows, h)
        for i, flight in enumerate(flights):
            mine = sizes[windows.flight == i].mean(axis=0).tolist()
            row["flights"].setdefault(flight.name, {})[h] = mine
    return row


def published_formula(predicted: Floats, windows: Windows, h: int) -> list[float]:
    """The means as the benchmark computes them (its utils/metrics_utils.py).

    It joins the flights into one table with the measured state of the step after each start, and
    takes the measured state h - 1 rows further for that at the horizon. For the last h - 1 starts
    of a flight these rows are of the next flight.
    """
    truth = windows.truth[h - 1 :, 0]
    return _sizes(predicted[: len(truth)], truth).mean(axis=0).tolist()


def _unseen(
    variant: Variant, base: Vehicle, held: Numbers, train: Sequence[FlightLog]
) -> list[float]:
    """Errors at the last horizon on each kind of training flights, fitted on the others; mean."""
    kinds = sorted({flight.name.partition("_")[0] for flight in train})
    errors = []
    for kind in kinds:
        rest = [one for one in train if not one.name.startswith(kind)]
        left = [one for one in train if one.name.startswith(kind)]
        windows = Windows.cut(rest, HORIZONS[-1], 2 * _STRIDE, (10, 25, 50))
        numbers = _flown(variant, _fitted(variant, base, held, windows, rest))
        cut = Windows.cut(left, HORIZONS[-1], _STRIDE // 2)
        sizes = _sizes(predict(base, [numbers], cut)[0], cut.truth)
        errors.append(sizes.mean(axis=(0, 1)))
    return [float(x) for x in np.mean(errors, axis=0)]


def _show(row: Mapping, whose: str) -> None:
    text = "  ".join(
        f"h={h}: " + " ".join(f"{x:.4f}" for x in row["published_formula"][h]) for h in HORIZONS
    )
    print(f"{whose:7}{row['name']:46}{text}", flush=True)


def _write(out: Path, rows: Sequence[Mapping], starts: int, stride: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    variants = []
    flights = []
    for row in rows:
        for kind in ("errors", "published formula"):
            for h, errors in row[kind.replace(" ", "_")].items():
                variants.append([row["name"], kind, h, *(f"{x:.5f}" for x in errors)])
        for flight, told in row["flights"].items():
            for h, errors in told.items():
                flights.append([row["name"], flight, h, *(f"{x:.5f}" for x in errors)])
    for name, told in PUBLISHED.items():
        for h, errors in told.items():
            variants.append([f"published: {name}", "published formula", h, *errors])
    for name, kind, lines in (("variants", "formula", variants), ("flights", "flight", flights)):
        with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["model", kind, "horizon", *MEASURES])
            writer.writerows(lines)
    # Chosen by kinds of flights that the fit had not seen, among the training flights.
    chosen = min(rows[1:], key=lambda row: row["unseen_score"])
    position, attitude, velocity, _ = chosen["errors"][HORIZONS[-1]]
    told = {"position": position, "velocity": velocity, "attitude": attitude}
    source = "studies/real_flights.py: mean over the test flights of arXiv 2512.14450"
    lines = [f'source = "{source}"', *(f"{name} = {value:.4g}" for name, value in told.items())]
    text = "\n".join((chosen["file"].rstrip(), "", "[real_flights]", *lines, ""))
    (out / "vehicle.toml").write_text(text, encoding="utf-8")
    summary = {
        "model": chosen["name"],
        "starts": starts,
        "stride": stride,
        "horizon_s": 0.5,
        "measures": MEASURES,
        "ours": chosen["errors"][50],
        "ours_by_the_published_formula": chosen["published_formula"][50],
        "published": {name: errors["50"] for name, errors in PUBLISHED.items()},
        "numbers": chosen["numbers"],
        "unseen_kinds": {row["name"]: row["unseen_kinds"] for row in rows[1:]},
        "unseen_score": {row["name"]: row["unseen_score"] for row in rows[1:]},
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    sys.exit(main())
