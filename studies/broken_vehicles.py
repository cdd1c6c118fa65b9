"""Broken vehicles and what the examination says of each: every fault, found by its own check.

    python studies/broken_vehicles.py [--out FILE.csv]

writes the table that `docs/physics.md` shows, and beside it `FILE.json`, the examination of the
paper's vehicle, within a minute. Each broken vehicle is the paper's with one thing wrong.
"""

import json
import math
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from measuring import RESULTS, options, table, write_rows
from rotorgram.cli.vehicle import expectation
from rotorgram.models import QUAD_XML
from rotorgram.models.checks import Check, examine

Edit = Callable[[str], str]


def replace(*pairs: tuple[str, str]) -> Edit:
    """Replace each first text by the second; it must be there."""

    def edit(text: str) -> str:
        for old, new in pairs:
            if old not in text:
                raise ValueError(f"there is no {old!r} to replace")
            text = text.replace(old, new)
        return text

    return edit


def reactions(*values: float) -> Edit:
    """Other reactions of the four rotors, N·m per newton."""

    def edit(text: str) -> str:
        for number, value in enumerate(values, 1):
            gear = (
                rf'(name="rotor{number}" class="quad" site="rotor{number}" gear="0 0 1 0 0) +\S+"'
            )
            text, count = re.subn(gear, rf'\1 {value:g}"', text)
            if count != 1:
                raise ValueError(f"there is no rotor {number}")
        return text

    return edit


def scaled(pattern: str, factor: float) -> Edit:
    """Multiply all numbers of the attributes that match."""

    def scale(match: re.Match[str]) -> str:
        values = " ".join(f"{float(word) * factor:g}" for word in match[2].split())
        return f'{match[1]}"{values}"'

    return lambda text: re.sub(rf'({pattern}=)"([^"]*)"', scale, text)


def inertial(words: str) -> Edit:
    """An inertia that the file writes out."""
    tag = f'<inertial pos="0 0 0" mass="20" {words}/>'
    return replace(('<freejoint name="free"/>', f'<freejoint name="free"/>{tag}'))


def both(first: Edit, second: Edit) -> Edit:
    """One edit after the other."""
    return lambda text: second(first(text))


def numeric(**values: float | str) -> Edit:
    """Coefficients; two underscores stand for the dot."""
    tags = "".join(
        f'<numeric name="rotorgram/{name.replace("__", ".")}" data="{value}"/>'
        for name, value in values.items()
    )
    return replace(("</mujoco>", f"<custom>{tags}</custom></mujoco>"))


def free(words: str) -> Edit:
    """Another free joint: only a joint of type free takes damping and the like."""
    return replace(('<freejoint name="free"/>', f'<joint name="free" type="free" {words}/>'))


SITE1 = '<site name="rotor1" pos=" 1  1 0"'
GEAR2 = 'site="rotor2" gear="0 0 1 0 0 -0.05"'
SITE3 = '<site name="rotor3" pos="-1 -1 0"/>'
MAST = '<body pos="3 0 0"><site name="rotor3"/></body></worldbody>'
PAIR = '<contact><pair geom1="hub" geom2="arm1"/></contact></mujoco>'

BROKEN: Final[dict[str, tuple[Edit, str]]] = {
    "yaw signs in the pattern of roll": (
        reactions(0.05, -0.05, -0.05, 0.05), "allocation: yaw apart from roll"),
    "yaw signs in the pattern of pitch": (
        reactions(0.05, 0.05, -0.05, -0.05), "allocation: yaw apart from pitch"),
    "no reactions": (reactions(0, 0, 0, 0), "allocation: rank"),
    "one reaction of the wrong sign": (
        reactions(0.05, -0.05, 0.05, 0.05), "turns: yaw of equal thrusts"),
    "one reaction ten times too large": (
        reactions(0.05, -0.5, 0.05, -0.05), "turns: reaction of rotor2 / median"),
    "reaction a hundred times too large": (
        reactions(5, -5, 5, -5), "units: reaction / arm"),
    "mass in grams": (scaled(" mass", 1000), "units: mass / arm³"),
    "lengths in millimetres": (scaled(" (?:pos|fromto|size)", 1000), "units: arm"),
    "inertia in kg·mm²": (
        inertial('diaginertia="5.03e6 5.03e6 1e7"'), "units: largest moment / (mass arm²)"),
    "inertia against the triangle inequality": (
        inertial('diaginertia="2 2 10"'), "inertia: triangle inequality"),
    "inertia that is not positive": (
        inertial('fullinertia="5 5 10 7 0 0"'), "inertia: smallest / largest moment"),
    "angle in degrees where radians are read": (
        replace((SITE1, f'{SITE1} euler="90 0 0"')), "lift of rotor1"),
    "rotor upside down": (
        replace((GEAR2, 'site="rotor2" gear="0 0 -1 0 0 0.05"')), "lift of rotor2"),
    "rotors that lean to one side": (
        replace(('gear="0 0 1', 'gear="0.2 0 1')),
        "trim: sideways acceleration / g"),
    "rotor of another body": (
        replace((SITE3, ""), ("</worldbody>", MAST)), "actuator rotor3: faults"),
    "rotor without limits": (
        replace(('ctrllimited="true" ctrlrange="0 100"', 'ctrllimited="false"')),
        "actuator rotor1: faults"),
    "rotors that give less than they are asked for": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 100" forcelimited="true" forcerange="0 80"')),
        "effect of rotor1: error per newton"),
    "too weak to hover": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 45"')), "hover: thrust to weight"),
    "thrust in millinewtons": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 100000"')), "hover: thrust to weight"),
    "center of mass beyond trim": (
        replace(('size="0.22 0.22 0.07" mass="12"',
                 'size="0.22 0.22 0.07" pos="1.8 0 0" mass="12"')),
        "hover: thrust of rotor3"),
    "Euler's integrator": (replace(('integrator="RK4"', "")), "integrator: observed order"),
    "physics step of 50 ms": (replace(('timestep="0.01"', 'timestep="0.05"')), "physics step"),
    "physics step too long for its inertia": (
        both(inertial('diaginertia="0.85 0.85 1.6"'),
             replace(('ctrlrange="0 100"', 'ctrlrange="0 400"'))), "physics step"),
    "motors faster than the physics step": (
        numeric(rotors__time_constant=0.004), "physics step"),
    "nothing that collides": (
        replace(('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"')),
        "floor: height at rest"),
    "parts that touch each other": (
        replace(("</mujoco>", PAIR)), "contacts in free flight"),
    "gravity that points up": (
        replace(('gravity="0 0 -9.8"', 'gravity="0 0 9.8"')), "gravity: part along -z"),
    "gravity in cm/s²": (
        replace(('gravity="0 0 -9.8"', 'gravity="0 0 -980"')), "gravity: size"),
    "armature of the free joint": (
        free('armature="0.5"'), "mass against a force of 1 N"),
    "damping of the free joint": (
        free('damping="0.05"'), "free fall: depth"),
    "damping that the integrator cannot follow": (
        free('damping="20000"'), "free fall: warnings"),
    "thrust coefficient of revolutions per minute": (
        numeric(rotors__radius=0.4, rotors__thrust_coefficient=1.2e-5), "units: tip speed"),
}  # fmt: skip
"""By what is wrong: how to break the paper's vehicle so, and the check that must find it."""


