"""Pictures that the benchmark of the formats writes: simulated ones, and real ones where there are.

Simulated: the scene of the labels' benchmark at 1280x720, its depth as a D405 and a D435 measure
it, its colour shaded, grained like stone, with a sensor's shot noise through a Bayer pattern. What
matters for an encoder is the noise, so real frames (REALSIM_DATA) are measured beside them:
  graspnet_demo_frame   Kinect 4, 1280x720, depth in mm
  ycbv_mini             Xtion, 640x480, depth in 0.1 mm, with masks
  apc_shelf_multiview   RealSense F200, 640x480
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from figures import DATA
from labels_scene import camera_720p, cameras, scene
from numpy.typing import NDArray

from realsim import images
from realsim.arrays import Array, Array32, Counts, Mask, Rgb
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer

SCENES = DATA / "scenes"
PIXELS_720P = 1280 * 720
FULL_WELL = 9000.0
"""Electrons of a white pixel: of a small sensor at a small gain."""
READ_NOISE = 3.0
"""[electrons]"""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Picture:
    """One frame."""

    kind: str
    """Where it is from; figures are taken over each kind."""
    rgb: Rgb
    """(H, W, 3)"""
    depth: Counts
    """(H, W)"""
    masks: tuple[Mask, ...] = ()
    """(H, W) of objects."""

    @property
    def share_of_720p(self) -> float:
        """Pixels over those of 1280x720."""
        return self.depth.size / PIXELS_720P


@lru_cache(maxsize=2)
def simulated(seed: int, count: int) -> tuple[Picture, ...]:
    """Return frames of 1280x720 as a D405 (odd: a D435) takes them."""
    rng = np.random.default_rng(seed)
    camera, placed = camera_720p(), scene()
    renderer = LabelRenderer(placed)
    found: list[Picture] = []
    for k, T_world_cam in enumerate(cameras(count, 0.5, 0.7)):
        sensor = DepthSensorModel.from_profile("d435" if k % 2 else "d405")
        labels = renderer.render(camera, T_world_cam)
        depth_m = sensor.measure(labels.depth_m, camera, rng)
        found.append(
            Picture(
                kind="d435" if k % 2 else "d405",
                rgb=_photograph(labels.normals(), labels.ids, T_world_cam[:3, :3], rng),
                depth=images.depth_counts(depth_m, 1e-4 if k % 2 == 0 else 1e-3),
                masks=tuple(labels.ids == i for i in np.unique(labels.ids) if i >= 0),
            )
        )
    return tuple(found)


def _photograph(
    normals: Array32, ids: NDArray[np.integer], R: Array,
    rng: np.random.Generator,
) -> Rgb:  # fmt: skip
    """Return (H, W, 3): one lamp, a colour for each object, grain, and the sensor's noise."""
    import cv2

    lamp = R.T @ np.array([0.3, 0.2, 0.93])
    shade = 0.25 + 0.75 * np.clip(normals @ lamp.astype(np.float32), 0, 1)
    colours = rng.uniform(0.15, 0.8, (int(ids.max()) + 2, 3)).astype(np.float32)
    linear = shade[..., None] * colours[ids + 1] * _grain(ids.shape, rng)[..., None]
    electrons = rng.poisson(linear * FULL_WELL) + rng.normal(0, READ_NOISE, linear.shape)
    values = np.clip(electrons / FULL_WELL, 0, 1) ** (1 / 2.2) * 255
    raw = np.empty(ids.shape, np.uint8)
    for row, column, channel in ((0, 0, 2), (0, 1, 1), (1, 0, 1), (1, 1, 0)):
        raw[row::2, column::2] = values[row::2, column::2, channel]
    return np.ascontiguousarray(cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB)[..., ::-1])


def _grain(shape: tuple[int, ...], rng: np.random.Generator) -> Array32:
    """Return a texture of all sizes (H, W) about 1: noise, enlarged by powers of two, summed."""
    import cv2

    total = np.ones(shape, np.float32)
    for step in (2, 4, 8, 16, 32, 64):
        small = rng.normal(0, 0.006 * step**0.5, (shape[0] // step + 1, shape[1] // step + 1))
        total += cv2.resize(small.astype(np.float32), (shape[1], shape[0]))
    return np.clip(total, 0.2, 1.2)


@lru_cache(maxsize=1)
def real() -> tuple[Picture, ...]:
    """Return the real frames; empty where there is no data."""
    found: list[Picture] = []
    one = SCENES / "graspnet_demo_frame"
    if (one / "color.png").is_file():
        found.append(_read("graspnet real", one / "color.png", one / "depth.png"))
    for colour in sorted((SCENES / "ycbv_mini/test").glob("*/rgb/*.png")):
        folder = colour.parents[1]
        masks = sorted((folder / "mask_visib").glob(f"{colour.stem}_*.png"))
        found.append(_read("ycbv real", colour, folder / "depth" / colour.name, masks))
    for colour in sorted((SCENES / "apc_shelf_multiview").glob("scene-*/*.color.png"))[:5]:
        depth = colour.with_name(colour.name.replace("color", "depth"))
        found.append(_read("f200 real", colour, depth))
    return tuple(found)


def _read(kind: str, colour: Path, depth: Path, masks: list[Path] | None = None) -> Picture:
    return Picture(
        kind=kind,
        rgb=images.read_rgb(colour),
        depth=images.read_image(depth),
        masks=tuple(images.read_grey(m) > 0 for m in masks or ()),
    )
