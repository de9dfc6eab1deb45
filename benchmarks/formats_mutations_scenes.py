"""Small valid scenes of every format, and what reads all of each: for the mutations."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

IMAGES_READ = 2


class Sample(NamedTuple):
    """A format: how a small valid sample is made, and how all of it is read."""

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]


# --- what reads everything ------------------------------------------------------------------------


def drain_source(source: Any) -> list[Any]:
    """Return what a frame source says, with its first frames."""
    frames = [frame for frame, _ in zip(source.frames(), range(IMAGES_READ), strict=False)]
    return [source.name, source.intrinsics, source.depth_unit_m, source.notes, source.extra, frames]


def drain_scene(scene: Any) -> list[Any]:
    """Return what a labelled scene says: cameras, poses, images, masks, models, grasps."""
    from realsim import images

    found: list[Any] = [scene.name, scene.number, scene.split, scene.T_world_table, scene.notes]
    for index in scene.indices:
        frame = scene.frame(index)
        found.append(frame)
        if index in scene.indices[:IMAGES_READ]:
            found.append(images.read_rgb(scene.colour_file(index)))
            depth = scene.depth_file(index)
            if depth is not None and frame.depth_unit_m is not None:
                found.append(images.read_depth(depth, frame.depth_unit_m))
            for k in range(len(frame.objects)):
                found += [scene.mask(index, k, visible=v) for v in (True, False)]
    return [*found, scene.models(), scene.grasps()]


# --- sessions and BOP -----------------------------------------------------------------------------


def labelled_session(folder: Path, views: int = 3) -> Any:
    """Write a session of two objects on a table, with BOP's labels."""
    from realsim.formats.bop import labels
    from realsim.geometry import se3
    from realsim.rendering.labels import LabelRenderer, PlacedMesh
    from registered_sessions import CAMERA, models_of, table_session, true_cameras, true_poses

    store = table_session(folder, views, (0.0, 0.0))
    models, poses = models_of(), true_poses()
    placed = [PlacedMesh(k, models[o.obj_id].mesh, o.T_world_obj) for k, o in enumerate(poses)]
    together = LabelRenderer(placed)
    alone = [LabelRenderer([p]) for p in placed]
    annotations: dict[int, Any] = {}
    infos: dict[int, Any] = {}
    coco: dict[int, Any] = {}
    for index, T in enumerate(true_cameras(views)):
        ids, depth = together.render(CAMERA, T).ids, store.depth_m(index)
        masks = [(r.render(CAMERA, T).ids >= 0, ids == k) for k, r in enumerate(alone)]
        annotations[index] = [(o.obj_id, se3.invert(T) @ o.T_world_obj) for o in poses]
        infos[index] = [labels.gt_info_entry(a, v, depth) for a, v in masks]
        coco[index] = [(o.obj_id, v) for o, (_, v) in zip(poses, masks, strict=True)]
        for k, pair in enumerate(masks):
            for mask, visible in zip(pair, (False, True), strict=True):
                store.write_image(labels.mask_path(index, k, visible=visible), mask)
    labels.write_scene_gt(store, annotations)
    labels.write_scene_gt_info(store, infos)
    labels.write_scene_gt_coco(store, coco, {o.obj_id: models[o.obj_id].name for o in poses})
    return store


def make_bop(folder: Path) -> None:
    """Write a BOP data set: one scene, models, camera.json."""
    import shutil

    store = labelled_session(folder / "test" / "000003")
    store.close()
    shutil.move(folder / "test/000003/models", folder / "models")
    for name in ("session.json", "manifest.jsonl"):
        (folder / "test/000003" / name).unlink(missing_ok=True)


def read_bop(folder: Path) -> Any:
    """Read a BOP data set every way."""
    from realsim.formats.bop.models import load_models
    from realsim.formats.bop.opening import open_labelled_bop

    return [drain_scene(open_labelled_bop(folder)), load_models(folder / "models")]


