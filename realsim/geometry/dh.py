"""Serial arms by their Denavit-Hartenberg numbers: forward kinematics and what an error does.

    T_(i-1)_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)

Frame `base` is the controller's base (ROS `base_link` is turned by 180 deg about z against it);
frame `ee` is DH frame 6, the bare tool flange with z out of it (ROS `tool0`). Joints in rad, in
the order base, shoulder, elbow, wrist 1, 2, 3. A factory calibration ADDS small deltas to the
nominal numbers (the controller's calibration.conf).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3

Array = NDArray[np.float64]
JOINTS = 6
DH_NUMBERS = ("theta", "alpha", "a", "d")
"""Order in which the 24 errors of an arm are numbered, joint by joint inside each."""
DIFFERENCE = 1e-6
"""Step of the numeric derivatives [rad or m]; central, so their error is 1e-10."""


def checked_row(value: ArrayLike, name: str) -> Array:
    """Return a read-only (6,) copy.

    Raises:
        InputError: not six finite numbers.
    """
    row = np.array(value, dtype=np.float64)
    if row.shape != (JOINTS,) or not np.all(np.isfinite(row)):
        raise InputError(f"{name} is {row.tolist()}; {JOINTS} finite numbers are needed.")
    row.setflags(write=False)
    return row


def _zeros() -> Array:
    return np.zeros(JOINTS)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DhArm:
    """Six revolute joints: nominal DH numbers, and what a calibration adds to them."""

    name: str
    a: Array
    """(6,) link lengths [m]."""
    d: Array
    """(6,) link offsets [m]."""
    alpha: Array
    """(6,) link twists [rad]."""
    theta: Array = field(default_factory=_zeros)
    """(6,) joint zero offsets [rad]."""
    delta_a: Array = field(default_factory=_zeros)
    """(6,) calibrated minus nominal a [m]."""
    delta_d: Array = field(default_factory=_zeros)
    """(6,) calibrated minus nominal d [m]; tens of metres are normal for the parallel joints."""
    delta_alpha: Array = field(default_factory=_zeros)
    """(6,) calibrated minus nominal alpha [rad]."""
    delta_theta: Array = field(default_factory=_zeros)
    """(6,) calibrated minus nominal theta [rad]."""

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for part in ("a", "d", "alpha", "theta"):
            for name in (part, f"delta_{part}"):
                row = checked_row(getattr(self, name), f"{self.name}: {name}")
                object.__setattr__(self, name, row)

    def link_frames(self, joints: ArrayLike) -> Array:
        """Return T_base_link (..., 7, 4, 4) of the base and the six links at joints (..., 6)."""
        q = np.asarray(joints, dtype=np.float64) + (self.theta + self.delta_theta)
        a, d = self.a + self.delta_a, self.d + self.delta_d
        alpha = self.alpha + self.delta_alpha
        ca, sa = np.cos(alpha), np.sin(alpha)
        c, s = np.cos(q), np.sin(q)
        links = np.zeros((*q.shape, 4, 4))
        links[..., 0, 0], links[..., 0, 1], links[..., 0, 2] = c, -s * ca, s * sa
        links[..., 1, 0], links[..., 1, 1], links[..., 1, 2] = s, c * ca, -c * sa
        links[..., 2, 1], links[..., 2, 2] = sa, ca
        links[..., 0, 3], links[..., 1, 3], links[..., 2, 3] = a * c, a * s, d
        links[..., 3, 3] = 1.0
        frames = np.empty((*q.shape[:-1], JOINTS + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        for i in range(JOINTS):
            frames[..., i + 1, :, :] = frames[..., i, :, :] @ links[..., i, :, :]
        return frames

    def forward(self, joints: ArrayLike) -> Array:
        """Return T_base_ee (..., 4, 4) [m] at joints (..., 6) [rad]."""
        return self.link_frames(joints)[..., JOINTS, :, :]

    def jacobian(self, joints: ArrayLike) -> Array:
        """Return J (..., 6, 6) with `forward(q + dq) = forward(q) @ exp(J @ dq)` to first order.

        Rows are the twist in ee axes, rotation first [rad, m]; column i is joint i's axis:
        w_i = R_ee_base z_i and v_i = R_ee_base (z_i x (p_ee - p_i)).
        """
        return jacobian_of(self.link_frames(joints))

    def corrected(self, errors: ArrayLike) -> "DhArm":
        """Return the arm with errors (24,) added: theta, alpha [rad], a, d [m], six each."""
        parts = np.asarray(errors, dtype=np.float64).reshape(len(DH_NUMBERS), JOINTS)
        deltas = {
            f"delta_{name}": getattr(self, f"delta_{name}") + part
            for name, part in zip(DH_NUMBERS, parts, strict=True)
        }
        return replace(self, **deltas)

    def error_basis(self, joints: ArrayLike) -> Array:
        """Return d twist / d error (..., 6, 24) at joints (..., 6).

        forward of the corrected arm = forward @ exp(basis @ errors) to first order; the twist is in
        ee axes, rotation first [rad, m], errors as in `corrected`.
        """
        columns: list[Array] = []
        here = se3.invert(self.forward(joints))
        for k in range(len(DH_NUMBERS) * JOINTS):
            step = np.zeros(len(DH_NUMBERS) * JOINTS)
            step[k] = DIFFERENCE
            ends = [se3.log(here @ self.corrected(s * step).forward(joints)) for s in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2 * DIFFERENCE))
        return np.stack(columns, -1)


def jacobian_of(frames: Array) -> Array:
    """Return the body Jacobian (..., 6, 6) of link frames (..., 7, 4, 4)."""
    axes = frames[..., :JOINTS, :3, 2]
    lever = frames[..., JOINTS:, :3, 3] - frames[..., :JOINTS, :3, 3]
    R_base_ee = frames[..., JOINTS, :3, :3]
    rotation = axes @ R_base_ee  # rows are R_ee_base @ z_i
    translation = np.cross(axes, lever) @ R_base_ee
    return np.swapaxes(np.concatenate([rotation, translation], -1), -1, -2)


_UR_ALPHA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0]) * (np.pi / 2)

UR5_ARM = DhArm(
    name="UR5",
    a=np.array([0.0, -0.425, -0.39225, 0.0, 0.0, 0.0]),
    d=np.array([0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823]),
    alpha=_UR_ALPHA,
)
"""UR5 of the CB3 series, nominal (Universal Robots: DH parameters for calculations)."""

UR5E_ARM = DhArm(
    name="UR5e",
    a=np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]),
    d=np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]),
    alpha=_UR_ALPHA,
)
"""UR5e, nominal. Its flange is 64 mm off a UR5's at the same joints: never swap them."""

ARMS = {arm.name: arm for arm in (UR5_ARM, UR5E_ARM)}
