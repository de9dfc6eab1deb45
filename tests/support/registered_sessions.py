"""Small sessions of known objects on a table, and registrations of them made by hand."""

from pathlib import Path

import numpy as np

from begun_sessions import begun, light_things
from plain_meshes import square
from realsim.app.register.files import write_result
from realsim.app.register.results import CameraChange, Registered, Remark
from realsim.arrays import Array
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene, SupportPlane, View
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.search.records import NotPlaced
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from shared_sessions import copy_of

CAMERA = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
NAMES = ("mug", "wedge")
PLACES = ((0.07, 0.0, 0.3), (-0.08, 0.03, 1.2))
"""x, y [m] and turn about z [rad] of the objects."""


def models_of() -> dict[int, ObjectModel]:
    """Return the objects of all sessions."""
    return {m.obj_id: m for m in (part(n) for n in NAMES)}


def true_poses() -> list[ObjectPose]:
    """Return where the objects stand, on the table z = 0."""
    poses: list[ObjectPose] = []
    for k, (name, (x, y, turn)) in enumerate(zip(NAMES, PLACES, strict=True)):
        model = part(name)
        T = se3.from_translation([x, y, -model.mesh.bounds[0, 2]]) @ se3.exp([0, 0, turn, 0, 0, 0])
        poses.append(ObjectPose(obj_id=model.obj_id, instance=k, T_world_obj=T))
    return poses


def true_cameras(views: int, *, posed: bool = True) -> list[Array]:
    """Return cameras around the table: at two heights, or led by hand in steps of 5 degrees."""
    out: list[Array] = []
    for k in range(views):
        a = 2 * np.pi * k / views if posed else np.radians(5.0 * k)
        eye = [0.34 * np.cos(a), 0.34 * np.sin(a), 0.26 + 0.12 * (k % 2 if posed else 0.5)]
        out.append(se3.look_at(eye, [0.0, 0.0, 0.03]))
    return out


def table_renderer() -> LabelRenderer:
    """Return what renders the objects on the table, a square metre of the plane z = 0."""
    models = models_of()
    placed = [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in true_poses()]
    return LabelRenderer([*placed, PlacedMesh(-1, square(0.5), np.eye(4))])


def table_session(
    folder: Path, views: int = 8, sigma: tuple[float, float] = (2e-3, 6e-4), seed: int = 1, *,
    posed: bool = True,
) -> SessionStore:  # fmt: skip
    """Return a session with rendered depth whose claimed cameras are a little off.

    Args:
        folder: where it is made.
        views: how many.
        sigma: of the cameras' errors [rad, m].
        seed: of these errors.
        posed: False leaves the cameras' poses out, as of a camera led by hand.
    """
    rng, renderer = np.random.default_rng(seed), table_renderer()
    store = begun(folder, CAMERA, {"gravity_up_world": [0, 0, 1]})
    for k, T in enumerate(true_cameras(views, posed=posed)):
        labels = renderer.render(CAMERA, T)
        claimed = T @ se3.exp(rng.normal(size=6) * np.repeat(sigma, 3)) if posed else None
        store.add_view(View(index=k, T_world_cam=claimed), light_things(labels.ids), labels.depth_m)
    save_models(store.folder / "models", models_of())
    return store


def registered_by_hand(store: SessionStore, *, left_out: int | None = None) -> Registered:
    """Return a registration of a session: the truth, with plausible uncertainties.

    Args:
        store: a session of `table_session`.
        left_out: a view that took no part.
    """
    claimed = {v.index: v.T_world_cam for v in store.session.views if v.T_world_cam is not None}
    kept = claimed.keys() - {left_out}
    cameras = {k: T for k, T in enumerate(true_cameras(len(claimed))) if k in kept}
    C = np.diag([3e-3, 2e-3, 1e-3, 3e-4, 2e-4, 1e-4]) ** 2
    objects = [
        ObjectPose(
            obj_id=o.obj_id, instance=o.instance, T_world_obj=o.T_world_obj, covariance=C,
            checks={"agree": 0.99, "probability": 0.97 - 0.4 * k}, verdict=verdict,
            reasons=() if verdict == "accepted" else ("half of it is hidden.",),
        )
        for k, (o, verdict) in enumerate(zip(true_poses(), ("accepted", "doubtful"), strict=True))
    ]  # fmt: skip

    def seen(k: int, o: ObjectPose) -> SeenPose:
        T_cam_obj = se3.invert(cameras[k]) @ o.T_world_obj
        return SeenPose(T_cam_obj=T_cam_obj, covariance=2 * C, sigma_px=0.1 * (k + 1))

    return Registered(
        scene=Scene(
            name="two objects", objects=tuple(objects),
            plane=SupportPlane(T_world_table=np.eye(4), rms_m=2e-4, inliers=900),
        ),
        single_view=Scene(name="two objects (single view)", objects=()),
        cameras=CameraChange(claimed=claimed, refined=cameras),
        seen={k: {o.instance: seen(k, o) for o in objects} for k in cameras},
        not_placed=(NotPlaced(obj_id=14, instance=7, reason="nothing there looks like it."),),
        remarks=(Remark(view=2, kind="little_depth", words="view 2 has hardly any depth."),),
        report={
            "asked": {"method": "joint"},
            "refinement": {
                "hand_eye_mm": 0.47, "hand_eye_deg": 0.11,
                "views": {str(k): {"shift_mm": 0.19, "turn_deg": 0.03} for k in cameras},
            },
        },
    )  # fmt: skip


def registered_copy(folder: Path, to: Path) -> SessionStore:
    """Return a copy of a session of `table_session` that is registered by hand."""
    store = SessionStore.open(copy_of(folder, to))
    write_result(store, registered_by_hand(store), models_of(), {})
    return store
