import io
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pose_rows import all_readings, folder, random_poses, rows_of, write_lines
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.geometry import se3
from realsim_calibration.inputs.pose_file import read_pose_file
from realsim_calibration.inputs.readings import (
    EULER_ORDERS,
    ROTATIONS,
    PoseReading,
    reading_from_text,
)
from refusals import refused

# --- every reading in every layout --------------------------------------------------------------


def as_json(path, tree):
    path.write_text(json.dumps(tree))
    return path


def write_opencv(path, raw):
    import cv2

    store = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    store.write("poses", np.ascontiguousarray(raw))
    store.release()
    return path


def write_files(path, raw, one):
    path.mkdir()
    for k, row in enumerate(raw):
        one(path / f"pose_{k}", row)
    return path


def square(raw):
    return raw.reshape(-1, 4, 4).tolist() if raw.shape[1] == 16 else raw.tolist()


def save_json(stem, row):
    joints = np.linspace(-1, 1, 6).tolist()
    stem.with_suffix(".json").write_text(json.dumps({"joints": joints, "tcp": row.tolist()}))


LAYOUTS = {
    "spaces": lambda d, r, n: write_lines(d / "a.txt", r, " ", head="# exported"),
    "commas": lambda d, r, n: write_lines(d / "a.csv", r, ","),
    "named lines": lambda d, r, n: write_lines(d / "a.csv", r, ",", n),
    "decimal commas": lambda d, r, n: write_lines(d / "a.csv", r, ";", decimal=","),
    "tabs": lambda d, r, n: write_lines(d / "a.tsv", r, "\t", n),
    "UR": lambda d, r, n: write_lines(d / "a.log", r, ", ", head="") and brackets(d / "a.log"),
    "json nested": lambda d, r, n: as_json(d / "a.json", {"poses": square(r), "images": n}),
    "json by image": lambda d, r, n: as_json(d / "a.json", dict(zip(n, square(r), strict=True))),
    "json entries": lambda d, r, n: as_json(
        d / "a.json",
        {"fps": 30, "frames": [{"file": a, "T": p} for a, p in zip(n, square(r), strict=True)]},
    ),
    "yaml": lambda d, r, n: as_json(d / "a.yaml", r.tolist()),
    "opencv": lambda d, r, n: write_opencv(d / "a.yml", r),
    "npy": lambda d, r, n: np.save(d / "a.npy", r) or d / "a.npy",
    "npz": lambda d, r, n: np.savez(d / "a.npz", poses=r, images=np.array(n)) or d / "a.npz",
    "json files": lambda d, r, n: write_files(d / "p", r, save_json),
    "txt files": lambda d, r, n: write_files(
        d / "p", r, lambda p, row: np.savetxt(p.with_suffix(".txt"), row[None], fmt="%.17g")
    ),
    "npy files": lambda d, r, n: write_files(
        d / "p", r, lambda p, row: np.save(p.with_suffix(".npy"), row)
    ),
}


def brackets(path):
    path.write_text("".join(f"p[{line}]\n" for line in path.read_text().splitlines()))
    return path


