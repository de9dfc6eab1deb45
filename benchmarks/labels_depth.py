"""Simulated depth against real frames: noise, and holes on objects.

Imported by `labels.py`: `python benchmarks/labels.py --part depth`.
Figures (simulated over real, or real over simulated: what is greater than 1; the worst frame):
  noise_ratio_real      median rms of 9x9 planes fitted to inverse depth
  holes_ratio_real      share of pixels without depth on the objects
What is fitted never is what is tested:
  ycbv_mini             frames 50, 51, 54 (their poses are right): each in turn is tested with the
                        sensor fitted to the other two; objects that those do not show get the
                        mean reflectance. Holes are counted on the objects only
  graspnet_demo_frame   one frame without meshes: fitted to the upper half of the table, tested on
                        the lower half; no hole ratio
  apc_shelf_multiview   F200, no meshes: walls of the shelf; fitted to even frames, tested on odd
                        ones; no hole ratio
The method was changed three times after looking at these frames, so new frames should decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from figures import DATA, Found
from labels_losses import FittedLosses, KnownView, LossFitConfig, fit_losses
from registration_real import ycbv_frame

from realsim.arrays import Array32, Mask
from realsim.errors import InputError
from realsim.geometry.camera import ray_table
from realsim.images import read_image
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.depth_sensors.fit import FittedDepthModel, fit_depth_model
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.plane import PlaneView, find_plane
from realsim.rendering.depth_sensors.profiles import DepthProfile, profile
from realsim.rendering.depth_sensors.statistics import hole_share, local_noise
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene

XTION = profile("structured_light")
F200 = replace(XTION, name="f200", baseline_m=0.047, min_z_m=0.2, max_z_m=1.5, depth_unit_m=1e-4)
"""Intel's F200: projector and camera 47 mm apart, as assumed for all ratios (it cancels)."""
GRASPNET = CameraIntrinsics(width=1280, height=720, fx=631.55, fy=631.21, cx=638.44, cy=366.50)
APC = CameraIntrinsics(width=640, height=480, fx=477.584, fy=477.584, cx=314.188, cy=245.884)
YCBV_FRAMES = (50, 51, 54)
EDGES = LossFitConfig(eye_offset_share=(0.0, -0.33, -0.67, -1.0))
"""YCB-Video's depth is registered to the colour camera, which stands between the eyes."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Compared:
    """One tested frame."""

    name: str
    fitted_on: str
    noise_ratio: float
    holes_ratio: float
    """NaN where the frame has no meshes."""
    noise_px: tuple[float, float]
    """Real and simulated."""
    holes: tuple[float, float]


def depth_real(seed: int, quick: bool) -> Found:
    """Return the worst factors over all tested frames; only ycbv_mini's frame 54 when quick."""
    rows = compared(quick, seed)
    found = Found()
    for key, part in (("noise_ratio_real", "noise_ratio"), ("holes_ratio_real", "holes_ratio")):
        ratios = {r.name: float(getattr(r, part)) for r in rows}
        # A share of 0 on one side alone is infinitely wrong, and must not drop out.
        factors = {
            n: max(r, 1 / r) if r > 0 else np.inf for n, r in ratios.items() if not np.isnan(r)
        }
        if factors:
            found.figures[key] = max(factors.values())
            said = ", ".join(f"{n} {ratios[n]:.2f}" for n in factors)
            found.over[key] = f"simulated over real: {said}"
    found.notes += [
        f"depth {r.name}: fitted on {r.fitted_on}; noise {r.noise_px[0]:.3f} px real, "
        f"{r.noise_px[1]:.3f} simulated; holes {r.holes[0]:.3f}, {r.holes[1]:.3f}"
        for r in rows
    ]
    if not rows:
        found.notes.append(f"no depth frames under {DATA}: noise and holes are not measured")
    return found


def compared(quick: bool, seed: int = 0) -> list[Compared]:
    """Return all tested frames; those whose data are not there are left out."""
    rows: list[Compared] = []
    if (DATA / "scenes/ycbv_mini").is_dir():
        views = [ycbv_view(s) for s in YCBV_FRAMES]
        tested = [2] if quick else [0, 1, 2]
        rows += [_ycbv(views, k, seed) for k in tested]
    if quick:
        return rows
    if (DATA / "scenes/graspnet_demo_frame").is_dir():
        rows.append(_graspnet(seed))
    if (DATA / "scenes/apc_shelf_multiview").is_dir():
        rows += _apc(seed)
    return rows


# --- frames with objects of known pose ----------------------------------------------------------


def ycbv_view(scene_id: int) -> tuple[KnownView, PlaneView]:
    """Return a frame of YCB-Video with its table, rendered, and the table's plane."""
    intrinsics, frame, models, truth, _ = ycbv_frame(scene_id)
    T = np.eye(4)
    objects = [PlacedMesh(p.instance, models[p.obj_id].mesh, p.T_world_obj) for p in truth]
    free = LabelRenderer(objects).render(intrinsics, T).ids < 0
    plane = find_plane(
        frame.depth_m, intrinsics, XTION.baseline_m, region=free, name=f"ycbv {scene_id}"
    )
    placed = [*objects, _table(plane, intrinsics)]
    labels = LabelRenderer(placed).render(intrinsics, T)
    view = KnownView(
        measured_m=frame.depth_m, exact_m=labels.depth_m, ids=labels.ids,
        kinds={p.instance: models[p.obj_id].name for p in truth}, intrinsics=intrinsics,
        scene=RayScene(placed), T_world_cam=T,
    )  # fmt: skip
    return view, plane


