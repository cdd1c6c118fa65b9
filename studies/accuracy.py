"""Accuracy and cost of integrators and physics steps.

    python studies/accuracy.py [--out FILE.csv]

writes the table that `docs/physics.md` shows, within a minute.

Two flights of the paper's vehicle. Tumbling: 5 s that begin with a spin about no axis of symmetry,
with four thrusts that change every 20 ms; compared with RK4 at 0.25 ms. Drop: 1.5 s that begin at
rest, 1 m above the floor, without thrust; contacts are soft, so that the craft sinks in.
"""

import copy
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from measuring import RESULTS, options, table, write_rows
from numpy.typing import NDArray
from rotorgram.models import Vehicle

INTEGRATORS: Final = {
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
"""The integrators compared; MuJoCo's Euler is semi-implicit."""

STEPS: Final = (0.001, 0.002, 0.005, 0.01, 0.02)
"""Physics steps compared, s; each divides the control step of 20 ms."""

_CONVERGED: Final = 0.00025
_CONTROL: Final = 0.02
_SPIN: Final = (1.0, 2.0, 3.0)  # rad/s
_SECONDS: Final = 5.0
_REPEATS: Final = 5  # the same flight; only the time it takes differs, and the least counts


@dataclass(frozen=True)
class Accuracy:
    """One integrator at one step."""

    integrator: str
    """Key of `INTEGRATORS`."""
    step_ms: float
    """Physics step, ms."""
    position_m: float
    """Distance from the converged path after 5 s of tumbling flight, m."""
    attitude_deg: float
    """Angle between the attitude reached and the converged one, degrees."""
    sinks_mm: float
    """Depth to which a drop from 1 m sinks into the floor, mm."""
    cost_us: float
    """Wall time of a simulated second of tumbling flight, µs: the machine's, not the model's."""


def accuracy(
    vehicle: Vehicle, integrators: Iterable[str] = INTEGRATORS, steps: Iterable[float] = STEPS
) -> list[Accuracy]:
    """Fly both flights with each integrator at each step (s)."""
    truth, _ = _tumble(vehicle, "RK4", _CONVERGED)
    rows = []
    for name in integrators:
        for step in steps:
            reached, cost = _tumble(vehicle, name, step, _REPEATS)
            off = float(np.linalg.norm(reached[:3] - truth[:3]))
            apart = min(np.linalg.norm(reached[3:] - sign * truth[3:]) for sign in (1, -1))
            turned = float(np.degrees(4 * np.arcsin(apart / 2)))
            sinks = _sinks(vehicle, name, step) * 1e3
            rows.append(Accuracy(name, step * 1e3, off, turned, sinks, cost))
    return rows


def markdown(rows: Sequence[Accuracy]) -> str:
    """The table, in Markdown."""
    head = (
        "integrator",
        "step, ms",
        "off the path, m",
        "off the attitude, °",
        "drop sinks, mm",
        "cost of a second, µs",
    )
    cells = (
        (
            row.integrator,
            f"{row.step_ms:g}",
            f"{row.position_m:.1e}",
            f"{row.attitude_deg:.1e}",
            f"{row.sinks_mm:.1f}",
            f"{row.cost_us:,.0f}",
        )
        for row in rows
    )
    return table(head, cells)


def _start(
    vehicle: Vehicle, integrator: str, step: float, height: float
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """(model, data) of a level craft at rest."""
    model = copy.copy(vehicle.model)
    model.opt.integrator = INTEGRATORS[integrator]
    model.opt.timestep = step
    data = mujoco.MjData(model)
    data.qpos[:] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
    return model, data


def _tumble(
    vehicle: Vehicle, integrator: str, step: float, repeats: int = 1
) -> tuple[NDArray[np.float64], float]:
    """(`qpos` after the flight, least µs for a simulated second)."""
    control_steps = round(_SECONDS / _CONTROL)
    substeps = round(_CONTROL / step)
    phases = np.arange(control_steps)[:, None] * (0.11, 0.13, 0.17, 0.19)
    thrusts = vehicle.hover_thrust * (1 + 0.3 * np.sin(phases))
    cost = float("inf")
    for _ in range(repeats):
        model, data = _start(vehicle, integrator, step, 1000.0)
        data.qvel[3:] = _SPIN
        begun = time.perf_counter()
        for thrust in thrusts:
            data.ctrl[:] = thrust
            mujoco.mj_step(model, data, nstep=substeps)
        cost = min(cost, (time.perf_counter() - begun) / _SECONDS * 1e6)
    return np.array(data.qpos), cost


def _sinks(vehicle: Vehicle, integrator: str, step: float) -> float:
    """Largest depth of the craft below its height of rest after a drop from 1 m, m."""
    model, data = _start(vehicle, integrator, step, vehicle.rest_height + 1.0)
    lowest = vehicle.rest_height
    for _ in range(round(1.5 / step)):
        mujoco.mj_step(model, data)
        lowest = min(lowest, float(data.qpos[2]))
    return vehicle.rest_height - lowest


def _main() -> None:
    out = RESULTS / "physics" / "accuracy.csv"
    args = options(__doc__, out=out).parse_args()
    rows = accuracy(Vehicle.load())
    print(markdown(rows))
    write_rows(args.out, rows)


if __name__ == "__main__":
    _main()
