"""Rays and distances to primitives, float32: formulas that NumPy runs, and Numba compiles.

A formula is array code of operators and of `_least`, `_most`, `_pick` and their like. NumPy runs it
on arrays; Numba on numbers, in loops that become vectors. The bits are the same: so are the
operations and their order, and none is fused with another. What compiled code leaves out, since it
is too far away or out of sight, no ray could meet by `_MARGIN`.

A table, shape (16, P), has of each primitive its center, its three axes, and half the sides of the
box about it, m; the last row is the radius by which that box is rounded. Of a height field it is
the number of columns to the first one with its heights, of the kind `REST`: how many it has along
x and along y, the cosine of its steepest slope, and its heights above its center, m, row by row.
A layout's has three further rows, `WAYS`.
"""

from collections.abc import Callable
from functools import cache, partial
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from ..models.matrices import cross, dot, times

KINDS = ("sphere", "capsule", "cylinder", "box", "plane", "hfield")
"""Capsule and cylinder stand along their third axis. That of a plane is its normal: what lies
below is solid. A height field has two triangles in each cell of its grid, as MuJoCo's."""
SPHERE, CAPSULE, CYLINDER, BOX, PLANE, HFIELD = range(len(KINDS))
REST = len(KINDS)
"""Kind of the columns of a table that are no primitive."""
HEADER = 3
"""Numbers before the heights of a height field."""
ROWS = 16
WAYS = slice(ROWS, ROWS + 3)
"""Further rows of a layout: the way of each in a control step, m, which ends at its center."""
_WHOLE = WAYS.stop  # rows of a layout
LANES = 16
"""Rays of a packet."""

_CENTER, _U, _V, _AXIS, _SIZE, _ROUNDING = 0, 3, 6, 9, 12, 15
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)
_TRUE = np.True_
_HEADER = np.float32(HEADER)
_AROUND = (-_ONE, _ZERO, _ONE)
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

# What formulas are made of: here for arrays; `Maker` has the first three for numbers.
_least: Function = np.minimum
_most: Function = np.maximum
_pick: Function = np.where
_root = np.sqrt
_down = np.floor
_index = np.int64


def _nonzero(x: Array) -> Array:
    return _pick(x >= _ZERO, _most(x, _TINY), _least(x, -_TINY))


# ---- where a ray enters and leaves a primitive, and whether it meets it
#
# By the ray's direction and the primitive, as `_seen` gives it.


def _sphere(ray: Vector, solid: Array) -> Array:
    return _ball(ray, solid[0], solid[5][0])


def _ball(ray: Vector, center: Vector, radius: Array) -> Array:
    """By the ray's nearest point: a difference of large squares would be lost."""
    along = dot(ray, center)
    x = center[0] - along * ray[0]
    y = center[1] - along * ray[1]
    z = center[2] - along * ray[2]
    square = radius * radius - (x * x + y * y + z * z)
    half = _root(_most(square, _ZERO))
    return along - half, along + half, square >= _ZERO


def _side(ray: Vector, solid: Array) -> Array:
    """The ray along the axes; of the endless cylinder about the third axis, as `_ball`."""
    _, u, v, axis, middle, size = solid
    x, y, z = dot(ray, u) + _NUDGE, dot(ray, v), dot(ray, axis)
    scale = _ONE / (x * x + y * y)
    along = (x * middle[0] + y * middle[1]) * scale
    p = middle[0] - along * x
    q = middle[1] - along * y
    square = size[0] * size[0] - (p * p + q * q)
    half = _root(_most(square, _ZERO) * scale)
    return (x, y, z), along - half, along + half, square >= _ZERO


def _cylinder(ray: Vector, solid: Array) -> Array:
    local, enters, leaves, meets = _side(ray, solid)
    _, _, _, _, middle, size = solid
    steep = _ONE / _nonzero(local[2])
    low = (middle[2] - size[2]) * steep
    high = (middle[2] + size[2]) * steep
    enters = _most(enters, _least(low, high))
    leaves = _least(leaves, _most(low, high))
    return enters, leaves, meets & (enters <= leaves)


