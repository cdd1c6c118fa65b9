"""Rays and distances to primitives, float32: formulas that NumPy runs, and Numba compiles.

A formula is array code of `_least`, `_most`, `_pick`, `_root` and operators. NumPy runs it on
arrays; Numba on numbers, in loops that become vectors. The bits are the same: so are the
operations and their order, and none is fused with another. What compiled code leaves out, since it
is too far away or out of sight, no ray could meet by `_MARGIN`.

A table, shape (16, P), has of each primitive its center, its three axes, and half the sides of the
box about it, m; the last row is the radius by which that box is rounded.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

KINDS = ("sphere", "capsule", "cylinder", "box", "plane")
"""Capsule and cylinder stand along their third axis. That of a plane is its normal: what lies
below is solid."""
ROWS = 16
LANES = 16
"""Rays of a packet."""

_SPHERE, _CAPSULE, _CYLINDER, _BOX, _PLANE = range(len(KINDS))
_CENTER, _U, _V, _AXIS, _SIZE, _ROUNDING = 0, 3, 6, 9, 12, 15
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_TINY = np.float32(1e-12)
_NUDGE = np.float32(1e-9)
_BIG = np.float32(1e30)
_UNTURNED = np.eye(3, dtype=np.float32).ravel()
_MARGIN = np.float32(0.01)  # m: at tens of metres, float32 rounds by far less

Array = Any
Vector = Any
"""Three numbers, or arrays of them."""
Function = Callable[..., Any]
Numba = Any
"""What Numba gives and takes, which has no types."""
Options = dict[str, Any]


# ---- what formulas are made of: here for arrays, in `compiled` for numbers


def _least(a: Array, b: Array) -> Array:
    return np.minimum(a, b)


def _most(a: Array, b: Array) -> Array:
    return np.maximum(a, b)


def _pick(flag: Array, yes: Array, no: Array) -> Array:
    return np.where(flag, yes, no)


def _root(x: Array) -> Array:
    return np.sqrt(x)


def _dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _nonzero(x: Array) -> Array:
    return _pick(x >= _ZERO, _most(x, _TINY), _least(x, -_TINY))


# ---- where a ray enters and leaves a primitive, and whether it meets it
#
# By the ray's direction and the primitive, as `_seen` gives it.


def _sphere(ray: Vector, solid: Array) -> Array:
    return _ball(ray, solid[0], solid[5][0])


def _ball(ray: Vector, center: Vector, radius: Array) -> Array:
    """By the ray's nearest point: a difference of large squares would be lost."""
    along = _dot(ray, center)
    x = center[0] - along * ray[0]
    y = center[1] - along * ray[1]
    z = center[2] - along * ray[2]
    square = radius * radius - (x * x + y * y + z * z)
    half = _root(_most(square, _ZERO))
    return along - half, along + half, square >= _ZERO


def _side(ray: Vector, middle: Vector, radius: Array) -> Array:
    """Of the endless cylinder about the third axis, as `_ball`."""
    x, y, _ = ray
    scale = _ONE / (x * x + y * y)
    along = (x * middle[0] + y * middle[1]) * scale
    p = middle[0] - along * x
    q = middle[1] - along * y
    square = radius * radius - (p * p + q * q)
    half = _root(_most(square, _ZERO) * scale)
    return along - half, along + half, square >= _ZERO


def _cylinder(ray: Vector, solid: Array) -> Array:
    _, u, v, axis, middle, size = solid
    local = (_dot(ray, u) + _NUDGE, _dot(ray, v), _dot(ray, axis))
    enters, leaves, meets = _side(local, middle, size[0])
    steep = _ONE / _nonzero(local[2])
    low = (middle[2] - size[2]) * steep
    high = (middle[2] + size[2]) * steep
    enters = _most(enters, _least(low, high))
    leaves = _least(leaves, _most(low, high))
    return enters, leaves, meets & (enters <= leaves)


def _capsule(ray: Vector, solid: Array) -> Array:
    """Where the ray crosses the side beyond an end, the ball there decides."""
    _, u, v, axis, middle, size = solid
    radius = size[0]
    height = size[3]
    local = (_dot(ray, u) + _NUDGE, _dot(ray, v), _dot(ray, axis))
    enters, leaves, meets = _side(local, middle, radius)
    first = enters * local[2] - middle[2]
    last = leaves * local[2] - middle[2]
    start = middle[2] + _pick(first > _ZERO, height, -height)
    end = middle[2] + _pick(last > _ZERO, height, -height)
    into, _, starts = _ball(local, (middle[0], middle[1], start), radius)
    _, out, ends = _ball(local, (middle[0], middle[1], end), radius)
    is_side = abs(first) <= height
    was_side = abs(last) <= height
    meets = meets & (is_side | starts) & (was_side | ends)
    return _pick(is_side, enters, into), _pick(was_side, leaves, out), meets


