"""What `realsim scan sfm` works on: a session, or a folder of photographs, with masks."""

from dataclasses import dataclass
from pathlib import Path

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.result import Poses
from realsim.store import SessionStore


@dataclass(frozen=True, kw_only=True, slots=True)
class SfmRequest:
    """What the command was told."""

    images: Path
    """A session or a folder of photographs."""
    out: Path | None = None
    """Where to write; None: SESSION/scans/sfm, or IMAGES/sfm."""
    poses: Poses | None = None
    """'unknown', 'known', 'refined'; None: 'refined' where the session has poses."""
    intrinsics: Path | None = None
    """File with the intrinsics of a plain folder."""
    masks: Path | None = None
    """Folder of masks, one for each photograph."""
    dense: bool | None = None
    """Whether depth is fused; None: if there is any."""
    at: tuple[float, float] | None = None
    """(x, y) in world [m] near the object whose mesh is wanted; None: there is only one."""
    text: bool = False
    """Whether the COLMAP model is written as text, too."""
    seed: int = 0
    """Seed of every random choice."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SfmInputs:
    """Photographs with what is known of them."""

    paths: tuple[Path, ...]
    intrinsics: CameraIntrinsics | None
    Ts_world_cam: tuple[Array | None, ...]
    poses: Poses
    store: SessionStore | None
    """The session, None for a plain folder."""
    notes: tuple[str, ...]

    def depth_of(self, name: str) -> Array32 | None:
        """Return the depth image of a photograph of the session, None where there is none."""
        index = int(Path(name).stem)
        if self.store is None or not self.store.has_depth(index):
            return None
        return self.store.depth_m(index)

    @property
    def has_depth(self) -> bool:
        """Whether any view has depth."""
        store = self.store
        return store is not None and any(store.has_depth(v.index) for v in store.session.views)


def sfm_inputs(request: SfmRequest) -> SfmInputs:
    """Return what the command works on.

    Raises:
        InputError: no images, or a session whose poses are needed and missing.
    """
    from realsim.scanning.sfm.photographs import photographs_in

    if (request.images / "session.json").is_file():
        return _session_inputs(request)
    paths = tuple(photographs_in(request.images))
    if request.poses in ("known", "refined"):
        raise InputError(
            f"--use-poses {request.poses} needs the robot's camera poses, and '{request.images}' "
            "is a plain folder. `realsim import` makes a session of images and poses; or leave "
            "--use-poses out."
        )
    intrinsics = None
    if request.intrinsics is not None:
        from realsim.app.importing.folder import camera_of_file
        from realsim.images import image_size

        intrinsics = camera_of_file(request.intrinsics, image_size(paths[0]))
    return SfmInputs(
        paths=paths, intrinsics=intrinsics, Ts_world_cam=(None,) * len(paths), poses="unknown",
        store=None, notes=("a folder of photographs: no robot poses, so no metric scale.",),
    )  # fmt: skip


def _session_inputs(request: SfmRequest) -> SfmInputs:
    """Return a session's photographs, camera and poses."""
    from realsim.app.stages import open_session
    from realsim.store.session_store import rgb_path

    store = open_session(request.images)
    if request.intrinsics is not None:
        raise InputError("a session has its own camera; --intrinsics is for photographs.")
    views = store.session.views
    posed = len(store.session.Ts_world_cam)
    poses = request.poses or ("refined" if posed == len(views) else "unknown")
    notes: list[str] = []
    if not posed and poses != "unknown":
        raise InputError(
            f"session '{request.images}' is not calibrated: none of its {len(views)} views has a "
            "camera pose. `realsim calibrate SESSION` finds them; --use-poses unknown maps "
            "without, and without a metric scale."
        )
    if not posed:
        notes.append(
            "the session is not calibrated: no camera poses, so no metric scale. `realsim "
            "calibrate SESSION` gives both."
        )
    elif posed < len(views) and request.poses is None:
        notes.append(f"{len(views) - posed} views have no camera pose, so poses are 'unknown'.")
    if not any(store.has_depth(v.index) for v in views):
        notes.append("the session has no depth images: no second scale, and no mesh.")
    return SfmInputs(
        paths=tuple(store.path(rgb_path(v.index)) for v in views),
        intrinsics=store.session.intrinsics,
        Ts_world_cam=tuple(v.T_world_cam for v in views),
        poses=poses, store=store, notes=tuple(notes),
    )  # fmt: skip


def sfm_masks(request: SfmRequest, inputs: SfmInputs) -> dict[str, Mask] | None:
    """Return the masks by the photographs' names."""
    from realsim.images import read_grey

    if request.masks is None:
        return None
    found: dict[str, Mask] = {}
    for path in inputs.paths:
        places = [request.masks / f"{stem}.png" for stem in (path.stem, path.name)]
        mask = next((p for p in places if p.is_file()), None)
        if mask is None:
            raise InputError(
                f"'{request.masks}' has no mask for {path.name}: {path.stem}.png is expected, "
                "white where features may lie."
            )
        found[path.name] = read_grey(mask) > 0
    return found
