"""Least times through gates or points in their order, by casadi and IPOPT: of a point mass, whose
thrust turns at once, and of the craft itself, with its rotors and its inertia.

A gate is its center, x and y of its direction and half its size: it is passed anywhere in its
opening, not against its direction. A point is its place and its radius. Speed is free at the end.
"""

from collections.abc import Callable
from typing import Any, Final

import casadi as ca
import numpy as np
import numpy.typing as npt
from rotorgram.models.vehicle import Vehicle

NODES: Final = 10
"""Times in which thrusts may change on the way to each gate or point. 40 lower the bound of a point
mass along a track of ours by at most 0.1 %.
"""
SHORTEST: Final = 0.01  # s: of the way to a gate or point
LONGEST: Final = 20.0
ASIDE: Final = 0.1  # m/s²: of the first thrusts, since upright is a saddle of some courses
GUESSES: Final = 8.0, 4.0, 16.0  # m/s²: accelerations with which IPOPT begins, until one leads on
PARTS: Final = 2  # steps of RK4 between two changes of the thrusts

Floats = npt.NDArray[np.float64]
Limit = float | Floats
LeastTime = Callable[[Floats, Floats], float]


class Problem:
    """The unknowns of a flight along a course, and the constraints on them. The solution has the
    least total time.

    Attributes:
        course: What differs from flight to flight: its start, then the gates or points.
    """

    def __init__(self, numbers: int) -> None:
        """`numbers` is the size of `course`."""
        self.course = ca.MX.sym("course", numbers)
        self._unknown: list[Any] = []
        self._limits: list[tuple[Floats, Floats]] = []
        self._terms: list[Any] = []
        self._ranges: list[tuple[Floats, Floats]] = []
        self._total = 0.0

    def unknown(self, rows: int, columns: int, low: Limit, high: Limit) -> Any:
        """Unknowns between two limits, of all or of each row, shape (rows, columns)."""
        found = ca.MX.sym("unknown", rows, columns)
        self._unknown.append(ca.vec(found))
        least, most = (np.tile(np.broadcast_to(limit, rows), columns) for limit in (low, high))
        self._limits.append((least, most))
        return found

    def time(self) -> Any:
        """The unknown time of the way to one gate or point, s."""
        found = self.unknown(1, 1, SHORTEST, LONGEST)
        self._total += found
        return found

    def need(self, term: Any, least: float, most: float) -> None:
        """Each number of a term must lie between these."""
        self._terms.append(ca.vec(term))
        count = self._terms[-1].shape[0]
        self._ranges.append((np.full(count, least), np.full(count, most)))

    def passes(self, target: Any, position: Any, velocity: Any) -> None:
        """A gate or a point is passed with this position, m, and velocity, m/s."""
        away = position - target[:3]
        if target.shape[0] == 4:
            self.need(ca.sumsqr(away) / target[3] ** 2, 0.0, 1.0)
            return
        c, s, half = target[3], target[4], target[5]
        self.need(c * away[0] + s * away[1], 0.0, 0.0)
        self.need(ca.vertcat(c * away[1] - s * away[0], away[2]) / half, -1.0, 1.0)
        self.need(c * velocity[0] + s * velocity[1], 0.0, np.inf)

    def solver(self) -> Callable[[Floats, Floats], float]:
        """From a first guess of the unknowns, in their order, and a course: the least time, s.

        It raises `RuntimeError` if IPOPT finds none.
        """
        unknown, terms = ca.vertcat(*self._unknown), ca.vertcat(*self._terms)
        problem = {"x": unknown, "p": self.course, "f": self._total, "g": terms}
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        solve = ca.nlpsol("least_time", "ipopt", problem, {**quiet, "ipopt.max_iter": 1000})
        columns = [*zip(*self._limits, strict=True), *zip(*self._ranges, strict=True)]
        names = ("lbx", "ubx", "lbg", "ubg")
        bounds = dict(zip(names, map(np.concatenate, columns), strict=True))

        def least(guess: Floats, course: Floats) -> float:
            found = solve(x0=guess, p=course, **bounds)
            if not solve.stats()["success"]:
                raise RuntimeError(f"least_time: {solve.stats()['return_status']} for {course}")
            return float(found["f"])

        return least


# ---- of a point mass


def of_point_mass(
    goals: int, width: int, lift: float, gravity: float, nodes: int = NODES
) -> LeastTime:
    """The least time of a point mass from rest, s.

    The function takes the start, m, shape (3,), and the gates or points, shape (goals, width).
    Thrust over mass has any direction and at most the size `lift`, m/s². It changes `nodes` times
    on the way to each goal, at even times.
    """
    problem = Problem(3 + goals * width)
    position = problem.course[:3]
    velocity = ca.MX.zeros(3)
    falls = ca.DM([0.0, 0.0, -gravity])
    left = ca.DM(np.arange(nodes, 0, -1) - 0.5)  # of the way, in parts, after a part's middle
    for goal in range(goals):
        time = problem.time()
        thrust = problem.unknown(3, nodes, -lift, lift)
        state = problem.unknown(6, 1, -np.inf, np.inf)
        part = time / nodes
        arrives = position + time * velocity + time**2 / 2 * falls
        arrives += part**2 * ca.mtimes(thrust, left)
        speed = velocity + time * falls + part * ca.sum2(thrust)
        problem.need(ca.sum1(thrust**2) / lift**2, 0.0, 1.0)
        problem.need(ca.vertcat(arrives, speed) - state, 0.0, 0.0)
        position, velocity = state[:3], state[3:]
        problem.passes(problem.course[3 + goal * width :][:width], position, velocity)
    solve = problem.solver()

    def least(start: Floats, targets: Floats) -> float:
        for acceleration in GUESSES:
            guess = straight(start, targets[:, :3], nodes, acceleration, gravity)
            try:
                return solve(guess, np.concatenate((start, targets.ravel())))
            except RuntimeError as error:
                failed = error
        raise failed

    return least


