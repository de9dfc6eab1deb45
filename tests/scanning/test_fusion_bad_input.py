"""What cannot be fused is named: frames without depth, other units, empty and crowded tables."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fusion_frames import exact_frames
from realsim.errors import DegenerateError, UnitError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, Mesh
from realsim.scanning.fusion.fuse import FusionConfig, FusionFrame, fuse_object
from refusals import refused

CAMERA = CameraIntrinsics(width=320, height=180, fx=162.0, fy=162.0, cx=159.5, cy=89.5)
CONFIG = FusionConfig(refine=False, rounds=1, voxel_m=0.0015)


def block(x: float, y: float, size: tuple[float, float, float]) -> Mesh:
    """A box on the table."""
    import trimesh

    box = trimesh.creation.box(size)
    return Mesh(vertices=box.vertices + np.array([x, y, size[2] / 2]), faces=box.faces)


def frames_of(meshes: tuple[Mesh, ...], table: bool = True) -> list[FusionFrame]:
    return exact_frames(meshes, CAMERA, 8, table)


@cache
def good() -> tuple[FusionFrame, ...]:
    """Eight frames of one block."""
    return tuple(frames_of((block(0, 0, (0.08, 0.06, 0.05)),)))


def fuse(frames: list[FusionFrame] | tuple[FusionFrame, ...], config: FusionConfig = CONFIG):
    return fuse_object(CAMERA, frames, config)


def test_no_depth_and_too_few_frames_are_named() -> None:
    empty = [replace(f, depth_m=np.zeros_like(f.depth_m)) for f in good()]
    refused("none of the 8 frames has depth", fuse, empty)
    refused("at least 3", fuse, good()[:2])
    refused("0 of 0 frames", fuse, [])


def test_millimetres_and_counts_are_named() -> None:
    in_mm = [replace(f, depth_m=(1e3 * f.depth_m).astype(np.float32)) for f in good()]
    refused(r"[Mm]illimetres", fuse, in_mm, error=UnitError)
    counts = [replace(f, depth_m=(1e3 * f.depth_m).astype(np.uint16)) for f in good()]
    refused("float32 metres", fuse, counts)


def test_frames_of_another_size_are_named_by_number() -> None:
    frames = [*good()[:5], replace(good()[5], depth_m=good()[5].depth_m[:100])]
    refused(r"view 5.*shape", fuse, frames)
    small = np.zeros((90, 160, 3), np.uint8)
    refused(r"view 0.*picture", fuse, [replace(good()[0], rgb=small), *good()[1:]])


def test_identical_frames_are_named() -> None:
    same = [replace(good()[0], index=k) for k in range(5)]
    refused("identical", fuse, same)
    pose = good()[0].T_world_cam
    refused("same place", fuse, [replace(f, T_world_cam=pose) for f in good()])
    refused("unique", fuse, [good()[0], *good()])


def test_an_empty_table_is_named() -> None:
    refused("nothing stands on the table", fuse, frames_of(()))


def test_several_objects_are_named_and_one_can_be_chosen() -> None:
    frames = frames_of((block(-0.06, 0, (0.05, 0.05, 0.05)), block(0.07, 0.02, (0.04, 0.06, 0.03))))
    refused(r"2 things .* mm at \(.*at_m", fuse, frames)
    fused = fuse(frames, replace(CONFIG, at_m=(0.07, 0.02)))
    middle = fused.mesh.bounds.mean(0)
    assert middle == pytest.approx([0.07, 0.02, 0.015], abs=0.003)
    assert any("also on the table" in note for note in fused.notes)
    refused("nothing stands at", fuse, frames, replace(CONFIG, at_m=(0.0, 0.15)))


def test_no_table_is_named() -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    alone = Mesh(vertices=ball.vertices, faces=ball.faces)
    refused("no table was found", fuse, frames_of((alone,), table=False), error=DegenerateError)


def test_an_object_that_is_mostly_holes_is_not_accepted() -> None:
    frames: list[FusionFrame] = []
    for f in good():
        points = ray_table(CAMERA) * f.depth_m[..., None]
        height = se3.transform(f.T_world_cam, points)[..., 2]
        # Only a stripe of the object reflects anything: the rest is transparent.
        x = se3.transform(f.T_world_cam, points)[..., 0]
        lost = (height > 0.002) & (np.abs(x - 0.025) > 0.010)
        frames.append(replace(f, depth_m=np.where(lost, np.float32(0), f.depth_m)))
    fused = fuse(frames)
    assert fused.verdict in ("doubtful", "rejected")
    assert fused.reasons
