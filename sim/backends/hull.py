"""Which crafts of W worlds reach level ground, from their solid geoms."""

from typing import Any, Final

import mujoco
import numpy as np
import torch

from ...models.vehicle import Vehicle, craft_bodies

_ROUNDED: Final = 1e-6  # m: what is no margin of a contact


class Hull:
    """The solid geoms of a craft.

    A geom with center c, radius r and axes aᵢ reaches from the body's origin, along a unit vector u
    downwards, u·c + r + Σ sᵢ |u·aᵢ| + sqrt(Σ (tᵢ u·aᵢ)²): a box has s, a cylinder one s and two t,
    an ellipsoid t. Vertices of a mesh are geoms without a size.

    Attributes:
        ground: Height at which a level craft of no depth would touch, m: 0 but for margins.
    """

    def __init__(self, vehicle: Vehicle, dtype: torch.dtype, device: torch.device) -> None:
        shapes = _shapes(vehicle.model)
        self._any = bool(shapes)
        if not shapes:
            self.ground = 0.0
            return
        centers, radii, axes, flat, rounded = map(np.array, zip(*shapes, strict=True))

        def put(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=dtype, device=device)

        self._centers, self._radii = put(centers), put(radii)[:, None]
        self._axes = put(axes.transpose(0, 2, 1).reshape(-1, 3))
        self._flat, self._rounded = put(flat)[..., None], put(rounded)[..., None]
        sizes = np.linalg.norm(flat, axis=1) + np.linalg.norm(rounded, axis=1)
        self._reach = float((np.linalg.norm(centers, axis=1) + radii + sizes).max())
        level = float(self._depth(put(np.array((0.0, 0.0, -1.0)))[:, None]))
        margin = vehicle.rest_height - level
        self.ground = margin if abs(margin) > _ROUNDED else 0.0

    def touches(self, height: torch.Tensor, quaternion: Any) -> torch.Tensor:
        """Whether crafts at such heights and attitudes (four vectors) touch the ground, (W,)."""
        height = height.detach() - self.ground
        if not self._any or not (height < self._reach).any():
            return torch.zeros_like(height, dtype=torch.bool)
        w, x, y, z = (part.detach() for part in quaternion)
        down = torch.stack((2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1))
        return height < self._depth(down)

    def _depth(self, down: torch.Tensor) -> torch.Tensor:
        """How far the craft reaches along unit vectors, body frame, (3, W): m, (W,)."""
        along = (self._axes @ down).reshape(-1, 3, down.shape[1])
        straight = (self._flat * along.abs()).sum(dim=1)
        round_ = (self._rounded * along).square().sum(dim=1).sqrt()
        return (self._centers @ down + self._radii + straight + round_).amax(dim=0)


def _shapes(model: mujoco.MjModel) -> list[tuple[Any, ...]]:
    """Center, radius, axes as columns, s and t of each geom that meets the ground."""
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    mujoco.mj_kinematics(model, data)
    ours = np.isin(model.geom_bodyid, craft_bodies(model))
    types, affinities = model.geom_contype, model.geom_conaffinity
    shapes: list[tuple[Any, ...]] = []
    none, kinds = (0.0, 0.0, 0.0), mujoco.mjtGeom
    for i in np.flatnonzero(ours).tolist():
        if not ((types[i] & affinities[~ours]) | (affinities[i] & types[~ours])).any():
            continue
        place, axes = data.geom_xpos[i].copy(), data.geom_xmat[i].reshape(3, 3).copy()
        a, b, c = model.geom_size[i].tolist()
        kind = kinds(model.geom_type[i])
        if kind == kinds.mjGEOM_MESH:
            mesh = model.geom_dataid[i]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            for vertex in model.mesh_vert[first : first + count].astype(np.float64):
                shapes.append((place + axes @ vertex, 0.0, axes, none, none))
            continue
        radius, flat, rounded = {
            kinds.mjGEOM_SPHERE: (a, none, none),
            kinds.mjGEOM_CAPSULE: (a, (0.0, 0.0, b), none),
            kinds.mjGEOM_BOX: (0.0, (a, b, c), none),
            kinds.mjGEOM_CYLINDER: (0.0, (0.0, 0.0, b), (a, a, 0.0)),
            kinds.mjGEOM_ELLIPSOID: (0.0, none, (a, b, c)),
        }[kind]
        shapes.append((place, radius, axes, flat, rounded))
    return shapes