def check(raw_poses, reading, T):
    assert len(raw_poses) == len(T)
    possible = set(raw_poses.possible)
    if raw_poses.values.shape[1] == 16:  # nothing comes first in a whole matrix
        possible |= {replace(p, position_first=reading.position_first) for p in possible}
    assert reading in possible, (str(reading), [str(p) for p in possible])
    assert np.abs(raw_poses.poses(reading) - T).max() < 1e-12


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=5, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(3, 14),
    reading=st.sampled_from(list(all_readings())),
    wide=st.booleans(),
)
def test_every_reading_survives_every_layout(layout, seed, n, reading, wide):
    T = random_poses(seed, n)
    raw = rows_of(reading, T, width=reading.widths[0 if wide else -1])
    names = [f"img_{k}.png" for k in range(n)]
    with folder() as place:
        found = read_pose_file(LAYOUTS[layout](place, raw, names))
    check(found, reading, T)
    if layout in ("named lines", "tabs", "npz", "json by image"):
        assert list(found.labels) == names
    if layout == "json files":
        assert np.allclose(found.joints, np.linspace(-1, 1, 6), atol=1e-15)
        assert found.stems[-1] == f"pose_{n - 1}"


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ("x,y,z,qx,qy,qz,qw", "quat_xyzw"),
        ("qw;qx;qy;qz;pos_x;pos_y;pos_z", "quat_wxyz,rotation_first"),
        ("x,y,z,rx,ry,rz", "rotvec"),
        ("x,y,z,rx,ry,rz", "euler_zyz,rad"),
        ("yaw,pitch,roll,x,y,z", "euler_ZYX,deg,rotation_first"),
        ("X,Y,Z,W,P,R", "euler_xyz,deg"),
        ("actual_TCP_pose_0 " + " ".join(f"actual_TCP_pose_{k}" for k in range(1, 6)), "rotvec"),
        ("x,y,z," + ",".join(f"r{r}{c}" for r in range(3) for c in range(3)), "matrix"),
    ],
)
def test_header_names_say_what_columns_are(tmp_path, header, text):
    reading = reading_from_text(f"{text},mm")
    T = random_poses(5, 9)
    raw = rows_of(reading, T, width=12 if text == "matrix" else 16)
    separator = next(s for s in ";, " if s in header)
    for k, start in enumerate(("", "# ")):
        path = write_lines(tmp_path / f"{k}.txt", raw, separator, head=start + header)
        found = read_pose_file(path)
        # names say where the position is, so the reading's order does not matter
        check(found, replace(reading, position_first=True), T)
        assert np.abs(found.poses(reading) - T).max() < 1e-12
        if "q" in header.lower() or text == "matrix":
            assert found.stated == replace(reading, position_first=True)


def test_units_in_names_extra_columns_and_joints(tmp_path):
    T = random_poses(6, 8)
    reading = reading_from_text("euler_xyz,deg,mm")
    joints = np.random.default_rng(0).uniform(-170, 170, (8, 6))
    table = np.hstack([joints, rows_of(reading, T), np.full((8, 1), 7.0)])
    head = ",".join(["image", *(f"q{k} [deg]" for k in range(6))])
    head += ",x (mm),y (mm),z (mm),roll_deg,pitch_deg,yaw_deg,force"
    names = [f"{k}.png" for k in range(8)]
    found = read_pose_file(write_lines(tmp_path / "a.csv", table, ",", names, head=head))
    meant = {f"euler_{o},deg,mm{i}" for o in ("xyz", "XYZ") for i in ("", ",inverted")}
    assert {str(p) for p in found.possible} == meant
    assert np.allclose(found.joints, np.radians(joints), atol=1e-14)
    assert list(found.labels) == names and any("force" in n for n in found.notes)
    check(found, reading, T)
    with pytest.raises(InputError, match=r"length unit is mm, not m.*rename the columns"):
        found.poses(reading_from_text("euler_xyz,deg,m"))
    moved = found.poses(reading_from_text("euler_xyz,rad,mm"), despite_names=True)
    assert np.allclose(moved[:, :3, 3], T[:, :3, 3])
    refused("not rotation_vector", found.poses, reading_from_text("rotvec,deg,mm"))


def test_degrees_under_names_that_state_radians_are_noted(tmp_path):
    numbers = rows_of(reading_from_text("rotvec,deg,m"), random_poses(6, 8))
    head = "x_m,y_m,z_m,rx_rad,ry_rad,rz_rad"
    found = read_pose_file(write_lines(tmp_path / "a.csv", numbers, ",", head=head))
    assert any("beyond two turns" in n and "rotvec,deg" in n for n in found.notes)


def test_time_and_index_columns_are_told_from_the_pose(tmp_path):
    T = random_poses(7, 6)
    reading = reading_from_text("quat_xyzw,m")
    times = 1305031102.17 + np.cumsum(np.full(6, 0.03))
    tum = write_lines(tmp_path / "a.txt", np.column_stack([times, rows_of(reading, T)]), " ")
    check(read_pose_file(tum), reading, T)
    vector = reading_from_text("rotvec,m")
    rows = np.column_stack([np.arange(3, 9), rows_of(vector, T)])
    counted = read_pose_file(write_lines(tmp_path / "b.txt", rows, " "))
    check(counted, vector, T)
    assert counted.stems == tuple("345678")


