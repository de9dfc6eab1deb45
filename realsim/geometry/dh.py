"""Serial arms by their Denavit-Hartenberg numbers: forward kinematics and what an error does.

    T_base_ee = T_base_0 T_0_1 ... T_(n-1)_n T_n_ee
    T_(i-1)_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)

Every chain of n turning joints has such numbers. Frame `base` is the controller's base (of a UR,
ROS's `base_link` is turned by 180 deg about z against it); frame `ee` is the bare tool flange with
z out of it (ROS `tool0`). Joints in rad, from the base outwards. A factory calibration ADDS small
deltas to the nominal numbers (a UR controller's calibration.conf).
"""

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3

DH_NUMBERS = ("theta", "alpha", "a", "d")
"""Order in which the 4 n errors of an arm are numbered, joint by joint inside each."""
DIFFERENCE = 1e-6
"""Step of the numeric derivatives [rad or m]; central, so their error is 1e-10."""


def checked_row(value: ArrayLike, name: str, count: int | None = None) -> Array:
    """Return a read-only (n,) copy.

    Args:
        value: one number a joint.
        name: what it is, for messages.
        count: n; None = any.

    Raises:
        InputError: not n finite numbers.
    """
    row = np.array(value, dtype=np.float64)
    if row.ndim != 1 or len(row) != (count or max(len(row), 1)) or not np.all(np.isfinite(row)):
        needed = f"{count} finite numbers are" if count else "a row of finite numbers is"
        raise InputError(f"{name} is {row.tolist()}; {needed} needed, one a joint.")
    row.setflags(write=False)
    return row


def _none() -> Array:
    return np.zeros(0)


def _still() -> Array:
    return np.eye(4)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DhArm:
    """n revolute joints: nominal DH numbers, and what a calibration adds to them."""

    name: str
    a: Array
    """(n,) link lengths [m]."""
    d: Array
    """(n,) link offsets [m]."""
    alpha: Array
    """(n,) link twists [rad]."""
    theta: Array = field(default_factory=_none)
    """(n,) joint zero offsets [rad]; none given = zeros, as of the deltas."""
    delta_a: Array = field(default_factory=_none)
    """(n,) calibrated minus nominal a [m]."""
    delta_d: Array = field(default_factory=_none)
    """(n,) calibrated minus nominal d [m]; tens of metres are normal for the parallel joints."""
    delta_alpha: Array = field(default_factory=_none)
    """(n,) calibrated minus nominal alpha [rad]."""
    delta_theta: Array = field(default_factory=_none)
    """(n,) calibrated minus nominal theta [rad]."""
    T_base_0: Array = field(default_factory=_still)
    """(4, 4) DH frame 0, whose z is the first joint's axis, in the base [m]."""
    T_n_ee: Array = field(default_factory=_still)
    """(4, 4) the flange in DH frame n [m]."""

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        n = len(checked_row(self.a, f"{self.name}: a"))
        for part in ("a", "d", "alpha", "theta"):
            for name in (part, f"delta_{part}"):
                row = getattr(self, name)
                row = np.zeros(n) if len(row) == 0 and name not in ("d", "alpha") else row
                object.__setattr__(self, name, checked_row(row, f"{self.name}: {name}", n))
        for name in ("T_base_0", "T_n_ee"):
            T = np.array(se3.check_rigid(getattr(self, name), f"{self.name}: {name}"))
            T.setflags(write=False)
            object.__setattr__(self, name, T)

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return len(self.a)

    def bare(self) -> "DhArm":
        """Return the numbers alone, without what a subclass adds."""
        return DhArm(**{f.name: getattr(self, f.name) for f in fields(DhArm)})

    def link_frames(self, joints: ArrayLike) -> Array:
        """Return T_base_link (..., n + 1, 4, 4) of base and links at joints (..., n).

        Link 0 is the base itself, the last one's frame is the flange; the others have DH frames.
        """
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
        links[..., 0, :, :] = self.T_base_0 @ links[..., 0, :, :]
        links[..., -1, :, :] = links[..., -1, :, :] @ self.T_n_ee
        frames = np.empty((*q.shape[:-1], self.joints + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        for i in range(self.joints):
            frames[..., i + 1, :, :] = frames[..., i, :, :] @ links[..., i, :, :]
        return frames

    def forward(self, joints: ArrayLike) -> Array:
        """Return T_base_ee (..., 4, 4) [m] at joints (..., n) [rad]."""
        return self.link_frames(joints)[..., -1, :, :]

    def jacobian(self, joints: ArrayLike) -> Array:
        """Return J (..., 6, n) with `forward(q + dq) = forward(q) @ exp(J @ dq)` to first order.

        Rows are the twist in ee axes, rotation first [rad, m]; column i is joint i's axis:
        w_i = R_ee_base z_i and v_i = R_ee_base (z_i x (p_ee - p_i)).
        """
        return self.jacobian_of(self.link_frames(joints))

    def jacobian_of(self, frames: Array) -> Array:
        """Return the body Jacobian (..., 6, n) of link frames (..., n + 1, 4, 4)."""
        turning = frames[..., :-1, :, :]
        if not np.array_equal(self.T_base_0, np.eye(4)):
            turning = turning.copy()
            turning[..., 0, :, :] = self.T_base_0
        axes = turning[..., :3, 2]
        lever = frames[..., -1:, :3, 3] - turning[..., :3, 3]
        R_base_ee = frames[..., -1, :3, :3]
        rotation = axes @ R_base_ee  # rows are R_ee_base @ z_i
        translation = np.cross(axes, lever) @ R_base_ee
        return np.swapaxes(np.concatenate([rotation, translation], -1), -1, -2)

    def corrected(self, errors: ArrayLike) -> "DhArm":
        """Return the arm with errors (4 n,) added: theta, alpha [rad], a, d [m], n of each."""
        parts = np.asarray(errors, dtype=np.float64).reshape(len(DH_NUMBERS), self.joints)
        deltas = {
            f"delta_{name}": getattr(self, f"delta_{name}") + part
            for name, part in zip(DH_NUMBERS, parts, strict=True)
        }
        return replace(self, **deltas)

    def error_basis(self, joints: ArrayLike) -> Array:
        """Return d twist / d error (..., 6, 4 n) at joints (..., n).

        forward of the corrected arm = forward @ exp(basis @ errors) to first order; the twist is in
        ee axes, rotation first [rad, m], errors as in `corrected`.
        """
        columns: list[Array] = []
        here = se3.invert(self.forward(joints))
        size = len(DH_NUMBERS) * self.joints
        for k in range(size):
            step = np.zeros(size)
            step[k] = DIFFERENCE
            ends = [se3.log(here @ self.corrected(s * step).forward(joints)) for s in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2 * DIFFERENCE))
        return np.stack(columns, -1)
