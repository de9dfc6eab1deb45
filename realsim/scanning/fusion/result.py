"""What a fused scan is: its frames, its settings, and the mesh with everything that limits it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Mask, UInt8
from realsim.records import Mesh, SupportPlane, Verdict


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FusionFrame:
    """One depth image, where it was taken, and its colours if there are any."""

    index: int
    """Number of the view in its session."""
    depth_m: Array32
    """(H, W) depth along z [m]; 0 = none. Distorted as the camera sees it."""
    T_world_cam: Array
    """(4, 4) camera in world [m]."""
    rgb: UInt8 | None = None
    """(H, W, 3) colours of the same pixels."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FusionConfig:
    """How depth images become a mesh."""

    voxel_m: float = 0.001
    """Edge of a voxel [m]. The noise that a D405 leaves after 24 views is 0.2 mm and a voxel of
    1 mm rounds a radius of 10 mm by 0.01 mm; 0.75 mm costs twice the time for the same error."""
    truncation_m: float = 0.004
    """Distances are cut off here [m]: three sigma of a D405 at 0.4 m; more would let the two sides
    of a wall disturb each other."""
    depth_limits_m: tuple[float, float] = (0.07, 1.0)
    """Depths outside are not used [m]: a D405 sees from 0.07 m, and is off by 7 mm at 1 m."""
    margin_m: float = 0.012
    """Space around the object in the volume [m]: three truncations."""
    reach_m: float = 0.30
    """What is looked for stands within this of the point at which the cameras look [m]."""
    at_m: tuple[float, float] | None = None
    """(x, y) in world [m] of the object if several things stand on the table."""
    edge_px: int = 2
    """Half the window in which a jump of depth makes a pixel untrusted [px]: stereo matches go
    wrong within one or two pixels of an edge."""
    edge_jump_m: float = 0.004
    """Jump [m] allowed besides slope and noise."""
    edge_slope_deg: float = 68.0
    """A surface seen at this angle is not yet an edge [deg]; from 72 a D405 loses pixels anyway."""
    least_cos: float = 0.25
    """Least cosine between a ray and the surface it measures (76 deg): beyond, the noise of the
    direction is larger than the measurement."""
    least_views: int = 2
    """A voxel must have been seen so often before it counts as known. With fewer than eight views
    once is enough."""
    noise_per_m: float | None = None
    """k of sigma_z = k z^2 [1/m]; None = measured from the images."""
    noise_floor_m: float = 0.0002
    """Least sigma_z [m]; a noiseless image must not weigh infinitely."""
    plane_tolerance_m: float = 0.004
    """Points within this (plus noise) of the plane belong to it [m]: tables are flat to 2 mm."""
    cut_m: float = 0.003
    """Below this height over the plane nothing is measured as the object [m]: rays that meet the
    table are as near there. Flat objects are cut at a quarter of their height instead."""
    cluster_gap_m: float = 0.010
    """Things on the table further apart than this are different things [m]."""
    least_size_m: float = 0.008
    """What is smaller than this in all directions is a speck, not an object [m]."""
    greatest_size_m: float = 0.45
    """What is larger is not an object on a table but a wall or a box around it [m]."""
    refine: bool = True
    """Whether the camera poses are refined before the fusion."""
    rounds: int = 4
    """Rounds of fusing and aligning; the third moves less than 0.02 mm in the simulated lab."""
    hand_eye_sigma: tuple[float, float] = (0.4e-3, np.radians(0.08))
    """1-sigma of the error common to all cameras, in the camera frame, per axis [m, rad]: a
    hand-eye calibration leaves 0.5 mm and 0.1 deg in all, some 0.8 mm and 0.15 deg."""
    arm_sigma: tuple[float, float] = (0.25e-3, np.radians(0.04))
    """1-sigma of the error of every view by itself, per axis [m, rad]: a calibrated arm."""
    outlier_factor: float = 5.0
    """A view that moves by more than this many of its sigmas, or disagrees with the others by
    this many times the usual, is left out."""
    largest_hole_m: float = 0.020
    """Invented patches wider than this (a disc of their area) make the scan doubtful [m]. All holes
    are closed, so that there is a volume."""
    least_measured_share: float = 0.80
    """With a smaller share of the surface above the cut measured, overhangs left aside, the scan is
    doubtful."""
    memory_voxels: int = 40_000_000
    """More voxels than this are not allocated (9 bytes each); the voxel grows instead."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewCorrection:
    """How one view's camera was moved to agree with the others."""

    index: int
    """Number of the view."""
    T_world_cam: Array
    """(4, 4) corrected pose of the camera in world [m]."""
    shift_mm: float
    """By how much the camera was moved [mm]."""
    turn_deg: float
    """By how much it was turned [deg]."""
    own_shift_mm: float
    """The part of the shift that is this view's alone, not the hand-eye's [mm]."""
    own_turn_deg: float
    """The part of the turn that is this view's alone [deg]."""
    rms_mm: float
    """RMS distance of its points on the object to the surface of all views, averaged over small
    patches [mm]; NaN where it has none."""
    used: bool = True
    """False: it speaks against the others and was left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Coverage:
    """Which part of the mesh was measured; shares of its area."""

    measured: float
    """Share of the whole surface that was measured."""
    measured_above_cut: float
    """Share of the surface above the cut that was measured, overhangs left aside: what cameras
    above a table can see."""
    underside: float
    """Share that is the flat underside on the table and the band below the cut: invented."""
    closed: float
    """Share above the cut that no camera measured though it does not face down: invented."""
    overhang: float
    """Share above the cut that faces down and was not measured: no camera above the table sees it;
    filled down to where the views see through."""
    largest_hole_mm: float
    """Width of the largest invented patch above the cut that does not face down: the diameter of a
    disc of its area [mm]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FusedObject:
    """The object as it was measured: a watertight mesh in world, and how sure it is."""

    mesh: Mesh
    """Watertight, faces outward, in the WORLD frame [m]; vertex colours if images were given."""
    plane: SupportPlane
    """The table it stands on, after refinement, in world."""
    measured: Mask
    """(V,) whether a camera measured the surface at the vertex; the rest is invented."""
    support: Int32
    """(V,) number of views that measured it."""
    sigma_m: Array
    """(V,) 1-sigma of the vertex along its normal [m]; NaN where it is invented."""
    coverage: Coverage
    corrections: tuple[ViewCorrection, ...]
    """Per view, in the order of their numbers; nothing moved if refinement is off."""
    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the verdict is not 'accepted'."""
    report: dict[str, Any]
    """Figures of every step; plain JSON values."""
    notes: tuple[str, ...] = field(default=())
    """What a user should know besides."""
    cpu_s: float = float("nan")
    """CPU time of the fusion [s]."""
