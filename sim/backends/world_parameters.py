"""Drawn parameters of the compiled model: which of its fields they change, and to what."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from ...models.vehicle import body_axes, owners, payload_body
from ..randomize import CENTER
from ..state import Array, ByName, stack

_FIELDS = {
    "mass": ("body_mass", "body_inertia", "dof_damping"),  # Unity's drag goes with the mass
    "inertia": ("body_inertia",),
    "payload": ("body_mass", "body_inertia"),
    "reaction": ("actuator_gear",),
    **dict.fromkeys(CENTER, ("body_ipos",)),
}


class WorldParameters:
    """Fields of a model that differ between worlds.

    Attributes:
        base: Their values in the model by name; empty if nothing that is drawn is of the model.
    """

    def __init__(self, model: mujoco.MjModel, drawn: Sequence[str]) -> None:
        fields = dict.fromkeys(field for name in drawn for field in _FIELDS.get(name, ()))
        self.base = {field: getattr(model, field).copy() for field in fields}
        owner = owners(model)
        self._craft = owner >= 0
        self._hung = np.zeros(model.nbody, bool)
        if "payload" in drawn:
            self._hung[payload_body(model)] = True
        # Of each craft the first of six degrees of freedom are those of its translation.
        self._linear = self._craft[model.dof_bodyid] & (np.arange(model.nv) % 6 < 3)
        self._torque = np.arange(6) >= 3  # of a gear
        self._axes = body_axes(model) * self._craft[:, None, None]
        of_sites = owner[model.site_bodyid[model.actuator_trnid[:, 0]]]
        self._of_bodies, self._of_dofs, self._of_rotors = (
            np.maximum(one, 0) for one in (owner, owner[model.dof_bodyid], of_sites)
        )

    def values(self, parameters: Mapping[str, Array]) -> ByName:
        """The fields by name, each (N, ...), of N worlds with these parameters, each (N, A)."""
        where = np.where
        ones = 1.0 + 0.0 * next(iter(parameters.values()))
        mass = parameters.get("mass", ones)
        inertia = mass * parameters.get("inertia", ones)
        loads = where(self._hung, parameters.get("payload", ones)[:, :1], 1.0)
        reaction = parameters.get("reaction", ones)[:, self._of_rotors, None]
        factors = {
            "body_mass": where(self._craft, mass[:, self._of_bodies], loads),
            "body_inertia": where(self._craft, inertia[:, self._of_bodies], loads)[..., None],
            "dof_damping": where(self._linear, mass[:, self._of_dofs], 1.0),
            "actuator_gear": where(self._torque, reaction, 1.0),
        }
        values = {
            field: factors[field] * base for field, base in self.base.items() if field in factors
        }
        if "body_ipos" in self.base:
            shift = stack([parameters.get(name, 0.0 * ones) for name in CENTER])
            moved = np.einsum("bji,wbj->wbi", self._axes, shift[:, self._of_bodies])
            values["body_ipos"] = self.base["body_ipos"] + moved
        return values