def _box(ray: Vector, solid: Array) -> Array:
    """By slabs: Kay and Kajiya, Ray tracing complex scenes, SIGGRAPH 1986."""
    _, u, v, axis, middle, size = solid
    x = _ONE / _nonzero(_dot(ray, u))
    y = _ONE / _nonzero(_dot(ray, v))
    z = _ONE / _nonzero(_dot(ray, axis))
    a, b, c = middle[0] * x, middle[1] * y, middle[2] * z
    p, q, r = abs(x) * size[0], abs(y) * size[1], abs(z) * size[2]
    enters = _most(_most(a - p, b - q), c - r)
    leaves = _least(_least(a + p, b + q), c + r)
    return enters, leaves, enters <= leaves


def _plane(ray: Vector, solid: Array) -> Array:
    """From above alone."""
    _, _, _, axis, middle, _ = solid
    down = _dot(ray, axis)
    met = middle[2] / _least(down, -_TINY)
    return met, met, down < -_TINY


_MEETINGS = (_sphere, _capsule, _cylinder, _box, _plane)
"""By `KINDS`."""


def _nearer(old: Array, enters: Array, leaves: Array, meets: Array) -> Array:
    """The least distance so far; a ray from within a primitive meets what it leaves."""
    met = _pick(enters >= _ZERO, enters, leaves)
    return _least(old, _pick(meets & (met >= _ZERO), met, _BIG))


# ---- primitives of a table


def _three(table: Array, first: int, j: Array) -> Vector:
    return table[first, j], table[first + 1, j], table[first + 2, j]


def _turned(m: Array, vector: Vector) -> Vector:
    """A vector of the world in the frame of a sensor, by the columns of its attitude."""
    x, y, z = vector
    return (
        m[0] * x + m[3] * y + m[6] * z,
        m[1] * x + m[4] * y + m[7] * z,
        m[2] * x + m[5] * y + m[8] * z,
    )


def _seen(table: Array, j: Array, place: Array, attitude: Array) -> Array:
    """Center, three axes and size of a primitive in the frame of a sensor, and between them its
    center along the axes. Its size is half its sides, and half of the third without its rounding.
    """
    x, y, z = _three(table, _CENTER, j)
    center = _turned(attitude, (x - place[0], y - place[1], z - place[2]))
    u = _turned(attitude, _three(table, _U, j))
    v = _turned(attitude, _three(table, _V, j))
    axis = _turned(attitude, _three(table, _AXIS, j))
    middle = (_dot(center, u), _dot(center, v), _dot(center, axis))
    a, b, c = _three(table, _SIZE, j)
    return center, u, v, axis, middle, (a, b, c, c - table[_ROUNDING, j])


def _gap(kind: Array, table: Array, j: Array, point: Vector) -> Array:
    """From a point to a primitive, m; below 0 within it."""
    x, y, z = _three(table, _CENTER, j)
    away = (point[0] - x, point[1] - y, point[2] - z)
    a, b, c = _three(table, _SIZE, j)
    radius = table[_ROUNDING, j]
    along = abs(_dot(away, _three(table, _U, j)))
    across = abs(_dot(away, _three(table, _V, j)))
    up = _dot(away, _three(table, _AXIS, j))
    is_round = kind == _CYLINDER
    along = _pick(is_round, _root(along * along + across * across), along) - (a - radius)
    across = _pick(is_round, _ZERO, across) - (b - radius)
    over = abs(up) - (c - radius)
    inside = _least(_most(along, _most(across, over)), _ZERO)
    along, across, over = _most(along, _ZERO), _most(across, _ZERO), _most(over, _ZERO)
    gap = _root(along * along + across * across + over * over) + inside - radius
    return _pick(kind == _PLANE, up, gap)


def distances(kinds: Array, table: Array, points: Array) -> Array:
    """From points, (N, 3), to the nearest primitive of a table, m, (N,), by NumPy."""
    gaps = _gap(kinds, table, slice(None), points.T[:, :, None])
    nearest: Array = gaps.min(axis=1, initial=np.inf)
    return nearest