def read_bop_source(folder: Path) -> Any:
    """Read a BOP scene as frames."""
    from realsim.formats.bop.scene import find_scenes, read_scene
    from realsim.formats.bop.source import open_bop

    (ref,) = find_scenes(folder)
    return [read_scene(ref), drain_source(open_bop(folder))]


def make_session(folder: Path) -> None:
    """Write a session of realsim with labels."""
    labelled_session(folder).close()


def read_session(folder: Path) -> Any:
    """Open a session, read all of it, check it."""
    from realsim.formats.session_scene import open_session_scene
    from realsim.store import SessionStore

    store = SessionStore.open(folder)
    try:
        session = store.session
        found: list[Any] = [session.name, session.intrinsics, session.views, store.extra]
        for view in session.views[:IMAGES_READ]:
            found += [store.rgb(view.index), store.depth_m(view.index)]
        found.append(drain_scene(open_session_scene(store)))
        store.check()
        return found
    finally:
        store.close()


# --- GraspNet -------------------------------------------------------------------------------------


def make_graspnet(folder: Path) -> None:
    """Write a GraspNet tree of one scene from rendered images."""
    from realsim import images
    from realsim.formats.graspnet.image_objects import meta_bytes
    from realsim.geometry import se3
    from realsim.geometry.mesh_files import ply_bytes
    from realsim.rendering.labels import LabelRenderer, PlacedMesh
    from registered_sessions import CAMERA, models_of, table_session, true_cameras, true_poses

    store = table_session(folder / "session", 3, (0.0, 0.0))
    home = folder / "scenes/scene_0007/kinect"
    poses, models, cameras = true_poses(), models_of(), true_cameras(3)
    numbers = [o.obj_id - 1 for o in poses]
    renderer = LabelRenderer(
        [
            PlacedMesh(n, models[n + 1].mesh, o.T_world_obj)
            for n, o in zip(numbers, poses, strict=True)
        ]
    )
    for name in ("rgb", "depth", "label", "annotations", "meta"):
        (home / name).mkdir(parents=True)
    np.save(home / "camera_poses.npy", np.stack([se3.invert(cameras[0]) @ T for T in cameras]))
    np.save(home / "cam0_wrt_table.npy", cameras[0])
    np.save(home / "camK.npy", CAMERA.K)
    for k, T in enumerate(cameras):
        Ts = [se3.invert(T) @ o.T_world_obj for o in poses]
        depth_m = store.depth_m(k)
        (home / f"rgb/{k:04d}.png").write_bytes(images.png_bytes(store.rgb(k)))
        counts = images.depth_counts(depth_m, 0.001)
        (home / f"depth/{k:04d}.png").write_bytes(images.png_bytes(counts))
        label = (renderer.render(CAMERA, T).ids + 1).astype(np.uint8)
        (home / f"label/{k:04d}.png").write_bytes(images.png_bytes(label))
        (home / f"annotations/{k:04d}.xml").write_text(_annotation(numbers, Ts))
        meta = meta_bytes(numbers, np.stack(Ts)[:, :3], CAMERA.K, 1000.0)
        (home / f"meta/{k:04d}.mat").write_bytes(meta)
    (folder / "scenes/scene_0007/object_id_list.txt").write_text("\n".join(map(str, numbers)))
    for n in numbers:
        (folder / f"models/{n:03d}").mkdir(parents=True)
        data = ply_bytes(models[n + 1].mesh, "m")
        (folder / f"models/{n:03d}/nontextured.ply").write_bytes(data)
    store.close()
    import shutil

    shutil.rmtree(folder / "session")


def _annotation(numbers: list[int], Ts: list[Any]) -> str:
    from realsim.geometry import se3

    rows: list[str] = []
    for number, T in zip(numbers, Ts, strict=True):
        q, t = se3.quaternion_wxyz(T[:3, :3]), T[:3, 3]
        rows.append(
            f"<obj><obj_id>{number}</obj_id><obj_name>{number:03d}.ply</obj_name>"
            f"<obj_path>models/{number:03d}.ply</obj_path>"
            f"<pos_in_world>{' '.join(f'{x:.4f}' for x in t)}</pos_in_world>"
            f"<ori_in_world>{' '.join(f'{x:.4f}' for x in q)}</ori_in_world></obj>"
        )
    return f'<?xml version="1.0"?><scene>{"".join(rows)}</scene>'


