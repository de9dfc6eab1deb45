"""From verified matches to cameras and points: COLMAP's mapper, or its triangulator at given poses.

Both run on one thread with a fixed seed: the same matches give the same bytes.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.formats.colmap.model import read_model
from realsim.geometry import se3
from realsim.interop import opencv_from_colmap_px, quiet_output, rigid3d_from_T
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.database import MatchDatabase
from realsim.scanning.sfm.result import Geometry
from realsim.store.atomic import write_bytes

Tick = Callable[[int, int], None]
LEAST_MODEL = 3
"""Views of the smallest model that is kept."""


def map_freely(
    database: MatchDatabase, config: SfmConfig, *, refine_camera: bool, folder: Path, tick: Tick
) -> list[Any]:
    """Return the pycolmap.Reconstructions of incremental mapping, the one of most views first.

    Args:
        database: with verified matches.
        config: thresholds and seed.
        refine_camera: whether the lens is solved for, too.
        folder: for COLMAP's own files; emptied.
        tick: called with (registered images, images).

    Raises:
        DegenerateError: no pair of views gives a start, or no three views go together.
    """
    import pycolmap

    pycolmap.set_random_seed(config.seed)
    total = len(database.image_ids)
    registered = 2

    def one_more() -> None:
        nonlocal registered
        registered += 1
        tick(min(registered, total), total)

    options = _options(config, config.mapping.reprojection_px)
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine_camera
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    tick(0, total)
    # COLMAP logs every step to stderr whatever its log level is set to.
    with quiet_output():
        models: dict[int, Any] = dict(
        pycolmap.incremental_mapping(
            database.path, database.photographs.root, folder, options,
            next_image_callback=one_more,
        )
    )  # fmt: skip
    shutil.rmtree(folder, ignore_errors=True)
    if not models:
        raise DegenerateError(
            "no pair of views gives a start: too few matches between views some 10 to 30 degrees "
            "apart, or the camera only turned on the spot. Take more views around the object, at "
            "15 degrees from one to the next, and put newspaper or the tag board under it."
        )
    found = sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    for model in found:
        _bundle(model, config, refine_camera)
    return found


def _bundle(model: Any, config: SfmConfig, refine_camera: bool) -> None:
    """Adjust a model once more, with a loss that forgives wrong matches."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_camera
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = config.mapping.robust_px
    options.ceres.solver_options.num_threads = 1
    with quiet_output():
        pycolmap.bundle_adjustment(model, options)


