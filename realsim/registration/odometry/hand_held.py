"""Camera poses of a capture without a robot: a camera led by hand over a table.

Each view is aligned to the last key view by KISS-ICP, turned and lifted so that its own table plane
is the common one; key views that see the same things again are aligned too, and one graph makes the
best of it all. The result is a start for the joint refinement, good to about 2 mm and 0.5 degrees.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.clouds import plane_frame
from realsim.interop import T_from_pose3, pose3_from_T
from realsim.records import CameraIntrinsics
from realsim.registration.evidence import DepthFrame, EvidenceConfig, check_frames, measure_noise
from realsim.registration.odometry import pairs
from realsim.registration.views import SampleConfig, sample_view

FREE = 1.0
"""Sigma of what the table does not tell (place on it [m] and turn about its normal [rad])."""
FIXED = 1e-6
"""Sigma of the first view's place [m] and turn [rad], which the table fixes as well."""
PAIR_MM = 0.3
"""Sigma of a pair's shift along each axis at 0 degrees [mm]; in simulation a pair of 6 to 12
degrees is wrong by 0.3 mm in all, one of 20 to 35 by 0.6."""
PAIR_DEG = 0.04
"""Sigma of its turn about each axis [deg]."""
PER_DEG = 0.05
"""Both grow by this part for each degree between the views."""
TABLE_MM = 0.4
"""Sigma of the height of a view over its own table plane [mm]."""
TABLE_DEG = 0.06
"""Sigma of its roll and pitch against it [deg]."""
CAUCHY = 2.0
"""Whitened length from which a pair counts less: a wrong loop must not bend the path."""
INFLATION = 2.0
"""Sigmas are enlarged by this: pairs of one view share its depth errors."""
FIT = pairs.FitConfig(convergence=1e-5, max_iterations=300)
"""Aligned to the end: what is left undone points back to the guess, and adds up on the way."""
KEY_DEG = 16.0
"""A view this far from the last key view becomes one [deg]; drift grows with their number, and
at 8 degrees the path turned 0.7 degrees too far in simulation instead of 0.1 to 0.7."""
KEY_OVERLAP = 0.8
"""Overlap with the last key view below which a view becomes one."""
LEAST_OVERLAP = 0.6
"""A view that overlaps less with those before it cannot be placed; wrong alignments have 0.6
at most in simulation."""
SAME_TABLE_DEG = 15.0
"""A plane that is tilted more than this against the predicted table is another thing's [deg];
hands turn less between two views."""
LOOP_DEG = 35.0
"""Key views at most this far apart are aligned if they do not follow each other [deg]."""
LOOPS = 3
"""Number of other views that are tried for each key view."""
SEED = 0
"""Seed of the random search for the table."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Graph:
    """The optimised poses."""

    Ts_world_cam: Array
    """(F, 4, 4) [m]."""
    covariances: Array
    """(F, 6, 6) of the right twists [rad, m]."""
    residuals: Array
    """(E, 6) what is left of each pair's twist [rad, m]."""


def optimise_poses(
    Ts_world_cam: Array, edges: Sequence[pairs.Edge], levelled: Sequence[bool], angles: Array
) -> Graph:
    """Return the poses that fit all pairs and the table best, with their covariances.

    Args:
        Ts_world_cam: (F, 4, 4) a first estimate in a world whose z = 0 is the table; the first
            view saw it and stays where it is on it.
        edges: measured pairs.
        levelled: (F,) whether the view saw the table, so that its height, roll and pitch are good.
        angles: (F, F) how different the views are [deg].
    """
    import gtsam

    graph: Any = gtsam.NonlinearFactorGraph()
    values: Any = gtsam.Values()
    noise: Any = gtsam.noiseModel
    for k, T in enumerate(Ts_world_cam):
        values.insert(k, pose3_from_T(T))
        if not levelled[k]:
            continue
        model = noise.Gaussian.Covariance(_of_table(T, FIXED if k == 0 else FREE))
        graph.add(gtsam.PriorFactorPose3(k, pose3_from_T(T), model))
    for e in edges:
        grown = 1.0 + PER_DEG * float(angles[e.first, e.second])
        sigmas = grown * np.repeat([np.radians(PAIR_DEG), 1e-3 * PAIR_MM], 3)
        model = noise.Robust.Create(
            noise.mEstimator.Cauchy.Create(CAUCHY), noise.Diagonal.Sigmas(sigmas)
        )
        graph.add(
            gtsam.BetweenFactorPose3(e.first, e.second, pose3_from_T(e.T_first_second), model)
        )
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    Ts = np.stack([T_from_pose3(result.atPose3(k)) for k in range(len(Ts_world_cam))])
    marginals: Any = gtsam.Marginals(graph, result)
    C = np.stack([np.asarray(marginals.marginalCovariance(k)) for k in range(len(Ts))])
    r = [
        se3.log(se3.invert(Ts[e.second]) @ Ts[e.first] @ e.T_first_second) for e in edges
    ]  # fmt: skip
    return Graph(
        Ts_world_cam=Ts,
        covariances=INFLATION**2 * C,
        residuals=np.stack(r) if r else np.zeros((0, 6)),
    )


