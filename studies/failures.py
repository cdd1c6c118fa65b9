"""What policies saw when they failed: the first flights of Forest-v0 that do not arrive.

    rotorgram train ppo --env rotorgram/Forest-v0 --effects motor_lag --env.density 0.125 \\
        --env.speed 2.5 5.5 --out runs/mlp
    rotorgram train ppo ... --set memory=64 "hidden=[64]" --out runs/gru
    rotorgram train ppo ... --set network=cnn "filters=[8, 16]" --out runs/cnn
    python studies/failures.py [--runs runs/mlp runs/gru runs/cnn] [--failures 10] [--sheets FOLDER]

A policy flies unseen layouts at 5 m/s, with 1 tree per 8 m², until so many flights have failed.
Each failure is a row of pictures: the chase view, in its corner the depth picture that the policy
has. Numbers are beside the solid that is nearest at the end. It is in the picture if rays without
noise meet it first. `cause_of` sorts failures; the page's picture has the first one of each cause.
Beside them stand the closest passes of flights that arrived.

It takes a minute for each policy on one core, the trainings up to twelve each.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from forest import woods
from measuring import RESULTS, options, write
from numpy.typing import NDArray
from PIL import Image
from rotorgram.agents import load
from rotorgram.flights.filming import moments
from rotorgram.flights.trajectories import Flights, Trajectory, fly_episodes
from rotorgram.rendering import Canvas, Stage
from rotorgram.rendering.insets import add_insets
from rotorgram.scenes import Layouts, Solids
from rotorgram.sim.sensors import range_sensors_of

DENSITY, SPEED = 0.125, 5.0
BATCH = 100  # flights at once
SECOND = 20  # control steps
START = 2 * SECOND  # control steps, in which a craft gathers speed
BEFORE = (20, 15, 10, 5, 0)  # control steps before the end, of the pictures of a row
WIDTH, HEIGHT = 288, 180  # of a picture
RUNS = [Path("runs/mlp"), Path("runs/gru"), Path("runs/cnn")]
PICTURE = Path("docs/images/failures.jpg")

Floats = NDArray[np.float64]
Facts = dict[str, object]


class Approach:
    """A second of a flight, and the solid that is nearest at its end."""

    def __init__(self, flight: Trajectory, end: int) -> None:
        self.flight = flight
        self.end = end
        self.solids = Solids.of_scene(flight.scene).standing()
        self.radius = flight.spec.constant("radius", "failures")
        point = flight.pose[end, :3]
        count = len(self.solids)
        ways = np.array([self.solids[n : n + 1].distance(point) for n in range(count)])
        self.nearest = int(ways.argmin())
        self.gap = float(np.sort(ways)[:2].sum())
        """Between the two nearest solids, through the craft's origin, m."""
        self.rows = np.arange(max(0, end - SECOND), end + 1)
        self.speeds = np.linalg.norm(flight.telemetry["velocity"][self.rows], axis=1)
        self.pixels = self._pixels()

    @property
    def solid(self) -> Solids:
        """The nearest one."""
        return self.solids[self.nearest : self.nearest + 1]

    @property
    def clearances(self) -> Floats:
        """From the craft's hull to the solid, m."""
        return self.solid.distance(self.flight.pose[self.rows, :3]) - self.radius

    @property
    def courses(self) -> list[int]:
        """Of each row the number of the trunk that a straight flight of a second would touch first;
        -1 of none.
        """
        trunks = np.flatnonzero(["/trunk" in name for name in self.solids.names])
        reach = self.solids.halves[trunks, 0] + self.radius
        found = []
        for row in self.rows.tolist():
            velocity = self.flight.telemetry["velocity"][row, :2]
            speed = np.hypot(*velocity) + 1e-9
            x, y = (self.solids.centers[trunks, :2] - self.flight.pose[row, :2]).T
            ahead = (x * velocity[0] + y * velocity[1]) / speed
            aside = (x * velocity[1] - y * velocity[0]) / speed
            way = ahead - np.sqrt(np.maximum(reach**2 - aside**2, 0.0))
            way[(abs(aside) > reach) | (ahead < 0.0)] = np.inf
            first = int(way.argmin())
            found.append(int(trunks[first]) if way[first] < speed else -1)
        return found

    @property
    def before(self) -> tuple[list[int], int]:
        """Trunks into which the course led before its last turn into the nearest; and for how many
        steps it led into that.
        """
        courses = self.courses
        while courses and courses[-1] != self.nearest:
            courses.pop()
        steps = 0
        while courses and courses[-1] == self.nearest:
            courses.pop()
            steps += 1
        return [number for number in courses if number >= 0], steps

    def _pixels(self) -> NDArray[np.int64]:
        """How many of the depth picture show the solid."""
        flight = self.flight
        if flight.config is None:
            raise ValueError("failures: expected flights of a task that is known here")
        (sensor,) = range_sensors_of(flight.config.sensors, flight.spec.control_period)
        layouts = Layouts.of(self.solids, self.solid)
        poses = flight.pose[self.rows]
        blank = np.zeros(sensor.shape)
        origins = np.array([sensor.reading(blank, pose).origin for pose in poses])
        first = sensor.rays.cast(layouts, origins, poses[:, 3:], which=0)
        alone = sensor.rays.cast(layouts, origins, poses[:, 3:], which=1)
        shown = (alone == first) & (alone < sensor.rays.reach)
        return np.asarray(shown.sum(axis=(1, 2)))

    def facts(self) -> Facts:
        """Numbers of the end, and of a second before it."""
        flight = self.flight
        return {
            "episode": flight.episode,
            "time": round(self.end / SECOND, 2),
            "place": flight.pose[self.end, :3].round(1).tolist(),
            "speed": round(float(self.speeds[-1]), 1),
            "slowest": round(float(self.speeds.min()), 1),
            "touched": bool(flight.telemetry["metrics"][-1, 1] > 0.5),
            "solid": self.solid.names[0],
            "gap": round(self.gap, 2),
            "clearance_before": round(float(self.clearances[0]), 2),
            "pixels_before": int(self.pixels[0]),
            "pictures_with_it": int((self.pixels[:-1] > 0).sum()),
            "seconds_on_course": self.before[1] / SECOND,
        }


