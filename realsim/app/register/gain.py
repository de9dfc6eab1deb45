"""What refining the cameras gained: outlines before and after, much enlarged."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from realsim.app.first_surfaces import FirstSurfaces
from realsim.app.register.results import Registered
from realsim.arrays import Image, Mask
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_corners
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.rendering.overlay import contact_sheet, draw_outlines
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore

CLAIMED_RGB, REFINED_RGB = (255, 92, 205), (58, 188, 92)
"""Outlines through the camera as it was claimed to be, and as it was refined."""


CROP_PX = 40
"""Side of the part of a photograph that shows what cameras gained [px]."""
ZOOM = 16
"""By which it is enlarged: one pixel is then as wide as a hand-drawn line."""


def placed_objects(result: Registered, models: Mapping[int, ObjectModel]) -> list[PlacedMesh]:
    """Return the objects as they stand in world."""
    return [
        PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in result.scene.objects
    ]


def camera_shifts_px(
    result: Registered, models: Mapping[int, ObjectModel], intrinsics: CameraIntrinsics
) -> dict[tuple[int, int], float]:
    """Return by how much objects moved in the images when cameras were refined.

    Returns:
        (view, instance) -> mean over the corners of the object's box [px].
    """
    out: dict[tuple[int, int], float] = {}
    for index, refined in result.cameras.refined.items():
        claimed = result.cameras.claimed.get(index)
        if claimed is None:
            continue
        for o in result.scene.objects:
            corners = box_corners(*models[o.obj_id].mesh.bounds)
            world = se3.transform(o.T_world_obj, corners)
            a, b = (
                camera.project(intrinsics, se3.transform(se3.invert(T), world))
                for T in (claimed, refined)
            )
            size = np.array([intrinsics.width, intrinsics.height])
            if np.all(np.isfinite(a)) and np.all((b > 0) & (b < size)):
                out[index, o.instance] = float(np.mean(np.linalg.norm(a - b, axis=1)))
    return out


def gain_picture(
    store: SessionStore, result: Registered, models: Mapping[int, ObjectModel]
) -> Image | None:
    """Return a small part of a photograph, much enlarged, with outlines before and after.

    The object that moved most in the images stands for all; None if cameras were not refined.
    """
    intrinsics = store.session.intrinsics
    shifts = camera_shifts_px(result, models, intrinsics)
    usable = {
        (view, instance): px for (view, instance), px in shifts.items()
        if result.scene.object(instance).verdict != "rejected"
    }  # fmt: skip
    if not usable or max(usable.values()) <= 0.0:
        return None
    index, instance = max(usable, key=lambda k: usable[k])
    scene = FirstSurfaces(placed_objects(result, models))
    ends = (result.cameras.claimed[index], result.cameras.refined[index])
    ids = scene.look(intrinsics, ends[1])[0]
    corner = _edge_corner(store.rgb(index), ids == instance, CROP_PX)
    zoomed = zoomed_camera(intrinsics, corner, CROP_PX, ZOOM)
    ground = _enlarged(store.rgb(index), corner)
    pictures: list[Image] = []
    for T, color in zip(ends, (CLAIMED_RGB, REFINED_RGB), strict=True):
        fine = scene.look(zoomed, T)[0]
        alone = np.where(fine == instance, fine, np.int32(-1)).astype(np.int32)
        pictures.append(draw_outlines(ground, alone, {instance: color}, 2))
    name = models[result.scene.object(instance).obj_id].name
    px = usable[index, instance]
    captions = [f"view {index}, {name}: camera as claimed", f"refined: {px:.2f} px away from it"]
    return contact_sheet(pictures, 2, captions)


def zoomed_camera(
    intrinsics: CameraIntrinsics, corner: tuple[int, int], side_px: int, zoom: int
) -> CameraIntrinsics:
    """Return the camera whose image is a square part of another's, enlarged.

    A pixel's centre is its integer coordinate: u' = (u - u0 + 1/2) zoom - 1/2.

    Args:
        intrinsics: the camera.
        corner: column and row of the part's first pixel.
        side_px: side of the part [px].
        zoom: by which it is enlarged.
    """
    x, y = corner
    return replace(
        intrinsics, width=side_px * zoom, height=side_px * zoom,
        fx=intrinsics.fx * zoom, fy=intrinsics.fy * zoom,
        cx=(intrinsics.cx - x + 0.5) * zoom - 0.5, cy=(intrinsics.cy - y + 0.5) * zoom - 0.5,
    )  # fmt: skip


def _edge_corner(rgb: Image, mask: Mask, side_px: int) -> tuple[int, int]:
    """Return the corner of the square around the outline's strongest edge in the photograph."""
    import cv2

    grey = cv2.GaussianBlur(rgb.mean(-1).astype(np.float32), (0, 0), 1.0)
    gy, gx = np.gradient(np.asarray(grey, dtype=np.float64))
    inside = np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)))
    strength = np.where(mask & (inside == 0), np.hypot(gx, gy), 0.0)
    # Over a square: one bright pixel is no edge to compare with.
    total = np.asarray(cv2.boxFilter(strength, -1, (side_px, side_px), normalize=False))
    row, column = np.unravel_index(int(np.argmax(total)), total.shape)
    half = side_px // 2
    return (
        int(np.clip(column - half, 0, max(0, rgb.shape[1] - side_px))),
        int(np.clip(row - half, 0, max(0, rgb.shape[0] - side_px))),
    )


def _enlarged(rgb: Image, corner: tuple[int, int]) -> Image:
    """Return a square part of a photograph, enlarged without smoothing its pixels away."""
    x, y = corner
    part = rgb[y : y + CROP_PX, x : x + CROP_PX]
    part = np.pad(
        part, ((0, CROP_PX - part.shape[0]), (0, CROP_PX - part.shape[1]), (0, 0)),
        mode="edge",
    )  # fmt: skip
    return np.repeat(np.repeat(part, ZOOM, axis=0), ZOOM, axis=1)