def model_at_poses(database: MatchDatabase, Ts_world_cam: Array) -> Any:
    """Return a pycolmap.Reconstruction of cameras at given poses (V, 4, 4), without points."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(str(database.path)) as db:
        for camera in db.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
    for name, number, T in zip(
        database.photographs.names, database.image_ids, Ts_world_cam, strict=True
    ):
        image = pycolmap.Image(name=name, image_id=number, camera_id=1)
        model.add_image_with_trivial_frame(image, rigid3d_from_T(se3.invert(T)))
    return model


def triangulated(
    model: Any, database: MatchDatabase, config: SfmConfig, error_px: float, folder: Path
) -> Any:
    """Return the model with points triangulated anew at its poses, which stay as they are.

    Args:
        model: a pycolmap.Reconstruction with poses.
        database: with verified matches.
        config: thresholds and seed.
        error_px: how far an observation may be from its point [px].
        folder: for COLMAP's own files; emptied.
    """
    import pycolmap

    pycolmap.set_random_seed(config.seed)
    options = _options(config, error_px)
    focal = float(model.cameras[1].mean_focal_length())
    angle = float(np.degrees(np.arctan(error_px / focal)))
    options.triangulation.create_max_angle_error = angle
    options.triangulation.continue_max_angle_error = angle
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with quiet_output():
        found: Any = pycolmap.triangulate_points(
            model, database.path, database.photographs.root, folder, True, options
        )
    shutil.rmtree(folder, ignore_errors=True)
    return found


def set_geometry(model: Any, geometry: Geometry) -> None:
    """Put the cameras and points of a geometry into the model that it came from."""
    poses = dict(zip(geometry.names, geometry.Ts_world_cam, strict=True))
    for image in model.images.values():
        if image.name in poses:
            model.frames[image.frame_id].rig_from_world = rigid3d_from_T(
                se3.invert(poses[image.name])
            )
    for number, xyz in zip(geometry.point_ids.tolist(), geometry.points, strict=True):
        model.points3D[number].xyz = xyz


def scaled(model: Any, scale: float, R: Array, t: Array) -> None:
    """Move a model by the similarity p -> scale R p + t, in place."""
    import pycolmap

    from realsim.interop import quaternion_xyzw_from_R

    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(quaternion_xyzw_from_R(R)), t))


def geometry_of(model: Any, folder: Path) -> Geometry:
    """Return the arrays of a pycolmap.Reconstruction, images by name.

    Args:
        model: with poses and points.
        folder: the model is written there, and its cameras read back by the project's own reader.
    """
    save_model(model, folder)
    read = read_model(folder)
    images = sorted(read.images, key=lambda i: i.name)
    place = {i.name: k for k, i in enumerate(images)}
    by_name = {str(i.name): i for i in model.images.values()}
    point_ids = np.array(sorted(model.points3D), dtype=np.int64)
    place_of = {int(p): k for k, p in enumerate(point_ids)}
    cameras: list[int] = []
    points: list[int] = []
    uv: list[Array] = []
    for name, camera in place.items():
        for point2D in by_name[name].get_observation_points2D():
            cameras.append(camera)
            points.append(place_of[int(point2D.point3D_id)])
            uv.append(np.asarray(point2D.xy))
    values = [model.points3D[int(p)] for p in point_ids]
    return Geometry(
        intrinsics=read.cameras[images[0].camera_id],
        names=tuple(place),
        Ts_world_cam=np.stack([i.T_world_cam for i in images]),
        points=np.array([v.xyz for v in values], dtype=np.float64).reshape(-1, 3),
        colors=np.array([v.color for v in values], dtype=np.uint8).reshape(-1, 3),
        cameras_of=np.array(cameras, dtype=np.int64),
        points_of=np.array(points, dtype=np.int64),
        uv_px=opencv_from_colmap_px(np.array(uv).reshape(-1, 2)),
        point_ids=point_ids,
    )


def save_model(model: Any, folder: Path, *, text: bool = False) -> None:
    """Write a model as COLMAP's binary or text files, each whole or not at all."""
    draft = folder.with_name(f".{folder.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(draft))
    for path in sorted(draft.iterdir()):
        write_bytes(folder / path.name, path.read_bytes())
    shutil.rmtree(draft)


def _options(config: SfmConfig, error_px: float) -> Any:
    """Return COLMAP's options of mapping and triangulation, seeded and on one thread."""
    import pycolmap

    m, seed = config.mapping, config.seed
    o = pycolmap.IncrementalPipelineOptions()
    o.num_threads = o.mapper.num_threads = 1
    o.random_seed = o.mapper.random_seed = o.triangulation.random_seed = seed
    o.min_model_size = LEAST_MODEL
    o.min_num_matches = config.features.min_inliers
    o.ba_refine_focal_length = o.ba_refine_extra_params = False
    o.ba_refine_principal_point = False
    o.extract_colors = True
    o.structure_less_registration_fallback = False
    o.mapper.init_min_num_inliers = m.init_min_inliers
    o.mapper.filter_max_reproj_error = error_px
    o.mapper.filter_min_tri_angle = o.triangulation.min_angle = m.min_angle_deg
    o.triangulation.merge_max_reproj_error = error_px
    o.triangulation.complete_max_reproj_error = error_px
    return o
