"""What a picture costs: by kind and size beside MuJoCo's own renderer, in an env, and over UDP.

    python studies/cameras.py [--seconds 1] [--repeats 7] [--out FILE.json]

Unless told otherwise a case draws the plain world with a Crazyflie from its camera `front`.
`mujoco.Renderer` draws the same model without shadows and smooth edges, and gives the same kind.
Cases take turns within a repeat, medians are told.

It takes about ten minutes on two cores.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # which MuJoCo's renderer needs before it is imported

import mujoco
import numpy as np
from measuring import options, seconds_of, table, write
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.models.cameras import OUTPUTS, chosen_views
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.scenes import seeded_scenes
from rotorgram.udp import RemoteVectorEnv
from rotorgram.udp.spawn import spawn_simulator, start_simulator
from swarm import advanced

ENV = "rotorgram/Hover-v0"
VEHICLE = "crazyflie2"
SIZES = ((64, 64), (128, 128), (320, 240))
EPISODE = 100_000  # control steps: none ends while it is measured

Step = Callable[[], object]
Times = dict[str, float]
WORLDS = ("plain", "airport", *seeded_scenes())


def ours(word: str, scene: str = "plain") -> tuple[Step, Cameras]:
    """A picture of a craft that flies, a little further from one to the next."""
    vehicle = Vehicle.load(VEHICLE)
    views = chosen_views([word], vehicle.cameras)
    cameras = Cameras(vehicle, views, scene=scene)
    everybody = np.ones(1, bool)
    place = np.array([[0.0, 0.0, 1.0]])
    turn = np.array([[1.0, 0.0, 0.0, 0.0]])
    due = {views[0].name: everybody}

    def step() -> None:
        place[0, 0] += 1e-3
        cameras.take(due, {"position": place, "quaternion": turn})

    step()
    return step, cameras


def theirs(kind: str, width: int, height: int, cameras: Cameras) -> Step:
    """The same by MuJoCo's renderer."""
    renderer = mujoco.Renderer(cameras.model, height, width)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    if kind == "depth":
        renderer.enable_depth_rendering()
    if kind == "segmentation":
        renderer.enable_segmentation_rendering()
    data = cameras.data

    def step() -> None:
        data.qpos[0] += 1e-3
        mujoco.mj_forward(cameras.model, data)
        renderer.update_scene(data, "drone_0/front")
        renderer.render()

    step()
    return step


def pictures(seconds: float, repeats: int) -> list[dict[str, Any]]:
    """Pictures per second by kind and size, ours and theirs."""
    rows = []
    for width, height in SIZES:
        for kind in OUTPUTS:
            here, cameras = ours(f"front_{kind}@{width}x{height}")
            cases = {"ours": here, "theirs": theirs(kind, width, height, cameras)}
            taken = seconds_of(cases, repeats, seconds)
            cameras.close()
            rows.append(
                {
                    "kind": kind,
                    "width": width,
                    "height": height,
                    "per_second": round(1 / taken["ours"], 1),
                    "renderer_per_second": round(1 / taken["theirs"], 1),
                    "ratio": round(taken["theirs"] / taken["ours"], 3),
                }
            )
    return rows


def milliseconds(cases: dict[str, tuple[Step, Cameras]], seconds: float, repeats: int) -> Times:
    """Of a picture of each case, in turns."""
    steps = {name: step for name, (step, _) in cases.items()}
    taken = seconds_of(steps, repeats, seconds)
    for _, cameras in cases.values():
        cameras.close()
    return {name: round(1e3 * time, 2) for name, time in taken.items()}


def surroundings(seconds: float, repeats: int) -> dict[str, Times]:
    """Milliseconds of a picture of 64 x 64 in each world, by kind."""
    return {
        kind: milliseconds(
            {world: ours(f"front_{kind}", world) for world in WORLDS}, seconds, repeats
        )
        for kind in ("rgb", "depth")
    }


def steps(drones: int, seconds: float, repeats: int) -> dict[str, float]:
    """Milliseconds of a step of so many drones: without pictures, with one each, and over UDP."""
    blind = {"episode_length": EPISODE, "action": "velocity"}
    flown = {"blind": blind, "seeing": {**blind, "cameras": ["front"]}}
    with ExitStack() as opened:
        cases: dict[str, Step] = {}
        for name, more in flown.items():
            local = LocalVectorEnv(ENV, drones, vehicle=VEHICLE, **more)
            opened.callback(local.close)
            pair = spawn_simulator(
                EnvConfig.from_keywords(ENV, vehicle=VEHICLE, **more), num_envs=drones
            )
            cases[name] = advanced(local, drones)
            cases[f"{name} over UDP"] = advanced(opened.enter_context(pair), drones)
        if drones > 1:
            several = opened.enter_context(two_simulators(drones, flown["seeing"]))
            cases["seeing over UDP, two simulators"] = advanced(several, drones)
        taken = seconds_of(cases, repeats, seconds)
    return {name: round(time * 1e3, 3) for name, time in taken.items()}


@contextmanager
def two_simulators(drones: int, settings: dict[str, Any]) -> Iterator[RemoteVectorEnv]:
    """A vector env of two processes, each of which draws half of the pictures."""
    here = ("127.0.0.1", 0)
    env = RemoteVectorEnv(
        here, env_id=ENV, options=settings, num_simulators=2, num_envs=drones,
        autoreset_mode="Disabled", connect=False,
    )  # fmt: skip
    config = EnvConfig.from_keywords(ENV, vehicle=VEHICLE, **settings)
    with ExitStack() as opened:
        for _ in range(2):
            process = start_simulator(config, env.address, num_envs=drones // 2)
            opened.enter_context(process)
        opened.callback(env.close)
        yield env


def shown(row: dict[str, Any]) -> list[str]:
    """A row of the table of pictures."""
    size = f"{row['width']} × {row['height']}"
    rates = [f"{row[name]:,.0f}" for name in ("per_second", "renderer_per_second")]
    return [row["kind"], size, *rates, f"{row['ratio']:.2f}"]


def main() -> None:
    """Measure, print and write."""
    args = options(__doc__, seconds=1.0, repeats=7, out=Path).parse_args()
    rows = pictures(args.seconds, args.repeats)
    head = ("kind", "pixels", "pictures/s", "of `mujoco.Renderer`", "ratio")
    print(table(head, map(shown, rows)))
    taken = {str(drones): steps(drones, args.seconds, args.repeats) for drones in (1, 16)}
    around = surroundings(args.seconds, args.repeats)
    print(taken, around, sep="\n")
    if args.out:
        write(
            args.out,
            {
                "pictures": rows,
                "milliseconds of a step": taken,
                "milliseconds by world": around,
            },
        )


if __name__ == "__main__":
    main()
