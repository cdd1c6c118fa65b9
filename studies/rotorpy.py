"""Flights of the AscTec Hummingbird, ours beside RotorPy's.

    python studies/rotorpy.py [--out FOLDER] [--python FILE]

writes `hummingbird.json`, which `docs/independent.md` shows, in some minutes. RotorPy comes from
PyPI into an environment that the script makes and removes; or FILE is the Python of one that has
it.

Both fly the parameters of RotorPy's own `hummingbird_params`, read when this runs: for ours they
become an MJCF file. The motor speeds commanded, the starts and the flights are those of
`independent.py`, whose solution stands beside both.
"""

import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any, Final

import numpy as np
from independent import (
    CONTROL,
    EFFECTS,
    SPIN,
    STEPS,
    VELOCITY,
    Flight,
    at_step,
    independent,
    ours,
    thrusts,
)
from measuring import options, table
from rotorgram.models import Vehicle

HERE: Final = Path(__file__).parent
RESULTS: Final = HERE.parent / "docs" / "results" / "rotorpy"
VERSION: Final = "3.0.0"
"""Of RotorPy."""


def mjcf(params: dict[str, Any]) -> str:
    """RotorPy's parameters as an MJCF file with our coefficients."""
    ratio = params["k_m"] / params["k_eta"]
    most = params["k_eta"] * params["rotor_speed_max"] ** 2
    moments = " ".join(repr(params[f"I{axes}"]) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    numbers = {
        "rotors.thrust_coefficient": (params["k_eta"],),
        "rotors.time_constant": (params["tau_m"],),
        "rotors.drag": (params["k_d"],),
        "rotors.inflow": (params["k_z"],),
        "rotors.lift": (params["k_h"],),
        "drag.quadratic": [params[f"c_D{axis}"] for axis in "xyz"],
    }
    told = "".join(
        f'<numeric name="rotorgram/{name}" data="{" ".join(map(repr, values))}"/>'
        for name, values in numbers.items()
    )
    places = params["rotor_pos"]
    turns = params["rotor_directions"]
    sites = "".join(
        f'<site name="r{i}" pos="{" ".join(map(repr, place))}"/>' for i, place in enumerate(places)
    )
    motors = "".join(
        f'<motor site="r{i}" gear="0 0 1 0 0 {turn * ratio!r}" ctrllimited="true"'
        f' ctrlrange="0 {most!r}"/>'
        for i, turn in enumerate(turns)
    )
    return f"""<mujoco model="hummingbird">
      <option timestep="0.01" integrator="RK4" gravity="0 0 {-params["g"]!r}"/>
      <custom>{told}</custom>
      <worldbody><body name="craft"><freejoint/>
        <inertial pos="0 0 0" mass="{params["mass"]!r}" fullinertia="{moments}"/>
        <geom type="sphere" size="0.1"/>{sites}
      </body></worldbody>
      <actuator>{motors}</actuator>
    </mujoco>"""


def compare(python: str) -> dict[str, Any]:
    """Fly every case with RotorPy, by that Python, and with ours; the numbers of the page."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hummingbird.xml"
        # Shares of the hover thrust are drawn from the vehicle, which has RotorPy's parameters.
        told = _theirs(python, {}, [])
        file.write_text(mjcf(told["params"]), encoding="utf-8")
        vehicle = Vehicle.load(file)
    commands = thrusts(vehicle)
    told = _theirs(python, EFFECTS, (commands / vehicle.hover_thrust).tolist())
    rows = []
    for name, effects in EFFECTS.items():
        tight, usual = (_flight(told["flights"][name][kind]) for kind in ("tight", "default"))
        row = {"effects": name, "metres": {}, "degrees": {}}
        flown = {"independent": independent(vehicle, commands, effects), "RotorPy": usual}
        for step in STEPS:
            flown[f"{step * 1e3:g} ms"] = ours(at_step(vehicle, step), commands, effects)
        for kind, flight in flown.items():
            apart = _level(flight).apart(tight)
            row["metres"][kind], row["degrees"][kind] = (float(f"{x:.3g}") for x in apart)
        rows.append(row)
    return {"rotorpy": told["version"], "rows": rows}


def _theirs(python: str, cases: dict[str, Any], shares: list[object]) -> dict[str, Any]:
    given = {
        "cases": cases,
        "kinds": ("tight", "default"),
        "shares": shares,
        "period": CONTROL,
        "velocity": VELOCITY,
        "rates": SPIN,
    }
    # Isolated: this folder has a rotorpy.py, which is not theirs.
    command = [python, "-I", str(HERE / "rotorpy_flights.py")]
    done = subprocess.run(
        command, input=json.dumps(given), stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout)


def _flight(told: list[object]) -> Flight:
    position, quaternion = (np.array(part) for part in told)
    return Flight(position, quaternion, np.zeros((len(position), 3)))


def _level(flight: Flight) -> Flight:
    """The flight counted from its first position: theirs begin at the origin."""
    return Flight(flight.position - flight.position[0], flight.quaternion, flight.rates)


def markdown(result: dict[str, Any]) -> str:
    """The table, in Markdown."""
    kinds = ["independent", "RotorPy", *(f"{step * 1e3:g} ms" for step in reversed(STEPS))]
    heads = ["independent solution", "RotorPy as it is", *(f"ours, {kind}" for kind in kinds[2:])]
    rows = []
    for row in result["rows"]:
        cells = (f"{row['metres'][k]:.1e} m, {row['degrees'][k]:.1e}°" for k in kinds)
        rows.append((row["effects"], *cells))
    return table(("effects", *heads), rows)


def _made(folder: str) -> str:
    """The Python of a new environment with RotorPy and what its vehicles import."""
    venv.create(folder, with_pip=True)
    bin_folder = "Scripts" if sys.platform == "win32" else "bin"
    python = str(Path(folder) / bin_folder / "python")
    for what in (["numpy", "scipy"], ["--no-deps", f"rotorpy=={VERSION}"]):
        subprocess.run([python, "-m", "pip", "install", "-q", *what], check=True)
    return python


def _main() -> None:
    args = options(__doc__, out=RESULTS, python=str).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = compare(args.python or _made(folder))
    args.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result, separators=(",", ":")).replace('{"effects"', '\n{"effects"')
    (args.out / "hummingbird.json").write_text(text + "\n", encoding="utf-8")
    print(markdown(result))


if __name__ == "__main__":
    _main()
