"""Real data: single frames of YCB-Video.

Imported by the registration benchmark. Figures:
  real_start_spread_mm, real_start_spread_deg
                        scenes 50, 51, 54: from the published pose and from a network's estimate to
                        the same pose; the worst of the objects that are not symmetric. Estimates
                        that turn a cuboid half round are named and not counted: depth cannot tell
  real_start_spread_median_mm
                        the same, median
  real_dz_mm_ours, real_dz_mm_truth
                        |measured - rendered depth|, median over an object's pixels, median over the
                        objects; at our pose and at the published one
  real_shift_named_share
                        scenes 52, 53, whose poses belong to a neighbouring image: does the tool
                        say by itself that all are off by one shift
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from figures import DATA
from registration_figures import Done

from realsim.arrays import Array
from realsim.formats.bop import scene as bop
from realsim.formats.bop.models import load_models
from realsim.formats.bop.scene import read_keyframe_poses
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.registration.body import footprint, make_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import DepthFrame
from realsim.registration.register import Registration, register_scene

MATCHING, SHIFTED = (50, 51, 54), (52, 53)
SYMMETRIC = (1, 4, 6, 13, 16, 18, 19, 20, 21)
"""Cans, the bowl, block, marker, clamps and brick: BOP names them symmetric, or a single view of
depth cannot tell the turn."""
TURNED_DEG = 90.0
"""A network's estimate that is turned further is of another pose."""
NEAR_M = 0.03
"""Pixels further from the rendered depth are another object's [m]."""


def real(keep: Path | None) -> Done:
    """Return the figures of the real data; not run where there is none."""
    del keep
    figures: dict[str, float] = {}
    notes: list[str] = []
    if (DATA / "scenes/ycbv_mini").is_dir():
        _add_ycbv(figures, notes)
    else:
        notes.append(f"no ycbv_mini under {DATA} (set REALSIM_DATA): real_* not run")
    return Done(figures=figures, notes=tuple(notes))


def ycbv_frame(
    scene_id: int,
) -> tuple[
    CameraIntrinsics, DepthFrame, dict[int, ObjectModel], list[ObjectPose], list[ObjectPose]
]:
    """Return camera, frame, models, published poses, and a network's of one scene.

    The world is the camera. A network's list lacks objects that it did not find.
    """
    root = DATA / "scenes/ycbv_mini"
    ref = next(r for r in bop.find_scenes(root) if r.scene_id == scene_id)
    scene = bop.read_scene(ref)
    (view,) = scene.session.views
    models = load_models(root / "models", [a.obj_id for a in scene.ground_truth[view.index]])
    truth = [
        ObjectPose(obj_id=a.obj_id, instance=k, T_world_obj=a.T_cam_obj)
        for k, a in enumerate(scene.ground_truth[view.index])
    ]
    network: list[ObjectPose] = []
    if scene_id in MATCHING:
        found = read_keyframe_poses(root, scene_id, view.index, source="cosypose")
        network = [replace(p, T_world_obj=found[p.obj_id]) for p in truth if p.obj_id in found]
    frame = DepthFrame(index=view.index, depth_m=scene.depth_m(view.index), T_world_cam=np.eye(4))
    return scene.session.intrinsics, frame, models, truth, network


def registered(scene_id: int, source: str) -> Registration:
    """Return the registration of a scene's frame from 'truth' or from the 'network'."""
    intrinsics, frame, models, truth, network = ycbv_frame(scene_id)
    starts = truth if source == "truth" else network
    config = RegistrationConfig(with_single_view=False)
    return register_scene(f"ycbv {scene_id}", intrinsics, [frame], models, starts, config)


def median_dz_mm(
    intrinsics: CameraIntrinsics, frame: DepthFrame, model: ObjectModel, T_cam_obj: Array
) -> float:
    """Return the median |measured - rendered depth| over an object's pixels [mm]."""
    pose = ObjectPose(obj_id=model.obj_id, instance=0, T_world_obj=T_cam_obj)
    body = make_body(pose, model, 32, 100)
    seen = footprint(body, intrinsics, T_cam_obj, 1)
    measured = frame.depth_m[seen.rows, seen.columns].astype(np.float64)
    dz = np.abs(measured - seen.z)
    own = (measured > 0) & (dz < NEAR_M)
    return 1e3 * float(np.median(dz[own])) if own.any() else float("nan")


def _add_ycbv(figures: dict[str, float], notes: list[str]) -> None:
    """Add the figures of the frames of YCB-Video."""
    spread: list[tuple[float, float]] = []
    ours: list[float] = []
    published: list[float] = []
    for scene_id in MATCHING:
        intrinsics, frame, models, truth, network = ycbv_frame(scene_id)
        said_by = {p.instance: p for p in network}
        first, second = registered(scene_id, "truth"), registered(scene_id, "network")
        for p in first.scene.objects:
            model = models[p.obj_id]
            ours.append(median_dz_mm(intrinsics, frame, model, p.T_world_obj))
            said = next(t for t in truth if t.instance == p.instance)
            published.append(median_dz_mm(intrinsics, frame, model, said.T_world_obj))
            other = [q for q in second.scene.objects if q.instance == p.instance]
            apart = [apart_by(model, p.T_world_obj, q.T_world_obj) for q in other]
            start = said_by.get(p.instance, said)
            turned = apart_by(model, said.T_world_obj, start.T_world_obj)[1] > TURNED_DEG
            counted = p.obj_id not in SYMMETRIC and not turned
            spread += apart if counted else []
            between = "not found"
            if apart:
                between = f"{apart[0][0]:.2f} mm {apart[0][1]:.2f} deg"
            why = " (symmetric)" if p.obj_id in SYMMETRIC else " (estimate half round)"
            notes.append(
                f"ycbv {scene_id} {model.name}: from both starts {between} apart"
                f"{'' if counted else why}; |dz| {ours[-1]:.2f} mm, published "
                f"{published[-1]:.2f}; {p.verdict}"
            )
    named: list[bool] = []
    for scene_id in SHIFTED:
        found = registered(scene_id, "truth")
        words = [f.words for f in found.findings if f.kind == "common shift"]
        named.append(bool(words))
        notes.append(f"ycbv {scene_id}: {words[0] if words else 'no common shift was reported'}")
    figures |= {
        "real_start_spread_mm": max((s[0] for s in spread), default=float("nan")),
        "real_start_spread_deg": max((s[1] for s in spread), default=float("nan")),
        "real_start_spread_median_mm": float(np.median([s[0] for s in spread])),
        "real_dz_mm_ours": float(np.nanmedian(ours)),
        "real_dz_mm_truth": float(np.nanmedian(published)),
        "real_shift_named_share": float(np.mean(named)),
    }


def apart_by(model: ObjectModel, T: Array, U: Array) -> tuple[float, float]:
    """Return how far two poses are apart at the middle of the box [mm], and turned [deg]."""
    middle = model.mesh.bounds.mean(0)[None]
    gap = se3.transform(T, middle) - se3.transform(U, middle)
    return 1e3 * float(np.linalg.norm(gap)), float(np.degrees(se3.angle(T[:3, :3].T @ U[:3, :3])))
