"""Metric scale: a mesh in unknown units and axes, and 24 depth pictures of the real thing."""

from dataclasses import replace

import numpy as np

from realsim.geometry import se3
from realsim.geometry.mesh import to_trimesh
from realsim.geometry.parts import part
from realsim.records import Mesh
from realsim.scanning.scale.fit import fit_scale
from realsim.scanning.simulated import ScanLabConfig, distorted, scan_views, standing

rng = np.random.default_rng(0)
true = part("mug").mesh  # metres
lab = ScanLabConfig(width=640, height=360, focal_px=324.0)
views = scan_views(true, standing(true, np.eye(3), rng), lab, rng)


def as_generated(mesh: Mesh) -> tuple[Mesh, float]:
    """Return the mesh as a generator would give it: turned, one unit long, and its scale."""
    turned = mesh.vertices @ se3.exp_so3([0.9, -0.4, 1.7]).T
    length = float(np.ptp(turned, axis=0).max())
    return replace(mesh, vertices=turned / length), length


def longest_mm(mesh: Mesh, scale: float) -> float:
    """Return the longest side of the smallest box around the mesh at this scale [mm]."""
    box = to_trimesh(mesh).bounding_box_oriented
    return 1e3 * scale * float(max(box.primitive.extents))


shapes = {"the exact shape": true, "off by 2 %": distorted(true, 0.02, rng)}
for name, shape in shapes.items():
    mesh, true_scale = as_generated(shape)
    fit = fit_scale(mesh, views.intrinsics, views.frames)  # nothing else is given
    off = 100 * (fit.scale / true_scale - 1)
    print(f"{name}: {fit.verdict}")
    print(f"  true scale  {true_scale:.5f} m per unit of the mesh")
    print(f"  found       {fit.scale:.5f} m, off by {off:+.2f} %")
    print(f"  sigma       {fit.sigma:.5f} m = {fit.sigma_percent:.2f} %")
    print(f"  longest     {longest_mm(mesh, fit.scale):.1f} mm")
    first = next(w for w in fit.limits if w.name != "surface offset")
    print(f"  limited by  {first.name} ({first.percent:.2f} %), {fit.cpu_s:.1f} CPU-s")
    for reason in fit.reasons:
        print(f"  because     {reason}")
