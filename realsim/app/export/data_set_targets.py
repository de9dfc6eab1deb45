"""Data sets and cameras that `realsim export` writes."""

from collections.abc import Sequence

from realsim.app.export import target
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import LabelledScene, WrittenScene


def _bop(scene: LabelledScene, folder: ExportFolder, job: target.SceneJob) -> WrittenScene:
    from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene

    request, place = job.request, job.place
    config = BopWriteConfig(
        colour=request.colour, jpeg_quality=request.jpeg_quality, masks=request.masks,
        # None keeps a name that says more than the number: obj_000008_up.
        number=None if place.number == scene.number else place.number,
        split=request.split or scene.split, camera=place.camera,
    )  # fmt: skip
    return write_bop_scene(scene, folder, config, progress=job.tick)


def _bop_root(folder: ExportFolder, job: target.RootJob) -> Sequence[str]:
    from realsim.formats.bop.root_files import write_bop_models, write_bop_root

    write_bop_models(job.models, folder, infos=job.infos)
    write_bop_root(folder, name=job.request.name or folder.folder.resolve().name)
    if not job.request.shards:
        return ()
    from realsim.formats.bop.webdataset import write_shards

    return (f"{write_shards(folder)} images of all scenes are in tar shards (SPLIT_web), too.",)


def _graspnet(scene: LabelledScene, folder: ExportFolder, job: target.SceneJob) -> WrittenScene:
    from realsim.formats.graspnet.scene import CAMERAS
    from realsim.formats.graspnet.write_plan import GraspnetWriteConfig
    from realsim.formats.graspnet.writing import write_graspnet_scene

    request = job.request
    camera = scene.camera if scene.camera in CAMERAS else request.camera or CAMERAS[0]
    config = GraspnetWriteConfig(
        camera=camera, number=job.place.number, ignore_distortion=request.keep_distortion,
        table_is_world=request.table_is_world, without_labels=not request.masks,
    )  # fmt: skip
    return write_graspnet_scene(scene, folder, config, progress=job.tick)


def _graspnet_root(folder: ExportFolder, job: target.RootJob) -> Sequence[str]:
    from realsim.formats.graspnet.tried_labels import write_tried_labels
    from realsim.formats.graspnet.writing import write_graspnet_models

    write_graspnet_models(job.models, folder)
    return write_tried_labels(folder, ((n, again().grasps()) for n, again in job.scenes))


def _colmap(scene: LabelledScene, folder: ExportFolder, job: target.SceneJob) -> WrittenScene:
    from realsim.formats.colmap.writing import write_colmap

    place = folder.below(job.place.name)
    return write_colmap(scene, place, job.request.points, progress=job.tick)


def _nerfstudio(scene: LabelledScene, folder: ExportFolder, job: target.SceneJob) -> WrittenScene:
    from realsim.formats.nerfstudio.writing import NerfstudioWriteConfig, write_nerfstudio

    return write_nerfstudio(
        scene, folder.below(job.place.name), NerfstudioWriteConfig(), progress=job.tick
    )


DATA_SETS: dict[str, target.Target] = {
    "bop": target.Target(
        name="BOP",
        kind="dataset",
        help="scenewise BOP: images, poses, masks, models, targets",
        conventions=(
            ("units", "millimetres; depth png * depth_scale = mm"),
            target.OPENCV,
            target.PIXEL,
            ("cam_R_m2c, cam_t_m2c", "object -> camera, row-major"),
            ("cam_R_w2c, cam_t_w2c", "world -> camera, row-major; left out where not known"),
            ("visib_fract", "visible pixels / all of the silhouette, beyond the border too"),
            (
                "lens",
                "undistorted; under --keep-distortion cam_distortion, a key that BOP does not "
                "have, holds OpenCV's k1 k2 p1 p2 k3 k4 k5 k6",
            ),
        ),
        loading=(
            "import json, pathlib\n"
            'scene = pathlib.Path("{scene}")\n'
            'poses = json.loads((scene / "scene_gt.json").read_text())'
        ),
        write_scene=_bop,
        write_root=_bop_root,
        is_pinhole=True,
        holds_cameras=True,
        no_place=(target.TABLE, target.TRIED),
        options=(*target.LABELLED, "split", "colour", "jpeg_quality", "shards"),
    ),
    "graspnet": target.Target(
        name="GraspNet-1Billion",
        kind="dataset",
        help="GraspNet's tree: annotations, camera poses, meta, labels, models, grasps",
        conventions=(
            ("units", "metres; depth png in millimetres (factor_depth 1000)"),
            target.OPENCV,
            ("camera_poses.npy", "camera i -> camera 0: p_0 = camera_poses[i] @ p_i"),
            ("cam0_wrt_table.npy", "camera 0 -> table, z up"),
            ("pos_in_world, ori_in_world", "object -> THIS image's camera; wxyz; nine decimals"),
            ("objects", "numbered from 0: realsim's and BOP's id - 1; label images hold the id"),
            (
                "grasp_label",
                "of every object what held: point, view, turn, depth, opening; score = "
                "friction, lower is better, -1 = failed or not tried",
            ),
            ("collision_label", "False = held in this very scene; True = not tried here"),
            ("rect", "the grasps along the camera's axis; score 1.1 - friction"),
        ),
        loading=(
            "import numpy as np\n"
            'poses = np.load("{scene}/camera_poses.npy")  # (N, 4, 4) camera i -> camera 0'
        ),
        write_scene=_graspnet,
        write_root=_graspnet_root,
        is_pinhole=True,
        holds_grasps=True,
        options=(*target.LABELLED, "table_is_world"),
    ),
    "colmap": target.Target(
        name="COLMAP",
        kind="cameras",
        help="cameras, images and points of a sparse model, one project a scene",
        conventions=(
            target.METRES,
            target.OPENCV,
            ("poses", "world -> camera, quaternion wxyz"),
            ("pixels", "the first pixel's centre is at 0.5"),
        ),
        loading='import pycolmap\nmodel = pycolmap.Reconstruction("{scene}/sparse/0")',
        write_scene=_colmap,
        no_place=(target.TABLE, target.TRIED),
        options=(*target.IMAGES, "points"),
    ),
    "nerfstudio": target.Target(
        name="nerfstudio",
        kind="cameras",
        help="transforms.json with images, depth and masks, one folder a scene",
        conventions=(
            target.METRES,
            ("camera axes", "OpenGL: x right, y up, z backward"),
            ("transform_matrix", "camera -> world"),
            ("depth", "16-bit PNG; depth_unit_scale_factor = metres per count"),
        ),
        loading='import json\nframes = json.load(open("{scene}/transforms.json"))["frames"]',
        write_scene=_nerfstudio,
        no_place=(target.TABLE, target.TRIED),
        options=target.IMAGES,
    ),
}
