"""Labelled pictures: plans, labels against the pictures, formats, and what an interrupt leaves."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each
from rotorgram.envs.config import EnvConfig
from rotorgram.flights import capture as capturing
from rotorgram.flights.capture import capture, label_file, objects_in, read_labels
from rotorgram.flights.coco import category
from rotorgram.flights.executors import WorkersConfig
from rotorgram.flights.viewpoints import Plan
from rotorgram.models import InputError
from rotorgram.udp.spawn import spawn_simulator
from test_cameras import BELLY, vehicle_with

Image = pytest.importorskip("PIL.Image")
ONE = WorkersConfig(jobs=1)
LINE = [sys.executable, "-m", "rotorgram.cli", "capture", "plan.toml", "--out", "out"]
PLAN = """
vehicle = "crazyflie2"
cameras = ["down@32x24", "down_depth@32x24", "down_segmentation@32x24", "front@16x16"]
seed = 7
fine = false

[[poses]]
from = "random"
count = 5
center = [0.0, 0.0, 2.0]
size = [4.0, 4.0, 2.0]
tilt = 0.5

[[poses]]
from = "flight"
env = "rotorgram/Landing-v0"
every = 40
options = { episode_length = 100 }
"""


def plan_of(folder: Path, text: str = PLAN) -> Plan:
    file = folder / "plan.toml"
    file.write_text(text, "utf-8")
    return Plan.read(file)


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the plan and the lock."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("plan.toml", ".lock")
    }


def wait_for(process: "subprocess.Popen[str]", is_there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 90
    while not is_there():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.001)


def assert_whole(folder: Path) -> None:
    """Every file of the frames that have labels is there, in its size."""
    for labels in (folder / "labels").glob("*.json"):
        for picture in json.loads(labels.read_text())["pictures"]:
            for name, size in picture["files"].items():
                assert (folder / name).stat().st_size == size


# ---- plans


def test_random_places_fill_the_box(tmp_path: Path) -> None:
    many = PLAN.replace("count = 5", "count = 400")
    poses, _ = plan_of(tmp_path, many).sequences()
    position = poses.position[:, 0]
    quaternion = poses.quaternion[:, 0]
    assert position.min(axis=0) == pytest.approx([-2, -2, 1], abs=0.1)
    assert position.max(axis=0) == pytest.approx([2, 2, 3], abs=0.1)
    assert np.linalg.norm(quaternion, axis=1) == pytest.approx(1.0)
    w, x, y, z = quaternion.T
    tilts = np.arccos(1 - 2 * (x**2 + y**2))
    headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    assert 0.45 < tilts.max() <= 0.5
    assert np.ptp(headings) > 6
    again, _ = plan_of(tmp_path, many).sequences()
    other, _ = plan_of(tmp_path, many.replace("seed = 7", "seed = 8")).sequences()
    assert (again.position == poses.position).all()
    assert (other.position[0] != poses.position[0]).all()


def test_places_and_flights_share_worlds(tmp_path: Path) -> None:
    """Places as evenly as they can be, flights in turn."""
    sources = """
    [[poses]]
    from = "random"
    count = 8
    [[poses]]
    from = "flight"
    env = "rotorgram/Hover-v0"
    episodes = 3
    every = 500
    """
    sequences = plan_of(tmp_path, f'scene = "gates:1-3"\n{sources}').sequences()
    names = ["gates:1", "gates:2", "gates:3"]
    assert [poses.scene for poses in sequences] == names * 2
    assert [len(poses) for poses in sequences[:3]] == [2, 3, 3]
    alone = plan_of(tmp_path, sources).sequences()[0]
    np.testing.assert_array_equal(
        np.concatenate([poses.position for poses in sequences[:3]]), alone.position
    )


def test_a_flight_gives_every_so_many_steps(tmp_path: Path) -> None:
    _, poses = plan_of(tmp_path).sequences()
    assert poses.times.tolist() == [0.0, 0.8, 1.6]
    assert poses.goal is not None
    assert poses.goal.shape == poses.position.shape == (3, 1, 3)
    assert [mark.shape for mark in poses.marks] == ["disc"]


@each("old, new, sentence", "plan")
def test_wrong_plans(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        plan_of(tmp_path, PLAN.replace(old, new))


def test_a_plan_nested_too_deeply(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="plan: expected a TOML file"):
        plan_of(tmp_path, "seed = " + "[" * 5000)


# ---- labels


def test_boxes_and_runs_are_those_of_the_mask() -> None:
    numbers = np.zeros((5, 6), np.int32)
    numbers[1:4, 2:5] = 2
    numbers[2, 3] = 1
    one, two = objects_in(numbers, ["nothing", "inner", "outer"])
    assert (one["name"], one["box"], one["area"]) == ("inner", [3, 2, 1, 1], 1)
    assert (two["name"], two["box"], two["area"]) == ("outer", [2, 1, 3, 3], 8)
    # Down the columns: 10 of the first two, the third's first; then 3; and so on.
    assert two["runs"] == [11, 3, 2, 1, 1, 1, 2, 3, 6]
    full = next(objects_in(np.ones((2, 2), np.int32), ["nothing", "all"]))
    assert full["runs"] == [0, 4]


def unrolled(runs: list[int], height: int, width: int) -> np.ndarray:
    flat = np.repeat(np.arange(len(runs)) % 2, runs).astype(bool)
    return flat.reshape(width, height).T


@each("name, kind", "categories")
def test_categories(name: str, kind: str) -> None:
    assert category(name) == kind


# ---- data sets


@pytest.fixture(scope="module")
def captured(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captured")
    assert capture(plan_of(folder), folder, ONE) == 8
    return folder


def test_every_file_is_there(captured: Path) -> None:
    labels = read_labels(captured, 8)
    assert [one["frame"] for one in labels] == list(range(8))
    for frame in labels:
        kinds = [(one["camera"], one["kind"]) for one in frame["pictures"]]
        assert kinds == [
            ("down", "rgb"), ("down", "depth"), ("down", "segmentation"), ("front", "rgb")
        ]  # fmt: skip
    assert_whole(captured)


def test_depth_in_millimetres_is_depth_in_metres(opengl: None, tmp_path: Path) -> None:
    tilted = plan_of(tmp_path, PLAN.replace("tilt = 0.5", "tilt = 1.4"))  # some see the horizon
    assert capture(tilted, tmp_path, ONE) == 8
    seen = set()
    for frame in read_labels(tmp_path, 8):
        depth, coded = (tmp_path / file for file in frame["pictures"][1]["files"])
        meters = np.load(depth)
        with Image.open(coded) as image:
            millimetres = np.asarray(image).astype(float)
        near = meters <= 65.535
        assert np.abs(millimetres[near] - 1000 * meters[near]).max(initial=0) <= 0.51
        assert not millimetres[~near].any()
        seen |= {*near.flat}
    assert seen == {True, False}


def test_boxes_are_those_of_the_pictures(captured: Path) -> None:
    told = json.loads((captured / "coco.json").read_text())
    names = {kind["id"]: kind["name"] for kind in told["categories"]}
    assert {"scene/floor", "task/disc of drone"} <= {*names.values()}
    masks = {}
    for image in told["images"]:
        number = Path(image["file_name"]).stem
        with Image.open(captured / "segmentation" / "down" / f"{number}.png") as file:
            masks[image["id"]] = np.asarray(file)
    assert len(told["annotations"]) >= 8
    for one in told["annotations"]:
        mask = unrolled(one["segmentation"]["counts"], *one["segmentation"]["size"])
        numbers = masks[one["image_id"]]
        value = numbers[mask][0]
        assert ((numbers == value) == mask).all()
        rows, columns = np.nonzero(mask)
        corner = [columns.min(), rows.min()]
        size = [np.ptp(columns) + 1, np.ptp(rows) + 1]
        assert one["bbox"] == corner + size
        assert one["area"] == mask.sum()


def test_lenses_bring_points_to_their_pixels(captured: Path) -> None:
    """The goal through the lens of the labels, against the box of the pad there."""
    inside = 0
    for frame in read_labels(captured, 8):
        picture = frame["pictures"][2]
        for thing in picture["objects"]:
            left, top, width, height = thing["box"]
            is_whole = left > 0 and top > 0 and left + width < 32 and top + height < 24
            if not (is_whole and thing["name"].startswith("task/disc")):
                continue
            point = np.add(frame["pose"]["goal"][0], (0.0, 0.0, 0.005))
            there = np.array(picture["rotation"]) @ point + picture["translation"]
            pixel = np.array(picture["matrix"]) @ there
            assert pixel[0] / pixel[2] == pytest.approx(left + width / 2, abs=1.0)
            assert pixel[1] / pixel[2] == pytest.approx(top + height / 2, abs=1.0)
            inside += 1
    assert inside


def test_times_count_the_steps_between_pictures(captured: Path) -> None:
    """Fault 44: every 40th control step of 0.02 s is 0.8 s apart, in labels and in COCO."""
    images = json.loads((captured / "coco.json").read_text())["images"]
    flight = [image["time"] for image in images if image["sequence"] == 1]
    assert flight == [0.0, 0.8, 1.6]
    times = [frame["time"] for frame in read_labels(captured, 8)]
    assert times == [0.0] * 5 + flight


def test_it_is_the_same_again_and_goes_on(captured: Path, tmp_path: Path) -> None:
    """Labels that are missing are made again; the rest stays; two workers give the same bits."""
    folder = tmp_path / "again"
    folder.mkdir()
    capture(plan_of(tmp_path), folder, WorkersConfig(jobs=2))
    whole = contents(captured)
    assert contents(folder) == whole
    kept = folder / "rgb" / "down" / "000001.png"
    other = bytearray(whole["rgb/down/000001.png"])
    other[other.index(b"IEND") + 5] ^= 1  # of the same size, and a picture
    kept.write_bytes(other)
    for number in (2, 7):
        label_file(folder, number).unlink()
    (folder / "rgb" / "down" / "000003.png").unlink()
    cut = folder / "segmentation" / "down" / "000004.png"
    cut.write_bytes(cut.read_bytes()[:-9])
    capture(plan_of(tmp_path), folder, ONE)
    assert kept.read_bytes() == other
    kept.write_bytes(whole["rgb/down/000001.png"])
    assert contents(folder) == whole


@pytest.mark.parametrize("text", ['{"frame"', "[" * 9000, '{"pictures": []}'])
def test_labels_that_were_altered_are_made_again(captured: Path, tmp_path: Path, text: str) -> None:
    folder = tmp_path / "altered"
    shutil.copytree(captured, folder)
    label_file(folder, 1).write_text(text)
    (folder / "labels" / "000099.json").write_text("of no frame")
    assert capture(plan_of(tmp_path), folder, ONE) == 8
    assert label_file(folder, 1).read_bytes() == label_file(captured, 1).read_bytes()
    assert (folder / "coco.json").read_bytes() == (captured / "coco.json").read_bytes()


def test_a_folder_of_another_plan(captured: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder of the same plan, got one of other"):
        capture(plan_of(tmp_path, PLAN.replace("seed = 7", "seed = 9")), captured, ONE)


def test_a_folder_of_another_vehicle(captured: Path, tmp_path: Path) -> None:
    """The same plan; the file that it names was changed since."""
    own = vehicle_with(tmp_path, BELLY).path
    text = PLAN.replace('"crazyflie2"', f'"{own}"').replace("down@32x24", "belly@32x24")
    plan = plan_of(tmp_path, text.replace("down_", "belly_"))
    folder = tmp_path / "out"
    folder.mkdir()
    assert capture(plan, folder, ONE) == 8
    own.write_text(own.read_text("utf-8").replace("fovy = 1.0", "fovy = 1.1"), "utf-8")
    with pytest.raises(InputError, match="expected a folder of the same vehicle, flights and MuJ"):
        capture(plan, folder, ONE)


def test_several_drones_and_a_camera_that_stands(opengl: None, tmp_path: Path) -> None:
    own = vehicle_with(tmp_path, BELLY).path
    text = f"""
    vehicle = "{own}"
    cameras = ["front@16x16", "front_segmentation@8x8", "tower@16x16", "tower_segmentation@16x16"]
    least_area = 2
    [[poses]]
    from = "random"
    count = 1
    [[poses]]
    from = "flight"
    env = "rotorgram/Formation-v0"
    drones = 2
    every = 30
    options = {{ episode_length = 60 }}
    """
    folder = tmp_path / "out"
    folder.mkdir()
    assert capture(plan_of(tmp_path, text), folder, ONE) == 4
    names = {path.name for path in (folder / "rgb" / "tower").iterdir()}
    assert names == {f"{i:06}.png" for i in range(4)}
    names = {path.name for path in (folder / "rgb" / "front").iterdir()}
    assert names == {"000000.png"} | {f"{i:06}_{k}.png" for i in (1, 2, 3) for k in (0, 1)}
    told = json.loads((folder / "coco.json").read_text())
    for image in told["images"]:
        with Image.open(folder / image["file_name"]) as file:
            assert file.size == (image["width"], image["height"])
    assert {image["file_name"].split("/")[0] for image in told["images"]} == {"rgb", "segmentation"}
    assert all(one["area"] >= 2 and one["iscrowd"] == 0 for one in told["annotations"])
    kinds = [kind["name"] for kind in told["categories"]]
    assert kinds == sorted(kinds)
    assert {"drone", "scene/floor"} <= {*kinds}


def test_a_journal_of_another_vehicle(tmp_path: Path) -> None:
    journal = tmp_path / "flight.mcap"
    with spawn_simulator(EnvConfig(env_id="rotorgram/Hover-v0"), record=journal) as env:
        env.reset(seed=1)
        for _ in range(4):
            env.step(env.action_space.sample())
    text = f"""
    cameras = ["front@16x16"]
    [[poses]]
    from = "journal"
    file = "{journal}"
    every = 2
    """
    (poses,) = plan_of(tmp_path, text).sequences()
    assert len(poses) == 3
    assert poses.times.tolist() == [0.0, 0.04, 0.08]
    with pytest.raises(InputError, match=r"plan: vehicle: expected .*, which flies in "):
        plan_of(tmp_path, 'vehicle = "crazyflie2"\n' + text).sequences()


def test_a_task_of_a_module_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.py").write_text(
        "from rotorgram.envs import register\n"
        "from rotorgram.envs.tasks.hover import Hover\n"
        "class Mine(Hover):\n    pass\n"
        'register("mine/Captured-v0", Mine)\n'
    )
    monkeypatch.chdir(tmp_path)
    text = """
    [[poses]]
    from = "flight"
    env = "mine:mine/Captured-v0"
    every = 50
    options = { episode_length = 100 }
    """
    (poses,) = plan_of(tmp_path, text).sequences()
    assert poses.times.tolist() == [0.0, 1.0, 2.0]
    assert poses.velocity is not None
    assert poses.body_rates is not None
    assert not poses.velocity[0].any()
    assert poses.velocity[1:].any()
    assert poses.body_rates[1:].any()


def test_a_full_disk_loses_nothing(
    opengl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "full"
    written = []
    folder.mkdir()
    whole = capturing.write_whole

    def full(path: Path, data: bytes) -> None:
        if len(written) == 12:
            raise OSError(28, "No space left on device", str(path))
        written.append(path)
        whole(path, data)

    monkeypatch.setattr(capturing, "write_whole", full)
    with pytest.raises(OSError, match="No space left on device"):
        capture(plan_of(tmp_path), folder, ONE)
    monkeypatch.undo()
    assert_whole(folder)
    assert not list(folder.rglob("*.tmp"))
    assert capture(plan_of(tmp_path), folder, ONE) == 8
    assert len(read_labels(folder, 8)) == 8


def test_one_ctrl_c_ends_it(opengl: None, tmp_path: Path) -> None:
    """With workers that have much left to do; what they made is kept, each file whole."""
    plan = PLAN.replace("count = 5", "count = 3000").replace("tilt = 0.5", "tilt = 0.5\n")
    (tmp_path / "plan.toml").write_text(plan, "utf-8")
    with subprocess.Popen(
        [*LINE, "--jobs", "2"], cwd=tmp_path, start_new_session=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        wait_for(process, lambda: len(list((tmp_path / "out" / "labels").glob("*.json"))) >= 5)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert error.endswith("rotorgram: interrupted\n")
    assert_whole(tmp_path / "out")


def test_a_run_that_is_killed_goes_on(captured: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of it; the same line again makes the folder whole."""
    (tmp_path / "plan.toml").write_text(PLAN, "utf-8")
    pipe = subprocess.DEVNULL
    with subprocess.Popen([*LINE, "--jobs", "1"], cwd=tmp_path, stdout=pipe, text=True) as process:
        wait_for(process, label_file(tmp_path / "out", 1).exists)
        process.kill()
    done = subprocess.run([*LINE, "--jobs", "1"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0
    assert "out: 8 frames" in done.stdout
    assert contents(tmp_path / "out") == contents(captured)
