"""Flights of RotorPy's Hummingbird, for `rotorpy.py`: run by the Python that has RotorPy.

Reads JSON from the standard input: the cases with their shares of the hover thrust, the start and
the control period. Writes JSON: RotorPy's parameters and, for each case, its states.
"""

import json
import sys
from importlib.metadata import version

import numpy as np
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

TIGHT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
USUAL_STEP = 0.01  # s: that of RotorPy's Environment, sim_rate = 100
AIR = {"body_drag": ("c_Dx", "c_Dy", "c_Dz"), "rotor_drag": ("k_d", "k_z", "k_h")}


def fly(effects, shares, period, velocity, rates, tight):
    """Positions and quaternions (scalar first) at the start and after each control period.

    `tight`: with tolerances that leave rounding alone; otherwise with RotorPy's own, and in steps
    of 10 ms, which its `Environment` takes.
    """
    params = dict(quad_params)
    for effect, names in AIR.items():
        if effect not in effects:
            params.update(dict.fromkeys(names, 0.0))
    craft = Multirotor(params, aero=True, integrator_kwargs=TIGHT if tight else None)
    hover = craft.mass * craft.g / craft.num_rotors / craft.k_eta
    state = {
        "x": np.zeros(3),
        "v": np.array(velocity),
        "q": np.array((0.0, 0.0, 0.0, 1.0)),
        "w": np.array(rates),
        "wind": np.array(effects.get("wind", (0.0, 0.0, 0.0))),
        "rotor_speeds": np.full(craft.num_rotors, np.sqrt(hover)),
    }
    flown = [(state["x"], state["q"])]
    for share in shares:
        speeds = np.sqrt(hover * np.array(share))
        if "motor_lag" not in effects:
            state["rotor_speeds"] = speeds  # at the command already: nothing lags
        steps = 1 if tight else round(period / USUAL_STEP)
        for _ in range(steps):
            state = craft.step(state, {"cmd_motor_speeds": speeds}, period / steps)
        flown.append((state["x"], state["q"]))
    positions = [x.tolist() for x, _ in flown]
    return positions, [np.roll(q, 1).tolist() for _, q in flown]


def main():
    """See the module."""
    given = json.load(sys.stdin)
    start = given["period"], given["velocity"], given["rates"]
    told = {
        name: {
            kind: fly(effects, given["shares"], *start, kind == "tight") for kind in given["kinds"]
        }
        for name, effects in given["cases"].items()
    }
    params = {k: v for k, v in quad_params.items() if k != "rotor_pos"}
    params["rotor_pos"] = [list(place) for place in quad_params["rotor_pos"].values()]
    params["g"] = Multirotor(quad_params).g
    params = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in params.items()}
    json.dump({"version": version("rotorpy"), "params": params, "flights": told}, sys.stdout)


if __name__ == "__main__":
    main()