def straight(
    start: Floats, places: Floats, nodes: int, acceleration: float, gravity: float
) -> Floats:
    """Where IPOPT begins: along straight lines, with this acceleration to the middle of each."""
    course = np.vstack((start, places))
    parts = []
    for goal, way in enumerate(np.diff(course, axis=0), 1):
        far = float(np.linalg.norm(way)) + 1e-3
        seconds = 2 * np.sqrt(far / acceleration)
        ahead = course[min(goal + 1, len(places))] - course[goal - 1]
        velocity = ahead / (np.linalg.norm(ahead) + 1e-3) * far / seconds
        halves = np.where(np.arange(nodes) < nodes / 2, 1.0, -1.0)[:, np.newaxis]
        thrust = halves * way / far * acceleration + np.array((ASIDE, ASIDE, gravity))
        parts += [[seconds], thrust.ravel(), course[goal], velocity]
    return np.concatenate(parts)


# ---- of the craft


def of_craft(vehicle: Vehicle, goals: int, width: int, nodes: int = NODES) -> Callable[..., float]:
    """The least time of a rigid craft without drag, whose rotors change their thrust at once.

    The function takes a flight, with which IPOPT begins: the states, shape (T + 1, 13), of
    position, velocity, attitude and body rates; the thrusts that led to each, shape (T + 1, R); the
    row in which each gate or point is passed; the control period, s; and the gates or points, shape
    (goals, width). What it finds is a local optimum: another way round may be faster.
    """
    rotors = vehicle.num_rotors
    problem = Problem(13 + goals * width)
    x, f, period = ca.MX.sym("x", 13), ca.MX.sym("f", rotors), ca.MX.sym("period")
    after = x
    for _ in range(PARTS):
        part = period / PARTS
        first = slope(vehicle, after, f)
        second = slope(vehicle, after + part / 2 * first, f)
        third = slope(vehicle, after + part / 2 * second, f)
        fourth = slope(vehicle, after + part * third, f)
        after += part / 6 * (first + 2 * second + 2 * third + fourth)
    step = ca.Function("step", [x, f, period], [after]).map(nodes)
    state = problem.course[:13]
    for goal in range(goals):
        time = problem.time()
        thrust = problem.unknown(rotors, nodes, vehicle.thrust_low, vehicle.thrust_high)
        states = problem.unknown(13, nodes, -np.inf, np.inf)
        before = ca.horzcat(state, states[:, :-1])
        problem.need(step(before, thrust, ca.repmat(time / nodes, 1, nodes)) - states, 0.0, 0.0)
        state = states[:, -1]
        target = problem.course[13 + goal * width :][:width]
        problem.passes(target, state[:3], state[3:6])
    solve = problem.solver()

    def least(
        states: Floats, thrusts: Floats, ends: Floats, period: float, targets: Floats
    ) -> float:
        guess = []
        for begin, end in zip((0, *ends[:-1]), ends, strict=True):
            rows = begin + np.arange(1, 2 * nodes + 1) * (end - begin) / (2 * nodes)
            later = np.minimum(np.ceil(rows), len(states) - 1).astype(int)
            middles, nexts = later[::2], later[1::2]
            guess += [[(end - begin) * period], thrusts[middles].ravel(), states[nexts].ravel()]
        return solve(np.concatenate(guess), np.concatenate((states[0], targets.ravel())))

    return least


def slope(vehicle: Vehicle, state: Any, thrusts: Any) -> Any:
    """The derivative of a state by time. The attitude is a quaternion w, x, y, z."""
    velocity, attitude, rates = state[3:6], state[6:10], state[10:13]
    w, x, y, z = ca.vertsplit(attitude)
    wrench = ca.mtimes(ca.DM(vehicle.allocation), thrusts)
    up = ca.vertcat(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    falls = ca.DM([0.0, 0.0, -vehicle.gravity])
    inertia = ca.DM(vehicle.inertia)
    momentum = ca.mtimes(inertia, rates)
    moment = wrench[1:] - ca.cross(rates, momentum)
    scalar = -(x * rates[0] + y * rates[1] + z * rates[2])
    vector = w * rates + ca.cross(attitude[1:], rates)
    turn = ca.vertcat(scalar, vector) / 2
    accelerations = wrench[0] / vehicle.mass * up + falls
    return ca.vertcat(velocity, accelerations, turn, ca.solve(inertia, moment))
