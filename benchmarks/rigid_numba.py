"""The physics step of the backend `rigid` by Numba, for `benchmarks/rigid.py`: JSON on stdout.

    python benchmarks/rigid_numba.py DRONES SECONDS

The arithmetic of `sim/backends/body.py` for the paper's vehicle, one loop over drones, float32,
fastmath, on one thread: what Numba could be, had it been kept. Runs in an environment with numba.
"""

import json
import sys
import time

import numba
import numpy as np
from numba import njit

STARTED = time.perf_counter()
DRONES, SECONDS = int(sys.argv[1]), float(sys.argv[2])
F = np.float32
H, HALF, TWO, SIXTH = F(0.01), F(0.5), F(2.0), F(1 / 6)
G, MASS, IX, IZ = F(9.8), F(20.0), F(5.025725), F(10.00163)
ROLL, PITCH = F((5.025725 - 10.00163) / 5.025725), F((10.00163 - 5.025725) / 5.025725)
TURN, MOST, TINY = F(4 * np.pi**2), F(np.pi**2), F(1e-30)
ZETA = (np.pi**2 / 6, np.pi**4 / 90, np.pi**6 / 945, np.pi**8 / 9450, np.pi**10 / 93555)
B0, B1, B2, B3, B4 = (
    F(2 * (zeta - 1) / (2 * np.pi) ** (2 * n)) for n, zeta in enumerate(ZETA, start=1)
)
inline = njit(inline="always", fastmath=True)


@inline
def rotated(w, x, y, z, a, b, c, t):
    square = (a * a + b * b + c * c) * (t * t)
    half = np.sqrt(F(0.25) * square + TINY)
    share, k = np.sin(half) / half * (HALF * t), np.cos(half)
    a, b, c = a * share, b * share, c * share
    return (
        w * k - x * a - y * b - z * c,
        x * k + w * a + y * c - z * b,
        y * k + w * b + z * a - x * c,
        z * k + w * c + x * b - y * a,
        square,
    )


@inline
def followed(a, b, c, t, square, p, q, r):
    s = min(square, MOST)
    k = ((((s * B4 + B3) * s + B2) * s + B1) * s + B0 + TWO / (TURN - s)) * (t * t)
    u, v, w = b * r - c * q, c * p - a * r, a * q - b * p
    x, y, z, half = b * w - c * v, c * u - a * w, a * v - b * u, HALF * t
    return p + half * u + k * x, q + half * v + k * y, r + half * w + k * z


@inline
def accelerated(w, x, y, z, p, q, r, s, tx, ty, tz):
    d = s + s
    return (
        (x * z + w * y) * d, (y * z - w * x) * d, s - (x * x + y * y) * d - G,
        tx + ROLL * q * r, ty + PITCH * p * r, tz,
    )  # fmt: skip


@njit(fastmath=True, cache=True)
def fly(state, thrust, levers, steps, out):
    for i in range(state.shape[1]):
        px, py, pz, w, x, y, z = (
            state[0, i], state[1, i], state[2, i], state[3, i], state[4, i], state[5, i],
            state[6, i],
        )  # fmt: skip
        vx, vy, vz, p, q, r = (
            state[7, i], state[8, i], state[9, i], state[10, i], state[11, i], state[12, i]
        )  # fmt: skip
        a, b, c, d = thrust[0, i], thrust[1, i], thrust[2, i], thrust[3, i]
        s = (a + b + c + d) / MASS
        tx = levers[0, 0] * a + levers[0, 1] * b + levers[0, 2] * c + levers[0, 3] * d
        ty = levers[1, 0] * a + levers[1, 1] * b + levers[1, 2] * c + levers[1, 3] * d
        tz = levers[2, 0] * a + levers[2, 1] * b + levers[2, 2] * c + levers[2, 3] * d
        for _ in range(steps):
            h = HALF * H
            a1, a2, a3, u1, u2, u3 = accelerated(w, x, y, z, p, q, r, s, tx, ty, tz)
            w1, x1, y1, z1, square = rotated(w, x, y, z, p, q, r, h)
            p1, q1, r1 = p + h * u1, q + h * u2, r + h * u3
            s1, s2, s3 = followed(p, q, r, h, square, p1, q1, r1)
            b1, b2, b3, v1, v2, v3 = accelerated(w1, x1, y1, z1, p1, q1, r1, s, tx, ty, tz)
            w1, x1, y1, z1, square = rotated(w, x, y, z, s1, s2, s3, h)
            p1, q1, r1 = p + h * v1, q + h * v2, r + h * v3
            e1, e2, e3 = followed(s1, s2, s3, h, square, p1, q1, r1)
            c1, c2, c3, m1, m2, m3 = accelerated(w1, x1, y1, z1, p1, q1, r1, s, tx, ty, tz)
            w1, x1, y1, z1, square = rotated(w, x, y, z, e1, e2, e3, H)
            p1, q1, r1 = p + H * m1, q + H * m2, r + H * m3
            f1, f2, f3 = followed(e1, e2, e3, H, square, p1, q1, r1)
            d1, d2, d3, n1, n2, n3 = accelerated(w1, x1, y1, z1, p1, q1, r1, s, tx, ty, tz)
            k = H * SIXTH
            i1, i2, i3 = (
                p + TWO * (s1 + e1) + f1,
                q + TWO * (s2 + e2) + f2,
                r + TWO * (s3 + e3) + f3,
            )
            w, x, y, z, square = rotated(w, x, y, z, i1, i2, i3, k)
            px += H * (vx + k * (a1 + b1 + c1))
            py += H * (vy + k * (a2 + b2 + c2))
            pz += H * (vz + k * (a3 + b3 + c3))
            vx += k * (a1 + TWO * (b1 + c1) + d1)
            vy += k * (a2 + TWO * (b2 + c2) + d2)
            vz += k * (a3 + TWO * (b3 + c3) + d3)
            p += k * (u1 + TWO * (v1 + m1) + n1)
            q += k * (u2 + TWO * (v2 + m2) + n2)
            r += k * (u3 + TWO * (v3 + m3) + n3)
            size = F(1.5) - HALF * (w * w + x * x + y * y + z * z)
            w, x, y, z = w * size, x * size, y * size, z * size
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = px, py, pz, w, x
        out[5, i], out[6, i], out[7, i], out[8, i], out[9, i] = y, z, vx, vy, vz
        out[10, i], out[11, i], out[12, i] = p, q, r


# Signs of the rotors' levers over the inertia: numbers of the paper's size.
signs = np.array(((1, 1, -1, -1), (-1, 1, 1, -1), (0.02, -0.02, 0.02, -0.02)))
levers = (signs / np.array((IX, IX, IZ))[:, None]).astype(F)
state = np.zeros((13, DRONES), F)
state[3] = 1.0
thrust = (49.0 * np.random.default_rng(0).uniform(0.999, 1.001, (4, DRONES))).astype(F)
out = np.empty_like(state)
fly(state, thrust, levers, 2, out)
first = time.perf_counter() - STARTED
times, start, used = 0, time.perf_counter(), time.process_time()
while time.perf_counter() - start < SECONDS:
    fly(state, thrust, levers, 2, out)
    state, out = out, state
    times += 1
flown = times * DRONES
rate = flown / (time.perf_counter() - start), flown / (time.process_time() - used)
print(json.dumps({"rate": rate, "first_step_s": first, "versions": {"numba": numba.__version__}}))
