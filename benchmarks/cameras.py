"""What a picture costs: by kind and size beside MuJoCo's own renderer, in an env, and over UDP.

    python benchmarks/cameras.py [--seconds 1] [--repeats 7] [--out FILE.json]
    python benchmarks/cameras.py --sheet FILE.png    pictures of every kind, to look at
    python benchmarks/cameras.py --worlds FILE.png   worlds of two seeds each

Each case draws the plain world with a Crazyflie from its camera `front`. `mujoco.Renderer` draws
the same model without shadows and smooth edges, and gives the same kind; it has no optical flow:
there ours is beside its depth. Cases take turns within a repeat, medians are told.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # which MuJoCo's renderer needs before it is imported

import mujoco
import numpy as np
from measuring import in_turns, medians, options, write
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.pairs import socket_pair
from rotorgram.models import SEEDED_WORLDS
from rotorgram.models.cameras import KINDS, cameras_of, chosen_views
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.udp import RemoteVectorEnv
from swarm import advanced, timed

ENV = "rotorgram/Hover-v0"
VEHICLE = "crazyflie2"
SIZES = ((64, 64), (128, 128), (320, 240))
EPISODE = 100_000  # control steps: none ends while it is measured

Step = Callable[[], object]


def ours(kind: str, width: int, height: int) -> tuple[Step, Cameras]:
    """A picture of a craft that moves a little from one to the next."""
    vehicle = Vehicle.load(VEHICLE)
    views = chosen_views([f"front_{kind}@{width}x{height}"], cameras_of(vehicle))
    cameras, everybody = Cameras(vehicle, views), np.ones(1, bool)
    place, turn = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
    due = {views[0].name: everybody}

    def step() -> None:
        place[0, 0] += 1e-3
        cameras.take(due, ~everybody, {"position": place, "quaternion": turn})

    step()
    return step, cameras


def theirs(kind: str, width: int, height: int, cameras: Cameras) -> Step:
    """The same by MuJoCo's renderer."""
    renderer = mujoco.Renderer(cameras.model, height, width)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    if kind in ("depth", "flow"):
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
        for kind in KINDS:
            here, cameras = ours(kind, width, height)
            cases = {"ours": here, "theirs": theirs(kind, width, height, cameras)}
            taken = medians(in_turns(cases, repeats, lambda step: timed(step, seconds)))
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


def steps(drones: int, seconds: float, repeats: int) -> dict[str, float]:
    """Milliseconds of a step of so many drones: without pictures, with one each, and over UDP."""
    blind: dict[str, Any] = {"episode_length": EPISODE, "action": "velocity"}
    flown = {"blind": blind, "seeing": {**blind, "cameras": ["front"]}}
    with ExitStack() as opened:
        cases: dict[str, Step] = {}
        for name, more in flown.items():
            local = LocalVectorEnv(ENV, drones, vehicle=VEHICLE, **more)
            opened.callback(local.close)
            pair = socket_pair(ENV, more, num_envs=drones, vehicle=VEHICLE)
            cases[name] = advanced(local, drones)
            cases[f"{name} over UDP"] = advanced(opened.enter_context(pair), drones)
        if drones > 1:
            several = opened.enter_context(two_simulators(drones, flown["seeing"]))
            cases["seeing over UDP, two simulators"] = advanced(several, drones)
        taken = medians(in_turns(cases, repeats, lambda step: timed(step, seconds)))
    return {name: round(time * 1e3, 3) for name, time in taken.items()}