def cause_of(approach: Approach) -> str:
    """Why a flight failed; the first that is true. Half of the wanted speed is slow. Else it is
    where the course led before it led into the trunk: nowhere else, here before, or into another.
    """
    if approach.flight.telemetry["metrics"][-1, 1] < 0.5:
        return "no touch"
    if "/trunk" not in approach.solid.names[0]:
        return "no trunk"
    if (approach.pixels[:-1] == 0).all():
        return "never in the picture"
    if approach.end > START and approach.speeds.min() < SPEED / 2:
        return "slow among trunks"
    others, _ = approach.before
    if not others:
        return "kept its course"
    return "turned back" if others[-1] == approach.nearest else "evaded another trunk"


def closest(flight: Trajectory) -> int:
    """Row of the closest pass after the start."""
    solids = Solids.of_scene(flight.scene).standing()
    return START + int(solids.distance(flight.pose[START:, :3]).argmin())


def flown(run: Path, wanted: int) -> Flights:
    """Flights up to the last failure that counts."""
    policy = load(run / "checkpoint.safetensors").policy
    env = woods(BATCH, DENSITY, SPEED)
    pilot = policy(env.env_spec)
    flights: Flights = []
    failed = 0
    while failed < wanted:
        more = fly_episodes(env, pilot, BATCH, "final", len(flights), observations=["depth"])
        for flight in more:
            flights.append(flight)
            failed += flight.headline[-1] < 0.5
            if failed == wanted:
                break
    env.close()
    return flights


def strip(approach: Approach) -> Image.Image:
    """Pictures of an approach, the last at the right."""
    flight = approach.flight
    wanted = {max(0, approach.end - steps): number for number, steps in enumerate(BEFORE)}
    whole = Image.new("RGB", (len(BEFORE) * WIDTH, HEIGHT))
    stage = Stage(flight.scene, 1, vehicle="hummingbird")
    with Canvas(stage, WIDTH, HEIGHT) as canvas:
        for step, moment in enumerate(moments(flight)):
            stage.show(moment)
            if step in wanted:
                picture = canvas.draw("chase")
                add_insets(picture, moment)
                whole.paste(Image.fromarray(picture), (wanted[step] * WIDTH, 0))
    return whole


def stacked(strips: Sequence[Image.Image], path: Path) -> None:
    """Write rows of pictures below each other."""
    whole = Image.new("RGB", (len(BEFORE) * WIDTH, len(strips) * HEIGHT))
    for number, row in enumerate(strips):
        whole.paste(row, (0, number * HEIGHT))
    whole.save(path, quality=80)


def main() -> None:
    args = options(
        __doc__, runs=RUNS, failures=10, sheets=Path("runs"), picture=PICTURE,
        out=RESULTS / "failures.json",
    ).parse_args()  # fmt: skip
    policies: list[Facts] = []
    causes: Counter[str] = Counter()
    firsts: dict[str, Image.Image] = {}
    for run in args.runs:
        flights = flown(run, args.failures)
        failed = [one for one in flights if one.headline[-1] < 0.5]
        arrived = [one for one in flights if one.headline[-1] > 0.5]
        rows = []
        strips = []
        for flight in failed:
            approach = Approach(flight, len(flight))
            cause = cause_of(approach)
            rows.append(approach.facts() | {"cause": cause})
            strips.append(strip(approach))
            firsts.setdefault(cause, strips[-1])
            print(run.name, rows[-1], flush=True)
        causes.update(str(row["cause"]) for row in rows)
        stacked(strips, args.sheets / f"{run.name}.png")
        passes = [Approach(one, closest(one)) for one in arrived]
        policies.append(
            {
                "policy": run.name,
                "flights": len(flights),
                "failures": rows,
                "passes": len(passes),
                "passes_slow": sum(bool(one.speeds.min() < SPEED / 2) for one in passes),
            }
        )
        print(policies[-1] | {"failures": len(rows)}, flush=True)
    stacked(list(firsts.values()), args.picture)
    write(args.out, {"density": DENSITY, "speed": SPEED, "causes": causes, "policies": policies})
    print(dict(causes), list(firsts))


if __name__ == "__main__":
    main()
