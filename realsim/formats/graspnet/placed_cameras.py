"""Where the cameras stood: as the source tells, or from objects that stand still."""

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3

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
