"""Broken vehicles: every fault is refused in a sentence, or found by its own check.

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
from rotorgram.models import QUAD_XML, InputError
from rotorgram.models.checks import Check, examine, failed

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
CARRY = "to carry a part of the weight of the level craft"
SHARE = "to carry its share of the weight"
BALANCE = "without a torque or a sideways force"
PAIR = '<contact><pair geom1="hub" geom2="arm1"/></contact></mujoco>'

BROKEN: Final[dict[str, tuple[Edit, str]]] = {
    "yaw signs in the pattern of roll": (
        reactions(0.05, -0.05, -0.05, 0.05), "allocation: torques apart from each other"),
    "yaw signs in the pattern of pitch": (
        reactions(0.05, 0.05, -0.05, -0.05), "allocation: torques apart from each other"),
    "no reactions": (reactions(0, 0, 0, 0), "allocation: torques apart from each other"),
    "one reaction of the wrong sign": (
        reactions(0.05, -0.05, 0.05, 0.05), CARRY),
    "one reaction ten times too large": (
        reactions(0.05, -0.5, 0.05, -0.05), "turns: reaction of rotor2 / median"),
    "reaction a hundred times too large": (
        reactions(5, -5, 5, -5), "units: reaction / arm"),
    "mass in grams": (scaled(" mass", 1000), SHARE),
    "lengths in millimetres": (scaled(" (?:pos|fromto|size)", 1000), "units: arm"),
    "inertia in kg·mm²": (
        inertial('diaginertia="5.03e6 5.03e6 1e7"'), "units: largest moment / (mass arm²)"),
    "inertia against the triangle inequality": (
        inertial('diaginertia="2 2 10"'), "inertia must satisfy A + B >= C"),
    "inertia that is not positive": (
        inertial('fullinertia="5 5 10 7 0 0"'), "inertia must have positive eigenvalues"),
    "angle in degrees where radians are read": (
        replace((SITE1, f'{SITE1} euler="90 0 0"')), BALANCE),
    "rotor upside down": (
        replace((GEAR2, 'site="rotor2" gear="0 0 -1 0 0 0.05"')), CARRY),
    "rotors that lean to one side": (
        replace(('gear="0 0 1', 'gear="0.2 0 1')),
        BALANCE),
    "rotor of another body": (
        replace((SITE3, ""), ("</worldbody>", MAST)), "rotor3 to be an actuator at a site"),
    "rotor without limits": (
        replace(('ctrllimited="true" ctrlrange="0 100"', 'ctrllimited="false"')),
        "rotor1 to have a thrust with limits"),
    "rotors that give less than they are asked for": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 100" forcelimited="true" forcerange="0 80"')),
        "rotor1 to have no forcerange narrower than its thrusts"),
    "too weak to hover": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 45"')), SHARE),
    "thrust in millinewtons": (
        replace(('ctrlrange="0 100"', 'ctrlrange="0 100000"')), "hover: thrust to weight"),
    "center of mass beyond trim": (
        replace(('size="0.22 0.22 0.07" mass="12"',
                 'size="0.22 0.22 0.07" pos="1.8 0 0" mass="12"')),
        SHARE),
    "Euler's integrator": (
        replace(('integrator="RK4"', "")), "physics step: error of attitude"),
    "physics step of 50 ms": (
        replace(('timestep="0.01"', 'timestep="0.05"')), "floor: height at rest"),
    "physics step too long for its inertia": (
        both(inertial('diaginertia="0.85 0.85 1.6"'),
             replace(('ctrlrange="0 100"', 'ctrlrange="0 400"'))),
        "physics step: error of attitude"),
    "nothing that collides": (
        replace(('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"')),
        "floor: height at rest"),
    "parts that touch each other": (
        replace(("</mujoco>", PAIR)), "a craft that is free above the ground"),
    "gravity that points up": (
        replace(('gravity="0 0 -9.8"', 'gravity="0 0 9.8"')), "gravity along -z"),
    "gravity in cm/s²": (
        replace(('gravity="0 0 -9.8"', 'gravity="0 0 -980"')), SHARE),
    "armature of the free joint": (
        free('armature="0.5"'), "free fall: depth"),
    "damping of the free joint": (
        free('damping="0.05"'), "free fall: depth"),
    "damping that the integrator cannot follow": (
        free('damping="20000"'), "free fall: warnings"),
    "thrust coefficient of revolutions per minute": (
        numeric(rotors__radius=0.4, rotors__thrust_coefficient=1.2e-5), "units: tip speed"),
}  # fmt: skip
"""By what is wrong: how to break the paper's vehicle so, and the check that must find it, or words
of the sentence by which flying refuses the file.
"""


@dataclass(frozen=True)
class Row:
    """One broken vehicle."""

    fault: str
    found_by: str
    """Name of the check that must find it; of a file that flying refuses words of the sentence."""
    found: bool
    """Whether it did."""
    measured: str
    """The check's measured value and its limits; empty if flying refuses the file."""
    meaning: str
    """The sentence of the check, or of the refusal."""
    failed: int
    """How many checks failed."""
    checks: int
    """How many there were; 0 if flying refuses the file."""


def break_vehicle(folder: Path, edit: Edit) -> Path:
    """Write the paper's vehicle, with something wrong, into a folder."""
    text = re.sub("<keyframe>.*</keyframe>", "", QUAD_XML.read_text("utf-8"), flags=re.DOTALL)
    (folder / "broken.xml").write_text(edit(text), "utf-8")
    return folder / "broken.xml"


def rows() -> list[Row]:
    """Examine every broken vehicle."""
    found = []
    for fault, (edit, name) in BROKEN.items():
        with tempfile.TemporaryDirectory() as folder:
            path = break_vehicle(Path(folder), edit)
            try:
                found.append(_row(fault, name, examine(path)))
            except InputError as error:
                sentence = str(error)
                found.append(Row(fault, name, name in sentence, "", sentence, 0, 0))
    return found


def _row(fault: str, name: str, checks: Sequence[Check]) -> Row:
    check = next(check for check in checks if check.name == name)
    measured = f"{check.measured:.4g} ({expectation(check)}) {check.unit}".strip()
    count = len(failed(checks))
    return Row(fault, name, not check.passed, measured, check.meaning, count, len(checks))


def markdown(rows: Sequence[Row]) -> str:
    """The table, in Markdown."""
    lines = []
    for row in rows:
        if row.checks:
            found_by = row.found_by
            share = f"{row.failed} of {row.checks}"
        else:
            found_by = f"refused: … {row.found_by} …"
            share = ""
        lines.append((row.fault, found_by, row.measured, share))
    return table(("what is wrong", "found by", "measured (expected)", "failed checks"), lines)


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
    found = rows()
    write_rows(path, found)
    begun = time.perf_counter()
    checks = examine()
    seconds = round(time.perf_counter() - begun, 3)
    print(markdown(found), examination(checks), sep="\n\n")
    report = {"seconds": seconds, "checks": list(map(report_of, checks))}
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    path.with_suffix(".json").write_text(text + "\n", "utf-8")


def report_of(check: Check) -> dict[str, object]:
    """For JSON: the fields by name, `tolerance` and `passed`; None for infinity and NaN."""
    values = vars(check) | {"tolerance": check.tolerance, "passed": check.passed}
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            values[name] = None
    return values


if __name__ == "__main__":
    _main()
