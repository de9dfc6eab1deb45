"""Cases of the scale benchmark: a simulated scan, a mesh of unknown scale, and a rough start.

Imported by `scale.py`. The given mesh is the true one, or one distorted by 2 %, turned at random
and divided by a factor of 0.3 to 3; the start is the truth moved by 10 mm, turned by 10 degrees and
off by x0.87 or x1.15. Depth is what a D405 stores: 16 bit, 0.1 mm. All methods see these images.
"""

from dataclasses import dataclass, replace

import numpy as np
from scale_shapes import SHAPES, resting_rotation

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.registration.evidence import DepthFrame
from realsim.scanning.scale.result import Similarity
from realsim.scanning.simulated import ScanLabConfig, ScanViews, distorted, scan_views, standing

DEPTH_UNIT_M = 1e-4
"""The D405's depth unit [m]; images are kept in it, as in a session."""
DISTORTION = 0.02
"""RMS shape error of the distorted meshes as a share of their largest extent."""
FACTOR = (0.3, 3.0)
"""The given mesh is in units of this many metres, log-uniform."""
START_MM, START_DEG = 10.0, 10.0
START_SCALES = (0.87, 1.15)
FULL_WIDTH = 1280
STREAMS = {"lab": 1, "shape": 2, "given": 3, "start": 4}
"""Numbers of the generators, so that a change in one leaves the others' draws alone."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Case:
    """One object scanned once."""

    name: str
    seed: int
    views: ScanViews
    given_exact: Mesh
    """What the lab saw, in other axes and unknown units."""
    given_distorted: Mesh
    """The same with a shape error of 2 %."""
    true_scale: float
    """Metres per unit of both given meshes."""
    start_exact: Similarity
    start_distorted: Similarity


def stream(name: str, seed: int, what: str) -> np.random.Generator:
    """Return the generator of one part of a case; the same for ever, whatever else is drawn."""
    return np.random.default_rng([seed, STREAMS[what], *name.encode()])


def lab(width: int) -> ScanLabConfig:
    """Return the lab of the benchmark, its camera `width` pixels wide (16:9), the same angle."""
    full = ScanLabConfig()
    share = width / FULL_WIDTH
    return replace(
        full, width=width, height=round(full.height * share), focal_px=full.focal_px * share
    )


def make_case(name: str, seed: int, width: int = FULL_WIDTH) -> Case:
    """Return a case.

    Args:
        name: one of `SHAPES`.
        seed: of everything that is drawn.
        width: of the depth images [px].
    """
    mesh = SHAPES[name]()
    rng = stream(name, seed, "lab")
    T_world_obj = standing(mesh, resting_rotation(mesh, rng), rng)
    views = scan_views(mesh, T_world_obj, lab(width), rng)
    views = replace(views, frames=tuple(map(_stored, views.frames)))
    bent = distorted(mesh, DISTORTION, stream(name, seed, "shape"))
    rng = stream(name, seed, "given")
    R_given = se3.random_rotation(rng)
    scale = float(np.exp(rng.uniform(*np.log(FACTOR))))
    T_world_given = T_world_obj @ se3.from_rt(R_given.T, np.zeros(3))
    exact, other = (_in_units(m, R_given, scale) for m in (mesh, bent))
    rng = stream(name, seed, "start")
    return Case(
        name=name, seed=seed, views=views, given_exact=exact, given_distorted=other,
        true_scale=scale, start_exact=_start(exact, scale, T_world_given, rng),
        start_distorted=_start(other, scale, T_world_given, rng),
    )  # fmt: skip


def _in_units(mesh: Mesh, R: Array, scale: float) -> Mesh:
    """Return the mesh turned by R (3, 3), in units of `scale` metres, without its paint."""
    return Mesh(vertices=mesh.vertices @ R.T / scale, faces=mesh.faces)


def _direction(rng: np.random.Generator) -> Array:
    """Return a random unit vector (3,)."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _start(mesh: Mesh, scale: float, T: Array, rng: np.random.Generator) -> Similarity:
    """Return the truth, moved and turned and rescaled about the middle of the object."""
    middle = mesh.bounds.mean(0)
    R = se3.exp_so3(np.radians(START_DEG) * _direction(rng)) @ T[:3, :3]
    place = se3.transform(T, scale * middle[None])[0] + START_MM / 1e3 * _direction(rng)
    rough = scale * float(rng.choice(START_SCALES))
    return Similarity(
        scale=rough, T_world_obj=se3.from_rt(R, place - R @ (rough * middle)), source="given"
    )


def _stored(frame: DepthFrame) -> DepthFrame:
    """Return a frame whose depth is a whole number of the sensor's units."""
    units = np.round(frame.depth_m / DEPTH_UNIT_M).astype(np.uint16)
    return replace(frame, depth_m=units.astype(np.float32) * np.float32(DEPTH_UNIT_M))