@contextmanager
def two_simulators(drones: int, settings: dict[str, Any]) -> Iterator[RemoteVectorEnv]:
    """A vector env of two processes, each of which draws half of the pictures."""
    here = ("127.0.0.1", 0)
    env = RemoteVectorEnv(
        here, env_id=ENV, options=settings, num_simulators=2, num_envs=drones,
        autoreset_mode="Disabled", connect=False,
    )  # fmt: skip
    told = {"server": env.address, "bind": here, "num_envs": drones // 2, "env": ENV}
    words = json.dumps(told | {"vehicle": VEHICLE, "options": settings})
    command = [sys.executable, "-P", "-m", "rotorgram.udp", words]
    with ExitStack() as opened:
        for _ in range(2):
            opened.enter_context(subprocess.Popen(command))
        opened.callback(env.close)
        yield env


def sheet(path: Path) -> None:
    """A step of flights: a row for each, of every kind and of `down`."""
    from matplotlib import colormaps, image

    scenes: list[tuple[str, str | None, str, dict[str, Any], int]] = [
        ("rotorgram/Landing-v0", "crazyflie2", "front", {"world": "airport"}, 1),
        ("rotorgram/Racing-v0", "skydio_x2", "front", {}, 1),
        ("rotorgram/Formation-v0", None, "chase", {}, 6),
    ]
    rows = []
    for env_id, vehicle, eye, more, drones in scenes:
        kinds = ("down", eye, *(f"{eye}_{kind}" for kind in KINDS[1:]))
        words = [f"{name}@160x120" for name in kinds]
        env = LocalVectorEnv(
            env_id, drones, drones=drones, vehicle=vehicle, cameras=words, action="velocity", **more
        )
        env.reset(seed=1)
        for _ in range(15):
            env.step(np.tile(np.float32((0.3, 0.1, 0.0, 0.2)), (drones, 1)))
        seen = {name: array[0] for name, array in env.observations.items()}
        depth = np.log(seen[f"{eye}_depth"][..., 0])
        flow = np.linalg.norm(seen[f"{eye}_flow"], axis=-1)
        shades = (
            colormaps["viridis_r"]((depth - depth.min()) / np.ptp(depth)),
            colormaps["tab20"](seen[f"{eye}_segmentation"][..., 0] % 20),
            colormaps["magma"](flow / max(flow.max(), 1e-9)),
        )
        told = [(255 * shade[..., :3]).astype(np.uint8) for shade in shades]
        rows.append(np.hstack([seen["down"], seen[eye], *told]))
        env.close()
    image.imsave(path, np.vstack(rows))


def worlds(path: Path) -> None:
    """Two seeds of each world that is made from one: from behind the paper's craft, and ahead."""
    from PIL import Image

    vehicle, rows = Vehicle.load(), []
    views = chosen_views(["chase@320x240", "front@320x240"], cameras_of(vehicle))
    state = {"position": np.array([[0.0, 0.0, 5.0]]), "quaternion": np.array([[0.9, 0, 0, 0.436]])}
    everybody = np.ones(1, bool)
    for name in SEEDED_WORLDS:
        row = []
        for seed in range(2):
            cameras = Cameras(vehicle, views, world=f"{name}:{seed}", fine=True)
            cameras.take({view.name: everybody for view in views}, everybody, state)
            row += [cameras.pictures[view.name][0] for view in views]
            cameras.close()
        rows.append(np.hstack(row))
    pictures = Image.fromarray(np.vstack(rows)).quantize(128, dither=Image.Dither.NONE)
    pictures.save(path, optimize=True)


def main() -> None:
    """Measure, print and write."""
    args = options(__doc__, seconds=1.0, repeats=7, out=Path, sheet=Path, worlds=Path).parse_args()
    if args.sheet or args.worlds:
        (sheet if args.sheet else worlds)(args.sheet or args.worlds)
        return
    rows = pictures(args.seconds, args.repeats)
    print("| kind | pixels | pictures/s | of `mujoco.Renderer` | ratio |")
    print("|---|---|---:|---:|---:|")
    for row in rows:
        size, names = f"{row['width']} × {row['height']}", ("per_second", "renderer_per_second")
        told = " | ".join(f"{row[name]:,.0f}" for name in names)
        print(f"| {row['kind']} | {size} | {told} | {row['ratio']:.2f} |")
    taken = {str(drones): steps(drones, args.seconds, args.repeats) for drones in (1, 16)}
    print("| ms of a step | " + " | ".join(f"{drones} drones" for drones in taken) + " |")
    print("|---|" + "---:|" * len(taken))
    for name in taken["16"]:
        told = (f"{one[name]:.2f}" if name in one else "–" for one in taken.values())
        print(f"| {name} | " + " | ".join(told) + " |")
    if args.out:
        write(args.out, {"pictures": rows, "milliseconds of a step": taken})


if __name__ == "__main__":
    main()