def read_graspnet(folder: Path) -> Any:
    """Read a GraspNet tree as a labelled scene."""
    from realsim.formats.graspnet.opening import open_scene
    from realsim.formats.graspnet.scene import open_graspnet

    return [drain_scene(open_scene(ref)) for ref in open_graspnet(folder).scenes]


def read_graspnet_table(folder: Path) -> Any:
    """Read a GraspNet scene as objects on a table."""
    from realsim.formats.graspnet.scene import read_graspnet_scene

    return read_graspnet_scene(folder / "scenes/scene_0007")


# --- cameras --------------------------------------------------------------------------------------


def _make_colmap(folder: Path, *, text: bool) -> None:
    import pycolmap

    from realsim import images
    from realsim.geometry import se3
    from realsim.interop import rigid3d_from_T

    rng = np.random.default_rng(1)
    model = pycolmap.Reconstruction()
    params = [35.0, 36.0, 20.5, 15.25, 0.1, -0.02, 0.003, 0.004]
    camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=40, height=30, params=params)
    model.add_camera_with_trivial_rig(camera)
    (folder / "images").mkdir(parents=True)
    for k in range(3):
        T = se3.look_at(rng.uniform(0.2, 0.5, 3), [0, 0, 0])
        image = pycolmap.Image(image_id=k + 1, camera_id=1, name=f"shot_{k}.png")
        model.add_image_with_trivial_frame(image, rigid3d_from_T(se3.invert(T)))
        rgb = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
        (folder / f"images/shot_{k}.png").write_bytes(images.png_bytes(rgb))
    (folder / "sparse/0").mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder / "sparse/0"))


def read_colmap(folder: Path) -> Any:
    """Read a COLMAP project as frames."""
    from realsim.formats.colmap.source import open_colmap

    return drain_source(open_colmap(folder, metres_per_unit=1.0))


def make_nerfstudio(folder: Path) -> None:
    """Write a nerfstudio folder with depth that agrees between views."""
    import json

    from realsim import images
    from registered_sessions import CAMERA, table_session, true_cameras

    store = table_session(folder / "s", 3, (0.0, 0.0))
    frames: list[Any] = []
    (folder / "images").mkdir()
    (folder / "depth").mkdir()
    for k, T in enumerate(true_cameras(3)):
        (folder / f"images/{k}.png").write_bytes(images.png_bytes(store.rgb(k)))
        counts = images.depth_counts(store.depth_m(k), 0.001)
        (folder / f"depth/{k}.png").write_bytes(images.png_bytes(counts))
        turned = T @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {"file_path": f"images/{k}.png", "depth_file_path": f"depth/{k}.png",
             "transform_matrix": turned.tolist()}
        )  # fmt: skip
    c = CAMERA
    head = {"camera_model": "OPENCV", "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy,
            "cx": c.cx, "cy": c.cy, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(head | {"frames": frames}))
    store.close()
    import shutil

    shutil.rmtree(folder / "s")


def read_nerfstudio(folder: Path) -> Any:
    """Read a nerfstudio folder as frames."""
    from realsim.formats.nerfstudio.source import open_nerfstudio

    return drain_source(open_nerfstudio(folder, metres_per_unit=1.0, depth_unit_m=0.001))


SCENES = (
    Sample("bop", make_bop, read_bop),
    Sample("bop frames", make_bop, read_bop_source),
    Sample("session", make_session, read_session),
    Sample("graspnet", make_graspnet, read_graspnet),
    Sample("graspnet table", make_graspnet, read_graspnet_table),
    Sample("colmap text", partial(_make_colmap, text=True), read_colmap),
    Sample("colmap binary", partial(_make_colmap, text=False), read_colmap),
    Sample("nerfstudio", make_nerfstudio, read_nerfstudio),
)
