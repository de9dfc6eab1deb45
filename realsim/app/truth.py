"""How far the loop's results are from the truth of the simulated lab."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from realsim.formats.bop.labels import mask_path
from realsim.geometry import se3
from realsim.geometry.metrics import mask_iou, mssd_symmetric
from realsim.records import Scene
from realsim.store import SessionStore
from realsim_capture_plans.lab import LabTruth, load_truth

IOU_VIEWS = 24
"""Masks are compared with the true ones in at most so many views, evenly spread."""
GOALS = {"handeye_mm": 0.5, "handeye_deg": 0.1, "object_mssd_mm": 1.0, "mask_iou": 0.95}
"""What the default demo (24 views) must reach."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LoopErrors:
    """Errors against the truth, one field a quantity; never mixed into one number."""

    handeye_mm: float
    """Translation error of T_ee_cam [mm]."""
    handeye_deg: float
    """Rotation error of T_ee_cam [deg]."""
    mount_mm: float
    """Distance of T_ee_cam from the mount that the arm's mean error makes it look like [mm]: what
    is left when the part that no camera can tell from another mount is taken out."""
    camera_mm: float
    """Median error of the camera centres through the robot pose [mm]."""
    camera_deg: float
    """Median rotation error of the camera poses [deg]."""
    object_mssd_mm: dict[int, float]
    """Per instance: greatest vertex distance, least over the symmetries [mm]."""
    single_view_mssd_mm: dict[int, float]
    """The same for ICP in the top-down view alone, the paper's way [mm]."""
    mask_iou: dict[int, float]
    """Per instance: mean intersection over union with the true visible masks."""
    iou_views: int
    """Views in which masks were compared."""

    def figures(self) -> dict[str, float]:
        """Return the figures that have goals."""
        return {
            "handeye_mm": self.handeye_mm,
            "handeye_deg": self.handeye_deg,
            "object_mssd_mm": float(np.median(list(self.object_mssd_mm.values()))),
            "mask_iou": float(np.mean(list(self.mask_iou.values()))),
        }

    def rows(self) -> list[list[str]]:
        """Return the table's rows: figure, measured, goal."""
        f = self.figures()
        worst = max(self.object_mssd_mm.values())
        single = float(np.median(list(self.single_view_mssd_mm.values())))
        return [
            ["hand-eye translation", f"{f['handeye_mm']:.3f} mm", f"<= {GOALS['handeye_mm']} mm"],
            ["hand-eye rotation", f"{f['handeye_deg']:.4f} deg", f"<= {GOALS['handeye_deg']} deg"],
            ["hand-eye less the arm's mean error", f"{self.mount_mm:.3f} mm", ""],
            ["camera centre, median view", f"{self.camera_mm:.3f} mm", ""],
            ["camera rotation, median view", f"{self.camera_deg:.4f} deg", ""],
            ["object MSSD, median", f"{f['object_mssd_mm']:.3f} mm",
             f"<= {GOALS['object_mssd_mm']} mm"],
            ["object MSSD, worst", f"{worst:.3f} mm", ""],
            ["object MSSD, one top-down view (paper's way)", f"{single:.3f} mm", ""],
            [f"visible-mask IoU, mean of {self.iou_views} views", f"{f['mask_iou']:.4f}",
             f">= {GOALS['mask_iou']}"],
        ]  # fmt: skip


def loop_errors(store: SessionStore, truth_folder: Path) -> LoopErrors:
    """Compare a session with the truth of the lab that made it.

    Raises:
        InputError: the truth folder is missing or belongs to another lab.
    """
    from realsim.app.stages import session_models
    from realsim.store import load_hand_eye, load_scene

    truth = load_truth(truth_folder)
    models = session_models(store)
    reported = [(v.index, v.T_base_ee) for v in store.session.views if v.T_base_ee is not None]
    true_cameras = {v.index: v.T_world_cam for v in truth.views}
    cameras = np.stack(
        [se3.invert(true_cameras[i]) @ T for i, T in store.session.Ts_world_cam.items()]
    )
    true_objects = {o.instance: o.T_world_obj for o in truth.objects}

    seen = np.stack([se3.invert(T) @ true_cameras[i] for i, T in reported])
    mount = se3.from_rt(se3.mean_rotation(seen[:, :3, :3]), seen[:, :3, 3].mean(0))
    T_ee_cam = load_hand_eye(store).T_ee_cam
    delta = se3.invert(truth.T_ee_cam) @ T_ee_cam

    def object_errors(scene: Scene) -> dict[int, float]:
        return {
            o.instance: 1e3
            * mssd_symmetric(true_objects[o.instance], o.T_world_obj, models[o.obj_id])
            for o in scene.objects
        }

    iou, n = _mask_ious(store, truth)
    return LoopErrors(
        handeye_mm=1e3 * float(np.linalg.norm(delta[:3, 3])),
        mount_mm=1e3 * float(np.linalg.norm((se3.invert(mount) @ T_ee_cam)[:3, 3])),
        handeye_deg=float(np.degrees(se3.angle(delta))),
        camera_mm=1e3 * float(np.median(np.linalg.norm(cameras[:, :3, 3], axis=1))),
        camera_deg=float(np.degrees(np.median(se3.angle(cameras)))),
        object_mssd_mm=object_errors(load_scene(store)),
        single_view_mssd_mm=object_errors(load_scene(store, "registration/single_view.json")),
        mask_iou=iou,
        iou_views=n,
    )


def _mask_ious(store: SessionStore, truth: LabTruth) -> tuple[dict[int, float], int]:
    """Return the mean IoU of every instance's written visible masks with the true ones."""
    from realsim.app.stages import session_models
    from realsim.arrays import evenly
    from realsim.rendering.labels import LabelRenderer, PlacedMesh

    models = session_models(store)
    renderer = LabelRenderer(
        [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in truth.objects]
    )
    cameras = {v.index: v.T_world_cam for v in truth.views}
    # A view that the registration left out has no masks.
    labelled = [k for k in sorted(cameras) if store.has(f"annotations/{k:06d}.json")]
    indices = labelled or sorted(cameras)
    picked = evenly(indices, IOU_VIEWS)
    values: dict[int, list[float]] = {o.instance: [] for o in truth.objects}
    for index in picked:
        labels = renderer.render(truth.intrinsics, cameras[index])
        entries = store.read_json(f"annotations/{index:06d}.json")["objects"]
        written = {entry["instance"]: k for k, entry in enumerate(entries)}
        for i, found in values.items():
            mine = np.zeros(labels.ids.shape, dtype=bool)
            if i in written:
                mine = store.read_image(mask_path(index, written[i], visible=True)) > 0
            iou = mask_iou(labels.visible(i), mine)
            if np.isfinite(iou):
                found.append(iou)
    return {i: float(np.mean(v)) for i, v in values.items() if v}, len(picked)