def _table(plane: PlaneView, intrinsics: CameraIntrinsics) -> PlacedMesh:
    """Return the piece of plane that the camera sees, as a rectangle."""
    n = plane.normal / np.linalg.norm(plane.normal)
    on = ray_table(intrinsics)[plane.mask].astype(np.float64)
    points = on / (on @ plane.normal)[:, None]
    a = np.cross(n, [1.0, 0.0, 0.0])
    a /= np.linalg.norm(a)
    b = np.cross(n, a)
    origin = n / float(np.linalg.norm(plane.normal))
    low_a, high_a = np.percentile(points @ a, [0.2, 99.8])
    low_b, high_b = np.percentile(points @ b, [0.2, 99.8])
    corners = [origin + a * x + b * y for x in (low_a, high_a) for y in (low_b, high_b)]
    mesh = Mesh(vertices=np.array(corners), faces=np.array([[0, 1, 2], [2, 1, 3]]))
    return PlacedMesh(BACKGROUND, mesh, np.eye(4))


def fitted_to(
    views: Sequence[tuple[KnownView, PlaneView]],
) -> tuple[FittedDepthModel, FittedLosses]:
    """Return noise and losses of a sensor from frames of YCB-Video."""
    first = views[0][0]
    noise = fit_depth_model(
        [v.measured_m for v, _ in views], first.intrinsics, XTION, unit_m=1e-3,
        regions=[p.area for _, p in views], names=[f"view {k}" for k in range(len(views))],
    )  # fmt: skip
    model = replace(noise.model, border=False, loss_patch_px=6.0)
    return noise, fit_losses(model, [v for v, _ in views], EDGES)


def _ycbv(views: Sequence[tuple[KnownView, PlaneView]], tested: int, seed: int) -> Compared:
    """Return one frame against the sensor fitted to the others."""
    others = [v for k, v in enumerate(views) if k != tested]
    _, losses = fitted_to(others)
    view, _ = views[tested]
    simulated = losses.model.measure(
        view.exact_m, view.intrinsics, np.random.default_rng([seed, tested]), scene=view.scene,
        T_world_cam=view.T_world_cam, reflectance=losses.reflectance_of(view),
    )  # fmt: skip
    objects = view.ids > BACKGROUND
    region = view.exact_m > 0
    names = " ".join(str(YCBV_FRAMES[k]) for k in range(len(views)) if k != tested)
    return _compare(
        f"ycbv {YCBV_FRAMES[tested]}", f"ycbv {names}", view.measured_m, simulated,
        view.intrinsics, XTION, region, objects,
    )  # fmt: skip


def _compare(
    name: str,
    fitted_on: str,
    real: Array32,
    simulated: Array32,
    intrinsics: CameraIntrinsics,
    kind: DepthProfile,
    region: Mask,
    objects: Mask | None,
) -> Compared:
    a = local_noise(real, intrinsics, kind.baseline_m, region).median_px
    b = local_noise(simulated, intrinsics, kind.baseline_m, region).median_px
    holes = (float("nan"), float("nan"))
    if objects is not None:
        holes = (hole_share(real, objects), hole_share(simulated, objects))
    return Compared(
        name=name, fitted_on=fitted_on, noise_ratio=b / a, holes_ratio=holes[1] / holes[0],
        noise_px=(a, b), holes=holes,
    )  # fmt: skip


# --- frames with planes alone -------------------------------------------------------------------


def _graspnet(seed: int) -> Compared:
    """Return the lower half of the table against the sensor fitted to the upper half."""
    depth = read_image(DATA / "scenes/graspnet_demo_frame/depth.png").astype(np.float32) * 1e-3
    upper = np.zeros(depth.shape, dtype=bool)
    upper[: GRASPNET.height // 2] = True
    fit = fit_depth_model([depth], GRASPNET, XTION, regions=[upper], unit_m=1e-3)
    plane = find_plane(depth, GRASPNET, XTION.baseline_m, region=~upper, name="graspnet")
    model = replace(fit.model, min_z_m=0.2, occlusion=False)
    return _plane_only(
        "graspnet lower half", "upper half", depth, plane, model, GRASPNET, XTION, seed
    )


def _plane_only(
    name: str,
    fitted_on: str,
    depth: Array32,
    plane: PlaneView,
    model: DepthSensorModel,
    intrinsics: CameraIntrinsics,
    kind: DepthProfile,
    seed: int,
) -> Compared:
    fB = intrinsics.fx * kind.baseline_m
    exact = np.where(plane.area, fB / np.nan_to_num(plane.disparity, nan=1.0), 0)
    simulated = model.measure(exact, intrinsics, np.random.default_rng([seed, 1]))
    real = np.where(plane.area, depth, 0).astype(np.float32)
    return _compare(
        name, fitted_on, real, simulated, intrinsics, kind, plane.mask & (simulated > 0), None
    )


def _apc(seed: int) -> list[Compared]:
    """Return walls of odd frames against the sensor fitted to those of even frames."""
    fitting: list[Array32] = []
    testing: list[tuple[int, Array32]] = []
    for k in range(15):
        path = DATA / f"scenes/apc_shelf_multiview/scene-0000/raw/frame-{k:06d}.depth.png"
        counts = read_image(path).astype(np.uint16)
        depth = ((counts >> 3) | (counts << 13)).astype(np.float32) * 1e-4
        depth[depth > F200.max_z_m] = 0
        try:
            find_plane(depth, APC, F200.baseline_m)
        except InputError:
            continue
        if k % 2 == 0:
            fitting.append(depth)
        else:
            testing.append((k, depth))
    fit = fit_depth_model(fitting, APC, F200)
    model = replace(fit.model, occlusion=False)
    return [
        _plane_only(
            f"apc {k}", "even frames", depth, find_plane(depth, APC, F200.baseline_m), model, APC,
            F200, seed,
        )
        for k, depth in testing
    ]  # fmt: skip
