"""Coloured points of a scene out of its depth images: what Gaussian splatting begins with."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from realsim import images
from realsim.arrays import Array, UInt8, evenly
from realsim.errors import InputError
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.geometry import se3
from realsim.geometry.clouds import voxel_mean
from realsim.geometry.depth import edge_mask, points_from_depth

FRAMES = 64
"""Images taken of a long scene, evenly; more see the same surfaces again."""
POINTS_PER_FRAME = 30_000
"""Points of one image, about, before they are averaged."""
VOXEL_M = 0.002
"""Edge of the voxels to begin with [m]: finer than what a depth camera resolves at arm's length."""
COARSER = 1.25
"""Factor by which the voxels grow until no more points are left than asked for."""
JUMP_SHARE = 0.02
"""Span within 3x3 pixels, as a share of the depth, that is an edge: points there fly between front
and back."""


MOST_POINTS = 10_000_000
"""Points that a data set may be asked to have: 500 MB as text."""
POINTS_ROW = "points.json"
"""Where an export notes their number."""


class ColouredPoints(NamedTuple):
    """Points with colours, in the order of their voxels."""

    points: Array
    """(N, 3) in world [m]."""
    colours: UInt8
    """(N, 3) RGB."""


def require_points(points: int) -> None:
    """Refuse a number of points that is not written.

    Raises:
        InputError: it is negative, or more than MOST_POINTS.
    """
    if not 0 <= points <= MOST_POINTS:
        raise InputError(f"{points} points; 0 to {MOST_POINTS} can be written.")


def write_points(
    scene: LabelledScene,
    folder: ExportFolder,
    most: int,
    piece: str,
    files_of: Callable[["ColouredPoints"], Mapping[str, Content]],
) -> int:
    """Write a scene's points as a piece if it is not there yet; return their number.

    Args:
        scene: the scene.
        folder: of the export.
        most: number of points; 0 = none.
        piece: its name.
        files_of: returns the files that hold the points.
    """
    if folder.has(piece):
        return int(dict(folder.rows(POINTS_ROW)).get(scene.name, 0))
    cloud = coloured_points(scene, most)
    count = len(cloud.points)
    folder.write_piece(piece, files_of(cloud), {POINTS_ROW: (scene.name, count)})
    return count


def coloured_points(scene: LabelledScene, most: int) -> ColouredPoints:
    """Return at most so many points of the images that have depth and a camera pose.

    Points are averaged in voxels, image by image, so that a scene of any length needs the memory of
    its surfaces only.

    Args:
        scene: the scene.
        most: number of points; 0 = none.

    Raises:
        InputError: depth and colour of an image have different sizes, or one cannot be read.
    """
    points, colours, weights = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    size_m = VOXEL_M
    for index in _taken(scene) if most > 0 else ():
        new, new_colours = _of_frame(scene, scene.frame(index))
        weights = np.concatenate([weights, np.ones(len(new))])
        means = voxel_mean(
            np.concatenate([points, new]), size_m, weights, np.concatenate([colours, new_colours])
        )
        points, weights, _, colours = means
        while len(points) > most:
            size_m *= COARSER
            points, weights, _, colours = voxel_mean(points, size_m, weights, colours)
    return ColouredPoints(points, np.clip(np.rint(colours), 0, 255).astype(np.uint8))


def _taken(scene: LabelledScene) -> list[int]:
    """Return the numbers of images with depth and pose, spread evenly over the scene."""
    deep = [i for i in scene.indices if scene.depth_file(i) is not None]
    posed = [i for i in deep if scene.frame(i).T_world_cam is not None]
    return evenly(posed, FRAMES)


def _of_frame(scene: LabelledScene, frame: LabelledFrame) -> tuple[Array, Array]:
    """Return points in world (N, 3) [m] and their colours (N, 3) of one image."""
    path = scene.depth_file(frame.index)
    if path is None or frame.depth_unit_m is None or frame.T_world_cam is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    depth_m = images.read_depth(path, frame.depth_unit_m)
    rgb = images.read_rgb(scene.colour_file(frame.index))
    if rgb.shape[:2] != depth_m.shape:
        raise InputError(
            f"{path} is {depth_m.shape[1]}x{depth_m.shape[0]} px, the colour image "
            f"{rgb.shape[1]}x{rgb.shape[0]} px: depth is not on the colour's pixels."
        )
    depth_m = np.where(edge_mask(depth_m, JUMP_SHARE * depth_m), np.float32(0), depth_m)
    stride = max(1, round((depth_m.size / POINTS_PER_FRAME) ** 0.5))
    points, pixels = points_from_depth(depth_m, frame.intrinsics, stride)
    colours = rgb[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return se3.transform(frame.T_world_cam, points), colours
