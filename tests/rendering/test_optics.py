"""What a camera does beyond a pinhole's sharp picture: lenses and noise."""

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv
from rotorgram.models import InputError
from rotorgram.models.cameras import Optics, chosen_views
from rotorgram.models.lens import Lens, distorted, undistorted
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from test_cameras import made, state, take, vehicle_with

__all__ = ["made"]  # a fixture

HOVER = "rotorgram/Hover-v0"
BARREL = (-0.28, 0.07, 0.001, -0.0005, 0.01)
DATA = Path(__file__).parents[1] / "data"
EYES = (DATA / "eyes.toml").read_text("utf-8")
OPTICS = EYES[EYES.index("[[cameras]]") :]
"""Tables of three cameras: wide, noisy and sharp."""


# ---- lenses


def test_a_lens_is_that_of_opencv() -> None:
    """`cv2.projectPoints` of OpenCV 4.13 for the same numbers."""
    matrix = np.array([[120.0, 0.0, 160.0], [0.0, 110.0, 118.0], [0.0, 0.0, 1.0]])
    lens = Lens(matrix, np.eye(3), np.zeros(3), BARREL)
    points = np.array([[0.1, -0.2, 1.0], [0.5, 0.4, 1.0], [-1.2, 0.9, 2.0], [0.3, 0.0, 0.5]])
    expected = [
        [171.825115, 96.3206225],
        [213.8527726, 157.55517324],
        [97.47541797, 161.02432202],
        [225.36437632, 118.0396],
    ]
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-7)


@pytest.mark.parametrize("lens", [BARREL, (0.4, -0.1, 0.0, 0.002, 0.0), (5.0, 0, 0, 0, 0)])
def test_a_distortion_is_undone(lens: tuple[float, ...]) -> None:
    flat = np.random.default_rng(0).uniform(-0.8, 0.8, (500, 2))
    np.testing.assert_allclose(undistorted(distorted(flat, lens), lens), flat, atol=1e-9)


@pytest.mark.parametrize("lens", [(-2.0, 0, 0, 0, 0), (0, 0, 3.0, 3.0, 0), (1e300, 0, 0, 0, 0)])
def test_a_lens_that_folds_its_picture(lens: tuple[float, ...]) -> None:
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    with pytest.raises(InputError, match=r"distortion: expected a lens that .* folds the picture"):
        undistorted(corners, lens)


def test_depth_and_flow_of_a_lens_that_distorts(made: Any, tmp_path: Path) -> None:
    """The ground lies at height 0 by `points`; it flows as `project` tells of these points."""
    craft = vehicle_with(tmp_path, OPTICS)
    cameras = made("wide_depth wide_flow wide_segmentation", craft)
    first, second = (state((x, 0.0, 1.0), quaternion=_pitched(0.5)) for x in (0.0, 0.1))
    take(cameras, **first)
    seen = take(cameras, fresh=False, **second)
    ground = seen["wide_segmentation"][0, ..., 0] == cameras.objects.index("scene/floor")
    near = ground & (seen["wide_depth"][0, ..., 0] < 20)
    assert near.sum() > 2000
    points = cameras.lens("wide_depth", second).points(seen["wide_depth"][0, ..., 0])
    # Depth is that of the nearest of pixels half as wide: a quarter of a pixel aside at most.
    assert np.median(np.abs(points[near][:, 2])) < 0.01
    middles = np.argwhere(near)[:, ::-1] + 0.5
    was = cameras.lens("wide_depth", first).project(points[near])
    np.testing.assert_allclose(seen["wide_flow"][0][near], middles - was, atol=2e-3)


def _pitched(angle: float) -> np.ndarray:
    """Nose down."""
    return np.array([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])


# ---- noise


