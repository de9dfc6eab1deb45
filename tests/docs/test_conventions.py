"""What docs/conventions.md states is what the code does: a statement, and the law behind it.

No file imports another that imports it by any way; imports for types alone do not count.
"""

import grimp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from documents import ROOT
from realsim import CameraIntrinsics, Mesh, TagBoard
from realsim.formats import label_maps
from realsim.formats.grasps.hand_frames import grasp_poses, hand_poses
from realsim.geometry import camera, se3
from realsim.interop import colmap_from_opencv_px
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim_sim_bridge.annotation import frame_labels

PAGE = " ".join((ROOT / "docs/conventions.md").read_text(encoding="utf-8").split())
LENS = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.0, cy=23.0)
RNG = np.random.default_rng(0)
T = se3.random_transform(RNG)


def states(*words: str) -> None:
    missing = [w for w in words if " ".join(w.split()) not in PAGE]
    assert not missing, f"conventions.md does not say: {missing}"


def test_transforms_map_b_to_a() -> None:
    states("`p_a = T_a_b @ p_b`")
    p = RNG.normal(size=3)
    assert np.allclose(se3.transform(T, p), (T @ [*p, 1.0])[:3])


def test_a_twist_has_its_rotation_first_and_perturbs_on_the_right() -> None:
    states("`[wx wy wz vx vy vz]`", "perturbs on the right: `T @ exp(xi)`")
    assert np.allclose(se3.exp([0, 0, 0.3, 0, 0, 0])[:3, 3], 0)
    assert np.allclose(se3.exp([0, 0, 0, 1, 2, 3])[:3, 3], [1, 2, 3])
    xi = 0.1 * RNG.normal(size=6)
    assert np.allclose(se3.log(se3.invert(T) @ (T @ se3.exp(xi))), xi)


def test_cameras_look_along_z_with_y_down() -> None:
    states("OpenCV: x right, y down, z forward")
    T_world_cam = se3.look_at([0.0, -1.0, 0.0], [0.0, 0.0, 0.0])
    assert np.allclose(T_world_cam[:3, 2], [0, 1, 0]) and T_world_cam[2, 1] < -0.99


def test_the_board_begins_at_its_first_tags_corner() -> None:
    states("origin at the first tag's top-left corner, x along the columns, y down the page")
    points = TagBoard(rows=2, columns=3, tag_size_m=0.03, gap_m=0.01).points_board
    assert np.allclose(points.min(0), 0) and np.allclose(points.max(0), [0.11, 0.07, 0])
    states("z into the paper")
    # Seen from the front, x right and y down: z points away from the camera that sees it upright.
    T_cam_board = se3.from_translation([0, 0, 0.5])
    uv = camera.project(LENS, se3.transform(T_cam_board, points))
    assert uv[:, 0].argmax() == points[:, 0].argmax() and T_cam_board[2, 2] > 0


def test_an_integer_pixel_is_a_pixels_centre() -> None:
    states("an integer coordinate is a pixel's centre", "extra half pixel")
    assert np.allclose(camera.project(LENS, [[0.0, 0.0, 1.0]]), [[31.0, 23.0]])
    assert np.allclose(camera.pixel_grid(2, 1).reshape(-1, 2), [[0, 0], [1, 0]])
    assert np.allclose(colmap_from_opencv_px([[0.0, 0.0]]), [[0.5, 0.5]])


