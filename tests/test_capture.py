"""Labelled pictures: plans, labels against the pictures, formats, and what an interrupt leaves."""

import json
import math
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.experiments import capture as capturing
from rotorgram.experiments.capture import capture, label_file, objects_in, read_labels
from rotorgram.experiments.capture_formats import category
from rotorgram.experiments.settings import WorkersConfig
from rotorgram.experiments.viewpoints import Plan
from rotorgram.models import InputError

Image = pytest.importorskip("PIL.Image")
ONE = WorkersConfig(jobs=1)
PLAN = """
vehicle = "crazyflie2"
cameras = ["down@32x24", "down_depth@32x24", "down_segmentation@32x24", "front_flow@16x16"]
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
    """All files but the lock, and the films, which hold the time."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".mp4" and path.name != ".lock"
    }


# ---- plans


def test_random_places_fill_the_box(tmp_path: Path) -> None:
    walk, _ = plan_of(tmp_path, PLAN.replace("count = 5", "count = 400")).walks()
    position, quaternion = walk.position[:, 0], walk.quaternion[:, 0]
    assert position.min(axis=0) == pytest.approx([-2, -2, 1], abs=0.1)
    assert position.max(axis=0) == pytest.approx([2, 2, 3], abs=0.1)
    assert np.linalg.norm(quaternion, axis=1) == pytest.approx(1.0)
    w, x, y, z = quaternion.T
    tilts = np.arccos(1 - 2 * (x**2 + y**2))
    assert 0.45 < tilts.max() <= 0.5
    headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    assert np.ptp(headings) > 6
    again, _ = plan_of(tmp_path, PLAN.replace("count = 5", "count = 400")).walks()
    other, _ = plan_of(tmp_path, PLAN.replace("seed = 7", "seed = 8")).walks()
    assert (again.position == walk.position).all()
    assert (other.position[0] != walk.position[0]).all()


