"""Gauss-Newton of scale and pose alone, from starts that are right to a tenth of the size.

Points of all views are drawn to the model's surface (data to model), and samples of the model that
lie outside of the measured outline are drawn back into it: the camera looked through there. The
first alone lets a model grow, for a huge one has a surface near every point.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.scale.accumulate import BLOCK, add_outline, add_surface
from realsim.scanning.scale.evidence import ScanEvidence, ScanView
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import (
    State,
    all_points,
    camera_numbers,
    metre_per_px,
    moved_object,
    symmetric,
)

Array = NDArray[np.float64]
WIDTHS = (0.25, 0.12, 0.06)
"""Tukey's cut-offs as shares of the object's size: 25, 12 and 6 mm of 10 cm."""
STEPS = 8
"""Steps with each."""
POINTS = 5_000
"""Measured points used: 100 ns each and step."""
OUTLINE_VIEWS = 12
"""Views whose outlines are used."""
SAMPLE_STEP = 3
"""Every third sample of the surface is looked at."""
OUTSIDE_WEIGHT = 0.3
"""Weight of one sample outside an outline relative to one measured point."""
OUTSIDE_PX = 3.0
"""A sample must lie so far outside [px]: the foot of an object is not measured."""
DAMPING = 1e-3
"""Levenberg: directions seen with less than this share of the best are moved along little."""
SETTLED = 2e-5
"""A step that moves no point by more than this share of the size ends a width."""


def coarse_fit(shape: ScanShape, evidence: ScanEvidence, start: State) -> State:
    """Return scale and pose from a rough start, the cameras taken as they are said to be."""
    views = evidence.views
    cameras = start.cameras(views)
    points, view_of = all_points(views)
    every = max(1, len(points) // POINTS)
    points, view_of = np.ascontiguousarray(points[::every]), np.ascontiguousarray(view_of[::every])
    n = len(points)
    weight, out = np.ones(n), (np.empty(n), np.empty(n))
    patch = np.zeros(n, dtype=np.int64)
    step = max(1, len(views) // OUTLINE_VIEWS)
    field = (shape.field.grid, shape.field.origin, shape.field.cell)
    state = start
    for width in WIDTHS:
        cut = width * evidence.size_m
        for _ in range(STEPS):
            H, b = np.zeros((len(views), BLOCK, BLOCK)), np.zeros((len(views), BLOCK))
            # The shape is taken as it is: one patch without offset.
            Hd, D, e = np.zeros((len(views), 1, BLOCK)), np.zeros(1), np.zeros(1)
            data = (points, view_of, weight, np.full(n, cut * cut))
            add_surface(
                field, state.pose, cameras, data, (patch, np.zeros(1)), (H, b, Hd, D, e), out
            )
            for k in range(0, len(views), step):
                _add_outside(
                    shape, evidence, state, (cameras[k], views[k]), cut,
                    (H[k], b[k], Hd[k], D, e),
                )  # fmt: skip
            x = _step(shape, state, symmetric(H.sum(0)[:7, :7]), b.sum(0)[:7])
            state = moved_object(state, x)
            reach = state.s * shape.radius
            if np.abs(x[:3]).max() + np.abs(x[3:6]).max() / reach + abs(x[6]) < SETTLED:
                break
    return state


def _step(shape: ScanShape, state: State, H: Array, b: Array) -> Array:
    """Return the damped step (7,): in scaled units every unknown moves the surface alike."""
    reach = state.s * shape.radius
    unit = np.array([reach, reach, reach, 1.0, 1.0, 1.0, reach])
    A = H / np.outer(unit, unit)
    A += DAMPING * max(float(np.trace(A)) / 7, 1e-9) * np.eye(7)
    return np.asarray(np.linalg.solve(A, b / unit) / unit)


def _add_outside(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    view: tuple[Array, ScanView],
    cut: float,
    system: tuple[Array, Array, Array, Array, Array],
) -> None:
    """Add the model's samples that lie outside of the measured outline in one view."""
    T, seen = view
    samples = np.ascontiguousarray(shape.samples[::SAMPLE_STEP])
    n = len(samples)
    metre = metre_per_px(evidence, T)
    rim = (seen.rim.distance_px, seen.rim.gap_px, float(seen.rim.left), float(seen.rim.top))
    # Unit variance in metres, as that of the points.
    data = (samples, np.full(n, OUTSIDE_WEIGHT), OUTSIDE_PX, 1.0 / metre**2)
    limits = (0.0, 2.0 * cut, 0.0, True)
    patches = (np.zeros(n, dtype=np.int64), np.zeros(1))
    add_outline(
        state.pose, T, camera_numbers(evidence.intrinsics), rim, data, limits, patches, system
    )