def over_ground(cameras: Cameras, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of the ground by `noisy` of so many worlds, without noise and with it."""
    level = state(*[(0.0, 0.0, 50.0)] * count, quaternion=_pitched(math.pi / 2))
    plain = take(cameras, **level)["noisy"].astype(float)
    dice = np.random.default_rng(1)
    everybody = np.ones(count, bool)
    cameras.take({"noisy": everybody}, everybody, level, lambda _: dice)
    return plain, cameras.pictures["noisy"].astype(float)


def test_noise_is_as_wide_as_told(made: Any, tmp_path: Path) -> None:
    """Over many pictures of the ground the mean is its colour, the spread that of √(a² v + b²)."""
    craft = vehicle_with(tmp_path, OPTICS.replace("exposure = 0.5", ""))
    plain, noisy = over_ground(made("noisy", craft, shape=(40, 1)), 40)
    between = (plain > 50) & (plain < 200)  # far from black and white, where it is cut
    assert between.mean() > 0.5
    noise = ((noisy - plain) / 255)[between]
    expected = np.sqrt(0.04**2 * plain / 255 + 0.02**2)[between]
    assert (noise / expected).std() == pytest.approx(1.0, rel=0.02)
    assert abs(noise.mean()) < 5e-4


def test_exposure_is_one_for_each_picture(made: Any, tmp_path: Path) -> None:
    craft = vehicle_with(tmp_path, OPTICS.replace("noise = [0.04, 0.02]", ""))
    both = over_ground(made("noisy", craft, shape=(60, 1)), 60)
    stops = []
    for own, picture in zip(*both, strict=True):
        lit = picture < 255
        share = (picture * own)[lit].sum() / (own**2)[lit].sum()
        assert np.abs(picture - share * own)[lit].max() <= 1.0  # of 255: it is rounded twice
        stops.append(np.log2(share))
    assert np.std(stops) == pytest.approx(0.5, rel=0.3)
    assert abs(np.mean(stops)) < 0.2


def test_noise_is_another_in_each_picture_and_flies_the_same(opengl: None) -> None:
    """The contract of envs has that it is the same alone and in a batch, here and over UDP."""
    noisy, clean = (
        LocalVectorEnv(HOVER, 2, vehicle=DATA / "eyes.toml", cameras=cameras, action="velocity")
        for cameras in ("noisy", "sharp@24x18")
    )
    with closing(noisy), closing(clean):
        seen = noisy.reset(seed=[5, 6])[0]
        sharp = clean.reset(seed=[5, 6])[0]
        for _ in range(3):
            before = seen["noisy"].copy()
            assert (before[0] != before[1]).any()
            assert (before != sharp["sharp"]).any()
            assert (seen["observation"] == sharp["observation"]).all()
            seen = noisy.step(np.zeros((2, 4), np.float32))[0]
            sharp = clean.step(np.zeros((2, 4), np.float32))[0]
            assert (seen["noisy"] != before).any()


# ---- files


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("-0.28, 0.07", "-3.0, 0.0"), "distortion: expected a lens that sees each direction"),
        (("0.0005, 0.01]", "0.0005]"), r"cameras\[1\].distortion: expected 5 numbers from"),
        (("noise = [0.04, 0.02]", "noise = 0.1"), r"cameras\[2\].noise: expected 2 numbers from"),
        (("exposure = 0.5", "exposure = -1"), r"exposure: expected a number from 0 to 10 stop"),
    ],
)
def test_wrong_optics(tmp_path: Path, change: tuple[str, str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        vehicle_with(tmp_path, OPTICS.replace(*change))


def test_what_a_file_says_is_what_mjcf_says_of_it(tmp_path: Path) -> None:
    """A vehicle's file that is written as MJCF keeps its optics, by custom texts."""
    craft = vehicle_with(tmp_path, OPTICS)
    told = {camera.name: camera.optics for camera in craft.cameras}
    assert told["wide"] == Optics(distortion=BARREL)
    assert told["noisy"] == Optics(exposure=0.5, noise=(0.04, 0.02))
    text = Vehicle.load().path.read_text("utf-8")
    start = text.index("<camera ")
    texts = "".join(
        f'<text name="rotorgram/cameras.eye.{key}" data="{data}"/>'
        for key, data in (("distortion", "-0.28 0.07 0.001 -0.0005 0.01"), ("exposure", "0.3"))
    )
    file = tmp_path / "own.xml"
    eye = '<camera name="eye" pos="0.5 0 0"/>'
    whole = text[:start] + eye + text[start:]
    file.write_text(whole.replace("</mujoco>", f"<custom>{texts}</custom></mujoco>"), "utf-8")
    named = {camera.name: camera.optics for camera in Vehicle.load(file).cameras}
    assert named["eye"] == Optics(distortion=BARREL, exposure=0.3)
    wrong = texts.replace('"0.3"', '"soon"')
    file.write_text(whole.replace("</mujoco>", f"<custom>{wrong}</custom></mujoco>"), "utf-8")
    with pytest.raises(InputError, match=r"camera eye.exposure: expected a number .* got 'soon'"):
        Vehicle.load(file)


def test_a_lens_that_needs_too_much(tmp_path: Path) -> None:
    text = OPTICS.replace("[-0.28, 0.07, 0.001, -0.0005, 0.01]", "[-0.05, 0.0, 0.0, 0.0, 0.0]")
    craft = vehicle_with(tmp_path, text.replace("[96, 72]\nfovy = 1.3", "[4000, 3000]\nfovy = 1.5"))
    with pytest.raises(InputError, match="distortion: expected a lens that needs at most 8192 pix"):
        Cameras(craft, chosen_views(["wide"], craft.cameras))
