"""Small BOP and GraspNet data sets of parts on a table, their poses exact or off on purpose."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bop_scenes import mm, png
from file_trees import bytes_of
from plain_meshes import square
from realsim.arrays import Array, UInt8
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.mesh import save_ply
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh

CAMERA = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
NAMES = ("box", "wedge")
EYES = ([0.0, -0.45, 0.45], [0.3, -0.35, 0.42])


def standing(turn: float = 0.0) -> list[PlacedMesh]:
    """Return the parts where they stand; `turn` [rad] makes another scene of them."""
    out: list[PlacedMesh] = []
    for k, name in enumerate(NAMES):
        mesh = part(name).mesh
        T = se3.from_translation([0.12 * k - 0.06, 0, -mesh.bounds[0, 2]])
        out.append(PlacedMesh(k, mesh, T @ se3.exp([0, 0, turn * (k + 1), 0, 0, 0])))
    return out


def cameras(views: int) -> list[Array]:
    """Return cameras that look at the parts."""
    return [se3.look_at(eye, [0.0, 0.0, 0.02]) for eye in EYES[:views]]


def looks(placed: Sequence[PlacedMesh], views: int) -> list[Labels]:
    """Return the labels of the parts on the table."""
    renderer = LabelRenderer([*placed, PlacedMesh(-1, square(0.5), np.eye(4))])
    return [renderer.render(CAMERA, T) for T in cameras(views)]


def grey_of(labels: Labels) -> UInt8:
    """Return a photograph of sorts."""
    grey = np.clip(255 * (1 - labels.depth_m), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, -1)


def bop_scene(folder: Path, *, turn: float = 0.0, views: int = 1, off_m: float = 0.0) -> None:
    """Write one BOP scene whose annotations are off by so much along the camera's x."""
    placed = standing(turn)
    scene_camera, scene_gt = {}, {}
    for k, (labels, T) in enumerate(zip(looks(placed, views), cameras(views), strict=True)):
        index = 3 + k
        png(folder / f"rgb/{index:06d}.png", grey_of(labels))
        png(folder / f"depth/{index:06d}.png", np.round(labels.depth_m * 1e4).astype(np.uint16))
        T_cam_world = se3.invert(T)
        R, t = mm(T_cam_world)
        scene_camera[str(index)] = {
            "cam_K": CAMERA.K.ravel().tolist(), "depth_scale": 0.1,
            "cam_R_w2c": R, "cam_t_w2c": t,
        }  # fmt: skip
        rows = []
        for m, p in enumerate(placed):
            R, t = mm(se3.from_translation([off_m, 0, 0]) @ T_cam_world @ p.T_world_obj)
            rows.append({"obj_id": part(NAMES[m]).obj_id, "cam_R_m2c": R, "cam_t_m2c": t})
            for kind, mask in (("mask", labels.amodal[m]), ("mask_visib", labels.visible(m))):
                png(folder / f"{kind}/{index:06d}_{m:06d}.png", 255 * mask.astype(np.uint8))
        scene_gt[str(index)] = rows
    (folder / "scene_camera.json").write_text(json.dumps(scene_camera))
    (folder / "scene_gt.json").write_text(json.dumps(scene_gt))


def bop_dataset(root: Path, scenes: int = 1, *, views: int = 1, off_m: float = 0.0) -> Path:
    """Write a BOP data set of some scenes and return its root."""
    for k in range(scenes):
        folder = root / f"test/{k + 1:06d}"
        # Oblique: along a face that is seen head-on, depth tells nothing of where an object is.
        bop_scene(folder, turn=0.5 + 0.2 * k, views=views, off_m=off_m)
    save_models(root / "models", {part(n).obj_id: part(n) for n in NAMES})
    return root


def annotation_xml(Ts_cam_obj: dict[int, Array]) -> str:
    """Return GraspNet's annotation of objects by their numbers, with its four decimals."""
    nodes: list[str] = []
    for number, T in Ts_cam_obj.items():
        q = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
        t, q = (" ".join(f"{x:.4f}" for x in v) for v in (T[:3, 3], q))
        nodes.append(
            f"<obj><obj_id>{number}</obj_id><obj_name>{number:03d}.ply</obj_name>"
            f"<obj_path>models/{number:03d}.ply</obj_path>"
            f"<pos_in_world>{t}</pos_in_world><ori_in_world>{q}</ori_in_world></obj>"
        )
    return f"<scene>{''.join(nodes)}</scene>"


def graspnet_dataset(root: Path, number: int = 100) -> Path:
    """Write a GraspNet tree of one scene seen by the Kinect in two images; return its root."""
    home = root / f"scenes/scene_{number:04d}"
    folder = home / "kinect"
    (folder / "annotations").mkdir(parents=True)
    placed = standing()
    Ts = cameras(2)
    numbers = [part(n).obj_id - 1 for n in NAMES]
    for k, (labels, T) in enumerate(zip(looks(placed, 2), Ts, strict=True)):
        png(folder / f"rgb/{k:04d}.png", grey_of(labels))
        png(folder / f"depth/{k:04d}.png", np.round(labels.depth_m * 1e3).astype(np.uint16))
        label = np.zeros(labels.ids.shape, np.uint8)
        seen: dict[int, Array] = {}
        for m, p in enumerate(placed):
            label[labels.visible(m)] = numbers[m] + 1
            seen[numbers[m]] = se3.invert(T) @ p.T_world_obj
        png(folder / f"label/{k:04d}.png", label)
        (folder / f"annotations/{k:04d}.xml").write_text(annotation_xml(seen))
    np.save(folder / "camK.npy", CAMERA.K)
    np.save(folder / "cam0_wrt_table.npy", Ts[0])
    np.save(folder / "camera_poses.npy", np.stack([se3.invert(Ts[0]) @ T for T in Ts]))
    (home / "object_id_list.txt").write_text("".join(f"{n}\n" for n in numbers))
    for n, name in zip(numbers, NAMES, strict=True):
        (root / f"models/{n:03d}").mkdir(parents=True)
        save_ply(root / f"models/{n:03d}/nontextured.ply", part(name).mesh, "m")
    return root


def content_and_times(root: Path) -> dict[str, tuple[bytes, int]]:
    """Return the bytes and the time of change of every file."""
    return {n: (data, (root / n).stat().st_mtime_ns) for n, data in bytes_of(root).items()}
