"""Benchmark of structure from motion in the simulated lab: how right is the metric scale?

    uv run python benchmarks/scale_sfm.py [--quick] [--json FILE]

The lab's camera takes photographs of the objects on bare wood and on a printed sheet; the robot's
poses carry the lab's arm error and a hand-eye error of 0.5 mm and 0.1 deg. Free mapping, then the
similarity to the robot's poses. Figures (keys of the JSON's "figures"):

sfm_scale_pct           |error| of the metric scale [%], greatest over the scenes: the similarity
                        between recovered and true camera centres, less 1
sfm_interval_hits       share of the scenes whose 95 % interval holds the truth
sfm_sigma_pct           the sigma that was claimed [%], median
sfm_registered          share of the views that found a place, least over the scenes
sfm_camera_mm           median distance of a recovered camera from the true one [mm]
sfm_refined_pct         as sfm_scale_pct for mapping from the robot's poses with refinement
sfm_refined_camera_mm   as sfm_camera_mm, after the refinement; sfm_robot_mm before it
sfm_refined_reliability share of signal in the refinement; below 0.7 the robot's poses are kept
sfm_table_mm            median height of the sheet's points over the true table, refined [mm]
sfm_cpu_s               CPU seconds of one free reconstruction of all views, median
"""

import argparse
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.images import png_bytes
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.photo import Lighting, PhotoRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.scanning.sfm.config import FeatureConfig, SfmConfig
from realsim.scanning.sfm.reconstruct import reconstruct
from realsim.scanning.sfm.result import Poses, SfmResult
from realsim_capture_plans import PlanConfig, hemisphere_plan
from realsim_capture_plans.lab import LabConfig, SimulatedLab

