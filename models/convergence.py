"""The convergence test behind the choice of integrator and timestep.

`python -m rotorgram.models.convergence` prints the table that `models/README.md` shows.

Two flights of one second. Constant: level, at rest, full thrust; the height has a closed form.
Tumbling: spinning about a general axis with uneven thrusts that turn with the body; compared with
RK4 at a sixteenth of the smallest step.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from . import load_model
from .constants import MAX_CLIMB_ACCELERATION, MAX_THRUST

__all__ = ["INTEGRATORS", "STEPS", "Miss", "convergence", "observed_order"]

INTEGRATORS: Final = {
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
"""The integrators compared; MuJoCo's Euler is semi-implicit."""

STEPS: Final = (0.02, 0.01, 0.005, 0.0025)
"""Timesteps compared, s; each divides one second."""

_SECONDS: Final = 1.0
_REPEATS: Final = 5  # the same flight; only the time it takes differs, and the least is told
_HEIGHT: Final = 100.0
_TUMBLING_CTRL: Final = (60.0, 45.0, 50.0, 49.0)
_TUMBLING_RATES: Final = (1.0, 2.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class Miss:
    """How far one integrator at one timestep misses after one second."""

    integrator: str
    """Key of `INTEGRATORS`."""
    timestep: float
    """Timestep, s."""
    constant: float
    """Height missed under constant thrust, m."""
    tumbling: float
    """Position missed in tumbling flight, m."""
    turning: float
    """Largest difference of a quaternion component in tumbling flight."""
    cost: float
    """Wall time of one step, microseconds: the machine's, not the model's."""


def convergence(integrator: str, steps: Sequence[float] = STEPS) -> list[Miss]:
    """Fly both flights with `integrator` at each of `steps` (s)."""
    truth, _ = _tumble("RK4", min(STEPS) / 16)
    climb = _HEIGHT + MAX_CLIMB_ACCELERATION * _SECONDS**2 / 2
    misses = []
    for step in steps:
        level, _ = _flight(integrator, step, (MAX_THRUST,) * 4, (0.0, 0.0, 0.0))
        tumbled, cost = _tumble(integrator, step)
        misses.append(
            Miss(
                integrator=integrator,
                timestep=step,
                constant=abs(float(level[2]) - climb),
                tumbling=float(np.linalg.norm(tumbled[:3] - truth[:3])),
                turning=float(np.abs(tumbled[3:] - truth[3:]).max()),
                cost=cost,
            )
        )
    return misses


def observed_order(errors: Sequence[float], steps: Sequence[float] = STEPS) -> float:
    """Slope of log(error) over log(step): the order of the method."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def _tumble(integrator: str, step: float) -> tuple[NDArray[np.float64], float]:
    return _flight(integrator, step, _TUMBLING_CTRL, _TUMBLING_RATES)


def _flight(
    integrator: str, step: float, ctrl: Sequence[float], rates: Sequence[float]
) -> tuple[NDArray[np.float64], float]:
    """(qpos after one second, least microseconds per step); ctrl in N, body rates in rad/s."""
    model = load_model()
    model.opt.integrator = INTEGRATORS[integrator]
    model.opt.timestep = step
    data = mujoco.MjData(model)
    count = round(_SECONDS / step)
    cost = float("inf")
    for _ in range(_REPEATS):
        mujoco.mj_resetData(model, data)
        data.qpos[2] = _HEIGHT
        data.qvel[3:] = rates
        data.ctrl[:] = ctrl
        begun = time.perf_counter()
        mujoco.mj_step(model, data, nstep=count)
        cost = min(cost, (time.perf_counter() - begun) / count * 1e6)
    return np.array(data.qpos), cost


def _main() -> None:
    """Print the table, in Markdown."""
    print("| integrator | step, ms | constant thrust, m | tumbling, m | turning | step costs, µs |")
    print("|---|---|---|---|---|---|")
    for name in INTEGRATORS:
        misses = convergence(name)
        for miss in misses:
            print(
                f"| {name} | {miss.timestep * 1e3:g} | {miss.constant:.1e} | {miss.tumbling:.1e} "
                f"| {miss.turning:.1e} | {miss.cost:.1f} |"
            )
        tumbling = observed_order([miss.tumbling for miss in misses])
        turning = observed_order([miss.turning for miss in misses])
        print(f"| {name}: observed order | | | {tumbling:.2f} | {turning:.2f} | |")


if __name__ == "__main__":
    _main()
