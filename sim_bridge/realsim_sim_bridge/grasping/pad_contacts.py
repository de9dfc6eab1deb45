"""Where the two finger pads touch an object first when they close on it."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.robots.hand import Hand, along_approach
from realsim_sim_bridge.grasping.antipodal import RaySurface

STEPS = 40
RAYS = 3
"""Steps in which a hand on an arc is closed to find where, and rays per side of a pad."""
SQUARE_LEVER = 0.3826
"""Mean distance of a unit square's points from its middle."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PadContacts:
    """One contact per finger, object frame; finger 0 is at -y of the grasp, finger 1 at +y."""

    points: Array
    """(N, 2, 3) middle of what touches [m]; NaN = the finger touches nothing."""
    normals: Array
    """(N, 2, 3) unit normals out of the object; NaN likewise."""
    levers_m: Array
    """(N, 2) mean distance of what touches from its middle [m]; NaN likewise."""

    @property
    def both(self) -> Mask:
        """(N,) whether both fingers touch."""
        return np.asarray(np.isfinite(self.levers_m).all(axis=1))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PadRays:
    """What parallel rays from two pads meet, object frame; R rays each, finger 0 at -y."""

    points: Array
    """(N, 2, R, 3) [m]; on the pad where nothing is touched."""
    normals: Array
    """(N, 2, R, 3) unit normals towards the pad."""
    touched: Mask
    """(N, 2, R) whether the pad touches there when it has closed."""


def pad_rays(
    surface: RaySurface,
    Ts_obj_pads: Array,
    openings_m: Array,
    geometry: Hand,
    rays: int,
    softness_m: float,
) -> PadRays:
    """Return what closing pads meet; arguments as of `pad_contacts`. Rays go by x, then by z."""
    n, cell = len(Ts_obj_pads), (np.arange(rays) + 0.5) / rays * 2 - 1
    width, length = geometry.pad_width_m, geometry.pad_length_m
    x, z = np.meshgrid(0.5 * width * cell, 0.5 * length * cell, indexing="ij")
    side = np.array([-1.0, 1.0])
    origins = np.empty((n, 2, rays * rays, 3))
    origins[..., 0], origins[..., 2] = x.ravel(), z.ravel()
    origins[..., 1] = 0.5 * openings_m[:, None, None] * side[:, None]
    shape = origins.shape
    origins = se3.transform(Ts_obj_pads, origins.reshape(n, 2 * rays * rays, 3)).reshape(shape)
    inward = -side[:, None] * Ts_obj_pads[:, None, :3, 1]
    directions = np.broadcast_to(inward[:, :, None], origins.shape)

    t, face = surface.first_hits(origins.reshape(-1, 3), directions.reshape(-1, 3))
    t, face = t.reshape(shape[:3]), face.reshape(shape[:3])
    # The other pad is where the opening ends.
    t = np.where(t <= openings_m[:, None, None], t, np.inf)
    first = t.min(axis=2, keepdims=True, initial=np.inf)
    touched = np.isfinite(t) & (t <= first + softness_m)
    normals = surface.face_normals[np.where(touched, face, 0)]
    # A pad comes from outside, whatever way the triangles face.
    facing = np.sum(normals * directions, axis=-1, keepdims=True)
    return PadRays(
        points=origins + np.where(touched, t, 0.0)[..., None] * directions,
        normals=np.where(facing > 0, -normals, normals),
        touched=touched,
    )


def pad_contacts(
    surface: RaySurface,
    Ts_obj_pads: Array,
    openings_m: Array,
    geometry: Hand,
    rays: int,
    softness_m: float,
) -> PadContacts:
    """Return the contacts of closing pads.

    Parallel rays leave each pad (2.9 mm apart at 7 per side; what is thinner edge-on may lie
    between them). What the pad meets within its softness of the first point is the contact.

    Args:
        surface: the object.
        Ts_obj_pads: (N, 4, 4) axes as of `grasp`, origin between the middles of the pads [m].
        openings_m: (N,) distance of the pads before closing [m].
        geometry: the hand.
        rays: per side of a pad.
        softness_m: how deep a pad gives way [m].
    """
    met = pad_rays(surface, Ts_obj_pads, openings_m, geometry, rays, softness_m)
    points, normals, touched = met.points, met.normals, met.touched
    weight = touched[..., None].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        count = weight.sum(axis=2)
        middle = (weight * points).sum(axis=2) / count
        normal = (weight * normals).sum(axis=2)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        away = np.linalg.norm(points - middle[:, :, None], axis=-1)
        spread = (touched * np.where(touched, away, 0.0)).sum(axis=2) / count[..., 0]
    # Each ray stands for a cell of the pad.
    of_cell = SQUARE_LEVER * np.sqrt(geometry.pad_width_m * geometry.pad_length_m) / rays
    return PadContacts(points=middle, normals=normal, levers_m=np.hypot(spread, of_cell))


def pad_heights(
    surface: RaySurface, Ts_obj_grasp: Array, openings_m: Array, geometry: Hand
) -> Array:
    """Return z (N,) [m] of the pads' middles, grasp frame, when the hand has closed; 0 of a slide.

    On an arc it depends on the width, and the width on where the pads meet: the fingers are closed
    in steps until what is between the pads is as wide. Where nothing is it stays the open
    hand's.
    """
    heights = geometry.z_pad(openings_m)
    if not geometry.arc_radius_m:
        return heights
    closing = np.ones(len(openings_m), dtype=np.bool_)
    for share in np.linspace(1.0, 0.0, STEPS + 1):
        k = np.flatnonzero(closing)
        Ts = along_approach(Ts_obj_grasp[k], geometry.z_pad(share * openings_m[k]))
        points = pad_contacts(surface, Ts, openings_m[k], geometry, RAYS, 0.0).points
        widths = np.sum((points[:, 1] - points[:, 0]) * Ts[:, :3, 1], axis=-1)
        met = widths >= (share - 1.0 / STEPS) * openings_m[k]
        heights[k[met]] = geometry.z_pad(widths[met])
        closing[k[met]] = False
    return heights
