"""Where the cameras of a data set are: on flights, in journals, at random places.

A plan is a TOML file; `docs/capture.md` has its fields. What it says is the same on every machine:
random places come from its seed, flights from the evaluation episodes' seeds.
"""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from ..agents import CONTROLLERS
from ..agents.checkpoints import load
from ..agents.policies import Policy
from ..envs.registry import env_spec
from ..envs.registry import load as load_env
from ..envs.spec import Discrete, Mark, component_names
from ..models import scenes_of
from ..models.cameras import View, cameras_of, chosen_views
from ..models.errors import InputError, expect
from ..models.fields import Limits, check
from ..models.frames import pose_in_mujoco_frame
from ..models.vehicle import Vehicle
from ..sim.rotations import multiplied
from .trajectories import Trajectory, flown_trajectories, recorded_trajectories

_KEYS: Final = ("vehicle", "world", "cameras", "seed", "fine", "fps", "least_area", "poses")
_SOURCES: Final[Mapping[str, Mapping[str, Any]]] = {
    "random": {
        "count": None, "center": (0.0, 0.0, 5.0), "size": (10.0, 10.0, 6.0), "tilt": 0.3,
        "world": "",
    },
    "flight": {
        "env": None, "agent": "geometric", "options": {}, "episodes": 1, "first": 0,
        "every": 10, "drones": 1, "aside": 0.0, "tilt": 0.0, "world": "",
    },
    "journal": {
        "file": None, "session": None, "drone": 0, "every": 10, "aside": 0.0, "tilt": 0.0,
        "world": "",
    },
}  # fmt: skip
"""Keys of each source of poses, and their defaults; a `count` and a `file` have to be there, and
without an `env` it is that of the checkpoint, or Hover."""
_CAMERAS: Final = ["front", "front_segmentation"]
MOST_FRAMES: Final = 1_000_000
_FURTHEST: Final = 1e4  # m
_MOST_BYTES: Final = 1_000_000  # of a plan


