"""Which crafts of W worlds reach level ground, by their solid geoms, or each other, by spheres."""

from functools import reduce

import mujoco
import numpy as np

from ...models.matrices import settled
from ...models.mjcf import level_data
from ...models.vehicle import Vehicle, can_touch, craft_geoms
from ..rotations import Parts
from ..state import Array, clip, some
from .body import added, forth

_ROUNDED = 1e-6  # m: what is no margin of a contact


class Hull:
    """The solid geoms of a craft, and its sphere.

    A geom with center c, radius r and axes aᵢ reaches from the body's origin, along a unit vector u
    downwards, u·c + r + Σ sᵢ |u·aᵢ| + sqrt(Σ (tᵢ u·aᵢ)²): a box has s, a cylinder one s and two t,
    an ellipsoid t. Vertices of a mesh are geoms without a size.

    Attributes:
        ground: Height at which a level craft of no depth would touch, m: 0 but for margins.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._shapes = shapes = _shapes(vehicle.model)
        self._reach = -np.inf
        self.ground = 0.0
        self._apart = 2 * vehicle.radius
        if not shapes:
            return
        centers, radii, axes, flat, rounded = map(settled, zip(*shapes, strict=True))
        numbers = (centers, radii, axes.transpose(0, 2, 1), flat, rounded)
        lists = [array.tolist() for array in numbers]
        self._shapes = list(zip(*lists, strict=True))
        sizes = np.linalg.norm(flat, axis=1) + np.linalg.norm(rounded, axis=1)
        self._reach = float((np.linalg.norm(centers, axis=1) + radii + sizes).max())
        margin = vehicle.rest_height - float(self._depth((0.0, 0.0, -1.0)))
        self.ground = margin if abs(margin) > _ROUNDED else 0.0

    def touches(self, height: Array, quaternion: Parts) -> Array:
        """Whether crafts at such heights and attitudes (four vectors) touch the ground."""
        height = height - self.ground
        near = height < self._reach
        if not (self._shapes and some(near)):
            return near
        w, x, y, z = quaternion
        down = (2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1)
        depth: Array = self._depth(down)
        return height < depth

    def collides(self, position: Parts) -> Array:
        """Whether a craft's sphere overlaps another of its world, bool, shape (W, A).

        Of `Vehicle.radius` about the body's origin, at positions, three of (W, A), m.
        """
        square: Array = 0.0
        for x in position:
            x = clip(x, -mujoco.mjMAXVAL, mujoco.mjMAXVAL)  # a bad state overflows
            apart = x[:, :, None] - x[:, None]
            square = square + apart * apart
        others = ~np.eye(square.shape[-1], dtype=bool)
        return ((square < self._apart**2) & others).any(axis=-1)

    def _depth(self, down: Parts) -> Array:
        """How far the craft reaches along unit vectors, body frame, three vectors: m."""
        depths = []
        for center, radius, axes, flat, rounded in self._shapes:
            terms = list(zip(center, down, strict=True))
            along = forth(axes, down)
            terms += [(side, abs(one)) for side, one in zip(flat, along, strict=True) if side]
            depth = added(radius, *terms)
            if any(rounded):
                pairs = zip(rounded, along, strict=True)
                depth = depth + np.sqrt(added(0.0, *((size * size, a, a) for size, a in pairs)))
            depths.append(depth)
        return reduce(np.maximum, depths)


def _shapes(model: mujoco.MjModel) -> list[tuple[Array, ...]]:
    """Center, radius, axes as columns, s and t of each geom that can touch the ground."""
    data = level_data(model)
    ours = craft_geoms(model)
    shapes: list[tuple[Array, ...]] = []
    none = (0.0, 0.0, 0.0)
    kinds = mujoco.mjtGeom
    for i in np.flatnonzero(ours & can_touch(model, ~ours)).tolist():
        place = data.geom_xpos[i].copy()
        axes = data.geom_xmat[i].reshape(3, 3).copy()
        a, b, c = model.geom_size[i].tolist()
        kind = kinds(model.geom_type[i])
        if kind == kinds.mjGEOM_MESH:
            mesh = model.geom_dataid[i]
            first = model.mesh_vertadr[mesh]
            count = model.mesh_vertnum[mesh]
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
