"""BOP scenes of boxes on a table, written by hand: masks and depth by intersecting rays."""

import json
from pathlib import Path

import cv2
import numpy as np

from plain_meshes import box
from realsim import ObjectModel
from realsim.formats.bop.models import save_models
from realsim.geometry import se3

WIDTH, HEIGHT = 96, 72
K = np.array([[90.0, 0, 47.25], [0, 91.0, 35.5], [0, 0, 1]])
SIZES_M = {1: (0.06, 0.05, 0.09), 7: (0.10, 0.07, 0.04)}
THINGS = ((1, -0.08, -0.03, 0.4), (7, 0.03, 0.05, 1.1), (1, 0.09, -0.05, 2.2))
"""Object id, x, y [m], turn about z [rad]; two alike."""


MODELS = {i: ObjectModel(obj_id=i, name=f"box{i}", mesh=box(size)) for i, size in SIZES_M.items()}


def rays(K=K):
    """Return directions (H, W, 3) with z = 1 of the pixel centres."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)


def box_depth(T_cam_obj, size, K=K):
    """Return z (H, W) [m] of a box's front, inf beside it (slab method)."""
    T = se3.invert(T_cam_obj)
    d = rays(K) @ T[:3, :3].T
    half = np.array(size) / 2
    with np.errstate(divide="ignore"):
        a, b = (-half - T[:3, 3]) / d, (half - T[:3, 3]) / d
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((near <= far) & (near > 0), near, np.inf)


def camera_poses(count, seed=3):
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        angle = 0.7 * k + rng.uniform(0, 0.2)
        eye = [0.42 * np.cos(angle), 0.42 * np.sin(angle), 0.38 + rng.uniform(-0.05, 0.05)]
        poses.append(se3.look_at(eye, [0, 0, 0.03], roll=rng.uniform(-0.3, 0.3)))
    return poses


def png(path: Path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def bbox(mask):
    """As BOP's calc_2d_bbox: x, y, greatest minus least."""
    ys, xs = mask.nonzero()
    if len(xs) == 0:
        return [-1, -1, -1, -1]
    return [int(v) for v in (xs.min(), ys.min(), xs.max() - xs.min(), ys.max() - ys.min())]


def mm(T):
    return T[:3, :3].ravel().tolist(), [round(1e3 * float(x), 6) for x in T[:3, 3]]


def write_boxes(
    root, *, split="test", scene="000003", camera="", count=5, depth_scale=0.1, colour="rgb",
    things=THINGS, with_poses=True, models=True, seed=3, drift=1.0,
):  # fmt: skip
    """Write a scene as BOP's own programs would; return its folder.

    The principal point moves by `drift` times (0.5, -0.25) px from image to image.
    """
    folder = Path(root) / split / scene
    s = f"_{camera}" if camera else ""
    rng = np.random.default_rng(seed)
    cameras, truth, infos = {}, {}, {}
    for k, T_world_cam in enumerate(camera_poses(count, seed)):
        i = 4 * k + 1
        Kk = K + drift * k * np.array([[0, 0, 0.5], [0, 0, -0.25], [0, 0, 0]])
        T_cw = se3.invert(T_world_cam)
        R, t = mm(T_cw)
        cameras[i] = {"cam_K": Kk.ravel().tolist(), "depth_scale": depth_scale}
        cameras[i] |= {"elev": 12.5 + k, "view_level": 2, "cam_model": {"kind": "pinhole"}}
        if with_poses:
            cameras[i] |= {"cam_R_w2c": R, "cam_t_w2c": t}
        Ts = [
            T_cw @ se3.from_rt(se3.exp_so3([0, 0, turn]), [x, y, SIZES_M[o][2] / 2])
            for o, x, y, turn in things
        ]
        Ts = [se3.from_rt(T[:3, :3], np.array(mm(T)[1]) / 1e3) for T in Ts]
        fronts = [box_depth(T, SIZES_M[o], Kk) for (o, *_), T in zip(things, Ts, strict=True)]
        d = rays(Kk) @ T_world_cam[:3, :3].T
        table = -T_world_cam[2, 3] / d[..., 2]
        seen = np.minimum.reduce([*fronts, np.where(table > 0, table, np.inf)])
        counts = np.where(np.isfinite(seen), np.rint(1e3 * seen / depth_scale), 0)
        counts[rng.random(counts.shape) < 0.03] = 0
        png(folder / f"depth{s}/{i:06d}.png", counts.astype(np.uint16))
        shape = (HEIGHT, WIDTH, 3) if colour == "rgb" else (HEIGHT, WIDTH)
        png(folder / f"{colour}{s}/{i:06d}.png", rng.integers(0, 255, shape, dtype=np.uint8))
        truth[i], infos[i] = [], []
        for n, ((obj_id, *_), T, front) in enumerate(zip(things, Ts, fronts, strict=True)):
            whole, visible = np.isfinite(front), np.isfinite(front) & (front <= seen)
            png(folder / f"mask{s}/{i:06d}_{n:06d}.png", whole.astype(np.uint8) * 255)
            png(folder / f"mask_visib{s}/{i:06d}_{n:06d}.png", visible.astype(np.uint8) * 255)
            R, t = mm(T)
            truth[i].append({"obj_id": obj_id, "cam_R_m2c": R, "cam_t_m2c": t, "score": 0.25})
            infos[i].append({
                "bbox_obj": bbox(whole) if visible.any() else [-1] * 4, "bbox_visib": bbox(visible),
                "px_count_all": int(whole.sum()), "px_count_visib": int(visible.sum()),
                "px_count_valid": int((counts[whole] > 0).sum()), "seen_by": "rays",
                "visib_fract": float(visible.sum() / whole.sum()) if whole.any() else 0.0,
            })  # fmt: skip
    for name, data in (("camera", cameras), ("gt", truth), ("gt_info", infos)):
        (folder / f"scene_{name}{s}.json").write_text(json.dumps(data))
    if models and not (Path(root) / "models").exists():
        save_models(Path(root) / "models", MODELS)
    return folder


def edit(path, change):
    data = json.loads(Path(path).read_text())
    change(data)
    Path(path).write_text(json.dumps(data))
