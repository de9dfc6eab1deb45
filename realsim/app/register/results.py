"""A registration as it lies in SESSION/registration, read again; see `register_files`.

How certain a pose is, with turns that change nothing set aside.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene, View
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.search.records import NotPlaced
from realsim.store import SessionStore, load_scene
from realsim.untrusted.own_json import array_from_json, number_from_json

Json = dict[str, Any]
FOLDER = "registration"
SCENE_FILE = f"{FOLDER}/scene.json"
TABLE_FILE = f"{FOLDER}/scene_table.json"
VIEWS_FILE = f"{FOLDER}/views.json"
CAMERAS_FILE = f"{FOLDER}/cameras.json"
SINGLE_FILE = f"{FOLDER}/single_view.json"
REPORT_FILE = f"{FOLDER}/report.json"
NEXT_FILE = f"{FOLDER}/next.json"
PAGE_FILE = f"{FOLDER}/register.html"
PICTURES = f"{FOLDER}/pictures"
STAGE_FILE = "stages/register.json"
FORMAT_VERSION = 1
SAME = 1e-11
"""Camera poses that differ by less are the same [m, rad]: making a rotation orthonormal twice
changes the last bit."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CameraChange:
    """Cameras before and after a registration."""

    claimed: dict[int, Array]
    """View -> (4, 4) T_world_cam as robot and calibration say [m]; all views that have one."""
    refined: dict[int, Array]
    """View -> (4, 4) as the registration found it [m]; only the views that took part."""

    @property
    def session(self) -> dict[int, Array]:
        """View -> (4, 4) what the session's views have from now on."""
        return self.claimed | self.refined


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that is wrong with a view, or with the scene."""

    view: int | None
    """Number of the view; None = of no one view."""
    kind: str
    words: str


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Registered:
    """A registration as it lies in a session."""

    scene: Scene
    single_view: Scene
    """The baseline."""
    cameras: CameraChange
    seen: dict[int, dict[int, SeenPose]]
    """View -> instance -> its pose there; NaN where an uncertainty is not known."""
    not_placed: tuple[NotPlaced, ...]
    remarks: tuple[Remark, ...]
    report: Json
    fixed: dict[str, CameraChange] = field(default_factory=dict[str, CameraChange])
    """The cameras that stand still, by name; of a registration that is read again they are in their
    own sessions (`store.cameras`)."""

    @property
    def is_usable(self) -> bool:
        """Whether anything was placed that is not rejected."""
        return any(o.verdict != "rejected" for o in self.scene.objects)


# --- reading ----------------------------------------------------------------------------------


def is_same_pose(a: Array, b: Array) -> bool:
    """Whether two poses are the same but for rounding."""
    return bool(np.allclose(a, b, rtol=0.0, atol=SAME))


def is_same_cameras(a: Mapping[int, Array], b: Mapping[int, Array]) -> bool:
    """Whether two sets of cameras are of the same views and the same but for rounding."""
    return set(a) == set(b) and all(is_same_pose(a[k], b[k]) for k in a)


def load_cameras(store: SessionStore) -> CameraChange | None:
    """Return the cameras before and after the registration; None if there was none."""
    return cameras_from_json(store.read_json(CAMERAS_FILE)) if store.has(CAMERAS_FILE) else None


def claimed_cameras(store: SessionStore) -> dict[int, Array]:
    """Return where the cameras are claimed to be, view by view.

    A view whose camera is the one that a registration set was claimed to be where the record says;
    any other has been calibrated since, and is its own claim.
    """
    now, record = store.session.Ts_world_cam, load_cameras(store)
    if record is None:
        return now
    return {
        k: record.claimed[k]
        if k in record.refined and k in record.claimed and is_same_pose(T, record.refined[k])
        else T
        for k, T in now.items()
    }


def keep_refined(store: SessionStore, claimed: Mapping[int, Array]) -> dict[int, Array]:
    """Return cameras that are about to be claimed, refined where that has been done of the same.

    A calibration that is run again and finds the same must not undo what the objects are placed by.
    """
    record = load_cameras(store)
    if record is None:
        return dict(claimed)
    out: dict[int, Array] = {}
    for k, T in claimed.items():
        stored = View(index=k, T_world_cam=T).T_world_cam
        known = stored is not None and k in record.claimed
        same = known and k in record.refined and is_same_pose(np.asarray(stored), record.claimed[k])
        out[k] = record.refined[k] if same else T
    return out


def load_seen(store: SessionStore) -> dict[int, dict[int, SeenPose]]:
    """Return view -> instance -> its pose there with covariance and pixel uncertainty."""
    if not store.has(VIEWS_FILE):
        return {}
    views: Json = store.read_json(VIEWS_FILE)["views"]
    return {
        int(index): {
            int(instance): SeenPose(
                T_cam_obj=array_from_json(row["T_cam_obj"]),
                covariance=array_from_json(row["covariance"], (6, 6)),
                sigma_px=number_from_json(row["sigma_px"]),
            )
            for instance, row in rows.items()
        }
        for index, rows in views.items()
    }


def load_registered(store: SessionStore) -> Registered:
    """Return the registration of a session.

    Raises:
        InputError: there is none, or a file of it is missing.
    """
    report: Json = store.read_json(REPORT_FILE)
    scene = load_scene(store)
    single = (
        load_scene(store, SINGLE_FILE) if store.has(SINGLE_FILE) else replace(scene, objects=())
    )
    cameras = load_cameras(store)
    missing: Sequence[Json] = report.get("not_placed", ())
    findings: Sequence[Json] = report.get("findings", ())
    return Registered(
        scene=scene, single_view=single,
        cameras=cameras or CameraChange(claimed=store.session.Ts_world_cam, refined={}),
        seen=load_seen(store),
        not_placed=tuple(NotPlaced(**m) for m in missing),
        remarks=tuple(Remark(f.get("view"), f["kind"], f["words"]) for f in findings),
        report=report,
    )  # fmt: skip


def with_objects(result: Registered, objects: Sequence[ObjectPose]) -> Registered:
    """Return a registration with other objects: those of its instances, perhaps elsewhere, or more.

    How sure a view is of an object is known only of one that has a covariance.
    """
    seen: dict[int, dict[int, SeenPose]] = {}
    for view, T_world_cam in result.cameras.refined.items():
        seen[view] = {}
        for o in objects:
            T_cam_obj = se3.invert(T_world_cam) @ o.T_world_obj
            old = result.seen.get(view, {}).get(o.instance)
            if old is None or o.covariance is None:
                unknown = np.full((6, 6), np.nan)
                old = SeenPose(T_cam_obj=T_cam_obj, covariance=unknown, sigma_px=np.nan)
            seen[view][o.instance] = replace(old, T_cam_obj=T_cam_obj)
    there = {o.instance for o in objects}
    return replace(
        result, scene=replace(result.scene, objects=tuple(objects)), seen=seen,
        not_placed=tuple(n for n in result.not_placed if n.instance not in there),
    )  # fmt: skip


def stand_alone(scene: Scene) -> Registered:
    """Return a scene of which nothing else is known."""
    return Registered(
        scene=scene, single_view=replace(scene, objects=()),
        cameras=CameraChange(claimed={}, refined={}), seen={}, not_placed=(), remarks=(),
        report={},
    )  # fmt: skip


def cameras_from_json(value: Json) -> CameraChange:
    """Return the cameras of `cameras.json`."""
    return CameraChange(
        claimed=poses_from_json(value["claimed"]), refined=poses_from_json(value["refined"])
    )


def poses_from_json(value: Json) -> dict[int, Array]:
    """Return poses by view."""
    return {int(k): np.array(T, dtype=np.float64) for k, T in value.items()}


DEPENDENT = 1e-3
"""An axis whose direction the others give to this adds no freedom."""


def held(covariance: ArrayLike, directions: Sequence[ArrayLike]) -> Array:
    """Return a pose's covariance (6, 6) given that it does not turn about some directions.

    A turn about an axis of revolution changes nothing, so it may be said to be none. The rest is
    then known better than the marginal says: with a = (u, 0) the direction of the turn,

        C' = C - C A (A^T C A)^-1 A^T C,   A = the directions as columns

    (Gaussian conditioning). Projecting the marginal instead leaves sin(t)^2 of the free turn's
    variance where covariance and declared axis differ by t: at 2 degrees, thousands of times the
    variance that is asked for.

    Args:
        covariance: (6, 6) of the right perturbation, rotation first [rad, m].
        directions: (3,) each, in the object's frame.
    """
    C = np.asarray(covariance, dtype=np.float64)
    basis: list[Array] = []
    for direction in directions:
        u = np.asarray(direction, dtype=np.float64)
        u = u / np.linalg.norm(u)
        rest = u - sum((np.dot(u, b) * b for b in basis), np.zeros(3))
        if np.linalg.norm(rest) > DEPENDENT:
            basis.append(rest / np.linalg.norm(rest))
    if len(basis) == 2:  # turns about two directions make every turn
        basis.append(np.cross(basis[0], basis[1]))
    if not basis:
        return C
    A = np.zeros((6, len(basis)))
    A[:3] = np.stack(basis, axis=1)
    seen = A.T @ C @ A
    return C - C @ A @ np.linalg.pinv(seen, hermitian=True) @ A.T @ C


def sigmas(covariance: Any, model: ObjectModel | None) -> tuple[float, float]:
    """Return what `largest` does, a model's axes of revolution set aside."""
    return largest(covariance, [] if model is None else [axis for axis, _ in model.symmetry_axes])


def largest(covariance: Any, axes: Sequence[ArrayLike]) -> tuple[float, float]:
    """Return the largest 1 sigma along and about any axis [mm, deg]; NaN = not known.

    Args:
        covariance: (6, 6) of the right perturbation, rotation first [rad, m]; None = not known.
        axes: (3,) of revolution, which are set aside.
    """
    if covariance is None or not np.all(np.isfinite(covariance)):
        return float("nan"), float("nan")
    C = held(covariance, axes)
    shift, turn = (float(np.linalg.eigvalsh(c)[-1]) for c in (C[3:, 3:], C[:3, :3]))
    return 1e3 * float(np.sqrt(max(shift, 0.0))), float(np.degrees(np.sqrt(max(turn, 0.0))))
