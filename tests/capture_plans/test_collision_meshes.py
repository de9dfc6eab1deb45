"""Proof that our UR5 is nowhere thinner than its published collision meshes."""

import numpy as np
import pytest

from given_plans import BENCH
from realsim.errors import MissingLibraryError
from realsim.geometry import se3
from realsim.robots.arm import UR5, arm_of
from realsim.robots.shapes import Box, Mount, Shape, WorkCell
from realsim_capture_plans.collision.mount import d405_mount, plain_bracket
from realsim_capture_plans.collision.ur5_meshes import MeshModel, compare_with_meshes, robots_folder

try:
    robots_folder()
except MissingLibraryError as error:
    pytest.skip(str(error), allow_module_level=True)

NOWHERE = Box(lower=(3, 3, 3), upper=(4, 4, 4))
IN_THE_AIR = WorkCell(table=Box(lower=(-4, -4, -4), upper=(4, 4, -2)), keep_out=NOWHERE)
SPLITS = 8


def outside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """How far points (..., 3) in the link's frame are outside a shape, by each bound [m]."""
    T = np.linalg.inv(shape.T_frame_shape)
    x = points @ T[:3, :3].T + T[:3, 3]
    if shape.kind == "box":
        return (np.abs(x) - np.array(shape.size_m) / 2).max(-1)
    radius, length = shape.size_m
    across = np.hypot(x[..., 0], x[..., 1])
    if shape.kind == "cylinder":
        return np.maximum(across - radius, np.abs(x[..., 2]) - length / 2)
    return np.hypot(across, np.maximum(0, np.abs(x[..., 2]) - length / 2)) - radius


def quartered(triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(t, 1) for t in parts])


@pytest.mark.parametrize("frame", range(7), ids=arm_of(UR5).link_names)
def test_every_triangle_lies_inside_our_shapes(frame: int) -> None:
    """A triangle with all corners in one convex shape is inside it; others are cut in four."""
    shapes = [s for s in arm_of(UR5).shapes if s.frame == frame]
    q = np.array([0.3, -0.8, 1.2, 0.5, -2.0, 0.7])
    triangles = MeshModel(d405_mount(), BENCH).triangles(q)[arm_of(UR5).link_names[frame]]
    T = np.linalg.inv(UR5.link_frames(q)[frame])
    left = triangles @ T[:3, :3].T + T[:3, 3]
    assert len(left) > 400
    assert np.min([outside(s, left) for s in shapes], axis=0).max() <= 0.0  # every vertex
    for _ in range(SPLITS):
        is_out = np.min([outside(s, left).max(-1) for s in shapes], axis=0) > 0
        if not is_out.any():
            return
        left = quartered(left[is_out])
    raise AssertionError(f"{len(left)} pieces stick out, near {left.mean((0, 1)) * 1e3} mm")


ACROSS = se3.from_translation([0.02, 0.07, 0.02])
BRACKET = plain_bracket(ACROSS, "D435")
D435 = Mount(name="across", camera="D435", T_ee_cam=ACROSS, bracket=BRACKET, cover_m=0.005)


@pytest.mark.parametrize(
    ("mount", "cell", "colliding"),
    [(d405_mount(), IN_THE_AIR, 0.2), (D435, BENCH, 0.5)],
    ids=["in the air", "covered D435 on a bench"],
)
def test_never_free_where_the_meshes_touch_and_seldom_the_reverse(
    mount: Mount, cell: WorkCell, colliding: float
) -> None:
    shares = compare_with_meshes(mount, cell, n=700)
    assert shares["unsafe_share"] == 0.0
    assert shares["overcautious_share"] <= 0.08
    assert shares["mesh_colliding_share"] > colliding