@pytest.mark.parametrize("start", [1305031102.17, 1700.0, 86400.0], ids="1970 28min day".split())
@pytest.mark.parametrize("stops", [False, True], ids=["stream", "stops"])
@pytest.mark.parametrize("unit", [1e9, 1e6])
def test_time_stamps_from_1970_and_from_the_machines_start(tmp_path, start, stops, unit):
    """28 minutes in ns have the size of ms since 1970: the steps tell them apart."""
    rng = np.random.default_rng(4)
    times = start + np.cumsum(rng.uniform(4, 20, 40) if stops else np.full(40, 0.033))
    rows = [f"{int(t * unit)},0.{k:02d},0.1,0.2,0,0,0,1" for k, t in enumerate(times, 10)]
    (tmp_path / "a.csv").write_text("\n".join(["timestamp,x,y,z,qx,qy,qz,qw", *rows]))
    assert np.allclose(read_pose_file(tmp_path / "a.csv").times, times, atol=2e-6)


def test_text_of_spreadsheets_and_windows(tmp_path):
    raw = rows_of(reading_from_text("rotvec,m"), random_poses(12, 4))
    text = "\r\n".join(" ".join(map(repr, row)) for row in raw.tolist())
    encoded = (text.encode("utf-16"), text.encode("utf-8-sig"), text.replace(".", ",").encode())
    for k, data in enumerate(encoded):
        (tmp_path / f"{k}.txt").write_bytes(data)
        assert np.array_equal(read_pose_file(tmp_path / f"{k}.txt").values, raw)


def test_ros_poses_and_parts(tmp_path):
    T = random_poses(8, 5)
    q = rows_of(reading_from_text("quat_xyzw,m"), T)

    def ros(row):
        return {
            "position": dict(zip("xyz", row[:3].tolist(), strict=True)),
            "orientation": dict(zip("xyzw", row[3:].tolist(), strict=True)),
        }

    parts = [{"R": t[:3, :3].tolist(), "t": t[:3, 3:].tolist(), "id": k} for k, t in enumerate(T)]
    stamped = [{"header": {"seq": k}, "pose": ros(r)} for k, r in enumerate(q)]
    path = tmp_path / "a.yaml"
    path.write_text("---\n".join(json.dumps(s) + "\n" for s in stamped))  # several documents
    rows = rows_of(reading_from_text("rotvec,mm"), T)
    vectors = [{"rvec": r[3:].tolist(), "tvec_mm": r[:3].tolist()} for r in rows]
    for file, stated in (
        (path, "quat_xyzw,m"),
        (as_json(tmp_path / "b.json", parts), "matrix,m"),
        (as_json(tmp_path / "c.json", vectors), "rotvec,rad,mm"),
    ):
        found = read_pose_file(file)
        assert str(found.stated) == stated
        check(found, found.stated, T)
    tree = [{"position": r[:3].tolist(), "quaternion": r[3:].tolist()} for r in q]
    found = read_pose_file(as_json(tmp_path / "d.json", tree))
    assert {p.rotation for p in found.possible} == {"quaternion_xyzw", "quaternion_wxyz"}
    check(found, reading_from_text("quat_xyzw,m"), T)


def test_matrices_as_blocks_of_lines_and_of_few_decimals(tmp_path):
    T = random_poses(9, 5)
    text = "\n\n".join("\n".join(" ".join(map(repr, row)) for row in t) for t in T.tolist())
    (tmp_path / "a.txt").write_text(text)
    found = read_pose_file(tmp_path / "a.txt")
    assert str(found.stated) == "matrix,m" and found.where[1] == "line 6"
    check(found, found.stated, T)
    (tmp_path / "b.txt").write_text("\n".join(" ".join(f"{x:.4f}" for x in t.ravel()) for t in T))
    rounded = read_pose_file(tmp_path / "b.txt")
    assert any("few decimals" in n for n in rounded.notes)
    back = rounded.poses(rounded.stated)
    assert np.abs(back - T).max() < 1e-4 and se3.check_rigid(back, "rounded") is not None