@dataclass(frozen=True, kw_only=True, eq=False)
class Walk:
    """T poses of A drones of one world, one after the other: an episode, or random places.

    MuJoCo's world frame, m.
    """

    name: str
    """Of its source."""
    times: np.ndarray
    """Since its start, shape (T,), s; those of random places are 0."""
    position: np.ndarray
    """Shape (T, A, 3)."""
    quaternion: np.ndarray
    """Shape (T, A, 4)."""
    velocity: np.ndarray | None = None
    """Mean of the control step before, m/s, shape (T, A, 3)."""
    body_rates: np.ndarray | None = None
    """The same, body frame, rad/s, shape (T, A, 3)."""
    goal: np.ndarray | None = None
    """Shape (T, A, 3)."""
    payload: np.ndarray | None = None
    """Shape (T, A, 3)."""
    actions: np.ndarray | None = None
    """What is flown from there, shape (T, A, n); nan where an episode has ended."""
    components: tuple[str, ...] = ()
    """Names of an action's numbers."""
    marks: tuple[Mark, ...] = ()
    world: str = "plain"
    """What surrounds the drones."""

    def __len__(self) -> int:
        """T."""
        return len(self.times)

    def part(self, first: int, end: int) -> "Walk":
        """The poses from `first` to before `end`."""
        arrays: dict[str, Any] = {
            k: x[first:end] for k, x in vars(self).items() if isinstance(x, np.ndarray)
        }
        return replace(self, **arrays)

    def state(self, row: int) -> dict[str, np.ndarray]:
        """One pose of all drones, as `Cameras.take` has it."""
        told = {"position": self.position[row], "quaternion": self.quaternion[row]}
        for name in ("velocity", "body_rates", "goal", "payload"):
            values = getattr(self, name)
            if values is not None:
                told[name] = values[row]
        return told


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a data set shows. `Plan.read` checks it."""

    text: str
    """The TOML file."""
    cameras: tuple[str, ...]
    """Words as of the option `cameras` of a task."""
    poses: tuple[Mapping[str, Any], ...]
    """Sources of poses."""
    vehicle: str | None = None
    world: str = "plain"
    """Its places and flights are in the worlds of `scenes_of` in turn."""
    seed: int = 0
    fine: bool = True
    """With shadows and smooth edges."""
    fps: float = 10.0
    """Of the videos."""
    least_area: int = 1
    """Pixels that an object needs to be told of."""

    @classmethod
    def read(cls, path: Path) -> "Plan":
        """Read a TOML file. Raises `InputError`, or `OSError` where it cannot be read."""
        size = path.stat().st_size
        expect(size <= _MOST_BYTES, "plan", f"at most {_MOST_BYTES} bytes", f"{size}")
        try:
            text = path.read_text(encoding="utf-8")
            table = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"plan: expected a TOML file, got {path.name}: {error}") from None
        except RecursionError:
            wanted = "a TOML file with tables as in docs/capture.md"
            raise InputError(f"plan: expected {wanted}, got too many in each other") from None
        for key in table:
            expect(key in _KEYS, "plan", f"some of {', '.join(_KEYS)}", repr(key))
        cameras, poses = table.pop("cameras", _CAMERAS), table.pop("poses", None)
        right = isinstance(cameras, list) and all(isinstance(one, str) for one in cameras)
        expect(right and cameras, "plan: cameras", "a list of names", repr(cameras))
        right = isinstance(poses, list) and all(isinstance(one, dict) for one in poses)
        expect(right and poses, "plan", "a table [[poses]] or more", "none")
        plan = cls(
            text=text, cameras=tuple(cameras),
            poses=tuple(_source(one, i) for i, one in enumerate(poses, 1)), **table,
        )  # fmt: skip
        scenes_of(plan.world)
        right = type(plan.seed) is int and 0 <= plan.seed < 1 << 63
        expect(right, "plan: seed", "a whole number from 0", repr(plan.seed))
        expect(type(plan.fine) is bool, "plan: fine", "true or false", repr(plan.fine))
        right = type(plan.least_area) is int and plan.least_area >= 1
        expect(right, "plan: least_area", "a number of pixels", repr(plan.least_area))
        check("plan: fps", Limits(0.1, 1000, "pictures a second"), plan.fps)
        for view in plan.views():
            shape = f"{view.shape[1]}x{view.shape[0]}"
            right = view.kind != "rgb" or not (view.shape[0] % 2 or view.shape[1] % 2)
            expect(right, f"plan: {view.name}", "even sizes, which its videos need", shape)
        return plan

    def views(self) -> tuple[View, ...]:
        """The pictures of each pose. Raises `InputError`."""
        return chosen_views(self.cameras, cameras_of(Vehicle.load(self.vehicle)))

    def walks(self) -> list[Walk]:
        """All poses. Raises `InputError`."""
        found: list[Walk] = []
        for number, source in enumerate(self.poses, 1):
            name, dice = f"{number} {source['from']}", np.random.default_rng([self.seed, number])
            scenes = scenes_of(source["world"] or self.world)
            if source["from"] == "random":
                places = _random(name, source, dice)
                shares = min(len(scenes), len(places))
                ends = np.linspace(0, len(places), shares + 1).astype(int).tolist()
                walks = [places.part(first, end) for first, end in pairwise(ends)]
            else:
                flies = source["from"] == "flight"
                flown = _flown(source, self.vehicle) if flies else _recorded(source, self.vehicle)
                walks = _walks(name, flown, source["every"], source.get("drones", 1))
                walks = [_moved(walk, source["aside"], source["tilt"], dice) for walk in walks]
            in_turn = zip(walks, cycle(scenes), strict=False)
            found += [replace(walk, world=world) for walk, world in in_turn]
        kinds = dict.fromkeys(walk.components for walk in found if walk.actions is not None)
        got = " and ".join(f"({', '.join(names)})" for names in kinds)
        expect(len(kinds) < 2, "plan", "flights with the same actions", got)
        count = sum(map(len, found))
        expect(count <= MOST_FRAMES, "plan", f"at most {MOST_FRAMES} poses", f"{count}")
        return found


def _source(table: dict[str, Any], number: int) -> dict[str, Any]:
    """A source of poses with all its keys. Raises `InputError`."""
    name, kind = f"plan: poses[{number}]", table.get("from")
    known = _SOURCES.get(kind) if isinstance(kind, str) else None
    if known is None:
        raise InputError(f"{name}.from: expected {_words(_SOURCES)}, got {kind!r:.80}")
    for key in table:
        expect(key in known or key == "from", name, f"some of {', '.join(known)}", repr(key))
    source = {**known, **table}
    for key in ("count", "episodes", "every", "drones"):
        if key in source:
            value = source[key]
            right = type(value) is int and 1 <= value <= MOST_FRAMES
            expect(right, f"{name}.{key}", f"1 to {MOST_FRAMES}", repr(value))
    for key in ("first", "drone"):
        right = key not in source or (type(source[key]) is int and source[key] >= 0)
        expect(right, f"{name}.{key}", "a whole number from 0", repr(source.get(key)))
    for key in ("center", "size"):
        if key in source:
            least = -_FURTHEST if key == "center" else 0.0
            check(f"{name}.{key}", Limits(least, _FURTHEST, "m", count=3), source[key])
    for key, most, unit in (("tilt", np.pi, "rad"), ("aside", _FURTHEST, "m")):
        check(f"{name}.{key}", Limits(0, most, unit), source.get(key, 0.0))
    if kind == "random":
        low = source["center"][2] - source["size"][2] / 2
        expect(low >= 0, name, "a box above the ground", f"one that begins at {low:g} m")
    session = source.get("session")
    right = session is None or (type(session) is int and session >= 1)
    expect(right, f"{name}.session", "a whole number from 1", repr(session))
    if source["world"] != "":
        scenes_of(source["world"])
    texts = {"env": "the id of a task", "agent": "a controller or a checkpoint",
             "file": "a journal (.mcap)"}  # fmt: skip
    for key, expected in texts.items():
        value = source.get(key) or ""
        right = isinstance(value, str) and (value != "" or key != "file")
        expect(right or key not in source, f"{name}.{key}", expected, repr(value))
    options = source.get("options", {})
    expect(isinstance(options, dict), f"{name}.options", "options by name", repr(options))
    return source


def _random(name: str, source: Mapping[str, Any], dice: np.random.Generator) -> Walk:
    """Places evenly in a box, any heading, tilted up to an angle about any level axis."""
    count, size = source["count"], np.array(source["size"], float)
    position = np.array(source["center"], float) + size * dice.uniform(-0.5, 0.5, (count, 3))
    half, zero = dice.uniform(-np.pi, np.pi, count) / 2, np.zeros(count)
    turned = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)
    quaternion = multiplied(_tilts((count,), source["tilt"], dice), turned)
    place, turn = position[:, None], quaternion[:, None]
    return Walk(name=name, times=zero, position=place, quaternion=turn)


def _moved(walk: Walk, aside: float, tilt: float, dice: np.random.Generator) -> Walk:
    """The cameras of a walk up to so far aside, m, or higher, and tilted up to an angle more."""
    shape = walk.position.shape
    moves = dice.uniform((-aside, -aside, 0.0), aside, shape)
    quaternion = multiplied(_tilts(shape[:-1], tilt, dice), walk.quaternion)
    return replace(walk, position=walk.position + moves, quaternion=quaternion)


def _tilts(shape: tuple[int, ...], most: float, dice: np.random.Generator) -> np.ndarray:
    """Rotations by up to an angle, rad, about any level axis, quaternions, (*shape, 4)."""
    axis, half = dice.uniform(-np.pi, np.pi, shape), most * np.sqrt(dice.uniform(0, 1, shape)) / 2
    parts = np.cos(half), np.sin(half) * np.cos(axis), np.sin(half) * np.sin(axis), 0.0 * half
    return np.stack(parts, axis=-1)


def _words(names: Iterable[str]) -> str:
    return " or ".join(map(repr, names))


def _flown(source: Mapping[str, Any], vehicle: str | None) -> list[Trajectory]:
    agent, options, drones = source["agent"], source["options"], source["drones"]
    env_id = load_env(source["env"] or "rotorgram/Hover-v0")  # the plan is the user's own
    controller = CONTROLLERS.get(agent)
    policy: Policy | None = None
    if controller is not None:
        options = {**controller.options, **options}
        policy = controller(env_spec(env_id, options, vehicle, drones))
    elif agent != "random":
        checkpoint = load(Path(agent))
        env_id, trained = env_id if source["env"] else checkpoint.env_id, checkpoint.spec
        if env_id == checkpoint.env_id:
            options = {**trained.options, **options}
        spec = env_spec(env_id, options, vehicle, drones)
        right = vehicle is not None or trained.vehicle_hash == spec.vehicle_hash
        expect(right, "plan: vehicle", f"{trained.vehicle}, on which {agent} was trained", "none")
        policy = checkpoint.policy(spec)
    episodes = range(source["first"], source["first"] + source["episodes"])
    return flown_trajectories(
        policy, env_id, options, episodes, vehicle=vehicle, of="final", drones=drones
    )


def _recorded(source: Mapping[str, Any], vehicle: str | None) -> list[Trajectory]:
    path, own = Path(source["file"]), Vehicle.load(vehicle).name
    flown = recorded_trajectories(path, session=source["session"], drone=source["drone"])
    name = flown[0].spec.vehicle
    expect(name == own, "plan: vehicle", f"{name}, which flies in {path}", own)
    return flown


def _walks(name: str, flown: Sequence[Trajectory], every: int, drones: int) -> list[Walk]:
    """Every so many steps of trajectories, of so many drones of each world."""
    found = []
    for first in range(0, len(flown), drones):
        world = flown[first : first + drones]
        steps = np.arange(0, max(map(len, world)) + 1, every)
        told = [_after(one, steps, name) for one in world]
        stacked: dict[str, Any] = {
            key: np.stack([one[key] for one in told], axis=1) for key in told[0]
        }
        spec = world[0].spec
        own = () if isinstance(spec.action, Discrete) else component_names(spec.action)
        found.append(
            Walk(
                name=name, times=steps * spec.control_period, marks=spec.marks,
                components=tuple(own) or ("choice",), **stacked,
            )
        )  # fmt: skip
    return found


def _after(one: Trajectory, steps: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Fields of a walk of one drone after so many steps; if it is out, it stays where it is."""
    arrays, rows = one.telemetry, np.minimum(steps, len(one))
    for key in ("position", "attitude"):
        expect(key in arrays, name, f"telemetry of the {key}", f"{sorted(arrays)}")
    pose = pose_in_mujoco_frame(arrays["position"], arrays["attitude"])
    now, before = pose[rows], pose[np.maximum(rows - 1, 0)]
    turned = np.zeros((len(rows), 3))
    for turn, new, old in zip(turned, now[:, 3:], before[:, 3:], strict=True):
        mujoco.mju_subQuat(turn, new, old)
    seconds = np.where(steps <= len(one), one.spec.control_period, np.inf)[:, None]
    actions = one.actions.reshape(len(one), -1)
    told = {
        "position": now[:, :3],
        "quaternion": now[:, 3:],
        "velocity": (now[:, :3] - before[:, :3]) / seconds,
        "body_rates": turned / seconds,
        "actions": np.append(actions, np.full((1, actions.shape[1]), np.nan), axis=0)[rows],
    }
    for key in ("goal", "payload"):
        if key in arrays:
            level = np.zeros_like(arrays[key][rows])
            told[key] = pose_in_mujoco_frame(arrays[key][rows], level)[:, :3]
    return told