@dataclass(frozen=True)
class Row:
    """One broken vehicle."""

    fault: str
    found_by: str
    """Name of the check that must find it."""
    found: bool
    """Whether it did."""
    measured: str
    """The check's measured value and its limits."""
    meaning: str
    """The check's sentence."""
    failed: int
    """How many checks failed."""
    checks: int
    """How many there were."""
    flies: bool
    """Whether `--vehicle` accepts the file."""


def break_vehicle(folder: Path, edit: Edit) -> Path:
    """Write the paper's vehicle, with something wrong, into a folder."""
    text = re.sub("<keyframe>.*</keyframe>", "", QUAD_XML.read_text("utf-8"), flags=re.DOTALL)
    (folder / "broken.xml").write_text(edit(text), "utf-8")
    return folder / "broken.xml"


def rows() -> list[Row]:
    """Examine every broken vehicle."""
    told = []
    for fault, (edit, name) in BROKEN.items():
        with tempfile.TemporaryDirectory() as folder:
            checks = examine(break_vehicle(Path(folder), edit))
        told.append(_row(fault, name, checks))
    return told


def _row(fault: str, name: str, checks: Sequence[Check]) -> Row:
    by_name = {check.name: check for check in checks}
    check, bad = by_name[name], [check for check in checks if not check.passed]
    measured = f"{check.measured:.4g} ({expectation(check)}) {check.unit}".strip()
    accepted = by_name["accepted by --vehicle"].passed
    return Row(fault, name, check in bad, measured, check.meaning, len(bad), len(checks), accepted)


def markdown(told: Sequence[Row]) -> str:
    """The table, in Markdown."""
    rows = []
    for row in told:
        flies = "yes" if row.flies else "no"
        failed = f"{row.failed} of {row.checks}"
        rows.append((row.fault, row.found_by, row.measured, flies, failed))
    return table(
        ("what is wrong", "found by", "measured (expected)", "flies", "failed checks"), rows
    )


def examination(checks: Sequence[Check]) -> str:
    """Every check of a vehicle, in Markdown."""
    head = ("check", "measured", "expected", "unit", "equation", "source")
    rows = (
        (
            check.name,
            f"{check.measured:.4g}",
            expectation(check),
            check.unit,
            check.equation,
            check.source,
        )
        for check in checks
    )
    return table(head, rows)


def read_report(path: Path) -> tuple[float, list[Check]]:
    """(Seconds it took, checks) of the examination that `main` wrote as JSON."""
    report = json.loads(path.read_text("utf-8"))
    for check in report["checks"]:
        check |= {"high": math.inf if check["high"] is None else check["high"]}
        del check["tolerance"], check["passed"]
    return report["seconds"], [Check(**check) for check in report["checks"]]


def _main() -> None:
    out = RESULTS / "physics" / "broken_vehicles.csv"
    path = options(__doc__, out=out).parse_args().out
    told = rows()
    write_rows(path, told)
    begun = time.perf_counter()
    checks = examine()
    seconds = round(time.perf_counter() - begun, 3)
    print(markdown(told), examination(checks), sep="\n\n")
    report = {"seconds": seconds, "checks": [check.report() for check in checks]}
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    path.with_suffix(".json").write_text(text + "\n", "utf-8")


if __name__ == "__main__":
    _main()