PACKAGES = ("realsim", "numpy", "pycolmap")
HAND_EYE_MM, HAND_EYE_DEG = 0.5, 0.1
SHEET_M, SHEET_PX = (0.6, 0.45), 1800
"""A sheet of newspaper under the objects, and the pixels of its picture along the longer side."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene:
    """One scene of the benchmark."""

    seed: int
    objects: int
    sheet: bool
    """Whether a printed sheet lies under the objects."""
    views: int = 18
    size: tuple[int, int] = (960, 540)
    samples: int = 2
    """Rays along each side of a pixel with contrast: a quarter of the lab's at a third of the time;
    1 is a third again."""
    features: FeatureConfig = field(default_factory=FeatureConfig)


SCENES = (
    Scene(seed=0, objects=3, sheet=False),
    Scene(seed=1, objects=5, sheet=True),
    Scene(seed=2, objects=5, sheet=True),
)
FEW = FeatureConfig(most_features=2048)
QUICK = (Scene(seed=1, objects=1, sheet=True, views=10, size=(640, 360), features=FEW, samples=1),)


class PhotoLab(SimulatedLab):
    """The lab, its table seen by a renderer of its own."""

    def renderer(self, sheet: bool, samples: int) -> PhotoRenderer:
        """Return the renderer of the objects, on a printed sheet if asked for."""
        self.place_objects()
        printed = [PlacedMesh(BACKGROUND, _sheet(self), np.eye(4))] if sheet else []
        return PhotoRenderer([*self._on_table, *printed], Lighting(samples=samples))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Photos:
    """What was photographed, what the robot says, and what is true."""

    paths: tuple[Path, ...]
    intrinsics: CameraIntrinsics
    robot: Array
    """(V, 4, 4) with the errors of the arm and of the hand-eye [m]."""
    true: Array
    """(V, 4, 4) [m]"""


def _sheet(lab: SimulatedLab) -> Mesh:
    """Return a sheet of random print: boxes of all sizes, like headlines, pictures and letters."""
    rng = np.random.default_rng(lab.config.seed)
    height = round(SHEET_PX * SHEET_M[1] / SHEET_M[0])
    image = np.full((height, SHEET_PX, 3), 235, np.uint8)
    for size in (160, 80, 40, 20, 10, 6):
        for _ in range(30 * (160 // size) ** 2 // 3):
            x, y = rng.integers(0, SHEET_PX), rng.integers(0, height)
            w, h = rng.integers(size // 3 + 1, size + 1, 2)
            image[y : y + h, x : x + w] = rng.integers(20, 240, 3)
    x0, y0 = lab.scene_center[:2] - np.array(SHEET_M) / 2
    x1, y1 = lab.scene_center[:2] + np.array(SHEET_M) / 2
    z = lab.table_height + 1e-4
    return Mesh(
        vertices=np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        uv=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        texture=image,
    )


def photograph(scene: Scene, folder: Path) -> Photos:
    """Take the photographs of a scene."""
    config = LabConfig(
        seed=scene.seed, n_objects=scene.objects, width=scene.size[0], height=scene.size[1]
    )
    lab = PhotoLab(config)
    renderer = lab.renderer(scene.sheet, scene.samples)
    rng = np.random.default_rng([scene.seed, 9])
    plan = hemisphere_plan(scene.views, lab.scene_center, lab.nominal_T_ee_cam, PlanConfig(), rng)
    w = rng.standard_normal(6)
    twist = np.concatenate([
        np.radians(HAND_EYE_DEG) * w[:3] / np.linalg.norm(w[:3]),
        HAND_EYE_MM / 1e3 * w[3:] / np.linalg.norm(w[3:]),
    ])  # fmt: skip
    T_ee_cam = lab.truth.T_ee_cam @ se3.exp(twist)
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    robot: list[Array] = []
    true: list[Array] = []
    for k, joints in enumerate(plan.joints):
        lab.arm.move(joints)
        state = lab.arm.state()
        true.append(lab.truth.T_world_cam(state.joints))
        photo = renderer.render(lab.truth.intrinsics, true[-1], rng)
        paths.append(folder / f"{k:06d}.png")
        paths[-1].write_bytes(png_bytes(photo.rgb))
        robot.append(state.T_base_ee @ T_ee_cam)
    return Photos(
        paths=tuple(paths), intrinsics=lab.truth.intrinsics, robot=np.stack(robot),
        true=np.stack(true),
    )  # fmt: skip


def sfm_scale_error(result: SfmResult, true: Array) -> tuple[float, float]:
    """Return the scale's error [%] and the median distance of the cameras from the true ones [mm].

    The true scale is that of the least-squares similarity from the recovered camera centres to the
    true ones, views left out that the result itself names as outliers.
    """
    import pycolmap

    keep = [k for k, n in enumerate(result.geometry.names) if n not in result.outliers]
    place = [int(Path(result.geometry.names[k]).stem) for k in keep]
    found, right = result.geometry.Ts_world_cam[keep, :3, 3], true[place, :3, 3]
    similarity: Any = pycolmap.estimate_sim3d(found, right)
    apart = np.linalg.norm(found - right, axis=1)
    return 100 * (1 / similarity.scale - 1), 1e3 * float(np.median(apart))


def measure(scene: Scene, folder: Path) -> dict[str, float]:
    """Photograph one scene and reconstruct it twice."""
    photos = photograph(scene, folder / "rgb")
    config = SfmConfig(features=scene.features)

    def run_one(poses: Poses) -> SfmResult:
        return reconstruct(
            photos.paths, photos.intrinsics, config, poses=poses, Ts_world_cam=list(photos.robot),
            folder=folder / "sfm",  # features and matches serve both
        )  # fmt: skip

    free, refined = run_one("unknown"), run_one("refined")
    error, mm = sfm_scale_error(free, photos.true)
    refined_error, refined_mm = sfm_scale_error(refined, photos.true)
    off = np.linalg.norm(photos.robot[:, :3, 3] - photos.true[:, :3, 3], axis=1)
    heights = refined.geometry.points[:, 2]
    return {
        "scale_pct": abs(error),
        "hit": float(abs(error) <= 1.96 * free.sigma_percent),
        "sigma_pct": free.sigma_percent,
        "registered": len(free.geometry.names) / len(photos.paths),
        "camera_mm": mm,
        "refined_pct": abs(refined_error),
        "refined_hit": float(abs(refined_error) <= 1.96 * refined.sigma_percent),
        "refined_camera_mm": refined_mm,
        "robot_mm": 1e3 * float(np.median(off)),
        "reliability": refined.reliability,
        "table_mm": 1e3 * float(np.median(heights[np.abs(heights) < 0.01])),
        "cpu_s": free.cpu_s,
    }


def measured(arguments: argparse.Namespace) -> Found:
    """Return the figures over all scenes."""
    rows: list[dict[str, float]] = []
    for scene in QUICK if arguments.quick else SCENES:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(scene, Path(folder)))

    def over(key: str, how: str) -> float:
        return float(getattr(np, how)([r[key] for r in rows]))

    return Found(figures={
        "sfm_scale_pct": over("scale_pct", "max"),
        "sfm_interval_hits": over("hit", "mean"),
        "sfm_sigma_pct": over("sigma_pct", "median"),
        "sfm_registered": over("registered", "min"),
        "sfm_camera_mm": over("camera_mm", "median"),
        "sfm_refined_pct": over("refined_pct", "max"),
        "sfm_refined_interval_hits": over("refined_hit", "mean"),
        "sfm_refined_camera_mm": over("refined_camera_mm", "median"),
        "sfm_robot_mm": over("robot_mm", "median"),
        "sfm_refined_reliability": over("reliability", "median"),
        "sfm_table_mm": over("table_mm", "median"),
        "sfm_cpu_s": over("cpu_s", "median"),
    })  # fmt: skip


if __name__ == "__main__":
    figure = Figure(unit="%", goal=Goal(high=0.5))
    run("scale_sfm", __doc__, PACKAGES, {"sfm_scale_pct": figure}, {"sfm": measured})
