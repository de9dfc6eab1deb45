"""The records in which the stages meet: what a camera, a session, a scene and a grasp are.

Records are frozen; their arrays are private read-only copies; shapes and ranges are checked once,
here, at construction. All units are SI (m, rad, s, kg, N) unless the name says otherwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3

Array = NDArray[np.float64]
DISTORTION_TERMS = 8
"""OpenCV order k1 k2 p1 p2 k3 k4 k5 k6; the Brown model leaves k4 k5 k6 at zero."""

Verdict = Literal["accepted", "doubtful", "rejected", "unchecked"]


def _frozen(value: ArrayLike, dtype: Any, shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    """Return a read-only copy of `value`, its shape checked (None = any length)."""
    array = np.array(value, dtype=dtype)
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        wanted = tuple("N" if n is None else n for n in shape)
        raise InputError(f"{name} has shape {array.shape}; the shape must be {wanted}.")
    array.setflags(write=False)
    return array


def _rigid(value: ArrayLike, name: str) -> Array:
    """Return a read-only rigid (4, 4) copy of `value`."""
    T = se3.check_rigid(value, name)
    return _frozen(T, np.float64, (4, 4), name)


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
        object.__setattr__(self, "distortion", _frozen(full, np.float64, (8,), "distortion"))

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
                object.__setattr__(self, name, _rigid(T, f"{name} of view {self.index}"))
        if self.joints is not None:
            object.__setattr__(self, "joints", _frozen(self.joints, np.float64, (None,), "joints"))


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
        object.__setattr__(self, "T_ee_cam", _rigid(self.T_ee_cam, "T_ee_cam"))
        object.__setattr__(self, "T_base_board", _rigid(self.T_base_board, "T_base_board"))
        for name, shape in (
            ("covariance", (6, 6)),
            ("intrinsics_sd", (12,)),
            ("view_rms_px", (None,)),
        ):
            value = _frozen(getattr(self, name), np.float64, shape, name)
            object.__setattr__(self, name, value)

    @property
    def sigma_deg(self) -> float:
        """Largest 1-sigma of the rotation about any axis [deg]."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of the translation along any axis [mm]."""
        return float(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """A triangle mesh in metres, with colours per vertex or a texture."""

    vertices: Array
    """(V, 3) [m]."""
    faces: NDArray[np.int32]
    """(F, 3) vertex numbers, counter-clockwise seen from outside."""
    colors: NDArray[np.uint8] | None = None
    """(V, 3) RGB per vertex."""
    uv: Array | None = None
    """(V, 2) texture coordinates, v up (OBJ's convention)."""
    texture: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB texture, first row at v = 1."""

    def __post_init__(self) -> None:
        """Check indices and freeze the arrays."""
        v = _frozen(self.vertices, np.float64, (None, 3), "mesh vertices")
        f = _frozen(self.faces, np.int32, (None, 3), "mesh faces")
        if len(v) == 0 or len(f) == 0:
            raise InputError(f"the mesh is empty ({len(v)} vertices, {len(f)} faces).")
        if not np.all(np.isfinite(v)):
            raise InputError("the mesh has vertices that are not finite numbers.")
        if f.min() < 0 or f.max() >= len(v):
            raise InputError(f"the mesh's faces name vertex {f.max()} of {len(v)}.")
        object.__setattr__(self, "vertices", v)
        object.__setattr__(self, "faces", f)
        if self.colors is not None:
            object.__setattr__(
                self, "colors", _frozen(self.colors, np.uint8, (len(v), 3), "colors")
            )
        if self.uv is not None:
            object.__setattr__(self, "uv", _frozen(self.uv, np.float64, (len(v), 2), "uv"))
        if self.texture is not None:
            t = _frozen(self.texture, np.uint8, (None, None, 3), "texture")
            object.__setattr__(self, "texture", t)

    @property
    def bounds(self) -> Array:
        """(2, 3) least and greatest corner [m]."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def extent(self) -> Array:
        """(3,) size of the axis-aligned box [m]."""
        return self.vertices.max(0) - self.vertices.min(0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectModel:
    """A known object: its mesh at metric scale, its symmetries and its matter."""

    obj_id: int
    """BOP object id, 1 or more."""
    name: str
    mesh: Mesh
    symmetries: Array = field(default_factory=lambda: np.eye(4)[None])
    """(S, 4, 4) discrete symmetries T_obj_obj, the identity first."""
    symmetry_axes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """Continuous symmetries: (axis, point on it [m])."""
    density: float = 1000.0
    """[kg/m^3]; the paper's value for every object."""

    def __post_init__(self) -> None:
        """Check the id, the symmetries and the density."""
        if self.obj_id < 1:
            raise InputError(f"object '{self.name}' has the id {self.obj_id}; BOP ids start at 1.")
        if not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"object '{self.name}' has the density {self.density} kg/m^3.")
        S = se3.check_rigid(np.atleast_3d(self.symmetries), f"symmetries of '{self.name}'")
        object.__setattr__(self, "symmetries", _frozen(S, np.float64, (None, 4, 4), "symmetries"))

    @property
    def diameter_m(self) -> float:
        """Greatest distance between two vertices [m] (BOP's diameter)."""
        from realsim.geometry.mesh import diameter

        return diameter(self.mesh)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectPose:
    """Where one instance of an object is, how sure that is, and what was checked."""

    obj_id: int
    instance: int
    """Number of this instance in the scene, 0 or more; unique in the scene."""
    T_world_obj: Array
    """(4, 4) object in world [m]."""
    covariance: Array | None = None
    """(6, 6) of the right perturbation, rotation first [rad, m]."""
    checks: dict[str, float] = field(default_factory=dict[str, float])
    """Named checks without ground truth, e.g. agree (share of pixels that agree with the depth)."""
    verdict: Verdict = "unchecked"
    reasons: tuple[str, ...] = ()
    """Why the verdict is not 'accepted'."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze the arrays."""
        name = f"T_world_obj of object {self.obj_id} (instance {self.instance})"
        object.__setattr__(self, "T_world_obj", _rigid(self.T_world_obj, name))
        if self.covariance is not None:
            C = _frozen(self.covariance, np.float64, (6, 6), "covariance")
            object.__setattr__(self, "covariance", C)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SupportPlane:
    """The plane the objects stand on; frame `table`: origin on the plane, z up out of it."""

    T_world_table: Array
    """(4, 4) table in world [m]."""
    rms_m: float = 0.0
    """RMS distance of the points that carry the plane [m]."""
    inliers: int = 0
    """How many points carry it."""

    def __post_init__(self) -> None:
        """Check that the frame is rigid and freeze it."""
        object.__setattr__(self, "T_world_table", _rigid(self.T_world_table, "T_world_table"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scene:
    """A registered scene: objects on a support plane."""

    name: str
    objects: tuple[ObjectPose, ...]
    plane: SupportPlane | None = None

    def __post_init__(self) -> None:
        """Check that the instances are unique."""
        instances = [o.instance for o in self.objects]
        if len(set(instances)) != len(instances):
            raise InputError(f"scene '{self.name}' has two objects with the same instance number.")

    def object(self, instance: int) -> ObjectPose:
        """Return the object with this instance number.

        Raises:
            InputError: there is none.
        """
        for o in self.objects:
            if o.instance == instance:
                return o
        raise InputError(
            f"instance {instance} is not in scene '{self.name}'; it has "
            f"{', '.join(str(o.instance) for o in self.objects) or 'no objects'}."
        )


STAGES = ("close", "lift", "oscillate", "pendulum")
"""The four stages of the slip test, in order."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspSet:
    """The grasp candidates of one object instance and what physics said of each.

    Frame `grasp`: origin between the fingertips, z = approach, y = closing axis.
    """

    obj_id: int
    instance: int
    Ts_obj_grasp: Array
    """(N, 4, 4) grasp in object [m]."""
    widths_m: Array
    """(N,) distance of the two contacts along the closing axis [m]."""
    scores: Array
    """(N,) in [0, 1]; NaN = not tried."""
    base_scores: Array
    """(N,) 0, 0.25, 0.5, 0.75 or 1: the stage reached; NaN = not tried."""
    slip_m: Array
    """(N, 4) slip relative to the gripper in each stage [m]; NaN = not executed, inf = lost."""
    slip_rad: Array
    """(N, 4) rotation relative to the gripper in each stage [rad]; NaN, inf likewise."""
    reachable: NDArray[np.bool_]
    """(N,) whether the arm has a collision-free trajectory to closure."""
    failures: tuple[str, ...]
    """(N,) why the grasp stopped where it stopped; '' = passed all."""
    parameters: dict[str, Any] = field(default_factory=dict[str, Any])
    """Everything the scores depend on, as plain JSON values."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same grasps and freeze them."""
        T = np.asarray(self.Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
        n = len(T)
        if n:
            T = se3.check_rigid(T, f"grasps of instance {self.instance}")
        object.__setattr__(self, "Ts_obj_grasp", _frozen(T, np.float64, (n, 4, 4), "Ts_obj_grasp"))
        for name in ("widths_m", "scores", "base_scores"):
            object.__setattr__(self, name, _frozen(getattr(self, name), np.float64, (n,), name))
        for name in ("slip_m", "slip_rad"):
            value = np.asarray(getattr(self, name), dtype=np.float64).reshape(n, len(STAGES))
            object.__setattr__(self, name, _frozen(value, np.float64, (n, len(STAGES)), name))
        object.__setattr__(self, "reachable", _frozen(self.reachable, np.bool_, (n,), "reachable"))
        if len(self.failures) != n:
            raise InputError(f"{len(self.failures)} failure notes for {n} grasps.")

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.Ts_obj_grasp)

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) whether the grasp is good: score >= 0.5."""
        return np.nan_to_num(self.scores, nan=-1.0) >= 0.5


def names_of(models: Sequence[ObjectModel]) -> str:
    """Return the models as 'name (id)' for an error message."""
    return ", ".join(f"{m.name} ({m.obj_id})" for m in models) or "none"
