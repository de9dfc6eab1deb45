import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pose_rows import all_readings, random_poses, rows_of
from realsim.errors import InputError, NotRigidError, UnitError
from realsim_calibration.inputs.readings import EULER_ORDERS, PoseReading, reading_from_text
from refusals import refused

# --- readings -----------------------------------------------------------------------------------


def test_euler_orders_are_scipys():
    angles = np.random.default_rng(1).uniform(-7, 7, (50, 3))
    for order in EULER_ORDERS:
        T = PoseReading(rotation=f"euler_{order}").apply(np.hstack([np.zeros((50, 3)), angles]))
        assert np.abs(T[:, :3, :3] - Rotation.from_euler(order, angles).as_matrix()).max() < 1e-14


def test_known_poses():
    c = np.cos(np.pi / 6)
    R = [[c, -0.5, 0], [0.5, c, 0], [0, 0, 1]]  # 30 deg about z
    w, s = np.cos(np.pi / 12), np.sin(np.pi / 12)
    for text, row in {
        "rotvec,mm": [100, 200, 300, 0, 0, np.pi / 6],
        "rotvec,deg,m": [0.1, 0.2, 0.3, 0, 0, 30],
        "quat_xyzw,m": [0.1, 0.2, 0.3, 0, 0, s, w],
        "quat_wxyz,m": [0.1, 0.2, 0.3, w, 0, 0, s],
        "euler_xyz,deg,m,rotation_first": [0, 0, 30, 0.1, 0.2, 0.3],
        "euler_ZYX,deg,m": [0.1, 0.2, 0.3, 30, 0, 0],
        "matrix,m": [*R[0], 0.1, *R[1], 0.2, *R[2], 0.3, 0, 0, 0, 1],
        "matrix_column_major,m": [c, 0.5, 0, 0, -0.5, c, 0, 0, 0, 0, 1, 0, 0.1, 0.2, 0.3, 1],
    }.items():
        T = reading_from_text(text).apply(row)[0]
        assert np.allclose(T[:3, :3], R, atol=1e-12), text
        assert np.allclose(T[:3, 3], [0.1, 0.2, 0.3], atol=1e-12), text
        inverse = reading_from_text(text + ",inverted").apply(row)[0]
        assert np.allclose(inverse @ T, np.eye(4), atol=1e-12), text


def test_texts_and_numbers_of_every_reading_come_back():
    T = random_poses(3, 6)
    for reading in all_readings():
        assert reading_from_text(str(reading)) == reading
        for width in reading.widths:
            raw = rows_of(reading, T, width=width)
            assert raw.shape == (6, width) and reading.fits(raw).all()
            assert np.abs(reading.apply(raw) - T).max() < 1e-12, reading


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("rotvec", "length unit"),
        ("mm,inverted", "rotation's format"),
        ("rotvec,mm,m", "two things"),
        ("euler_XYZ,mm", "angle unit"),
        ("euler_XYx,deg,mm", "not known"),
        ("euler_xxy,deg,mm", "not known"),
        ("quat,m", "not known"),
        ("quat_xyzw,deg,m", "no angles"),
    ],
)
def test_unclear_readings_are_refused_with_what_is_accepted(text, says):
    refused(says, reading_from_text, text)


def test_rows_that_are_no_poses_are_named():
    reading = PoseReading(rotation="matrix")
    raw = rows_of(reading, random_poses(0, 5))
    names = [f"line {k}" for k in range(10, 15)]
    for change, error, says in (
        (lambda r: r.__setitem__((2, 0), np.nan), InputError, r"line 12 \(1 of 5\).*NaN"),
        (lambda r: r.__setitem__((1, slice(0, 3)), -r[1, :3]), NotRigidError, "line 11.*mirrored"),
        (lambda r: r.__setitem__((3, slice(0, 3)), 2 * r[3, :3]), NotRigidError, "line 13.*not a"),
        (lambda r: r.__setitem__((4, 12), 0.2), NotRigidError, "line 14.*last row"),
        (lambda r: r.__setitem__((4, 3), 650.0), UnitError, "line 14.*--reading matrix,mm if"),
    ):
        bad = raw.copy()
        change(bad)
        refused(says, reading.apply, bad, error=error, rows=names)
        assert reading.fits(bad).sum() == (5 if error is UnitError else 4)
    with pytest.raises(NotRigidError, match=r"row 1.*length 1"):
        PoseReading(rotation="quaternion_xyzw").apply(
            [[0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 1, 1, 0, 0]]
        )
    refused("takes 7 numbers", PoseReading(rotation="quaternion_xyzw").apply, np.zeros((3, 6)))
