"""Drawn parameters of the compiled model: which of its fields they change, and to what."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from ...models.vehicle import body_axes, craft_bodies, payload_body
from ..randomize import CENTER
from ..state import Array, constant, stack

_FIELDS: Final = {
    "mass": ("body_mass", "body_inertia", "dof_damping"),  # Unity's drag goes with the mass
    "inertia": ("body_inertia",),
    "payload": ("body_mass", "body_inertia"),
    "reaction": ("actuator_gear",),
    **dict.fromkeys(CENTER, ("body_ipos",)),
}


class Varied:
    """Fields of a model that differ between worlds.

    Attributes:
        fields: Their names; empty if nothing that is drawn is of the model.
    """

    def __init__(self, model: mujoco.MjModel, drawn: Sequence[str], xp: Any) -> None:
        self._names, self._xp = [name for name in drawn if name in _FIELDS], xp
        self.fields = tuple(dict.fromkeys(f for name in self._names for f in _FIELDS[name]))
        self._base = {name: getattr(model, name).copy() for name in self.fields}
        self._craft, self._hung = np.zeros(model.nbody), np.zeros(model.nbody)
        self._craft[craft_bodies(model)] = 1.0
        if "payload" in self._names:
            self._hung[payload_body(model)] = 1.0
        self._linear = np.arange(model.nv) < 3  # degrees of freedom of the craft's translation
        self._torque = np.arange(6) >= 3  # of a gear
        self._axes = np.zeros((model.nbody, 3, 3))
        self._axes[craft_bodies(model)] = body_axes(model)

    def values(self, parameters: Mapping[str, Array]) -> dict[str, Array]:
        """The fields by name, each (N, ...), of N worlds with these parameters, each (N,)."""
        where = self._xp.where
        given = {name: parameters[name] for name in self._names}
        like = next(iter(given.values()))
        told = {name: constant(base, like) for name, base in self._base.items()}
        ones = 1.0 + 0.0 * like
        craft, hung = (constant(x, like) > 0.5 for x in (self._craft, self._hung))
        mass, payload = (given.get(name, ones)[:, None] for name in ("mass", "payload"))
        inertia = mass * given.get("inertia", ones)[:, None]
        loads = where(hung, payload, 1.0)
        linear, torque = (constant(x, like) > 0.5 for x in (self._linear, self._torque))
        reaction = given.get("reaction", ones)[:, None, None]
        factors = {
            "body_mass": where(craft, mass, loads),
            "body_inertia": where(craft, inertia, loads)[..., None],
            "dof_damping": where(linear, mass, 1.0),
            "actuator_gear": where(torque, reaction, 1.0),
        }
        values = {name: factors[name] * base for name, base in told.items() if name in factors}
        if "body_ipos" in told:
            shift = stack([given.get(name, 0.0 * ones) for name in CENTER])
            axes = constant(self._axes, like)
            values["body_ipos"] = told["body_ipos"] + self._xp.einsum("bji,wj->wbi", axes, shift)
        return values
