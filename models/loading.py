"""Loading the vehicle, and naming exactly which vehicle was loaded."""

import math
import struct
from hashlib import blake2b
from typing import Final

import mujoco

from . import SCENE_XML

__all__ = ["apply_linear_drag", "load_model", "model_hash", "model_xml"]

_HASH_BYTES: Final = 16


def load_model(linear_drag: float = 0.0, *, visual: bool = True) -> mujoco.MjModel:
    """Compile the scene: vehicle, floor, sky and light.

    Args:
        visual: Keep what is only looked at. Without it the physics is the same, bit for bit, and
            faster.
        linear_drag: 1/s. Acceleration −linear_drag · velocity, as Unity's `Rigidbody.drag`; finite
            and not negative. 0 is the paper's frictionless craft.

    Raises:
        ValueError: if `linear_drag` is negative or not finite.
    """
    linear_drag = _checked_drag(linear_drag)
    spec = mujoco.MjSpec.from_file(str(SCENE_XML))
    spec.compiler.discardvisual = not visual
    model = spec.compile()
    apply_linear_drag(model, linear_drag)
    return model


def apply_linear_drag(model: mujoco.MjModel, linear_drag: float) -> None:
    """Set the drag of `model` in place: a force −linear_drag · mass · velocity (world frame, N).

    It acts on the three translations of the free joint, the model's first joint, and leaves the
    rotations alone.
    """
    model.dof_damping[0:3] = _checked_drag(linear_drag) * mujoco.mj_getTotalmass(model)


def model_hash(linear_drag: float = 0.0) -> str:
    """32 hexadecimal characters that name the model `load_model(linear_drag)` gives.

    BLAKE2b over the whole MJCF with its includes resolved, as `MjSpec.to_xml()` writes it, and the
    drag as a little-endian float64. Comments, layout and the folder do not enter; numbers do, to
    the six digits that MuJoCo writes. Another version of MuJoCo may write the MJCF differently.
    """
    drag = struct.pack("<d", _checked_drag(linear_drag))
    return blake2b(model_xml().encode() + b"\0" + drag, digest_size=_HASH_BYTES).hexdigest()


def model_xml() -> str:
    """The whole MJCF of the scene with its includes resolved, as `MjSpec.to_xml()` writes it."""
    return str(mujoco.MjSpec.from_file(str(SCENE_XML)).to_xml())


def _checked_drag(linear_drag: float) -> float:
    """`linear_drag` as a float, −0.0 turned into 0.0; ValueError unless finite and >= 0."""
    if not (math.isfinite(linear_drag) and linear_drag >= 0.0):
        raise ValueError(f"linear_drag: expected a finite number >= 0 (1/s), got {linear_drag!r}")
    return float(linear_drag) + 0.0
