"""Rays against MuJoCo's: how fast, and how far off, on random scenes of every kind of solid.

    python studies/sight.py [--scenes 1302] [--rounds 9] [--out FILE.json]

A scan has 768 rays of 20 m, as a camera of 24 x 32 with 90 degrees, or as a lidar of 16 rings from
-15 to 15 degrees. Each of 256 sensors is in a scene of its own; the area of a scene grows with the
number of its solids. One core, in turns, medians. Errors are those of a ray in a scene of 60.

It takes about three minutes.
"""

import mujoco
import numpy as np
from measuring import RESULTS, options, seconds_of, table, write
from mujoco import MjModel, MjSpec, mjtGeom
from numpy.random import Generator
from rotorgram.scenes import Layouts, Rays, Solids

REACH = 20.0
SENSORS = {
    "camera": Rays.pinhole(24, 32, 90.0, REACH),
    "lidar": Rays.rings(16, 48, -15.0, 15.0, REACH),
}
SIDES = {20: 24.0, 60: 40.0, 200: 72.0}
"""Width of a scene by its number of solids, m."""
WORLDS = 256
FEW = 32  # of them for MuJoCo
OFF = 2e-4  # m: a ray that is further off is counted
GRAZING = 1e-4
"""rad: a ray grazes a solid if, turned by so much, it meets nearer points and further ones."""


def random_model(dice: Generator, count: int) -> MjModel:
    """Level ground, and solids of all kinds, upright or at any attitude."""
    spec = MjSpec()
    spec.worldbody.add_geom(type=mjtGeom.mjGEOM_PLANE, size=(0, 0, 1))
    side = SIDES[count]
    kinds = (
        mjtGeom.mjGEOM_SPHERE,
        mjtGeom.mjGEOM_CAPSULE,
        mjtGeom.mjGEOM_CYLINDER,
        mjtGeom.mjGEOM_BOX,
    )
    for _ in range(count - 1):
        kind = kinds[dice.integers(len(kinds))]
        size = dice.uniform((0.2, 0.5, 0.0), (0.6, 3.0, 0.0))
        if kind == mjtGeom.mjGEOM_BOX:
            size = dice.uniform(0.3, 1.5, 3)
        turn = dice.normal(size=4)
        if dice.random() < 0.6:
            turn[1:3] = 0.0
        x, y = dice.uniform(-side / 2, side / 2, 2)
        spec.worldbody.add_geom(type=kind, size=size, pos=(x, y, dice.uniform(0, 8)), quat=turn)
    return spec.compile()


def random_poses(dice: Generator, count: int, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and attitudes of sensors, float32 so that MuJoCo gets the same."""
    low = (-0.375 * side, -0.375 * side, 1.0)
    high = (0.375 * side, 0.375 * side, 6.0)
    heading = dice.uniform(0, np.pi, count)
    tilt = dice.uniform(-0.15, 0.15, (count, 2))
    w, z = np.cos(heading), np.sin(heading)
    turns = np.column_stack((w, tilt[:, 0], tilt[:, 1], z))
    return dice.uniform(low, high, (count, 3)).astype(np.float32), turns


def by_mujoco(model: MjModel, place: np.ndarray, turn: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """`mj_ray` of each ray, m, shape (N,); rays (N, 3) in the sensor's frame."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, turn / np.linalg.norm(turn))
    ahead = rays @ matrix.reshape(3, 3).T
    start = place.astype(float)
    none = np.zeros(1, np.int32)
    found = [mujoco.mj_ray(model, data, start, one, None, True, -1, none) for one in ahead]
    far = np.array(found)
    return np.where((far < 0) | (far > REACH), REACH, far)


def errors(scenes: int) -> dict[str, float]:
    """Of one scan of each sensor in half of the scenes."""
    dice = np.random.default_rng(7)
    worst, off, far, grazing, rays = 0.0, 0, 0, 0, 0
    for number in range(scenes):
        sensor = list(SENSORS.values())[number % 2]
        model = random_model(dice, 60)
        place, turn = random_poses(dice, 1, SIDES[60])
        ours = sensor.cast(Layouts.of(Solids.of_model(model)), place, turn).ravel()
        ahead = sensor.directions.reshape(-1, 3)
        gaps = abs(ours - by_mujoco(model, place[0], turn[0], ahead))
        rays += gaps.size
        is_off = gaps > OFF
        worst = max(worst, float(gaps[~is_off].max()))
        off += int(is_off.sum())
        far += int((gaps > 0.01).sum())
        for ray in np.flatnonzero(is_off).tolist():
            near = ahead[ray] + GRAZING * dice.normal(size=(64, 3))
            near /= np.linalg.norm(near, axis=1, keepdims=True)
            turned = by_mujoco(model, place[0], turn[0], near)
            grazing += bool(turned.min() < ours[ray] < turned.max() and np.ptp(turned) > 0.02)
    return {"rays": rays, "within": worst, "off": off, "of_them_1_cm": far, "grazing": grazing}


def speed(count: int, name: str, rounds: int) -> dict[str, object]:
    """Scans a second of a sensor, among so many solids."""
    dice = np.random.default_rng(count)
    models = [random_model(dice, count) for _ in range(WORLDS)]
    layouts = Layouts.of(*map(Solids.of_model, models))
    place, turn = random_poses(dice, WORLDS, SIDES[count])
    which = np.arange(WORLDS)
    datas = [mujoco.MjData(model) for model in models[:FEW]]
    for model, data in zip(models, datas, strict=False):
        mujoco.mj_kinematics(model, data)
    sensor = SENSORS[name]
    ahead = sensor.directions.reshape(-1)
    geoms = np.zeros(len(ahead) // 3, np.int32)
    found = np.zeros(len(geoms))

    def ours() -> None:
        sensor.cast(layouts, place, turn, which=which)

    def theirs() -> None:
        for model, data, start in zip(models, datas, place.astype(float), strict=False):
            mujoco.mj_multiRay(
                model, data, start, ahead, None, True, -1, geoms, found, None, len(geoms), REACH
            )

    took = seconds_of({"ours": ours, "theirs": theirs}, rounds, 0.1)
    scans = WORLDS / took["ours"]
    other = FEW / took["theirs"]
    return {
        "solids": count, "sensor": name, "scans": scans, "mj_multiRay": other,
        "ratio": scans / other,
    }  # fmt: skip


def main() -> None:
    """Measure, and write the file."""
    out = RESULTS / "performance" / "sight.json"
    args = options(__doc__, scenes=1302, rounds=9, out=out).parse_args()
    rows = [speed(count, name, args.rounds) for count in SIDES for name in SENSORS]
    found = errors(args.scenes)
    cells = [
        [str(row["solids"]), str(row["sensor"]), f"{row['scans']:,.0f}",
         f"{row['mj_multiRay']:,.0f}", f"{row['ratio']:.0f}"]
        for row in rows
    ]  # fmt: skip
    print(table(["solids", "sensor", "scans/s", "`mj_multiRay`", "ratio"], cells))
    print(found)
    write(args.out, {"speeds": rows, "errors": found})


if __name__ == "__main__":
    main()
