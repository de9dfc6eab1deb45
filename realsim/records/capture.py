"""What a capture is: the camera, the views, the session, the tag board, the hand-eye."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.records.checked_arrays import Array, frozen, rigid

DISTORTION_TERMS = 8
"""OpenCV order k1 k2 p1 p2 k3 k4 k5 k6; the Brown model leaves k4 k5 k6 at zero."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CameraIntrinsics:
    """A pinhole camera with Brown (k1 k2 p1 p2 k3) or rational (+ k4 k5 k6) distortion.

    Integer pixel coordinates are pixel centres (OpenCV, BOP).
    """

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point x [px]."""
    cy: float
    """Principal point y [px]."""
    distortion: Array = field(default_factory=lambda: np.zeros(DISTORTION_TERMS))
    """(8,) OpenCV's k1 k2 p1 p2 k3 k4 k5 k6; shorter lists are filled with zeros."""

    def __post_init__(self) -> None:
        """Check ranges and freeze the distortion."""
        if self.width < 1 or self.height < 1:
            raise InputError(f"the image size {self.width}x{self.height} is not positive.")
        for name in ("fx", "fy"):
            f = getattr(self, name)
            if not (np.isfinite(f) and f > 0):
                raise InputError(f"the focal length {name} is {f}; it must be positive pixels.")
        if not (np.isfinite(self.cx) and np.isfinite(self.cy)):
            raise InputError(f"the principal point ({self.cx}, {self.cy}) is not finite.")
        d = np.asarray(self.distortion, dtype=np.float64).ravel()
        if len(d) > DISTORTION_TERMS and np.any(d[DISTORTION_TERMS:] != 0):
            raise InputError(
                f"{len(d)} distortion coefficients were given; the Brown (5) and the rational (8) "
                "model are supported, not thin-prism or tilted ones."
            )
        full = np.zeros(DISTORTION_TERMS)
        full[: min(len(d), DISTORTION_TERMS)] = d[:DISTORTION_TERMS]
        object.__setattr__(self, "distortion", frozen(full, np.float64, (8,), "distortion"))

    @property
    def K(self) -> Array:
        """The (3, 3) camera matrix [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return bool(np.any(self.distortion != 0))

    @classmethod
    def from_K(
        cls, K: ArrayLike, width: int, height: int, distortion: ArrayLike | None = None
    ) -> "CameraIntrinsics":
        """Return the record of a (3, 3) camera matrix [px].

        Raises:
            InputError: K has skew, or its last row is not 0 0 1.
        """
        K = np.asarray(K, dtype=np.float64).reshape(3, 3)
        if abs(K[0, 1]) > 1e-9 or not np.allclose(K[2], [0, 0, 1]) or abs(K[1, 0]) > 1e-9:
            raise InputError(
                f"the camera matrix {K.tolist()} is not [[fx 0 cx] [0 fy cy] [0 0 1]]."
            )
        return cls(
            width=width,
            height=height,
            fx=float(K[0, 0]),
            fy=float(K[1, 1]),
            cx=float(K[0, 2]),
            cy=float(K[1, 2]),
            distortion=np.zeros(DISTORTION_TERMS) if distortion is None else np.asarray(distortion),
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class View:
    """One frame: where the arm said it was and, once calibrated, where the camera is."""

    index: int
    """Number of the frame: its file name on disk."""
    T_base_ee: Array | None = None
    """(4, 4) the controller's tool pose in its base [m]; None for data sets without a robot."""
    joints: Array | None = None
    """(6,) joint angles [rad]; None where they are not known."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]; None before calibration."""
    time_s: float = 0.0
    """Time stamp of the frame [s]."""

    def __post_init__(self) -> None:
        """Check that the poses are rigid and freeze them."""
        for name in ("T_base_ee", "T_world_cam"):
            T = getattr(self, name)
            if T is not None:
                object.__setattr__(self, name, rigid(T, f"{name} of view {self.index}"))
        if self.joints is not None:
            object.__setattr__(self, "joints", frozen(self.joints, np.float64, (None,), "joints"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CaptureSession:
    """What was captured: a camera, its views, and how depth is stored. Images stay on disk."""

    name: str
    intrinsics: CameraIntrinsics
    views: tuple[View, ...]
    depth_unit_m: float
    """Metres per unit of the 16-bit depth images (BOP's depth_scale / 1000)."""

    def __post_init__(self) -> None:
        """Check the depth unit and that view numbers are unique."""
        if not (np.isfinite(self.depth_unit_m) and 1e-6 <= self.depth_unit_m <= 0.01):
            raise InputError(
                f"session '{self.name}': the depth unit is {self.depth_unit_m} m per count; "
                "between 1e-6 and 0.01 is accepted (0.001 for millimetres, 0.0001 for a D405)."
            )
        indices = [v.index for v in self.views]
        if len(set(indices)) != len(indices):
            raise InputError(f"session '{self.name}' has two views of the same number.")

    def view(self, index: int) -> View:
        """Return the view with this number.

        Raises:
            InputError: there is none.
        """
        for v in self.views:
            if v.index == index:
                return v
        raise InputError(
            f"view {index} is not in session '{self.name}'; it has "
            f"{', '.join(str(v.index) for v in self.views[:12])}"
            f"{'...' if len(self.views) > 12 else '.'}"
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TagBoard:
    """A flat grid of AprilTags; frame `board` has its origin at the grid's first corner.

    Tag (row r, column c) has the id `first_id + r * columns + c`; x runs along the columns, y along
    the rows (down the printed page), so z points INTO the paper (OpenCV's board convention).
    """

    rows: int
    columns: int
    tag_size_m: float
    """Edge of a tag's black square [m]."""
    gap_m: float
    """White gap between neighbouring tags [m]."""
    family: Literal["tag36h11"] = "tag36h11"
    first_id: int = 0

    def __post_init__(self) -> None:
        """Check counts and sizes."""
        if self.rows < 1 or self.columns < 1:
            raise InputError(f"a tag board needs rows and columns, got {self.rows}x{self.columns}.")
        if not (0.001 <= self.tag_size_m <= 1.0) or not (0.0 < self.gap_m <= 1.0):
            raise InputError(
                f"tag size {self.tag_size_m} m and gap {self.gap_m} m: metres are expected, tags "
                "between 0.001 and 1 m. Were millimetres given?"
            )

    @property
    def ids(self) -> NDArray[np.int64]:
        """(rows * columns,) tag ids."""
        return self.first_id + np.arange(self.rows * self.columns)

    @property
    def corners_board(self) -> Array:
        """(tags, 4, 3) corners in the board frame [m], clockwise from the top left as printed."""
        pitch = self.tag_size_m + self.gap_m
        r, c = np.divmod(np.arange(self.rows * self.columns), self.columns)
        square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
        origin = np.stack([c * pitch, r * pitch, np.zeros(len(r))], -1)
        return origin[:, None] + square[None] * self.tag_size_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y of the outermost corners [m]."""
        pitch = self.tag_size_m + self.gap_m
        return self.columns * pitch - self.gap_m, self.rows * pitch - self.gap_m


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HandEye:
    """A hand-eye calibration: the camera in the hand, and everything that says how good it is."""

    T_ee_cam: Array
    """(4, 4) camera in the controller's tool frame [m]."""
    covariance: Array
    """(6, 6) of the right perturbation of T_ee_cam, rotation first [rad, m]."""
    T_base_board: Array
    """(4, 4) board in base [m]."""
    intrinsics: CameraIntrinsics
    """The camera as calibrated together with the hand-eye."""
    intrinsics_sd: Array
    """(4 + 8,) 1-sigma of fx fy cx cy [px] and of the 8 distortion terms (0 = held fixed)."""
    view_indices: tuple[int, ...]
    """Views used."""
    view_rms_px: Array
    """(views used,) reprojection RMS of each view through the robot pose [px]."""
    held_out_px: float
    """RMS of views predicted by a fit without them, through the robot pose [px]."""
    rejected: tuple[tuple[int, str], ...] = ()
    """(view, reason) of every view that was not used."""
    method: str = ""
    starts: tuple[tuple[str, float], ...] = ()
    """(closed form, its reprojection RMS [px]) of every start tried."""

    def __post_init__(self) -> None:
        """Check that the poses are rigid and freeze the arrays."""
        object.__setattr__(self, "T_ee_cam", rigid(self.T_ee_cam, "T_ee_cam"))
        object.__setattr__(self, "T_base_board", rigid(self.T_base_board, "T_base_board"))
        for name, shape in (
            ("covariance", (6, 6)),
            ("intrinsics_sd", (12,)),
            ("view_rms_px", (None,)),
        ):
            value = frozen(getattr(self, name), np.float64, shape, name)
            object.__setattr__(self, name, value)

    @property
    def sigma_deg(self) -> float:
        """Largest 1-sigma of the rotation about any axis [deg]."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of the translation along any axis [mm]."""
        return float(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))