def test_numbers_leave_open_what_they_do_not_say(tmp_path):
    T = random_poses(10, 12)
    rows = rows_of(reading_from_text("euler_ZYX,deg,mm"), T)
    six = read_pose_file(write_lines(tmp_path / "a.txt", rows, " "))
    assert {p.angle_unit for p in six.possible if p.position_first} == {"deg"}
    assert {p.length_unit for p in six.possible if p.position_first} == {"mm"}
    assert {p.rotation for p in six.possible} == {r for r in ROTATIONS if r[:3] in ("eul", "rot")}
    assert six.stated is None
    near = T.copy()
    near[:, :3, 3] = 10.0 / 1000 * se3.random_rotation(np.random.default_rng(0), 12)[:, 0]
    rows = rows_of(reading_from_text("quat_wxyz,mm"), near)
    open_unit = read_pose_file(write_lines(tmp_path / "b.txt", rows, " "))
    assert {p.length_unit for p in open_unit.possible} == {"m", "mm"}
    rotations = {p.rotation for p in open_unit.possible if p.position_first}
    assert rotations == {"quaternion_xyzw", "quaternion_wxyz"}
    still = np.tile(np.eye(4), (4, 1, 1))
    both = read_pose_file(as_json(tmp_path / "c.json", still.tolist()))
    assert {p.rotation for p in both.possible} == {"matrix", "matrix_column_major"}


# --- what is refused ---------------------------------------------------------------------------


ROW = "0.5 -0.1 0.4 1.1 2.8 -0.1\n"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.txt", "", "is empty"),
        ("a.txt", ROW + "0.5 -0.1 0.4 1.1 2.8\n" + ROW, "line 2: 5 fields.*line 1 has 6"),
        ("a.txt", "0.5 -0.1 0.4 1.1 2.8 -0.1 9\n" * 3, "no pose format fits its 7 numbers"),
        ("a.txt", "nan nan nan nan nan nan\n" * 3, "all 3 poses hold NaN"),
        ("a.csv", "0.5,-0.1,,1.1,2.8,-0.1\n", "line 1: field 3 is empty"),
        ("a.csv", "x,y,z,foo,bar\n1,2,3,4,5\n", "complete rotation is missing"),
        ("a.csv", "x_mm,y_m,z_mm,rx,ry,rz\n1,2,3,4,5,6\n", "state the units"),
        ("a.json", "[[1, 2, 3", "line 1 column"),
        ("a.json", '{"a.png": [1,2,3,4,5,6],\n "a.png": [1,2,3,4,5,6]}', "'a.png' is there twice"),
        ("a.json", '{"a":[[1,2,3,4,5,6]],"b":[[1,2,3,4,5,6]]}', r"2 lists of poses \(a, b\)"),
        ("a.json", '{"poses":[[1,2,3,4,5,6]],"images":["a","b"]}', "'images' holds 2 entries"),
        ("a.yaml", "poses: [1, 2\n  b: }", "not valid YAML.*line 2"),
        ("a.yaml", "a: !!python/object/apply:os.system ['true']\n", "has the tag"),
        ("a.xml", "<a/>", "not .xml"),
    ],
)
def test_malformed_files_are_refused_by_place(tmp_path, name, content, says):
    (tmp_path / name).write_text(content)
    refused(says, read_pose_file, tmp_path / name)


def test_bombs_and_pickles_are_refused(tmp_path):
    lines = ["a0: &a0 [1, 2, 3, 4, 5, 6]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    (tmp_path / "loop.yaml").write_text("a: &a [*a]")
    for name in ("bomb.yaml", "loop.yaml"):
        refused(r"unfolds|inside of what", read_pose_file, tmp_path / name)
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for name in ("a.npy", "a.npz"):
        refused(r"pickled|Python objects", read_pose_file, tmp_path / name)
    header = io.BytesIO()
    huge = {"descr": "<f8", "fortran_order": False, "shape": (10**11, 6)}
    np.lib.format.write_array_header_1_0(header, huge)
    (tmp_path / "huge.npy").write_bytes(header.getvalue())
    refused("not a readable npy", read_pose_file, tmp_path / "huge.npy")


@settings(max_examples=40, deadline=None)
@given(
    data=st.binary(max_size=200)
    | st.text(max_size=200).map(lambda s: s.encode("utf-8", "replace")),
    ending=st.sampled_from(["txt", "csv", "json", "yaml", "npy", "npz"]),
)
def test_no_content_whatever_ends_in_a_traceback(data, ending):
    with folder() as place:
        path = place / f"a.{ending}"
        path.write_bytes(data)
        try:
            read_pose_file(path)
        except InputError as error:
            assert str(path) in str(error)


# --- Readings: numbers to poses, and what is unclear.


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
    apply, long = PoseReading(rotation="quaternion_xyzw").apply, np.eye(7)[[6, 3]]
    long[1, 4] = 1
    refused(r"row 1.*length 1", apply, long, error=NotRigidError)
    refused("takes 7 numbers", apply, np.zeros((3, 6)))