def wall() -> tuple[LabelRenderer, np.ndarray]:
    v = np.array([[-1.0, -1, 0.8], [1, -1, 0.8], [1, 1, 0.8], [-1, 1, 0.8]])
    mesh = Mesh(vertices=v, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    v = 0.25 * (v - [0, 0, 0.8]) + [0, 0, 0.4]
    front = Mesh(vertices=v - [0.2, 0, 0], faces=np.array([[0, 1, 2], [0, 2, 3]]))
    return LabelRenderer([PlacedMesh(0, mesh, np.eye(4)), PlacedMesh(1, front, np.eye(4))]), v


def test_depth_is_along_z_and_silhouettes_are_amodal() -> None:
    states("float32 metres along z (not along the ray), 0 = no measurement", "`mask/` is amodal")
    labels = wall()[0].render(LENS, np.eye(4))
    assert labels.depth_m.dtype == np.float32
    behind = labels.visible(0)
    assert np.allclose(labels.depth_m[behind], 0.8, atol=1e-6)
    assert labels.amodal[0].all() and not behind.all()
    states("visible pixels / all pixels of the object's silhouette")
    share = labels.px_count_visib[0] / labels.px_count_all[0]
    assert labels.visible_fraction[0] == share < 1
    away = wall()[0].render(LENS, se3.from_rt(se3.exp_so3([np.pi, 0, 0]), np.zeros(3)))
    assert not away.depth_m.any()


def test_a_quaternion_has_its_order_in_its_name() -> None:
    states("`quaternion_wxyz`, `quaternion_xyzw`")
    assert np.allclose(se3.quaternion_wxyz(np.eye(3)), [1, 0, 0, 0])
    R = Rotation.from_rotvec([0.1, 0.2, 0.3])
    assert np.allclose(np.roll(R.as_quat(), 1), se3.quaternion_wxyz(R.as_matrix()))


def test_label_maps_are_coded_as_the_table_says() -> None:
    states("instance + 1; 0 = no object")
    assert label_maps.instance_counts(np.array([[-1, 0, 6]], np.int32)).tolist() == [[0, 1, 7]]
    states("0 to 65535 over the model's box", "the box's own corner is 1 1 1")
    high = np.array([0.1, 0.2, 0.3])
    Ts = np.stack([se3.from_translation(corner - [0, 0, 1]) for corner in (0 * high, high)])
    scale = np.tile(65535 / high, (2, 1)).astype(np.float32)
    counts = frame_labels._coordinates(
        np.zeros((1, 2, 2)), np.ones((1, 2), np.float32), np.array([[0, 1]], np.int32), Ts,
        np.ones((1, 2), bool), np.zeros((2, 3), np.float32), scale,
    )  # fmt: skip
    assert counts.tolist() == [[[1, 1, 1], [65535, 65535, 65535]]]
    states("round((n + 1) * 32767.5)")
    n = np.array([[0.6, 0.0, -0.8]], np.float32)
    counts = np.round((n + 1) * 32767.5).astype(np.uint16)
    assert np.abs(label_maps.normals_of(counts) - n).max() < 2e-5


@pytest.mark.parametrize(("frame", "closing"), [("grasp", 1), ("panda_hand", 1), ("acronym", 0)])
def test_frames_of_the_hand_are_those_of_the_table(frame: str, closing: int) -> None:
    states("mounting face (0.1034 m behind `grasp`), approach z, closing x")
    hand = hand_poses(np.eye(4), frame)
    assert np.allclose(hand[:3, 2], [0, 0, 1]) and np.allclose(np.abs(hand[:3, closing]), [0, 1, 0])
    assert np.isclose(hand[2, 3], 0.0 if frame == "grasp" else -0.1034)
    assert np.allclose(grasp_poses(hand, frame), np.eye(4))


def test_no_file_of_the_four_packages_imports_itself_by_a_circle() -> None:
    graph = grimp.build_graph(
        "realsim", "realsim_calibration", "realsim_capture_plans", "realsim_sim_bridge",
        exclude_type_checking_imports=True,
    )  # fmt: skip
    left = {m: graph.find_modules_directly_imported_by(m) for m in graph.modules}
    # What imports nothing that is left is in no circle; take it away until nothing more goes.
    while free := {m for m, imported in left.items() if not imported & left.keys()}:
        left = {m: imported for m, imported in left.items() if m not in free}
    # The same from the other side: what nobody left imports.
    while ends := left.keys() - set().union(*left.values()):
        left = {m: imported for m, imported in left.items() if m not in ends}
    assert not left, {m: sorted(imported & left.keys()) for m, imported in left.items()}
