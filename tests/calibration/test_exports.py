"""What a calibration leaves behind: every format reads back as the same transform."""

import ast
import json
import math
import shlex
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.exports import write
from realsim_calibration.exports.calibration_file import calibration_text, read_calibration
from realsim_calibration.exports.frames import FrameNames, note_lines, published_transform
from realsim_calibration.exports.write import opencv_text, write_exports
from realsim_calibration.results import HandEyeReport, Mode
from refusals import refused
from tests.calibration.conftest import record
from tried_grasps import assert_same

axis = hnp.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(
    lambda v: np.linalg.norm(v) > 1e-3
)
angles = st.one_of(
    st.floats(-math.pi, math.pi),
    st.sampled_from([0.0, math.pi, math.pi / 2, -math.pi / 2, 1e-17, 1e-9, math.pi - 1e-9]),
)


@st.composite
def transforms(draw: st.DrawFn) -> Array:
    """Return rigid transforms, among them turns by 0, 90 and 180 deg about the axes."""
    w = draw(st.one_of(axis, st.sampled_from([np.eye(3)[k] for k in range(3)])))
    R = se3.exp_so3(w / np.linalg.norm(w) * draw(angles))
    if draw(st.booleans()):
        R = se3.from_rt([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.zeros(3))[:3, :3] @ R
    return se3.from_rt(R, [draw(st.floats(-2, 2)) for _ in range(3)])


def rigid_of(xyz: Any, xyzw: Any) -> Array:
    """Return T of a translation and a quaternion x y z w, by scipy's formula."""
    q = np.array([float(v) for v in xyzw])
    assert abs(q @ q - 1) < 1e-12
    return se3.from_rt(Rotation.from_quat(q).as_matrix(), [float(v) for v in xyz])


def yaml11(text: str) -> Any:
    """Return what a YAML 1.1 reader takes a text for.

    By the letter of YAML 1.1 a bare y is true; PyYAML, the reader of ROS, leaves it a name.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.version = (1, 1)

    def named(value: Any) -> Any:
        if isinstance(value, dict):
            return {"y" if k is True else k: named(v) for k, v in value.items()}
        return value

    return named(yaml.load("%YAML 1.1\n---\n" + text))


def same(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return bool(np.abs(a - b).max() < 1e-9)


FRAMES = FrameNames(robot_base="base", hand="tool0", camera_optical="cam_optical", name="ur5")
ASIDE = se3.from_rt(FRAMES.T_link_optical[:3, :3], [0.0, 0.015, 0.001])
LINK = FrameNames(camera_link="camera_link", T_link_optical=ASIDE)


# --- laws ---------------------------------------------------------------------------------------


@given(X=transforms(), mode=st.sampled_from(["eye_in_hand", "eye_to_hand"]))
@settings(max_examples=15, deadline=None)
def test_easy_handeye_reads_the_same_transform(X: Array, mode: Mode) -> None:
    report = record(X, mode)
    two = yaml11(write.easy_handeye2_text(report, FRAMES))
    t, q = two["transform"]["translation"], two["transform"]["rotation"]
    assert all(type(v) is float for v in (*t.values(), *q.values()))
    assert same(rigid_of([t[k] for k in "xyz"], [q[k] for k in "xyzw"]), X)
    T = yaml11(write.easy_handeye_text(report, FRAMES))["transformation"]
    assert all(type(v) is float for v in T.values())
    assert same(rigid_of([T[k] for k in "xyz"], [T[k] for k in ("qx", "qy", "qz", "qw")]), X)


@given(X=transforms(), frames=st.sampled_from([FRAMES, LINK]))
@settings(max_examples=15, deadline=None)
def test_ros_commands_and_launch_carry_the_same_transform(X: Array, frames: FrameNames) -> None:
    report = record(X)
    expected, parent, child = published_transform(report, frames)
    words = shlex.split(write.ros2_command(report, frames))
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    named = dict(zip(words[4::2], words[5::2], strict=True))
    assert (named["--frame-id"], named["--child-frame-id"]) == (parent, child)
    xyz = [named[f"--{k}"] for k in "xyz"]
    assert same(rigid_of(xyz, [named[f"--q{k}"] for k in "xyzw"]), expected)

    old = shlex.split(write.ros1_command(report, frames))
    assert len(old) == 12 and old[-2:] == [parent, child]
    assert same(rigid_of(old[3:6], old[6:10]), expected)

    tree = ast.parse(write.ros2_launch_text(report, frames))
    lists = [n for n in ast.walk(tree) if isinstance(n, ast.keyword) and n.arg == "arguments"]
    assert ast.literal_eval(lists[0].value) == words[4:]


@given(X=transforms(), frames=st.sampled_from([FRAMES, LINK]))
@settings(max_examples=15, deadline=None)
def test_urdf_reads_the_same_transform(X: Array, frames: FrameNames) -> None:
    """rpy about fixed axes: R = Rz Ry Rx, read with this formula and compared."""
    root = ET.fromstring(write.urdf_text(record(X), frames))
    T = np.eye(4)
    links = [link.attrib["name"] for link in root.findall("link")]
    for joint in root.findall("joint"):
        origin, child = joint.find("origin"), joint.find("child")
        assert origin is not None and child is not None and joint.attrib["type"] == "fixed"
        assert child.attrib["link"] in links
        r, p, y = (float(v) for v in origin.attrib["rpy"].split())
        R = se3.exp_so3([0, 0, y]) @ se3.exp_so3([0, p, 0]) @ se3.exp_so3([r, 0, 0])
        T = T @ se3.from_rt(R, [float(v) for v in origin.attrib["xyz"].split()])
    # Down to the optical frame the chain is X in either case.
    assert links[-1] == frames.camera_optical
    assert same(T, X)


@given(X=transforms(), mode=st.sampled_from(["eye_in_hand", "eye_to_hand"]))
@settings(max_examples=15, deadline=None)
def test_opencv_reads_the_same_transform(X: Array, mode: Mode) -> None:
    report = record(X, mode)
    text = opencv_text(report, FRAMES)
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    at, target = ("gripper", "base") if mode == "eye_in_hand" else ("base", "gripper")
    R, t = (storage.getNode(f"{k}_cam2{at}").mat() for k in "Rt")
    assert t.shape == (3, 1) and same(se3.from_rt(R, t[:, 0]), X)
    R, t = (storage.getNode(f"{k}_target2{target}").mat() for k in "Rt")
    assert same(se3.from_rt(R, t[:, 0]), report.Z_alone)
    assert same(storage.getNode("camera_matrix").mat(), report.intrinsics_alone.K)
    assert same(storage.getNode("dist_coeffs").mat()[0], report.intrinsics_alone.distortion)
    assert int(storage.getNode("image_width").real()) == 1280


# --- known answers ------------------------------------------------------------------------------


def test_camera_link_of_a_camera_that_looks_along_the_tool() -> None:
    """Optical = tool axes, 0.1 m ahead: the body's x axis is then the tool's z axis."""
    report = record(se3.from_translation([0.0, 0.0, 0.1]))
    T, parent, child = published_transform(report, FrameNames(camera_link="camera_link"))
    assert (parent, child) == ("tool0", "camera_link")
    np.testing.assert_allclose(T[:3, 0], [0, 0, 1], atol=1e-15)  # forward
    np.testing.assert_allclose(T[:3, 1], [-1, 0, 0], atol=1e-15)  # left
    np.testing.assert_allclose(T[:3, 2], [0, -1, 0], atol=1e-15)  # up = against the image's y
    np.testing.assert_allclose(T[:3, 3], [0, 0, 0.1], atol=1e-15)


def test_easy_handeye2_has_the_keys_of_its_message_and_no_others() -> None:
    """set_message_fields refuses unknown keys, so the layout must be the message's own."""
    read = yaml11(write.easy_handeye2_text(record(np.eye(4), "eye_to_hand"), FRAMES))
    assert list(read) == ["parameters", "transform"]
    assert read["parameters"] == {
        "name": "ur5",
        "calibration_type": "eye_on_base",
        "robot_base_frame": "base",
        "robot_effector_frame": "tool0",
        "tracking_base_frame": "cam_optical",
        "tracking_marker_frame": "calibration_target",
        "freehand_robot_movement": True,
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    old = yaml11(write.easy_handeye_text(record(np.eye(4)), FRAMES))
    assert old["parameters"]["eye_on_hand"] is True and old["parameters"]["namespace"] == "/ur5/"


def test_every_text_says_frames_units_accuracy_and_warnings() -> None:
    report = record(se3.from_translation([0.0, 0.0, 0.1]))
    notes = "\n".join(note_lines(report, FRAMES))
    for text_of in (
        write.easy_handeye2_text, write.easy_handeye_text, write.ros1_script, write.ros2_script,
        write.ros2_launch_text, write.urdf_text, opencv_text,
    ):  # fmt: skip
        text = text_of(report, FRAMES)
        assert "OPTICAL" in text and "Metres" in text and "1 sigma" in text
        assert "WITHOUT the robot's error map" in text and "WARNING" in text
    assert "alert(1)" in notes and all("\n" not in n for n in note_lines(report, FRAMES))


def test_the_shell_scripts_run_one_command_with_the_words(tmp_path: Path) -> None:
    """A shell runs the script with a `ros2` that prints its arguments: comments stay comments."""
    fake = tmp_path / "ros2"
    fake.write_text('#!/bin/sh\nfor w in "$@"; do echo "$w"; done\n')
    fake.chmod(0o755)
    report = record(se3.from_translation([0.1, -0.2, 1e-17]))
    script = tmp_path / "publish.sh"
    script.write_text(write.ros2_script(report, FRAMES))
    env = {"PATH": f"{tmp_path}:/bin:/usr/bin"}
    said = subprocess.check_output(["/bin/sh", str(script)], env=env, text=True)
    assert said.split() == shlex.split(write.ros2_command(report, FRAMES))[1:]


def test_write_exports_writes_readable_files(tmp_path: Path) -> None:
    report = record(se3.exp([0.1, 0.2, 0.3, 0.04, 0.05, 0.06]))
    paths = [*write_exports(report, tmp_path / "out", frames=FRAMES), tmp_path / "out/SHA256SUMS"]
    assert all(p.is_file() and p.stat().st_size > 0 for p in paths)
    on_disk = {p for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert set(paths) == on_disk  # nothing half-written is left beside them
    with np.load(tmp_path / "out/calibration.npz") as arrays:
        assert np.array_equal(arrays["T_parent_cam"], report.X_alone)
        assert np.array_equal(arrays["T_target_parent_board"], report.Z_alone)
        assert np.array_equal(arrays["K"], report.intrinsics_alone.K)
        assert any("do not mix" in note for note in arrays["notes"])
        assert str(arrays["parent"]) == "tool0" and str(arrays["cam"]) == "cam_optical"
    assert np.abs(read_calibration(paths[0]).X - report.X).max() < 1e-12


def test_edited_files_are_kept_beside_those_of_the_next_run(tmp_path: Path) -> None:
    told: list[str] = []
    for k, edit in enumerate(("", "by hand", "anew", "")):
        report = record(se3.exp([0.1, 0.2, 0.3, 0.04, 0.05, 0.06 + 0.01 * k]))
        write_exports(report, tmp_path, frames=FRAMES, tell=told.append)
        if edit:
            (tmp_path / "camera.urdf").write_text(edit)
    kept = {p.name: p.read_text() for p in tmp_path.rglob("*.kept*")}
    assert kept == {"camera.urdf.kept": "by hand", "camera.urdf.kept2": "anew"}
    assert len(told) == 2 and "camera.urdf.kept'" in told[0]
    assert "by hand" not in (tmp_path / "camera.urdf").read_text()


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [{"hand": "/tool0"}, {"hand": "tool 0"}, {"target": "base"}, {"name": "../x"}, {"target": ""}],
)
def test_frame_names_that_tf_refuses(wrong: dict[str, Any]) -> None:
    refused(".", FrameNames, **wrong)


def test_the_base_is_no_hand_that_carries_a_camera(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="robot_base and hand have the same name: 'base'"):
        write_exports(record(np.eye(4)), tmp_path / "out", frames=FrameNames(hand="base"))
    assert not list(tmp_path.rglob("*.*"))


# --- `calibration.json`: every number comes back, and a damaged file is named.
TARGETS: tuple[Target, ...] = (
    TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01, ids_from="bottom"),
    CharucoBoard(rows=7, columns=5, square_m=0.033, marker_m=0.02),
    Chessboard(rows=6, columns=8, square_m=0.0219),
    CircleGrid(rows=10, columns=10, pitch_m=0.0254, large_origin=True),
)


@given(
    twist=st.tuples(*[st.floats(-1.5, 1.5)] * 6),
    seed=st.integers(0, 11),
    target=st.sampled_from(TARGETS),
)
@settings(max_examples=12, deadline=None)
def test_json_round_trip_is_exact(
    twist: tuple[float, ...], seed: int, target: Target, tmp_path_factory: pytest.TempPathFactory
) -> None:
    mode: Mode = "eye_in_hand" if seed % 2 else "eye_to_hand"
    report = record(se3.exp(twist), mode, target, seed)
    path = tmp_path_factory.mktemp("json") / "calibration.json"
    path.write_text(calibration_text(report, FRAMES), encoding="utf-8")
    again = read_calibration(path)
    assert type(again.target) is type(report.target)
    assert calibration_text(again, FRAMES) == path.read_text(encoding="utf-8")
    assert_same(report, again, 1e-12)  # a rotation may be made orthonormal


DROPPED = object()


def damaged(report: HandEyeReport, key: str, value: Any) -> str:
    document = json.loads(calibration_text(report, FRAMES))
    at = document
    *way, last = key.split("/")
    for step in way:
        at = at[int(step) if step.isdigit() else step]
    if value is DROPPED:
        del at[last]
    else:
        at[last] = value
    return json.dumps(document)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("schema", "other", "schema 'other'"),
        ("version", 99, "version 99"),
        ("mode", "sideways", "sideways"),
        ("X", DROPPED, "missing required field `X`"),
        ("X/quaternion_xyzw", [1.0, 0.0, 0.0, 0.0], "different transforms"),
        ("views/2/uv", [[1.0, "x"]], "views[2].uv"),
        ("views/0/index", None, "views[0].index"),
        ("target/rows", DROPPED, "rows"),
        ("checks/0/verdict", "superb", "superb"),
        ("robot_map/kind", "odd", "odd"),
        ("intrinsics_alone/fx", "wide", "fx"),
        ("board/half_sides_m", [0.1], "half_sides_m"),
        ("map_scores", [["none"]], "map_scores"),
    ],
)
def test_a_damaged_entry_is_named(key: str, value: Any, says: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(damaged(record(np.eye(4)), key, value))
    assert says in refused(r"calibration\.json", read_calibration, path)


@pytest.mark.parametrize(("text", "says"), [("{", "not valid JSON"), ("[1, 2]", "list")])
def test_another_file_is_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    refused("does not exist", read_calibration, path)
    path.write_text(text)
    refused(says, read_calibration, path)
