"""What a capture is: the camera, the views, the session."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records.checked_arrays import freeze, frozen, numbered, numbers, rigid, whole

DISTORTION_TERMS = 8
"""OpenCV order k1 k2 p1 p2 k3 k4 k5 k6; the Brown model leaves k4 k5 k6 at zero."""
LONGEST_SIDE = 32_768
"""Pixels of an image along one side; a file can claim any number, and arrays are made of it."""


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
        if not (whole(self.width, 1, LONGEST_SIDE) and whole(self.height, 1, LONGEST_SIDE)):
            raise InputError(
                f"the image size is {self.width!r}x{self.height!r}; whole numbers of 1 to "
                f"{LONGEST_SIDE} pixels a side are accepted."
            )
        for name in ("fx", "fy"):
            f = getattr(self, name)
            if not (np.isfinite(f) and f > 0):
                raise InputError(f"the focal length {name} is {f}; it must be positive pixels.")
        if not (np.isfinite(self.cx) and np.isfinite(self.cy)):
            raise InputError(f"the principal point ({self.cx}, {self.cy}) is not finite.")
        d = np.squeeze(numbers(self.distortion, np.float64, "the distortion"))
        if d.ndim > 1:
            raise InputError(f"the distortion has shape {d.shape}; one row of numbers is expected.")
        d = d.ravel()
        if not np.all(np.isfinite(d)):
            raise InputError(f"the distortion {d.tolist()} is not of finite numbers.")
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
    """(n,) joint angles [rad]; None where they are not known."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]; None before calibration."""
    time_s: float = 0.0
    """Time stamp of the frame [s]."""

    def __post_init__(self) -> None:
        """Check that the poses are rigid and freeze them."""
        numbered(self.index, "the number of a view")
        for name in ("T_base_ee", "T_world_cam"):
            T = getattr(self, name)
            if T is not None:
                object.__setattr__(self, name, rigid(T, f"{name} of view {self.index}"))
        freeze(self, joints=(None,))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CaptureSession:
    """What was captured: a camera, its views, and how depth is stored. Images stay on disk."""

    name: str
    intrinsics: CameraIntrinsics
    views: tuple[View, ...] = ()
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

    @property
    def Ts_world_cam(self) -> dict[int, Array]:
        """Return where the camera stood, of every view that says it, by the view's number."""
        return {v.index: v.T_world_cam for v in self.views if v.T_world_cam is not None}

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