def _capsule(ray: Vector, solid: Array) -> Array:
    """Where the ray crosses the side beyond an end, the ball there decides."""
    local, enters, leaves, meets = _side(ray, solid)
    _, _, _, _, middle, size = solid
    radius = size[0]
    height = size[3]
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
    x = _ONE / _nonzero(dot(ray, u))
    y = _ONE / _nonzero(dot(ray, v))
    z = _ONE / _nonzero(dot(ray, axis))
    a, b, c = middle[0] * x, middle[1] * y, middle[2] * z
    p, q, r = abs(x) * size[0], abs(y) * size[1], abs(z) * size[2]
    enters = _most(_most(a - p, b - q), c - r)
    leaves = _least(_least(a + p, b + q), c + r)
    return enters, leaves, enters <= leaves


def _plane(ray: Vector, solid: Array) -> Array:
    """From above alone."""
    _, _, _, axis, middle, _ = solid
    down = dot(ray, axis)
    met = middle[2] / _least(down, -_TINY)
    return met, met, down < -_TINY


# ---- height fields


def _number(table: Array, j: Array, place: Array) -> Array:
    """Of a height field that is column `j`: one of its header, or a height."""
    k = _index(place)
    return table[k & (ROWS - 1), j + _index(table[_ROUNDING, j]) + k // ROWS]


def _height(table: Array, j: Array, x: Array, y: Array) -> Array:
    """Above the center of a height field, at a place in cells from its first corner, m."""
    wide = _number(table, j, _ZERO)
    column = _least(_most(_down(x), _ZERO), wide - _TWO)
    row = _least(_most(_down(y), _ZERO), _number(table, j, _ONE) - _TWO)
    x, y = x - column, y - row
    corner = _HEADER + row * wide + column
    low, high = _number(table, j, corner), _number(table, j, corner + wide + _ONE)
    side = _number(table, j, _pick(x > y, corner + _ONE, corner + wide))
    first, second = _most(x, y), _least(x, y)
    return low + first * (side - low) + second * (high - side)


def _above(table: Array, j: Array, line: Array, t: Array) -> Array:
    """Of a point of a ray, above the surface, m."""
    x, y, z, along, across, up = line
    return z + up * t - _height(table, j, x + along * t, y + across * t)


def _hfield(ray: Vector, solid: Array) -> Array:
    """From one line of the grid to the next: between them the surface is a straight line."""
    seen, table, j, reach = solid
    _, u, v, axis, middle, size = seen
    wide = (_number(table, j, _ZERO) - _ONE) / (size[0] + size[0])
    deep = (_number(table, j, _ONE) - _ONE) / (size[1] + size[1])
    x, y = (size[0] - middle[0]) * wide, (size[1] - middle[1]) * deep
    along, across = dot(ray, u) * wide, dot(ray, v) * deep
    line = (x, y, -middle[2], along, across, dot(ray, axis))
    enters, leaves, meets = _box(ray, seen)
    leaves = _least(leaves, reach)
    start = _most(enters, _ZERO)
    gap = _above(table, j, line, start)
    is_within = gap < _ZERO
    side = _pick(is_within, -_ONE, _ONE)
    is_wall = is_within & (enters > _ZERO)
    met = _pick(is_wall, start, leaves)
    hits = is_within & meets
    ended = is_wall | (start >= leaves)
    t = start
    first, stride, pace = _lines(x, along, start)
    second, step, speed = _lines(y, across, start)
    third, leap, rate = _lines(x - y, along - across, start)
    count = _number(table, j, _ZERO) + _number(table, j, _ONE)
    for _ in range(_index(count + count)):
        one, two, three = (first - x) * pace, (second - y) * speed, (third - (x - y)) * rate
        end = _most(t, _least(_least(one, two), _least(three, leaves)))
        after = _above(table, j, line, end)
        crosses = (side * after <= _ZERO) & (ended < _TRUE)
        met = _pick(crosses, t + (end - t) * (gap / _nonzero(gap - after)), met)
        hits = hits | crosses
        ended = ended | crosses | (end >= leaves)
        if np.all(ended):
            break
        first = _pick(one <= end, first + stride, first)
        second = _pick(two <= end, second + step, second)
        third = _pick(three <= end, third + leap, third)
        t = end
        gap = after
    return met, met, hits


def _lines(x: Array, speed: Array, t: Array) -> Array:
    """Number of the next line of a grid that a point crosses, of the one behind that less it, and
    the time between two of them.
    """
    is_back = speed < _ZERO
    following = _down(x + speed * t) + _pick(is_back, _ZERO, _ONE)
    return following, _pick(is_back, -_ONE, _ONE), _ONE / _nonzero(speed)


def _met(kind: Array, ray: Vector, solid: Array, table: Array, j: Array, reach: Array) -> Array:
    """As the formula of a kind."""
    if kind == SPHERE:
        return _sphere(ray, solid)
    if kind == CAPSULE:
        return _capsule(ray, solid)
    if kind == CYLINDER:
        return _cylinder(ray, solid)
    if kind == BOX:
        return _box(ray, solid)
    if kind == PLANE:
        return _plane(ray, solid)
    return _hfield(ray, (solid, table, j, reach))


def _nearer(old: Array, enters: Array, leaves: Array, meets: Array) -> Array:
    """The least distance so far; a ray from within a primitive meets what it leaves."""
    met = _pick(enters >= _ZERO, enters, leaves)
    return _least(old, _pick(meets & (met >= _ZERO), met, _BIG))


# ---- primitives of a table


def _three(table: Array, first: int, j: Array) -> Vector:
    return table[first, j], table[first + 1, j], table[first + 2, j]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _turned(m: Array, vector: Vector) -> Vector:
    """A vector of the world in the frame of a sensor, by the columns of its attitude."""
    return times(((m[0], m[3], m[6]), (m[1], m[4], m[7]), (m[2], m[5], m[8])), vector)


def _seen(table: Array, j: Array, place: Array, attitude: Array) -> Array:
    """Center, three axes and size of a primitive in the frame of a sensor, and between them its
    center along the axes. Its size is half its sides, and half of the third without its rounding.
    """
    center = _turned(attitude, _minus(_three(table, _CENTER, j), place))
    u = _turned(attitude, _three(table, _U, j))
    v = _turned(attitude, _three(table, _V, j))
    axis = _turned(attitude, _three(table, _AXIS, j))
    middle = times((u, v, axis), center)
    a, b, c = _three(table, _SIZE, j)
    return center, u, v, axis, middle, (a, b, c, c - table[_ROUNDING, j])


def _local(table: Array, j: Array, point: Vector) -> Vector:
    """A point from the center of a primitive, along its axes."""
    away = _minus(point, _three(table, _CENTER, j))
    return times((_three(table, _U, j), _three(table, _V, j), _three(table, _AXIS, j)), away)


def _gap(kind: Array, table: Array, j: Array, point: Vector, radius: Array) -> Array:
    """From a point to a primitive but a height field, m; below 0 within it."""
    along, across, up = _local(table, j, point)
    along, across = abs(along), abs(across)
    a, b, c = _three(table, _SIZE, j)
    is_round = kind == CYLINDER
    along = _pick(is_round, _root(along * along + across * across), along) - (a - radius)
    across = _pick(is_round, _ZERO, across) - (b - radius)
    over = abs(up) - (c - radius)
    inside = _least(_most(along, _most(across, over)), _ZERO)
    along, across, over = _most(along, _ZERO), _most(across, _ZERO), _most(over, _ZERO)
    gap = _root(along * along + across * across + over * over) + inside - radius
    return _pick(kind == PLANE, up, gap)


def _gap_then(
    kind: Array, table: Array, j: Array, point: Vector, left: Array, radius: Array
) -> Array:
    """As `_gap`, of a primitive that still has a share of its way to go: exact below a radius;
    otherwise at least the radius, and a lower bound until the end of the step.

    So a craft touches the primitive now if this is below the craft's radius. If not, it cannot
    touch it in this step before it has itself flown the difference.
    """
    along, across, up = _three(table, ROWS, j)
    there = (point[0] + left * along, point[1] + left * across, point[2] + left * up)
    gap = _gap(kind, table, j, there, table[_ROUNDING, j])
    way = left * (abs(along) + abs(across) + abs(up))
    return _most(_least(gap, radius), gap - way)


def _gap_of_hfield(table: Array, j: Array, point: Vector) -> Array:
    """As `_gap`, exact up to the width of a cell; beyond it a lower bound."""
    along, across, up = _local(table, j, point)
    a, b, _ = _three(table, _SIZE, j)
    last, final = _number(table, j, _ZERO) - _TWO, _number(table, j, _ONE) - _TWO
    wide, deep = (a + a) / (last + _ONE), (b + b) / (final + _ONE)
    place = (along + a, across + b, up)
    x = _most(_least(place[0] / wide, last + _ONE), _ZERO)
    y = _most(_least(place[1] / deep, final + _ONE), _ZERO)
    over = up - _height(table, j, x, y)
    column, row = _least(_down(x), last), _least(_down(y), final)
    x, y = x - column, y - row
    aside = _least((_ONE + _least(x, _ONE - x)) * wide, (_ONE + _least(y, _ONE - y)) * deep)
    field = (table, j, wide, deep, place)
    square = _BIG
    for m in _AROUND:
        for n in _AROUND:
            p = _most(_least(row + m, final), _ZERO)
            q = _most(_least(column + n, last), _ZERO)
            low = _corner(field, p, q)
            high = _corner(field, p + _ONE, q + _ONE)
            right = _corner(field, p, q + _ONE)
            left = _corner(field, p + _ONE, q)
            square = _least(square, _least(_triangle(low, right, high), _triangle(low, high, left)))
    beyond = _most(aside, abs(over) * _number(table, j, _TWO))
    near = _least(_root(square), beyond)
    return _most(_gap(BOX, table, j, point, _ZERO), _pick(over < _ZERO, -near, near))


def _corner(field: Array, row: Array, column: Array) -> Vector:
    """Of the grid of a height field, from a place, with cells of a width and a depth."""
    table, j, wide, deep, place = field
    height = _number(table, j, _HEADER + row * _number(table, j, _ZERO) + column)
    return _minus((column * wide, row * deep, height), place)


def _triangle(p: Vector, q: Vector, r: Vector) -> Array:
    """Square of the distance of the origin."""
    first, second, third = _minus(q, p), _minus(r, q), _minus(p, r)
    normal = cross(first, third)
    across = dot(normal, p)
    is_before = dot(cross(first, normal), p) <= _ZERO
    is_beside = dot(cross(second, normal), q) <= _ZERO
    is_behind = dot(cross(third, normal), r) <= _ZERO
    edge = _least(_edge(p, first), _least(_edge(q, second), _edge(r, third)))
    flat = across * across / dot(normal, normal)
    return _pick(is_before & is_beside & is_behind, flat, edge)


def _edge(start: Vector, way: Vector) -> Array:
    """Square of the distance of the origin from a line that leads a way from its start."""
    share = _least(_most(-dot(start, way) / dot(way, way), _ZERO), _ONE)
    near = (start[0] + share * way[0], start[1] + share * way[1], start[2] + share * way[2])
    return dot(near, near)


def distances(
    kinds: Array, table: Array, points: Array, left: Array = _ZERO, radius: Array = _ZERO
) -> Array:
    """From points, (N, 3), to the nearest primitive of a table, m, (N,), by NumPy."""
    plain = kinds < HFIELD
    solids = table[:, plain]
    point = points.T[:, :, None]
    everything = slice(None)
    if left > _ZERO:
        gaps = _gap_then(kinds[plain], solids, everything, point, left, radius)
    else:
        gaps = _gap(kinds[plain], solids, everything, point, solids[_ROUNDING])
    nearest: Array = gaps.min(axis=1, initial=np.inf)
    for j in np.flatnonzero(kinds == HFIELD).tolist():
        nearest = _least(nearest, _gap_of_hfield(table, j, points.T))
    return nearest


def _nearest(kinds: Array, table: Array, point: Vector, left: Array, radius: Array) -> Array:
    """From a point to the nearest primitive of a layout but the first, the ground, m; 1e30 if there
    is none. While ways are left, as `_gap_then`; height fields do not move.
    """
    others = _index(left > _ZERO)
    for j in range(1, kinds.size):
        others += kinds[j] >= HFIELD
    nearest = _BIG
    for j in range(1, kinds.size):
        kind = kinds[j]
        if others == 0:  # decided before the loop, which becomes vectors
            nearest = _least(nearest, _gap(kind, table, j, point, table[_ROUNDING, j]))
        elif kind == HFIELD:
            nearest = _least(nearest, _gap_of_hfield(table, j, point))
        elif kind < HFIELD and left > _ZERO:
            nearest = _least(nearest, _gap_then(kind, table, j, point, left, radius))
        elif kind < HFIELD:
            nearest = _least(nearest, _gap(kind, table, j, point, table[_ROUNDING, j]))
    return nearest


def _first(kinds: Array, table: Array, point: Vector, ray: Vector) -> Array:
    """Along a ray from a point to the first primitive but the ground, m; 1e30 if there is none."""
    found = _BIG
    for j in range(1, kinds.size):
        if kinds[j] < REST:
            solid = _seen(table, j, point, _UNTURNED)
            found = _nearer(found, *_met(kinds[j], ray, solid, table, j, _BIG))
    return found


def first_by_numpy(kinds: Array, table: Array, point: Array, ray: Array) -> Array:
    """As `_first`, of points and directions, (3, N)."""
    with np.errstate(all="ignore"):
        return _first(kinds, table, point, ray)


def _gaps(
    kinds: Array, tables: Array, which: Array, points: Array, due: Array, left: Array,
    radius: Array, out: Array,
) -> None:  # fmt: skip
    """Set `out`, (W, A), to the distances of points, (W, A, 3), where `due`, (W, A), is true.

    float32, m; of layouts as `_packets` has them.
    """
    for w in range(out.shape[0]):
        kind, table = kinds[which[w]], tables[which[w]]
        for a in range(out.shape[1]):
            if due[w, a]:
                point = (points[w, a, 0], points[w, a, 1], points[w, a, 2])
                out[w, a] = _nearest(kind, table, point, left, radius)


def gaps_by_numpy(
    kinds: Array, tables: Array, which: Array, points: Array, due: Array, left: Array,
    radius: Array, out: Array,
) -> None:  # fmt: skip
    """As `_gaps`."""
    for w in np.flatnonzero(due.any(axis=1)):
        layout = kinds[which[w], 1:], tables[which[w], :, 1:]
        near = distances(*layout, points[w], left, radius)
        out[w] = np.where(due[w], np.minimum(near, _BIG), out[w])


def _nearest_at(
    count: int,
    kinds: Numba,
    table: Numba,
    x: Array,
    y: Array,
    z: Array,
    left: Array,
    radius: Array,
) -> Array:
    """As `_nearest`, by the addresses of the kinds and of the table of so many primitives."""
    layout = _array(kinds, (count,)), _array(table, (_WHOLE, count))
    return _nearest(*layout, (x, y, z), left, radius)


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
    layout = _array(kinds, (count,)), _array(table, (_WHOLE, count))
    return _first(*layout, (x, y, z), (dx, dy, dz))


_array: Numba = None  # of an address: in `compiled` alone


# ---- all rays of a sensor


def _packets(
    kinds: Array, tables: Array, which: Array, place: Array, attitude: Array,
    directions: Array, planes: Array, whole: Array, slots: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """Distances along rays of W sensors to the first primitive, m; to their ends if there is none.

    Args:
        kinds, tables: Of layouts, (S, P) and (S, 19, P).
        which: Layout of each sensor, (W,).
        place: Of each sensor, m, (W, 3).
        attitude: From its frame to the world's: rows of matrices, (W, 9).
        directions: Of packets of rays, unit vectors: x of the rays, then y, then z, (K, 48).
        planes: About a packet each: five normals that point inwards. So many packets side by side
            as a packet has rays, (ceil(K / 16), 240).
        whole: About all rays and their ends: normals, and how far inside a sensor is, m, (F, 4).
        slots: Where each ray is among those of the packets, (N,).
        reach: How far rays go, m, (K, 16).
        out: (W, N).
    """
    furthest = reach.max()
    far = np.empty(kinds.shape[1], np.float32)
    bounds = whole.copy()
    hits = np.empty((planes.shape[0], LANES), np.int32)
    hit = hits.reshape(-1)
    found = np.empty((directions.shape[0], LANES), np.float32)
    flat = found.reshape(-1)
    for w in range(out.shape[0]):
        kind = kinds[which[w]]
        table = tables[which[w]]
        found[:] = reach
        _ranges(table, place[w], furthest, far)
        if whole.shape[0]:
            _hide(table, place[w], attitude[w], whole, bounds, far)
        for j in range(kind.size):
            if far[j] > _MARGIN or kind[j] == REST:
                continue
            solid = _seen(table, j, place[w], attitude[w])
            if kind[j] < BOX:
                _look(_depth_of_round, planes, solid, hits)
            elif kind[j] == PLANE:
                hits[:] = 1
            else:
                _look(_depth, planes, solid, hits)
            if kind[j] == SPHERE:
                _meet(_sphere, solid, hit, directions, found)
            elif kind[j] == CAPSULE:
                _meet(_capsule, solid, hit, directions, found)
            elif kind[j] == CYLINDER:
                _meet(_cylinder, solid, hit, directions, found)
            elif kind[j] == BOX:
                _meet(_box, solid, hit, directions, found)
            elif kind[j] == PLANE:
                _meet(_plane, solid, hit, directions, found)
            else:
                _meet_hfield((solid, table, j, furthest), hit, directions, found)
        for i in range(slots.size):
            out[w, i] = flat[slots[i]]


def _ranges(table: Array, place: Array, reach: Array, far: Array) -> None:
    """Set `far` to how far primitives lie beyond the reach of rays from a place, m."""
    for j in range(far.size):
        far[j] = _gap(BOX, table, j, place, _ZERO) - reach


def _hide(table: Array, place: Array, m: Array, planes: Array, bounds: Array, far: Array) -> None:
    """Set `far` to a large number where a primitive lies behind one of six planes of a sensor, by
    its place and the rows of its attitude. `bounds` become the planes with normals in the world.
    """
    rows = (m[:3], m[3:6], m[6:])
    for f in range(6):
        bounds[f, 0], bounds[f, 1], bounds[f, 2] = times(rows, planes[f])
    for j in range(far.size):
        center = _minus(_three(table, _CENTER, j), place)
        u, v, axis = _three(table, _U, j), _three(table, _V, j), _three(table, _AXIS, j)
        solid = (center, u, v, axis, center, _three(table, _SIZE, j))
        worst = _BIG
        for f in range(6):
            worst = _least(worst, _depth(bounds[f], solid) + bounds[f, 3])
        far[j] = _pick(worst >= -_MARGIN, far[j], _BIG)


def _depth(normal: Vector, solid: Array) -> Array:
    """How far the box about a primitive reaches along a normal."""
    center, u, v, axis, _, size = solid
    sides = size[0] * abs(dot(normal, u)) + size[1] * abs(dot(normal, v))
    return dot(normal, center) + (sides + size[2] * abs(dot(normal, axis)))


def _depth_of_round(normal: Vector, solid: Array) -> Array:
    """The same of what is round about its third axis, quicker; of a cylinder somewhat more."""
    center, _, _, axis, _, size = solid
    return dot(normal, center) + (size[0] + size[3] * abs(dot(normal, axis)))


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


def _meet_hfield(solid: Array, hit: Array, directions: Array, found: Array) -> None:
    _meet(_hfield, solid, hit, directions, found)


def _shorten(formula: Function, solid: Array, d: Array, t: Array) -> None:
    for i in range(LANES):
        ray = (d[i], d[LANES + i], d[2 * LANES + i])
        t[i] = _nearer(t[i], *formula(ray, solid))


def by_numpy(
    kinds: Array, tables: Array, which: Array, place: Array, attitude: Array,
    directions: Array, planes: Array, whole: Array, slots: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """As `_packets`, and nothing is left out."""
    ray = [directions[:, first : first + LANES] for first in range(0, 3 * LANES, LANES)]
    for w in range(len(out)):
        kind, table = kinds[which[w]], tables[which[w]]
        found = reach
        for j in np.flatnonzero(kind < REST).tolist():
            solid = _seen(table, j, place[w], attitude[w])
            found = _nearer(found, *_met(kind[j], ray, solid, table, j, reach.max()))
        out[w] = found.ravel()[slots]


# ---- Numba


class Compiled(NamedTuple):
    """What Numba has compiled."""

    packets: Function
    gaps: Function
    nearest: Numba
    """C function `_nearest_at`, whose first three arguments have 64 bits."""
    first: Numba
    """C function `_first_at`."""


def _one_instruction() -> Function:
    """The lesser of two numbers. Of `a if a < b else b`, before a store, LLVM makes a masked store,
    and of a loop of them no vectors.
    """
    from llvmlite import ir
    from numba.extending import intrinsic

    @intrinsic
    def least(_: Numba, a: Numba, b: Numba) -> Numba:
        def emit(_: Numba, builder: Numba, __: Numba, given: Numba) -> Numba:
            number = ir.FloatType()
            kind = ir.FunctionType(number, [number, number])
            function = builder.module.declare_intrinsic("llvm.minnum", [number], kind)
            return builder.call(function, given, fastmath=("nnan", "nsz"))

        return a(a, a), emit

    return least


class Maker:
    """Makes code of the functions of a module. Raises `ImportError` without Numba.

    Attributes:
        names: What code calls: functions of the module, which are inlined.
    """

    def __init__(self, module: Options) -> None:
        from numba import njit
        from numba.core.cpu import CPUTargetOptions
        from numba.core.options import TargetOptions

        # No array overlaps another one: Numba can be told so, but has no public option for it.
        mapping: Function = TargetOptions.Mapping
        setattr(CPUTargetOptions, "noalias", mapping("noalias"))  # noqa: B010
        options: Options = {"error_model": "numpy", "boundscheck": False, "nogil": True}
        self.compile: Function = partial(njit, **options)
        inline = self.compile(forceinline=True, noalias=True)
        self.names = dict(module)
        for name, function in module.items():
            if isinstance(function, FunctionType):
                self.names[name] = inline(self.own(function))
        self.names["_least"] = _one_instruction()
        self.names["_most"] = inline(lambda a, b: a if a > b else b)
        self.names["_pick"] = inline(lambda flag, yes, no: yes if flag else no)

    def own(self, function: Function) -> Function:
        """Its code, which calls what `names` has."""
        return FunctionType(function.__code__, self.names)

    def made(self, kinds: str, function: Function) -> Function:
        """Code that takes arguments of these kinds, and returns nothing."""
        made: Function = self.compile(f"void({kinds})", cache=True)(self.own(function))
        return made


@cache
def compiled() -> Compiled | None:
    """Kernels by Numba, or None where it is not installed: the extra `fast` brings it."""
    try:
        maker = Maker(globals())
    except ImportError:
        return None
    import numba

    for large in (_gap_of_hfield, _meet_hfield):  # inlined, they would slow the others
        maker.names[large.__name__] = maker.compile()(maker.own(large))
    layouts, rows = "int8[:,::1],f4[:,:,::1],i8[::1]", "f4[:,::1]"
    rays = f"{rows},{rows},{rows},{rows},{rows},u8[::1],{rows}"
    packets = maker.made(f"{layouts},{rays},{rows}", _packets)
    gaps = maker.made(f"{layouts},f4[:,:,::1],b1[:,::1],f4,f4,{rows}", _gaps)
    maker.names["_array"] = vars(numba)["carray"]

    def by_address(function: Function, count: int) -> Numba:
        """A function of C of a layout and so many further numbers."""
        numbers = ",f4" * count
        kind = f"f4(i8,CPointer(i1),CPointer(f4){numbers})"
        return vars(numba)["cfunc"](kind, cache=True)(maker.own(function))

    return Compiled(packets, gaps, by_address(_nearest_at, 5), by_address(_first_at, 6))
