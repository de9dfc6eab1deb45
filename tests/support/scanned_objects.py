"""Small quick simulated scans with known truth, rendered once per test process.

A quarter of a D405's pixels, with half of its disparity's noise: the depth is as good as a D405's.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from plain_meshes import box
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.mesh import merged
from realsim.geometry.parts import object_model
from realsim.records import Mesh
from realsim.registration.evidence import DepthFrame, measure_noise
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence, gather_scan
from realsim.scanning.scale.fit import fit_scale
from realsim.scanning.scale.result import ScaleFit, Similarity
from realsim.scanning.scale.shape import ScanShape, make_shape
from realsim.scanning.scale.state import ScaleState, first_state
from realsim.scanning.scale.table import find_object, find_table
from realsim.scanning.simulated import ScanLabConfig, ScanViews, distorted, scan_views, standing

UNIT_M = 0.1
"""Metres per unit of the scans made here: the scale that a fit should find."""
SENSOR = DepthSensorModel(disparity_noise_px=0.04, correlation_px=1.0, quantum_px=1 / 64)
LAB = ScanLabConfig(views=10, width=640, height=360, focal_px=324.0, sensor=SENSOR)
"""Errors of hand-eye, arm and depth as in a real lab."""
TRUE = {"hand_eye_mm": 0.0, "hand_eye_deg": 0.0, "arm_mm": 0.0, "arm_deg": 0.0}
EXACT = replace(LAB, sensor=DepthSensorModel.noiseless(), **TRUE)
"""No error of any kind."""
LABS = {"lab": LAB, "exact": EXACT}


@dataclass(frozen=True, eq=False)
class Scanned:
    """An object on a table, the views of it, and the same object as a scan without scale."""

    real: Mesh
    """At its size [m]."""
    scan: Mesh
    """The same shape in units of `UNIT_M`."""
    views: ScanViews

    @property
    def T_world_obj(self) -> Array:
        """(4, 4) where both stand."""
        return self.views.T_world_obj

    @property
    def frames(self) -> tuple[DepthFrame, ...]:
        return self.views.frames

    @property
    def truth(self) -> Similarity:
        return Similarity(scale=UNIT_M, T_world_obj=self.T_world_obj, source="truth")


def in_world(frames: tuple[DepthFrame, ...], W: Array) -> tuple[DepthFrame, ...]:
    """The frames of a scene that stands elsewhere in the world."""
    return tuple(replace(f, T_world_cam=W @ f.T_world_cam) for f in frames)


@lru_cache(maxsize=64)
def scanned(name: str, lab: str = "lab", seed: int = 0, views: int = 10) -> Scanned:
    """Return views of an object by its name; `lab` is one of LABS."""
    return scanned_mesh(real_mesh(name), replace(LABS[lab], views=views), seed)


def scanned_mesh(real: Mesh, config: ScanLabConfig = LAB, seed: int = 0) -> Scanned:
    """Return views of any mesh [m]."""
    rng = np.random.default_rng(seed)
    T = standing(real, np.eye(3), rng)
    return Scanned(real, scaled(real, 1 / UNIT_M), scan_views(real, T, config, rng))


def rough_start(known: Scanned, seed: int = 0) -> Similarity:
    """Return the truth off by 8 %, 6 mm and 6 deg, about the centre of the mesh."""
    rng = np.random.default_rng(seed)
    w, v = rng.standard_normal((2, 3))
    w *= np.radians(6.0) / np.linalg.norm(w)
    v *= 0.006 / np.linalg.norm(v)
    factor = 1.08 if rng.random() < 0.5 else 1 / 1.08
    c = known.real.bounds.mean(0)
    T = known.T_world_obj @ se3.from_translation(c) @ se3.from_rt(se3.exp_so3(w), v)
    T = T @ se3.from_translation(-factor * c)
    return Similarity(scale=UNIT_M * factor, T_world_obj=T, source="given")


def fit_of(known: Scanned, mesh: Mesh | None = None, **given: Any) -> ScaleFit:
    """Return the fit of the scan, or of another mesh, from a rough start unless `start` says."""
    options = {"start": rough_start(known), **given}
    frames = options.pop("frames", known.frames)
    mesh = known.scan if mesh is None else mesh
    return fit_scale(mesh, known.views.intrinsics, frames, **options)


@lru_cache(maxsize=64)
def fitted(name: str, lab: str = "lab", seed: int = 0, views: int = 10) -> ScaleFit:
    """Return the fit of `scanned` with the same arguments from a rough start."""
    return fit_of(scanned(name, lab, seed, views))


@lru_cache(maxsize=16)
def evidence_of(name: str, lab: str = "lab", seed: int = 0, views: int = 10) -> ScanEvidence:
    """Return what the views of `scanned` say."""
    return gathered(scanned(name, lab, seed, views))


def gathered(known: Scanned, config: ScaleConfig | None = None) -> ScanEvidence:
    """Return the evidence of a scan."""
    config = config or ScaleConfig()
    camera, frames = known.views.intrinsics, known.frames
    noise = measure_noise(frames, config.noise)
    plane = find_table(camera, frames, config.table, config.seed)
    footprint = find_object(camera, frames, plane, noise, config.table, None)
    return gather_scan(camera, frames, (plane, footprint), noise, config)


@lru_cache(maxsize=16)
def shape_of(name: str) -> ScanShape:
    """Return the scan of an object as the fit sees it."""
    return make_shape(scaled(real_mesh(name), 1 / UNIT_M), ScaleConfig())


def true_state(known: Scanned, shape: ScanShape, evidence: ScanEvidence) -> ScaleState:
    """Return the state at which scale and pose are true."""
    s = UNIT_M / shape.unit
    return first_state(evidence, s, known.T_world_obj @ se3.from_translation(UNIT_M * shape.center))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    return replace(mesh, vertices=mesh.vertices * factor)


def mirrored(mesh: Mesh) -> Mesh:
    """Return the mirror image, its faces still outward."""
    return replace(mesh, vertices=mesh.vertices * [-1, 1, 1], faces=mesh.faces[:, ::-1].copy())


def joined(*meshes: Mesh) -> Mesh:
    """Return several meshes as one."""
    return merged(meshes)


def subdivided(mesh: Mesh, least_faces: int) -> Mesh:
    """Return the same surface with at least so many faces: every face in four, repeatedly."""
    import trimesh

    vertices, faces = mesh.vertices, mesh.faces
    while len(faces) < least_faces:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Mesh(vertices=np.asarray(vertices), faces=np.asarray(faces, dtype=np.int32))


def block(size: tuple[float, float, float] = (0.08, 0.05, 0.06)) -> Mesh:
    """Return a box [m] about the origin, 12 triangles outward."""
    return box(size)


def shifted(mesh: Mesh, x: float, y: float, z: float) -> Mesh:
    return replace(mesh, vertices=mesh.vertices + np.array([x, y, z]))


def scalene() -> Mesh:
    """Return a body without any symmetry, mirror or turn: a block with two unlike posts [m]."""
    tall = shifted(block((0.02, 0.025, 0.07)), 0.035, -0.012, 0.045)
    low = shifted(block((0.03, 0.02, 0.04)), -0.025, 0.018, 0.03)
    return joined(block((0.1, 0.065, 0.03)), tall, low)


def real_mesh(name: str) -> Mesh:
    """Return one of the bodies made here or an object at hand by its name [m]."""
    made = {"block": block, "scalene": scalene}
    return made[name]() if name in made else object_model(name).mesh


def wrong(mesh: Mesh, amplitude: float, seed: int = 0) -> Mesh:
    """Return the mesh with a smooth shape error of this RMS share of its size."""
    return distorted(mesh, amplitude, np.random.default_rng(seed))


def surface_gap_mm(fit: ScaleFit, known: Scanned, mesh: Mesh | None = None) -> float:
    """Return the greatest distance of a vertex from where it really is [mm]."""
    mesh = known.scan if mesh is None else mesh
    found = se3.transform(fit.T_world_obj, fit.scale * mesh.vertices)
    real = se3.transform(known.T_world_obj, known.real.vertices)
    return 1e3 * float(np.linalg.norm(found - real, axis=1).max())