def _nearest(kinds: Array, table: Array, x: Array, y: Array, z: Array) -> Array:
    """From a point to the nearest primitive of a layout but the first, the ground, m; 1e30 if there
    is none.
    """
    nearest = _BIG
    for j in range(1, kinds.size):
        nearest = _least(nearest, _gap(kinds[j], table, j, (x, y, z)))
    return nearest


def _first(
    kinds: Array, table: Array, x: Array, y: Array, z: Array, dx: Array, dy: Array, dz: Array
) -> Array:
    """Along a ray from a point to the first primitive but the ground, m; 1e30 if there is none."""
    found = _BIG
    ray = (dx, dy, dz)
    for j in range(1, kinds.size):
        solid = _seen(table, j, (x, y, z), _UNTURNED)
        kind = kinds[j]
        if kind == _SPHERE:
            enters, leaves, meets = _sphere(ray, solid)
        elif kind == _CAPSULE:
            enters, leaves, meets = _capsule(ray, solid)
        elif kind == _CYLINDER:
            enters, leaves, meets = _cylinder(ray, solid)
        elif kind == _BOX:
            enters, leaves, meets = _box(ray, solid)
        else:
            enters, leaves, meets = _plane(ray, solid)
        found = _nearer(found, enters, leaves, meets)
    return found


def first_by_numpy(kinds: Array, table: Array, point: Array, ray: Array) -> Array:
    """As `_first`, of a point and a direction, (3,)."""
    with np.errstate(all="ignore"):
        return _first(kinds, table, *point, *ray)


def _gaps(kinds: Array, tables: Array, which: Array, points: Array, due: Array, out: Array) -> None:
    """Set `out`, (W, A), to the distances of points, (W, A, 3), where `due`, (W, A), is true.

    float32, m; of layouts as `_packets` has them.
    """
    for w in range(out.shape[0]):
        for a in range(out.shape[1]):
            if due[w, a]:
                x, y, z = points[w, a, 0], points[w, a, 1], points[w, a, 2]
                out[w, a] = _nearest(kinds[which[w]], tables[which[w]], x, y, z)


def gaps_by_numpy(
    kinds: Array, tables: Array, which: Array, points: Array, due: Array, out: Array
) -> None:
    """As `_gaps`."""
    for w in np.flatnonzero(due.any(axis=1)):
        near = distances(kinds[which[w], 1:], tables[which[w], :, 1:], points[w])
        out[w] = np.where(due[w], np.minimum(near, _BIG), out[w])


def _nearest_at(count: int, kinds: Numba, table: Numba, x: Array, y: Array, z: Array) -> Array:
    """As `_nearest`, by the addresses of the kinds and of the table of so many primitives."""
    return _nearest(_array(kinds, (count,)), _array(table, (ROWS, count)), x, y, z)


def _first_at(
    count: int,
    kinds: Numba,
    table: Numba,
    x: Array,
    y: Array,
    z: Array,
    dx: Array,
    dy: Array,
    dz: Array,
) -> Array:
    """As `_first`, by such addresses."""
    return _first(_array(kinds, (count,)), _array(table, (ROWS, count)), x, y, z, dx, dy, dz)


_array: Numba = None  # of an address: in `compiled` alone


# ---- all rays of a sensor


