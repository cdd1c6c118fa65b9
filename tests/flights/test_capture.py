"""Labelled pictures of recorded flights: poses, labels, what interrupts leave."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each
from programs import EXAMPLES
from rotorgram.cli import main
from rotorgram.flights.executors import WorkersConfig
from rotorgram.models import InputError
from test_cameras import BELLY, vehicle_with

Image = pytest.importorskip("PIL.Image")
pytest.importorskip("mcap")
capturing = pytest.importorskip("capture")  # examples/capture.py
PoseSequence = capturing.PoseSequence
CaptureConfig = capturing.CaptureConfig
capture = capturing.capture
ONE = WorkersConfig(jobs=1)
CONFIG = CaptureConfig(
    vehicle="crazyflie2",
    cameras=("down@32x24", "down_depth@32x24", "down_segmentation@32x24", "front@16x16"),
    every=40,
    aside=0.5,
    tilt=0.3,
    seed=7,
    fast=True,
)
LINE = [sys.executable, str(EXAMPLES / "capture.py")]


def recorded(path: Path, env: str, vehicle: str, *words: str) -> Path:
    """Two flights of a controller."""
    flags = ["--env", env, "--vehicle", vehicle, "--episodes", "2", "--record", str(path), *words]
    assert main(["evaluate", "geometric", *flags]) == 0
    return path


@pytest.fixture(scope="module")
def landing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("journals") / "landing.mcap"
    length = ["--episode-length", "100"]
    return recorded(path, "rotorgram/Landing-v0", "crazyflie2", *length)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def labels_of(folder: Path) -> list[dict]:
    files = sorted((folder / "labels").glob("*.json"))
    return [json.loads(file.read_text()) for file in files]


def assert_whole(folder: Path) -> None:
    """Every picture of the frames that have labels can be read, in its size."""
    for frame in labels_of(folder):
        for picture in frame["pictures"]:
            file = folder / picture["file"]
            size = (picture["width"], picture["height"])
            if file.suffix == ".npy":
                assert np.load(file).shape == size[::-1]
                continue
            with Image.open(file) as image:
                image.load()
                assert image.size == size


# ---- poses


def poses_of(journal: Path, **changes: object) -> list[PoseSequence]:
    settings = {"vehicle": "crazyflie2", **changes}
    return capturing.sequences_of([journal], CaptureConfig(**settings))


def test_an_episode_gives_every_so_many_steps(landing: Path) -> None:
    first, second = poses_of(landing, every=40)
    for poses in (first, second):
        assert poses.source == "landing.mcap"
        assert poses.times.tolist() == [0.0, 0.8, 1.6]
        assert poses.states["goal"].shape == poses.states["position"].shape == (3, 1, 3)
        assert [mark.shape for mark in poses.marks] == ["disc"]
    assert (first.states["position"][0] != second.states["position"][0]).any()


def test_poses_are_moved_and_tilted_within_bounds(landing: Path) -> None:
    changes = {"every": 1, "aside": 2.0, "tilt": 0.5}
    (still, _) = poses_of(landing, every=1)
    (poses, _) = poses_of(landing, **changes)
    moved = (poses.states["position"] - still.states["position"])[:, 0]
    assert moved.min(axis=0) == pytest.approx([-2.0, -2.0, 0.0], abs=0.2)
    assert moved.max(axis=0) == pytest.approx([2.0, 2.0, 2.0], abs=0.2)
    both = poses.states["quaternion"] * still.states["quaternion"]
    tilts = 2 * np.arccos(np.abs(both.sum(axis=-1)).clip(0.0, 1.0))
    assert 0.45 < tilts.max() <= 0.5
    (again, _) = poses_of(landing, **changes)
    (other, _) = poses_of(landing, seed=8, **changes)
    assert (again.states["position"] == poses.states["position"]).all()
    assert (other.states["position"][0] != poses.states["position"][0]).all()


@each("name, value, sentence", "capture")
def test_wrong_settings(name: str, value: object, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        CaptureConfig(**{"vehicle": "crazyflie2", name: value})


def test_a_journal_of_another_vehicle(landing: Path) -> None:
    with pytest.raises(InputError, match=r"^vehicle: expected .*, which flies in .*landing.mcap"):
        poses_of(landing, vehicle="hummingbird")


def test_a_journal_without_a_flight(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    with pytest.raises(InputError, match="expected an episode with a step in it, got none"):
        poses_of(empty)


# ---- labels


def test_boxes_and_runs_are_those_of_the_mask() -> None:
    numbers = np.zeros((5, 6), np.int32)
    numbers[1:4, 2:5] = 2
    numbers[2, 3] = 1
    one, two = capturing.objects_in(numbers, ["nothing", "inner", "outer"])
    assert (one["name"], one["box"], one["area"]) == ("inner", [3, 2, 1, 1], 1)
    assert (two["name"], two["box"], two["area"]) == ("outer", [2, 1, 3, 3], 8)
    # Down the columns: 10 of the first two, the third's first; then 3; and so on.
    assert two["runs"] == [11, 3, 2, 1, 1, 1, 2, 3, 6]
    full = next(capturing.objects_in(np.ones((2, 2), np.int32), ["nothing", "all"]))
    assert full["runs"] == [0, 4]


def unrolled(runs: list[int], height: int, width: int) -> np.ndarray:
    flat = np.repeat(np.arange(len(runs)) % 2, runs).astype(bool)
    return flat.reshape(width, height).T


@each("name, kind", "categories")
def test_categories(name: str, kind: str) -> None:
    assert capturing.category(name) == kind


# ---- data sets


@pytest.fixture(scope="module")
def captured(opengl: None, landing: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captured") / "out"
    assert capture([landing], folder, CONFIG, ONE) == 6
    return folder


def test_every_file_is_there(captured: Path) -> None:
    frames = labels_of(captured)
    assert [one["frame"] for one in frames] == list(range(6))
    for frame in frames:
        kinds = [(one["camera"], one["kind"]) for one in frame["pictures"]]
        assert kinds == [
            ("down", "rgb"), ("down", "depth"), ("down", "segmentation"), ("front", "rgb")
        ]  # fmt: skip
    assert_whole(captured)
    assert len(contents(captured)) == 6 * 5 + 1
    info = json.loads((captured / "coco.json").read_text())["info"]
    assert (info["vehicle"], info["aside"], info["seed"]) == ("crazyflie2", 0.5, 7)


def test_depth_is_in_metres_along_the_axis(captured: Path) -> None:
    """The middle pixel through the lens of the labels, on the ground or on the pad."""
    for frame in labels_of(captured):
        picture = frame["pictures"][1]
        depth = np.load(captured / picture["file"])
        assert depth.dtype == np.float32
        pixel = np.array([16.5, 12.5, 1.0])
        there = np.linalg.inv(picture["matrix"]) @ pixel * depth[12, 16]
        point = np.array(picture["rotation"]).T @ (there - picture["translation"])
        assert -0.01 < point[2] < 0.1


def test_boxes_are_those_of_the_pictures(captured: Path) -> None:
    told = json.loads((captured / "coco.json").read_text())
    names = {kind["id"]: kind["name"] for kind in told["categories"]}
    assert {"scene/floor", "task/disc of drone"} <= {*names.values()}
    masks = {}
    for image in told["images"]:
        number = Path(image["file_name"]).stem
        with Image.open(captured / "segmentation" / "down" / f"{number}.png") as file:
            masks[image["id"]] = np.asarray(file)
    assert len(told["annotations"]) >= 6
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
    for frame in labels_of(captured):
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
    assert [image["sequence"] for image in images] == [0, 0, 0, 1, 1, 1]
    assert [image["time"] for image in images] == [0.0, 0.8, 1.6] * 2
    assert [frame["time"] for frame in labels_of(captured)] == [0.0, 0.8, 1.6] * 2


def test_two_workers_give_the_same_files(captured: Path, landing: Path, tmp_path: Path) -> None:
    folder = tmp_path / "again"
    capture([landing], folder, CONFIG, WorkersConfig(jobs=2))
    assert contents(folder) == contents(captured)


def test_a_folder_that_exists(opengl: None, captured: Path, landing: Path) -> None:
    words = [str(landing), "--vehicle", "crazyflie2", "--out", str(captured)]
    done = subprocess.run([*LINE, *words], stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("out: expected a new folder")


def test_several_drones_and_a_camera_that_stands(opengl: None, tmp_path: Path) -> None:
    own = str(vehicle_with(tmp_path, BELLY).path)
    words = ["--drones", "2", "--episode-length", "60"]
    journal = recorded(tmp_path / "two.mcap", "rotorgram/Formation-v0", own, *words)
    cameras = ("front@16x16", "front_segmentation@8x8", "tower@16x16", "tower_segmentation@16x16")
    folder = tmp_path / "out"
    config = CaptureConfig(vehicle=own, cameras=cameras, every=30)
    assert capture([journal], folder, config, ONE) == 6
    names = {path.name for path in (folder / "rgb" / "tower").iterdir()}
    assert names == {f"{i:06}.png" for i in range(6)}
    names = {path.name for path in (folder / "rgb" / "front").iterdir()}
    assert names == {f"{i:06}_{k}.png" for i in range(6) for k in (0, 1)}
    told = json.loads((folder / "coco.json").read_text())
    for image in told["images"]:
        with Image.open(folder / image["file_name"]) as file:
            assert file.size == (image["width"], image["height"])
    assert {image["file_name"].split("/")[0] for image in told["images"]} == {"rgb", "segmentation"}
    assert all(one["iscrowd"] == 0 for one in told["annotations"])
    kinds = [kind["name"] for kind in told["categories"]]
    assert kinds == sorted(kinds)
    assert {"drone", "scene/floor"} <= {*kinds}
    assert "nothing" not in kinds


def test_a_full_disk_keeps_what_is_there(
    opengl: None, landing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "full"
    written = []
    whole = capturing.write_whole

    def full(path: Path, data: bytes) -> None:
        if len(written) == 12:
            raise OSError(28, "No space left on device", str(path))
        written.append(path)
        whole(path, data)

    monkeypatch.setattr(capturing, "write_whole", full)
    with pytest.raises(OSError, match="No space left on device"):
        capture([landing], folder, CONFIG, ONE)
    assert_whole(folder)
    assert len(labels_of(folder)) == 2
    assert not list(folder.rglob("*.tmp"))


def test_one_ctrl_c_ends_it(opengl: None, landing: Path, tmp_path: Path) -> None:
    """With workers that have much left to do; what they made is kept, each file whole."""
    many = [str(landing)] * 20
    flags = ["--vehicle", "crazyflie2", "--every", "1", "--out", "out", "--jobs", "2"]
    with subprocess.Popen(
        [*LINE, *many, *flags], cwd=tmp_path, start_new_session=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        wait_for(process, lambda: len(list((tmp_path / "out" / "labels").glob("*.json"))) >= 5)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    assert process.returncode == 130
    assert_whole(tmp_path / "out")


def wait_for(process: "subprocess.Popen[str]", is_there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 90
    while not is_there():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.001)