def test_a_flight_gives_every_so_many_steps(tmp_path: Path) -> None:
    _, walk = plan_of(tmp_path).walks()
    assert walk.times.tolist() == [0.0, 0.8, 1.6]
    assert walk.goal is not None
    assert walk.goal.shape == walk.position.shape == (3, 1, 3)
    assert [mark.shape for mark in walk.marks] == ["disc"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("seed = 7", "seed = -1"), "plan: seed: expected a whole number from 0, got -1"),
        (("seed = 7", "sed = 7"), "plan: expected some of vehicle, world, .* got 'sed'"),
        (("seed = 7", 'world = "moon"'), "world: expected 'plain' or 'airport' .* got 'moon'"),
        (("count = 5", "count = 0"), r"plan: poses\[1\].count: expected 1 to 1000000, got 0"),
        (("count = 5", ""), r"plan: poses\[1\].count: expected 1 to 1000000, got None"),
        (("tilt = 0.5", "tilt = 4"), r"poses\[1\].tilt: expected 0 to 3.14159 rad, got 4"),
        (("tilt = 0.5", "tip = 4"), r"poses\[1\]: expected some of count, center, size, tilt"),
        (('from = "random"', 'from = "air"'), r"poses\[1\].from: expected 'random' or 'flight'"),
        (("[4.0, 4.0, 2.0]", "[4.0]"), r"poses\[1\].size: expected three numbers, m, got \[4.0\]"),
        (
            ('env = "rotorgram/Landing-v0"', "env = 3"),
            r"\[2\].env: expected the id of a task, got 3",
        ),
        (("every = 40", "agent = 5"), r"\[2\].agent: expected a controller or a checkpoint, got 5"),
        (("{ episode_length = 100 }", "1"), r"poses\[2\].options: expected options by name, got 1"),
        (("down@32x24", "down@33x24"), "plan: down: expected even sizes, .* got 33x24"),
        (("down@32x24", "rear"), "cameras: expected some of front, down"),
        (("seed = 7", "seed ="), "plan: expected a TOML file, got plan.toml"),
    ],
)
def test_wrong_plans(tmp_path: Path, change: tuple[str, str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        plan_of(tmp_path, PLAN.replace(*change))


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


def test_categories() -> None:
    assert category("forest/tree_12") == "forest/tree"
    assert category("task/disc_0 of drone_3") == "task/disc of drone"
    assert category("drone_0") == "drone"


# ---- data sets


@pytest.fixture(scope="module")
def captured(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captured")
    assert capture(plan_of(folder), folder, ONE) == 8
    return folder


def test_every_file_is_there(captured: Path) -> None:
    labels = read_labels(captured)
    assert [one["frame"] for one in labels] == list(range(8))
    for frame in labels:
        kinds = [(one["camera"], one["kind"]) for one in frame["pictures"]]
        assert kinds == [
            ("down", "rgb"), ("down", "depth"), ("down", "segmentation"), ("front", "flow")
        ]  # fmt: skip
        for one in frame["pictures"]:
            assert all((captured / file).is_file() for file in one["files"])
    text = (captured / "README.md").read_text("utf-8")
    assert "8 frames of Crazyflie 2.x" in text
    assert "| 5 | 1 random, world `plain` |" in text
    assert PLAN.strip() in text
    with Image.open(captured / "contact.png") as sheet:
        assert sheet.size == (4 * 160, 8 * 160)  # 32x24 is 160x120, the square flow 160x160


def test_depth_in_millimetres_is_depth_in_metres(captured: Path) -> None:
    for frame in read_labels(captured):
        depth, coded = (captured / file for file in frame["pictures"][1]["files"])
        meters = np.load(depth)
        with Image.open(coded) as image:
            millimetres = np.asarray(image).astype(float)
        near = meters <= 65.535
        assert np.abs(millimetres[near] - 1000 * meters[near]).max(initial=0) <= 0.51
        assert not millimetres[~near].any()


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
        left, top, width, height = one["bbox"]
        assert (columns.min(), rows.min()) == (left, top)
        assert (columns.max() + 1, rows.max() + 1) == (left + width, top + height)
        assert one["area"] == mask.sum()


def test_poses_bring_points_to_their_pixels(captured: Path) -> None:
    """KITTI's [R | t] and P against the lens of the labels, and that against the pad."""
    lines = (captured / "poses" / "down_drone_0.txt").read_text().splitlines()
    poses = np.array([[float(x) for x in line.split()] for line in lines]).reshape(8, 3, 4)
    key, *numbers = (captured / "calib.txt").read_text().splitlines()[0].split()
    assert key == "P_down:"
    projection = np.array(numbers, float).reshape(3, 4)
    seen = 0
    for frame, pose in zip(read_labels(captured), poses, strict=True):
        picture = frame["pictures"][2]
        pads = [one for one in picture["objects"] if one["name"].startswith("task/disc")]
        for pad in pads:
            left, top, width, height = pad["box"]
            if left == 0 or top == 0 or left + width == 32 or top + height == 24:
                continue  # a part of it alone
            point = np.add(frame["pose"]["goal"][0], (0.0, 0.0, 0.005))
            there = pose[:, :3].T @ (point - pose[:, 3])
            pixel = projection @ np.append(there, 1.0)
            assert pixel[0] / pixel[2] == pytest.approx(left + width / 2, abs=1.0)
            assert pixel[1] / pixel[2] == pytest.approx(top + height / 2, abs=1.0)
            seen += 1
    assert seen


def test_the_layout_of_lerobot(captured: Path) -> None:
    parquet: Any = pytest.importorskip("pyarrow.parquet")
    root = captured / "lerobot"
    info = json.loads((root / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (2, 8, 10.0)
    rows = [
        parquet.read_table(
            root / info["data_path"].format(episode_chunk=0, episode_index=episode)
        ).to_pylist()
        for episode in range(2)
    ]
    assert [len(one) for one in rows] == [5, 3]
    assert set(rows[0][0]) | {"observation.images.down"} == set(info["features"])
    assert [row["index"] for one in rows for row in one] == list(range(8))
    labels = read_labels(captured)
    assert rows[1][2]["observation.state"][:3] == pytest.approx(labels[7]["pose"]["position"][0])
    assert rows[1][2]["time"] == 1.6
    video = info["video_path"].format(
        episode_chunk=0, video_key="observation.images.down", episode_index=1
    )
    ffmpeg: Any = pytest.importorskip("imageio_ffmpeg")
    assert ffmpeg.count_frames_and_secs(str(root / video))[0] == 3


def test_it_is_the_same_again_and_goes_on(captured: Path, tmp_path: Path) -> None:
    """Labels that are missing are made again; the rest stays; two workers give the same bits."""
    folder = tmp_path / "again"
    folder.mkdir()
    capture(plan_of(tmp_path), folder, WorkersConfig(jobs=2))
    whole = contents(captured)
    whole.pop("plan.toml")
    assert {k: v for k, v in contents(folder).items() if k != "plan.toml"} == whole
    kept = folder / "rgb" / "down" / "000001.png"
    kept.write_bytes(whole["rgb/down/000000.png"])
    for number in (2, 7):
        label_file(folder, number).unlink()
    (folder / "rgb" / "down" / "000003.png").unlink()
    capture(plan_of(tmp_path), folder, ONE)
    assert kept.read_bytes() == whole["rgb/down/000000.png"]
    kept.write_bytes(whole["rgb/down/000001.png"])
    told = contents(folder)
    for name in ("labels/000003.json", "rgb/down/000003.png", "labels/000007.json", "coco.json"):
        assert told[name] == whole[name]
    assert told["flow/front/000007.npy"] == whole["flow/front/000007.npy"]


@pytest.mark.parametrize("text", ['{"frame"', "[]", '{"frame": 1}'])
def test_labels_that_were_altered(captured: Path, tmp_path: Path, text: str) -> None:
    folder = tmp_path / "altered"
    shutil.copytree(captured, folder)
    label_file(folder, 1).write_text(text)
    with pytest.raises(InputError, match=r"000001.json: expected labels of a frame, got"):
        capture(plan_of(tmp_path), folder, ONE)
    label_file(folder, 1).unlink()
    assert capture(plan_of(tmp_path), folder, ONE) == 8


def test_a_folder_of_another_plan(captured: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder of the same plan, got one of another"):
        capture(plan_of(tmp_path, PLAN.replace("seed = 7", "seed = 9")), captured, ONE)


def test_a_full_disk_loses_nothing(
    opengl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, written = tmp_path / "full", []
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
    for file in (folder / "labels").glob("*.json"):
        for one in json.loads(file.read_text())["pictures"]:
            assert all((folder / name).is_file() for name in one["files"])
    assert not list(folder.rglob("*.part"))
    assert capture(plan_of(tmp_path), folder, ONE) == 8
    assert len(read_labels(folder)) == 8


def test_flow_is_since_the_pose_before(captured: Path) -> None:
    flows = [np.load(captured / "flow" / "front" / f"{i:06}.npy") for i in range(8)]
    assert not flows[0].any()
    assert not flows[5].any()  # the first of the flight
    assert all(flow.any() for flow in (flows[1], flows[6], flows[7]))
    assert math.isfinite(float(np.abs(flows[7]).max()))


def test_a_run_that_is_killed_goes_on(captured: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of it; the same line again makes the folder whole."""
    (tmp_path / "plan.toml").write_text(PLAN, "utf-8")
    line = [sys.executable, "-m", "rotorgram.cli", "capture", "plan.toml", "--out", "out"]
    pipe = subprocess.DEVNULL
    with subprocess.Popen([*line, "--jobs", "1"], cwd=tmp_path, stdout=pipe) as process:
        deadline = time.monotonic() + 60
        while not label_file(tmp_path / "out", 1).exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.001)
        process.kill()
    done = subprocess.run([*line, "--jobs", "1"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0
    assert "out: 8 frames" in done.stdout
    whole, told = contents(captured), contents(tmp_path / "out")
    left = {name for name in told if name.endswith(".part")}
    assert {name: told[name] for name in told.keys() - left} == whole
