"""Camera poses as GraspNet-1Billion stores them: npy files in a camera's folder.

`camera_poses.npy` (N, 4, 4) holds every camera in the FIRST camera's frame, `cam0_wrt_table.npy`
(4, 4) the first camera in the table's frame, so that

    T_table_cam[i] = cam0_wrt_table @ camera_poses[i]

in metres, cameras as OpenCV's (generate_scene_model of graspnetAPI). `camK.npy` (3, 3) is the
camera matrix [px].

Where the cameras stood: as the source tells, or from objects that stand still.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Array32
from realsim.errors import InputError, UnitError
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
from realsim.untrusted.arrays import read_npy

POSES, FIRST, MATRIX = "camera_poses.npy", "cam0_wrt_table.npy", "camK.npy"
MOST_VIEWS = 100_000
"""A file with more is no camera poses."""
FARTHEST_M = 20.0
"""Cameras about a table are nearer to each other, and to it; a greater number is millimetres."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CameraFiles:
    """What the npy files of a camera's folder say; None = the file is not there."""

    poses: Array | None
    """(N, 4, 4) as in the file: camera i in camera 0 [m]."""
    first: Array | None
    """(4, 4) as in the file: camera 0 in table [m]."""
    K: Array | None
    """(3, 3) [px]."""


def read_camera_poses(folder: Path | str) -> Array:
    """Return T_table_cam (N, 4, 4) [m] of a camera's folder.

    Raises:
        InputError: a file is missing, or is not what it should be.
        NotRigidError: a matrix is not a rigid transform.
    """
    folder = Path(folder)
    for name in (FIRST, POSES):
        if not (folder / name).is_file():
            raise InputError(
                f"there is no {folder / name}; a GraspNet camera folder holds {POSES} and {FIRST}."
            )
    found = read_camera_files(folder)
    assert found.first is not None and found.poses is not None
    first = se3.check_rigid(found.first, str(folder / FIRST))
    return first @ se3.check_rigid(found.poses, str(folder / POSES))


def read_camera_files(folder: Path) -> CameraFiles:
    """Return what the npy files of a camera's folder say, their shapes and units checked.

    Raises:
        InputError: a file is damaged, or has another shape.
        NotRigidError: a matrix is not a rigid transform.
        UnitError: translations in millimetres.
    """
    poses, first = _optional(folder / POSES), _optional(folder / FIRST)
    K = _optional(folder / MATRIX)
    if first is not None and first.shape != (4, 4):
        raise InputError(f"{folder / FIRST} has the shape {first.shape}; (4, 4) is needed.")
    if poses is not None and (poses.ndim != 3 or poses.shape[1:] != (4, 4)):
        raise InputError(f"{folder / POSES} has the shape {poses.shape}; (N, 4, 4) is needed.")
    if poses is not None and not 0 < len(poses) <= MOST_VIEWS:
        raise InputError(f"{folder / POSES} holds {len(poses)} poses; 1 to {MOST_VIEWS} are read.")
    if K is not None and K.shape != (3, 3):
        raise InputError(f"{folder / MATRIX} has the shape {K.shape}; (3, 3) is needed.")
    if K is not None and not np.all(np.isfinite(K)):
        raise InputError(f"{folder / MATRIX} holds numbers that are not finite.")
    for name, Ts in ((FIRST, first), (POSES, poses)):
        if Ts is None:
            continue
        se3.check_rigid(Ts, str(folder / name))
        far = float(np.max(np.linalg.norm(Ts[..., :3, 3], axis=-1)))
        if far > FARTHEST_M:
            raise UnitError(
                f"{folder / name} holds a translation of {far:g}; it is in metres, and no camera "
                f"about a table is {FARTHEST_M:g} m away. If the file is in millimetres, divide "
                "its translations by 1000."
            )
    return CameraFiles(poses=poses, first=first, K=K)


def npy_bytes(array: Array | Array32) -> bytes:
    """Return an array as the bytes of a npy file."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def _optional(path: Path) -> Array | None:
    """Return the numbers of a file, None where there is none.

    Raises:
        InputError: not an array of real numbers.
    """
    if not path.is_file():
        return None
    array = read_npy(path, most_bytes=MOST_VIEWS * 16 * 8 + 4096)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path} has the type {array.dtype}; an array of numbers is needed.")
    return np.array(array, dtype=np.float64)


SPREAD_LIMIT_M = 0.010
"""Camera poses by several objects may differ by so much, no more."""


class CameraPlacer:
    """Places frame after frame in the frame of the first camera by the objects they show."""

    def __init__(self) -> None:
        """Begin without a frame."""
        self._known: dict[tuple[int, int | None], Array] = {}
        self._waiting: list[tuple[int, dict[tuple[int, int | None], Array]]] = []
        self.Ts_0_cam: dict[int, Array] = {}
        self.worst_m = 0.0
        """Largest distance of one object's answer from the median of all [m]."""

    def add(self, frame: LabelledFrame) -> None:
        """Take in the next frame; one without a known object waits for those that come."""
        seen = _objects(frame.objects)
        if not self.Ts_0_cam:
            self._place(frame.index, seen, np.eye(4))
            return
        self._waiting.append((frame.index, seen))
        while self._place_one():
            pass

    def require_all(self, name: str) -> None:
        """Check that every frame has found its place.

        Raises:
            InputError: a frame shows no object that another one shows.
        """
        if self._waiting:
            raise InputError(
                f"image {self._waiting[0][0]} of {name} has no camera pose and no object in common "
                "with the others; its place cannot be found, and GraspNet's camera_poses.npy needs "
                "one for each image."
            )

    def _place_one(self) -> bool:
        for k, (index, seen) in enumerate(self._waiting):
            shared = [key for key in seen if key in self._known]
            if shared:
                Ts = np.stack([self._known[key] @ se3.invert(seen[key]) for key in shared])
                del self._waiting[k]
                self._place(index, seen, self._mean(Ts, index))
                return True
        return False

    def _mean(self, Ts: Array, index: int) -> Array:
        centre = np.median(Ts[:, :3, 3], axis=0)
        spread = float(np.max(np.linalg.norm(Ts[:, :3, 3] - centre, axis=1)))
        if spread > SPREAD_LIMIT_M:
            raise InputError(
                f"image {index} has no camera pose, and its objects disagree by "
                f"{1e3 * spread:.0f} mm about where the camera stood (at most "
                f"{1e3 * SPREAD_LIMIT_M:.0f} mm): they were moved, or an annotation is wrong. "
                "Leave such images out, or write them as scenes of their own."
            )
        self.worst_m = max(self.worst_m, spread)
        return se3.from_rt(se3.mean_rotation(Ts[:, :3, :3]), centre)

    def _place(self, index: int, seen: dict[tuple[int, int | None], Array], T: Array) -> None:
        self.Ts_0_cam[index] = T
        for key, T_cam_obj in seen.items():
            self._known.setdefault(key, T @ T_cam_obj)


def _objects(objects: tuple[LabelledObject, ...]) -> dict[tuple[int, int | None], Array]:
    """Return T_cam_obj of the objects that can be known again in another image."""
    ids = [o.obj_id for o in objects]
    return {
        (o.obj_id, o.instance): o.T_cam_obj
        for o in objects
        if o.instance is not None or ids.count(o.obj_id) == 1
    }