def _of_table(T_world_cam: Array, free: float) -> Array:
    """Return the covariance (6, 6) of the camera's right twist that its table plane leaves.

    In the world's twist it is diagonal; T exp(xi) = exp(Ad xi) T maps it to the camera's. `free` is
    the sigma of the place on the table and of the turn about its normal.
    """
    tilt, height = np.radians(TABLE_DEG), 1e-3 * TABLE_MM
    # Turned under the camera, so that a tilt does not count as a change of height as well.
    below = se3.from_translation([*T_world_cam[:2, 3], 0.0])
    sigmas = np.array([tilt, tilt, free, free, free, height])
    A = se3.adjoint(se3.invert(T_world_cam) @ below)
    return A @ np.diag(np.square(sigmas)) @ A.T


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandHeld:
    """Where a hand-held camera was; z = 0 of the world is the table, its origin near the things."""

    Ts_world_cam: Array
    """(F, 4, 4) [m]."""
    covariances: Array
    """(F, 6, 6) of the right twists against the first view [rad, m]."""
    overlaps: Array
    """(F,) share of a view's points that the views before it saw; 1 for the first."""
    levelled: tuple[bool, ...]
    """(F,) whether the view saw the table."""
    keys: tuple[int, ...]
    """Places of the key views."""
    residual_mm: float
    """Median of what is left of a pair's shift [mm]."""
    cpu_s: float
    """CPU time [s]."""


def hand_held_poses(
    intrinsics: CameraIntrinsics, depths: Sequence[Array32], sample: SampleConfig
) -> HandHeld:
    """Return the camera's poses from its depth images alone.

    Args:
        intrinsics: the camera.
        depths: (H, W) each, along z [m], 0 = none, in the order in which they were taken.
        sample: how images are thinned out.

    Raises:
        InputError: a view overlaps too little with those before it, or holds nothing above the
            table; it is named by its place in the list.
        DegenerateError: the first view sees no table.
    """
    began = time.process_time()
    clouds = _clouds(intrinsics, depths, sample)
    path = _Path(clouds)
    for k in range(1, len(clouds)):
        path.add(k)
    Ts, clouds = np.stack(path.poses), path.clouds
    aim = np.median(
        [se3.transform(T, c.source).mean(0) for T, c in zip(Ts, clouds, strict=True)], 0
    )
    levelled = tuple(c.normal is not None for c in clouds)
    angles = pairs.view_angles(Ts, aim)
    Ts = optimise_poses(Ts, path.edges, levelled, angles).Ts_world_cam
    loops = _loops(path, Ts, pairs.view_angles(Ts, aim))
    graph = optimise_poses(Ts, [*path.edges, *loops], levelled, angles)
    r = graph.residuals if len(graph.residuals) else np.zeros((1, 6))
    return HandHeld(
        Ts_world_cam=graph.Ts_world_cam,
        covariances=graph.covariances,
        overlaps=np.array(path.overlaps),
        levelled=levelled,
        keys=tuple(path.keys),
        residual_mm=float(1e3 * np.median(np.linalg.norm(r[:, 3:], axis=1))),
        cpu_s=time.process_time() - began,
    )


def _clouds(
    intrinsics: CameraIntrinsics, depths: Sequence[Array32], sample: SampleConfig
) -> list[pairs.ViewCloud]:
    """Return every view split into its table and what stands on it."""
    frames = check_frames(
        [DepthFrame(index=k, depth_m=d, T_world_cam=np.eye(4)) for k, d in enumerate(depths)],
        intrinsics,
    )
    noise = measure_noise(frames, EvidenceConfig())
    rng = np.random.default_rng(SEED)
    clouds: list[pairs.ViewCloud] = []
    for frame in frames:
        points = sample_view(intrinsics, frame, noise, sample)
        cloud = pairs.view_cloud(points, None, rng)
        if frame.index == 0 and cloud.normal is None:
            raise DegenerateError(
                "view 0 sees no table: no plane carries at least "
                f"{100 * pairs.LEAST_SHARE:.0f} % of its points. The first view of a "
                "hand-held capture has to show the table; look down on it from 30 to 50 cm."
            )
        if cloud.normal is not None and len(cloud.source) < pairs.LEAST_POINTS:
            raise InputError(
                f"view {frame.index} holds only {len(cloud.source)} averaged points above the "
                f"table; at least {pairs.LEAST_POINTS} are needed. Leave the view out, or "
                "keep the things on the table in the picture."
            )
        clouds.append(cloud)
    return clouds