def _packets(
    kinds: Array, tables: Array, which: Array, place: Array, attitude: Array,
    directions: Array, planes: Array, whole: Array, slots: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """Distances along rays of W sensors to the first primitive, m; `reach` if there is none.

    Args:
        kinds, tables: Of layouts, (S, P) and (S, 16, P).
        which: Layout of each sensor, (W,).
        place: Of each sensor, m, (W, 3).
        attitude: From its frame to the world's: rows of matrices, (W, 9).
        directions: Of packets of rays, unit vectors: x of the rays, then y, then z, (K, 48).
        planes: About a packet each: five normals that point inwards. So many packets side by side
            as a packet has rays, (ceil(K / 16), 240).
        whole: Such planes about all rays, (F, 3).
        slots: Where each ray is among those of the packets, (N,).
        reach: float32, m.
        out: (W, N).
    """
    far = np.empty(kinds.shape[1], np.float32)
    aside = np.empty(15, np.float32)
    hits = np.empty((planes.shape[0], LANES), np.int32)
    hit = hits.reshape(-1)
    found = np.empty((directions.shape[0], LANES), np.float32)
    flat = found.reshape(-1)
    for w in range(out.shape[0]):
        kind = kinds[which[w]]
        table = tables[which[w]]
        found[:] = reach
        _ranges(table, place[w], far)
        if whole.shape[0]:
            for f in range(5):
                aside[f], aside[5 + f], aside[10 + f] = _turned_back(attitude[w], whole[f])
            _hide(table, place[w], aside, far)
        for j in range(kind.size):
            if far[j] > reach + _MARGIN:
                continue
            solid = _seen(table, j, place[w], attitude[w])
            if kind[j] == _PLANE:
                hits[:] = 1
                _meet(_plane, solid, hit, directions, found)
                continue
            if kind[j] == _BOX:
                _look(_depth, planes, solid, hits)
                _meet(_box, solid, hit, directions, found)
                continue
            _look(_depth_of_round, planes, solid, hits)
            if kind[j] == _SPHERE:
                _meet(_sphere, solid, hit, directions, found)
            elif kind[j] == _CAPSULE:
                _meet(_capsule, solid, hit, directions, found)
            else:
                _meet(_cylinder, solid, hit, directions, found)
        for i in range(slots.size):
            out[w, i] = flat[slots[i]]


def _ranges(table: Array, place: Array, far: Array) -> None:
    """Distances of a point to the boxes about primitives."""
    for j in range(far.size):
        x, y, z = _three(table, _CENTER, j)
        away = (place[0] - x, place[1] - y, place[2] - z)
        a = _most(abs(_dot(away, _three(table, _U, j))) - table[_SIZE, j], _ZERO)
        b = _most(abs(_dot(away, _three(table, _V, j))) - table[_SIZE + 1, j], _ZERO)
        c = _most(abs(_dot(away, _three(table, _AXIS, j))) - table[_SIZE + 2, j], _ZERO)
        far[j] = _root(a * a + b * b + c * c)


def _turned_back(m: Array, vector: Array) -> Vector:
    """A vector of a sensor's frame in the world."""
    x, y, z = vector[0], vector[1], vector[2]
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


def _hide(table: Array, place: Array, normals: Array, far: Array) -> None:
    """Set the distances of what lies behind one of five planes through a point: x of all normals,
    then y, then z, in the world.
    """
    for j in range(far.size):
        x, y, z = _three(table, _CENTER, j)
        center = (x - place[0], y - place[1], z - place[2])
        u, v, axis = _three(table, _U, j), _three(table, _V, j), _three(table, _AXIS, j)
        worst = _BIG
        for f in range(5):
            normal = (normals[f], normals[5 + f], normals[10 + f])
            depth = _dot(normal, center) + table[_SIZE, j] * abs(_dot(normal, u))
            depth += table[_SIZE + 1, j] * abs(_dot(normal, v))
            worst = _least(worst, depth + table[_SIZE + 2, j] * abs(_dot(normal, axis)))
        far[j] = _pick(worst >= -_MARGIN, far[j], _BIG)


def _depth(normal: Vector, solid: Array) -> Array:
    """How far the box about a primitive reaches along a normal."""
    center, u, v, axis, _, size = solid
    sides = size[0] * abs(_dot(normal, u)) + size[1] * abs(_dot(normal, v))
    return _dot(normal, center) + (sides + size[2] * abs(_dot(normal, axis)))


def _depth_of_round(normal: Vector, solid: Array) -> Array:
    """The same of what is round about its third axis, quicker; of a cylinder somewhat more."""
    center, _, _, axis, _, size = solid
    return _dot(normal, center) + (size[0] + size[3] * abs(_dot(normal, axis)))


def _look(depth: Function, planes: Array, solid: Array, hits: Array) -> None:
    """Into which packets a primitive may reach."""
    for g in range(planes.shape[0]):
        n = planes[g]
        hit = hits[g]
        for k in range(LANES):
            worst = _BIG
            for f in range(5):
                x, y, z = 3 * f * LANES + k, (3 * f + 1) * LANES + k, (3 * f + 2) * LANES + k
                worst = _least(worst, depth((n[x], n[y], n[z]), solid))
            hit[k] = worst >= -_MARGIN


def _meet(formula: Function, solid: Array, hit: Array, directions: Array, found: Array) -> None:
    """Shorten the rays of the packets that may meet a primitive."""
    for k in range(directions.shape[0]):
        if hit[k]:
            _shorten(formula, solid, directions[k], found[k])


def _shorten(formula: Function, solid: Array, d: Array, t: Array) -> None:
    for i in range(LANES):
        ray = (d[i], d[LANES + i], d[2 * LANES + i])
        enters, leaves, meets = formula(ray, solid)
        t[i] = _nearer(t[i], enters, leaves, meets)


def by_numpy(
    kinds: Array, tables: Array, which: Array, place: Array, attitude: Array,
    directions: Array, planes: Array, whole: Array, slots: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """As `_packets`, and nothing is left out."""
    ray = [directions[:, first : first + LANES] for first in range(0, 3 * LANES, LANES)]
    for w in range(len(out)):
        kind = kinds[which[w]]
        found = np.full(ray[0].shape, reach)
        for j in range(kind.size):
            solid = _seen(tables[which[w]], j, place[w], attitude[w])
            found = _nearer(found, *_MEETINGS[kind[j]](ray, solid))
        out[w] = found.ravel()[slots]


# ---- Numba


class Compiled(NamedTuple):
    """What Numba has compiled."""

    packets: Function
    gaps: Function
    nearest: int
    """Address of `_nearest_at`, whose first three arguments have 64 bits."""
    first: int
    """Address of `_first_at`."""
    owners: Numba
    """Of the code there."""


@cache
def compiled() -> Compiled | None:
    """Kernels by Numba, or None where it is not installed: the extra `fast` brings it."""
    try:
        import numba
        from llvmlite import ir
        from numba import cfunc, njit, types
        from numba.core.cpu import CPUTargetOptions
        from numba.core.options import TargetOptions
        from numba.extending import intrinsic
    except ImportError:
        return None
    # No array overlaps another one: Numba can be told so, but has no public option for it.
    mapping: Function = TargetOptions.Mapping
    setattr(CPUTargetOptions, "noalias", mapping("noalias"))  # noqa: B010
    options: Options = {"error_model": "numpy", "boundscheck": False, "nogil": True}

    @intrinsic
    def least(_: Numba, a: Numba, b: Numba) -> Numba:
        """One instruction. Of `a if a < b else b`, before a store, LLVM makes a masked store, and
        of a loop of them no vectors."""

        def emit(_: Numba, builder: Numba, __: Numba, given: Numba) -> Numba:
            number = ir.FloatType()
            kind = ir.FunctionType(number, [number, number])
            function = builder.module.declare_intrinsic("llvm.minnum", [number], kind)
            return builder.call(function, given, fastmath=("nnan", "nsz"))

        return a(a, a), emit

    names: Options = dict(globals())
    inner: Options = {**options, "forceinline": True, "noalias": True}
    inline: Function = njit(**inner)
    names["_least"] = least
    names["_most"] = inline(lambda a, b: a if a > b else b)
    names["_pick"] = inline(lambda flag, yes, no: yes if flag else no)
    names["_root"] = inline(lambda x: np.sqrt(x))
    inlined = (
        _dot, _nonzero, _sphere, _ball, _side, _cylinder, _capsule, _box, _plane, _nearer, _three,
        _turned, _turned_back, _seen, _gap, _nearest, _first, _ranges, _hide, _depth,
        _depth_of_round, _look, _shorten, _meet,
    )  # fmt: skip
    for function in inlined:
        names[function.__name__] = inline(FunctionType(function.__code__, names))
    table, row, numbers = "f4[:,:,::1]", "i8[::1]", "f4[:,::1]"
    kinds = ["int8[:,::1]", table, row, *[numbers] * 5, "u8[::1]", "f4", numbers]
    whole: Options = {**options, "cache": True}
    packets = njit(f"void({','.join(kinds)})", **whole)(FunctionType(_packets.__code__, names))
    kinds = ["int8[:,::1]", table, row, table, "b1[:,::1]", numbers]
    gaps = njit(f"void({','.join(kinds)})", **whole)(FunctionType(_gaps.__code__, names))
    names["_array"] = vars(numba)["carray"]
    number = types.float32
    pointer: Numba = types.CPointer

    def by_address(function: Function, count: int) -> Numba:
        """A function of C of a layout and so many further numbers."""
        kind = number(types.int64, pointer(types.int8), pointer(number), *[number] * count)
        return cfunc(kind, cache=True)(FunctionType(function.__code__, names))

    nearest, first = owners = by_address(_nearest_at, 3), by_address(_first_at, 6)
    return Compiled(packets, gaps, nearest.address, first.address, owners)
