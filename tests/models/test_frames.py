"""The paper's frame against signs worked out by hand and against rotation matrices."""

import math
import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.models.frames import (
    attitudes_in_paper_frame,
    positions_in_paper_frame,
    positions_in_world_frame,
    quaternions_in_world_frame,
)
from scipy.spatial.transform import Rotation
from tables import DATA

# (x, y, z) -> (X, Y, Z): right is minus left, up is up, forward is forward.
S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
# MuJoCo, right-handed: +z turns the nose left, +y puts the nose down, +x lowers the right side.
# Unity, left-handed: +Y turns the nose right, +X puts the nose down, +Z raises the right side.
SIGNS = {"z": (0, -1, 0), "y": (1, 0, 0), "x": (0, 0, -1)}
ANGLE = st.floats(-180, 180)
COORDINATE = st.floats(-100, 100)
POSITION = st.tuples(COORDINATE, COORDINATE, COORDINATE)
BELOW_180 = st.floats(-179, 179)
ATTITUDE = st.tuples(st.floats(-89, 89), BELOW_180, BELOW_180)
BY_HAND = tomllib.loads((DATA / "by_hand.toml").read_text(encoding="utf-8"))


def scalar_first(attitude: Rotation) -> np.ndarray:
    return attitude.as_quat(scalar_first=True)


def unity(phi: float, theta: float, psi: float) -> np.ndarray:
    """Unity's rotation matrix: Z first, then X, then Y, about fixed axes; angles in degrees."""
    angles = [theta, phi, psi]
    turned = Rotation.from_euler("YXZ", angles, degrees=True)
    return np.asarray(turned.as_matrix())


def turned_by(yaw: float, pitch: float, roll: float) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion in MuJoCo's world, and rotation matrix in Unity's."""
    angles = [yaw, pitch, roll]
    attitude = Rotation.from_euler("ZYX", angles, degrees=True)
    matrix = S @ attitude.as_matrix() @ S.T
    return scalar_first(attitude), matrix


@pytest.mark.parametrize(("mujoco", "paper"), BY_HAND["positions"])
def test_position(mujoco: list[float], paper: list[float]) -> None:
    found = positions_in_paper_frame(mujoco)
    assert found.tolist() == paper


def test_level_is_zero_without_negative_zeros() -> None:
    zeros = np.zeros((2, 3))
    level = np.array([[1.0, 0.0, 0.0, 0.0], [-1.0, -0.0, -0.0, -0.0]])
    places = positions_in_paper_frame(zeros)
    attitudes = attitudes_in_paper_frame(level)
    assert places.tobytes() == zeros.tobytes()
    assert attitudes.tobytes() == zeros.tobytes()


@pytest.mark.parametrize("axis", SIGNS)
@pytest.mark.parametrize("degrees", [-89.0, -60.0, 30.0, 89.0])
def test_a_rotation_about_one_axis(axis: str, degrees: float) -> None:
    attitude = Rotation.from_euler(axis, degrees, degrees=True)
    found = attitudes_in_paper_frame(scalar_first(attitude))
    expected = degrees * np.array(SIGNS[axis])
    assert found == pytest.approx(expected)


def test_a_pitch_of_30_degrees_then_a_yaw_by_hand() -> None:
    # Nose down by 30 degrees, then the whole craft turned left by 90: the nose points to -X, and
    # sin 30 below the horizon. Unity calls that 30 about X first and then -90 about Y.
    attitude = Rotation.from_euler("yz", [30.0, 90.0], degrees=True)
    angles = attitudes_in_paper_frame(scalar_first(attitude))
    forward = attitude.apply([1.0, 0.0, 0.0])
    nose = positions_in_paper_frame(forward)
    assert angles == pytest.approx((30.0, -90.0, 0.0))
    assert nose == pytest.approx((-math.sqrt(0.75), -0.5, 0.0))


@given(ANGLE, st.floats(-89.9, 89.9), ANGLE)
def test_any_attitude_against_matrices(yaw: float, pitch: float, roll: float) -> None:
    quaternion, expected = turned_by(yaw, pitch, roll)
    for attitude in attitudes_in_paper_frame([quaternion, -quaternion]):
        sizes = np.abs(attitude)
        assert (sizes <= (90, 180, 180)).all()
        found = unity(*attitude)
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("pitch", [-90.0, 90.0])
@pytest.mark.parametrize("yaw", [-179.0, -90.0, 0.0, 45.0, 179.0])
@pytest.mark.parametrize("roll", [0.0, 30.0, -120.0])
def test_nose_straight_up_or_down(pitch: float, yaw: float, roll: float) -> None:
    quaternion, expected = turned_by(yaw, pitch, roll)
    phi, theta, psi = attitudes_in_paper_frame(quaternion)
    assert phi == pitch
    assert psi == 0.0
    assert -180 <= theta <= 180
    # At the pole an angle is known to the square root of the rounding only.
    found = unity(phi, theta, psi)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_pose_by_hand_on_the_way_back() -> None:
    # 1 m right, 2 m up, 3 m forward, nose 90 degrees to the right: MuJoCo turns by -90 about +z.
    half = math.sqrt(0.5)
    place = positions_in_world_frame((1.0, 2.0, 3.0))
    turned = quaternions_in_world_frame((0.0, 90.0, 0.0))
    assert place.tolist() == [3.0, -1.0, 2.0]
    assert turned == pytest.approx([half, 0.0, 0.0, -half])


@given(POSITION, ATTITUDE)
def test_there_and_back(position: tuple[float, ...], attitude: tuple[float, ...]) -> None:
    place = positions_in_world_frame(position)
    back = positions_in_paper_frame(place)
    assert tuple(back) == position
    quaternion = quaternions_in_world_frame(attitude)
    turned = attitudes_in_paper_frame(quaternion)
    assert turned == pytest.approx(attitude, abs=1e-6)


@pytest.mark.parametrize("shape", [(), (7,), (3, 5), (0,)])
def test_any_leading_axes(shape: tuple[int, ...]) -> None:
    count = math.prod(shape)
    rows = np.tile([0.5, -0.5, 0.5, 0.5], (count, 1))
    quaternions = rows.reshape(*shape, 4)
    attitudes = attitudes_in_paper_frame(quaternions)
    assert attitudes.shape == (*shape, 3)
    places = positions_in_paper_frame(attitudes)
    assert places.shape == (*shape, 3)
    back = positions_in_world_frame(places)
    assert back.shape == (*shape, 3)
    turned = quaternions_in_world_frame(attitudes)
    assert turned.shape == (*shape, 4)


def test_nan_stays_nan_and_is_no_warning() -> None:
    unknown = [np.nan] * 4
    attitudes = attitudes_in_paper_frame([unknown, [1.0, 0.0, 0.0, 0.0]])
    assert np.isnan(attitudes[0]).all()