class _Path:
    """The views one after the other, each placed by the key view before it."""

    def __init__(self, clouds: Sequence[pairs.ViewCloud]) -> None:
        """Begin with the first view, over the table."""
        self.clouds = list(clouds)
        self.meter = pairs.PairMeter(self.clouds, FIT)
        first = self.clouds[0]
        assert first.normal is not None  # checked when the clouds were made
        T_cam_table = plane_frame(first.normal, first.offset, first.target)
        self.poses = [se3.invert(T_cam_table)]
        self.keys = [0]
        self.edges: list[pairs.Edge] = []
        self.overlaps = [1.0]

    def add(self, k: int) -> None:
        """Place view k: by the last key view, and by the key before that."""
        # The hand goes on as it did; if that was wrong, it stood still.
        moved = self.poses[-1] @ self._last_step()
        self._doubt_table(k, moved)
        best = self._try(k, self.keys[-1], moved)
        for reference, guess in ((k - 1, moved), (self.keys[-1], self.poses[-1])):
            if best.overlap < KEY_OVERLAP:
                other = self._try(k, reference, guess)
                best = other if other.overlap > best.overlap else best
        if best.overlap < LEAST_OVERLAP:
            raise InputError(
                f"view {k} cannot be placed: only {100 * best.overlap:.0f} % of its points fit "
                f"view {best.first} ({100 * LEAST_OVERLAP:.0f} % are needed). The "
                "camera moved too far between them, or something on the table was moved; take "
                "views in steps of at most 6 degrees, or leave this one out."
            )
        T = self.poses[best.first] @ best.T_first_second
        self.edges.append(best)
        self.overlaps.append(best.overlap)
        self.poses.append(T)
        before = [j for j in self.keys[-2:] if j != best.first]
        for j in before:
            edge = self._try(k, j, T)
            if edge.overlap >= LEAST_OVERLAP:
                self.edges.append(edge)
        turned = np.degrees(se3.angle(pairs.relative(np.stack(self.poses), self.keys[-1], k)))
        if turned > KEY_DEG or best.overlap < KEY_OVERLAP:
            self.keys.append(k)

    def _try(self, k: int, reference: int, T_world_cam: Array) -> pairs.Edge:
        """Return view k measured against a view that is placed, from a guess of its pose."""
        return self.meter.measure(reference, k, se3.invert(self.poses[reference]) @ T_world_cam)

    def _last_step(self) -> Array:
        """Return the motion between the last two views (4, 4)."""
        if len(self.poses) < 2:
            return np.eye(4)
        return se3.invert(self.poses[-2]) @ self.poses[-1]

    def _doubt_table(self, k: int, T_world_cam: Array) -> None:
        """Forget view k's plane if it is not where the table must be."""
        normal = self.clouds[k].normal
        if normal is None:
            return
        tilt = np.degrees(np.arccos(np.clip(T_world_cam[2, :3] @ normal, -1.0, 1.0)))
        if tilt > SAME_TABLE_DEG:
            # PairMeter keeps this very list.
            self.clouds[k] = replace(self.clouds[k], normal=None)


def _loops(path: _Path, Ts: Array, angles: Array) -> list[pairs.Edge]:
    """Return pairs of key views that see the same but do not follow each other."""
    known = {(e.first, e.second) for e in path.edges}
    found: list[pairs.Edge] = []
    for place, k in enumerate(path.keys):
        earlier = np.array(path.keys[: max(place - 1, 0)], dtype=np.int64)
        near = earlier[np.argsort(angles[k, earlier], kind="stable")] if len(earlier) else earlier
        tried = 0
        for j in near.tolist():
            if tried == LOOPS or angles[j, k] > LOOP_DEG:
                break
            if (j, k) in known:
                continue
            tried += 1
            edge = path.meter.measure(j, k, pairs.relative(Ts, j, k))
            if edge.overlap >= LEAST_OVERLAP:
                found.append(edge)
    return found
