"""When two poses of a shape are the same: the distance between them, whatever its symmetries.

    d(A, B) = min over g of max over v of |A^-1 B v - g v|,  v the corners of the box.

g is a discrete symmetry S, or a turn about a continuous axis after it. The turn is not sampled: it
is the twist of the rotation of A^-1 B S^-1 about the axis. Two axes that cross make a ball, and
then only its middle counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.mesh import box_corners
from realsim.records import ObjectModel

PARALLEL = 0.99
"""Cosine above which two continuous axes are one."""
CHUNK = 4096
"""Pairs of pose and symmetry that are held at once."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sameness:
    """What of a shape matters for the comparison of two poses."""

    corners: Array
    """(8, 3) of the box [m]."""
    symmetries: Array
    """(S, 4, 4) discrete ones, the identity first."""
    axis: tuple[Array, Array] | None
    """Direction (3,) and point (3,) [m] of the continuous axis, if there is one."""
    ball_center: Array | None
    """(3,) the middle of a shape that every rotation leaves as it is, or None."""

    def distances(self, T: Array, others: Array) -> Array:
        """Return the distance (N,) [m] of a pose (4, 4) to others (N, 4, 4)."""
        D = se3.invert(T) @ others
        if self.ball_center is not None:
            return np.linalg.norm(se3.transform(D, self.ball_center[None])[:, 0] - self.ball_center,
                                  axis=-1)  # fmt: skip
        step = max(1, CHUNK // len(self.symmetries))
        parts = [self._distances(D[i : i + step]) for i in range(0, len(D), step)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def distance(self, T_a: Array, T_b: Array) -> float:
        """Return the distance [m] of two poses (4, 4)."""
        return float(self.distances(T_a, T_b[None])[0])

    def angle_deg(self, R_a: Array, R_b: Array) -> float:
        """Return the smallest turn [deg] that makes one rotation (3, 3) the other."""
        if self.ball_center is not None:
            return 0.0
        D = np.eye(4)
        D[:3, :3] = R_a.T @ R_b
        G = self._nearest(D[None])[0]
        turns = np.swapaxes(G[:, :3, :3], -1, -2) @ D[:3, :3]
        return float(np.degrees(np.min(se3.angle(turns))))

    def _nearest(self, D: Array) -> Array:
        """Return the symmetries (N, S, 4, 4) that may be nearest to motions D (N, 4, 4)."""
        S = np.broadcast_to(self.symmetries, (len(D), *self.symmetries.shape))
        if self.axis is None:
            return S
        direction, point = self.axis
        R = D[:, None, :3, :3] @ np.swapaxes(self.symmetries[:, :3, :3], -1, -2)
        # tan(twist / 2) = (v . a) / w of the quaternion, both times 4 w or of the rotation's parts:
        # sin and cos of the twist come from a . (R - R^T) and from the trace without a's part.
        skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0],
                         R[..., 1, 0] - R[..., 0, 1]], axis=-1)  # fmt: skip
        along = np.einsum("i,...ij,j->...", direction, R, direction)
        twist = np.arctan2(skew @ direction, np.trace(R, axis1=-2, axis2=-1) - along)
        turn = se3.exp_so3(twist[..., None] * direction)
        return se3.from_rt(turn, point - turn @ point) @ S

    def _distances(self, D: Array) -> Array:
        """Return the distance (N,) of motions D (N, 4, 4) from the nearest symmetry."""
        off = D[:, None] - self._nearest(D)
        moved = self.corners @ np.swapaxes(off[..., :3, :3], -1, -2) + off[..., None, :3, 3]
        return np.sqrt(np.einsum("nsvi,nsvi->nsv", moved, moved).max(-1).min(-1))


def make_sameness(model: ObjectModel) -> Sameness:
    """Return what of a model matters for the comparison of two poses."""
    axes = [(np.asarray(a, np.float64) / np.linalg.norm(a), np.asarray(p, np.float64))
            for a, p in model.symmetry_axes]  # fmt: skip
    ball = len(axes) > 1 and any(abs(a @ axes[0][0]) < PARALLEL for a, _ in axes[1:])
    return Sameness(
        corners=box_corners(*model.mesh.bounds),
        symmetries=np.asarray(model.symmetries, dtype=np.float64),
        axis=axes[0] if axes and not ball else None,
        ball_center=axes[0][1] if ball else None,
    )


def distinct(sameness: Sameness, Ts: Sequence[Array], apart_m: float) -> list[int]:
    """Return the places of the poses that differ: of those within `apart_m`, the first."""
    kept: list[int] = []
    for n, T in enumerate(Ts):
        known = np.array([Ts[k] for k in kept]).reshape(-1, 4, 4)
        if not kept or sameness.distances(T, known).min() > apart_m:
            kept.append(n)
    return kept
