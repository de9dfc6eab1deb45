"""`realsim scan sfm`: photographs to metric cameras and points, depth images to a mesh.

The mesh of `realsim scan sfm`: depth images fused at the reconstructed cameras.

What `realsim scan sfm` works on: a session, or a folder of photographs, with masks.
"""

from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError, RealsimError
from realsim.interop import import_pycolmap
from realsim.records import CameraIntrinsics
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.result import Poses, SfmResult
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim.scanning.fusion.result import FusedObject


@dataclass(frozen=True, kw_only=True, slots=True)
class SfmRequest:
    """What the command was told."""

    images: Path
    """A session or a folder of photographs."""
    out: Path | None = None
    """Where to write; None: SESSION/scans/sfm, or IMAGES/sfm."""
    poses: Poses | None = None
    """'unknown', 'known', 'refined'; None: 'refined' where the session has poses."""
    intrinsics: Path | None = None
    """File with the intrinsics of a plain folder."""
    masks: Path | None = None
    """Folder of masks, one for each photograph."""
    dense: bool | None = None
    """Whether depth is fused; None: if there is any."""
    at: tuple[float, float] | None = None
    """(x, y) in world [m] near the object whose mesh is wanted; None: there is only one."""
    text: bool = False
    """Whether the COLMAP model is written as text, too."""
    seed: int = 0
    """Seed of every random choice."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SfmInputs:
    """Photographs with what is known of them."""

    paths: tuple[Path, ...]
    intrinsics: CameraIntrinsics | None
    Ts_world_cam: tuple[Array | None, ...]
    poses: Poses
    store: SessionStore | None
    """The session, None for a plain folder."""
    notes: tuple[str, ...]

    def depth_of(self, name: str) -> Array32 | None:
        """Return the depth image of a photograph of the session, None where there is none."""
        index = int(Path(name).stem)
        if self.store is None or not self.store.has_depth(index):
            return None
        return self.store.depth_m(index)

    @property
    def has_depth(self) -> bool:
        """Whether any view has depth."""
        store = self.store
        return store is not None and any(store.has_depth(v.index) for v in store.session.views)


def sfm_inputs(request: SfmRequest) -> SfmInputs:
    """Return what the command works on.

    Raises:
        InputError: no images, or a session whose poses are needed and missing.
    """
    from realsim.scanning.sfm.database import photographs_in

    if (request.images / "session.json").is_file():
        return _session_inputs(request)
    paths = tuple(photographs_in(request.images))
    if request.poses in ("known", "refined"):
        raise InputError(
            f"--use-poses {request.poses} needs the robot's camera poses, and '{request.images}' "
            "is a plain folder. `realsim import` makes a session of images and poses; or leave "
            "--use-poses out."
        )
    intrinsics = None
    if request.intrinsics is not None:
        from realsim.app.importing.folder import camera_of_file
        from realsim.images import image_size

        intrinsics = camera_of_file(request.intrinsics, image_size(paths[0]))
    return SfmInputs(
        paths=paths, intrinsics=intrinsics, Ts_world_cam=(None,) * len(paths), poses="unknown",
        store=None, notes=("a folder of photographs: no robot poses, so no metric scale.",),
    )  # fmt: skip


def _session_inputs(request: SfmRequest) -> SfmInputs:
    """Return a session's photographs, camera and poses."""
    from realsim.app.stages import open_session
    from realsim.store.session_store import rgb_path

    store = open_session(request.images)
    if request.intrinsics is not None:
        raise InputError("a session has its own camera; --intrinsics is for photographs.")
    views = store.session.views
    posed = len(store.session.Ts_world_cam)
    poses = request.poses or ("refined" if posed == len(views) else "unknown")
    notes: list[str] = []
    if not posed and poses != "unknown":
        raise InputError(
            f"session '{request.images}' is not calibrated: none of its {len(views)} views has a "
            "camera pose. `realsim calibrate SESSION` finds them; --use-poses unknown maps "
            "without, and without a metric scale."
        )
    if not posed:
        notes.append(
            "the session is not calibrated: no camera poses, so no metric scale. `realsim "
            "calibrate SESSION` gives both."
        )
    elif posed < len(views) and request.poses is None:
        notes.append(f"{len(views) - posed} views have no camera pose, so poses are 'unknown'.")
    if not any(store.has_depth(v.index) for v in views):
        notes.append("the session has no depth images: no second scale, and no mesh.")
    return SfmInputs(
        paths=tuple(store.path(rgb_path(v.index)) for v in views),
        intrinsics=store.session.intrinsics,
        Ts_world_cam=tuple(v.T_world_cam for v in views),
        poses=poses, store=store, notes=tuple(notes),
    )  # fmt: skip


def sfm_masks(request: SfmRequest, inputs: SfmInputs) -> dict[str, Mask] | None:
    """Return the masks by the photographs' names."""
    from realsim.images import read_grey

    if request.masks is None:
        return None
    found: dict[str, Mask] = {}
    for path in inputs.paths:
        places = [request.masks / f"{stem}.png" for stem in (path.stem, path.name)]
        mask = next((p for p in places if p.is_file()), None)
        if mask is None:
            raise InputError(
                f"'{request.masks}' has no mask for {path.name}: {path.stem}.png is expected, "
                "white where features may lie."
            )
        found[path.name] = read_grey(mask) > 0
    return found


MESH, FUSION = "dense.ply", "dense.json"


def mesh_from_depth(
    request: SfmRequest, inputs: SfmInputs, result: SfmResult, out: Path, console: Console
) -> bool:
    """Fuse the depth images at the reconstructed cameras; return whether nothing speaks against."""
    asked = request.dense
    wanted = inputs.has_depth if asked is None else asked
    if not wanted:
        return True
    if not result.is_metric or result.verdict == "rejected":
        console.warn("no mesh: depth is fused at metric cameras that were not rejected.")
        return asked is None
    try:
        with console.stage("sfm", "mesh from depth") as tick:
            tick(0, 1)
            fused = _fused(inputs, result, request.at)
    except RealsimError as error:
        if asked or request.at is not None:
            raise
        console.warn(f"no mesh: {error}")
        return False
    _write_dense(fused, out)
    _show_dense(fused, console)
    console.say(f"mesh      {out / MESH} (metres)")
    console.say(f"next      realsim scan import {quote(str(out / MESH))} --unit m --name NAME")
    return fused.verdict == "accepted"


def _fused(inputs: SfmInputs, result: SfmResult, at_m: tuple[float, float] | None) -> "FusedObject":
    from realsim.scanning.fusion.fuse import fuse_object
    from realsim.scanning.fusion.result import FusionConfig, FusionFrame

    store = inputs.store
    assert store is not None
    wrong = set(result.outliers) if result.poses == "unknown" else set[str]()
    cameras = dict(zip(result.geometry.names, result.geometry.Ts_world_cam, strict=True))
    if result.poses != "unknown":
        # A view of bare table has no features, but the robot knows where it was taken.
        for path, T in zip(inputs.paths, inputs.Ts_world_cam, strict=True):
            if T is not None:
                cameras.setdefault(path.name, T)
    frames: list[FusionFrame] = []
    for name, T in sorted(cameras.items()):
        depth = inputs.depth_of(name)
        if depth is None or name in wrong:
            continue
        index = int(Path(name).stem)
        frames.append(FusionFrame(index=index, depth_m=depth, T_world_cam=T, rgb=store.rgb(index)))
    return fuse_object(result.geometry.intrinsics, frames, FusionConfig(at_m=at_m))


def _write_dense(fused: "FusedObject", out: Path) -> None:
    """Write the mesh [m] in axes of its own, its report and its picture."""
    from realsim.geometry import se3
    from realsim.geometry.mesh import ply_bytes, transformed
    from realsim.scanning.fusion.picture import fusion_picture
    from realsim.store.atomic import write_bytes, write_json

    T_world_obj = own_frame(fused)
    mesh = transformed(fused.mesh, se3.invert(T_world_obj))
    write_bytes(out / MESH, ply_bytes(mesh, "m"))
    write_bytes(out / "dense.png", fusion_picture(fused))
    document: dict[str, Any] = {
        "verdict": fused.verdict, "reasons": list(fused.reasons), "notes": list(fused.notes),
        "unit": "m", "T_world_obj": T_world_obj.tolist(), "report": fused.report,
    }  # fmt: skip
    write_json(out / FUSION, document)


def own_frame(fused: "FusedObject") -> Array:
    """Return T_world_obj (4, 4): z up, the origin under the middle of the object on the table."""
    from realsim.geometry import se3

    T = fused.plane.T_world_table.copy()
    in_table = se3.transform(se3.invert(T), fused.mesh.vertices)
    middle = 0.5 * (in_table.min(0) + in_table.max(0))
    T[:3, 3] = se3.transform(T, np.array([middle[0], middle[1], 0.0]))[0]
    return T


def _show_dense(fused: "FusedObject", console: Console) -> None:
    extent = 1e3 * fused.mesh.extent
    c = fused.coverage
    console.table(
        "Mesh from depth", ["figure", "value"],
        [
            ["size (x, y, height)", " x ".join(f"{x:.1f}" for x in extent) + " mm"],
            ["faces", str(len(fused.mesh.faces))],
            ["surface measured", f"{c.measured:.0%}, above the table's edge "
                                 f"{c.measured_above_cut:.0%}"],
            ["sigma along the normal, median", f"{1e3 * np.nanmedian(fused.sigma_m):.2f} mm"],
            ["verdict", fused.verdict],
        ],
    )  # fmt: skip
    for text in (*fused.notes, *fused.reasons):
        console.say(f"          {text}")


__all__ = ["SfmRequest", "run_scan_sfm", "show_sfm"]
PLACE = "scans/sfm"
"""Where in a session the result lies."""
STEPS = {"features": "features", "matches": "matches", "mapping": "cameras and points"}
"""Steps of the reconstruction as they are shown."""
WORST_VIEWS = 8
"""Views listed in the table, the farthest from the robot first."""


def run_scan_sfm(request: SfmRequest, console: Console) -> bool:
    """Reconstruct, write, show; return whether everything was accepted.

    Raises:
        InputError: the images, the camera or the poses cannot be used.
        DegenerateError: the images do not determine a reconstruction.
    """
    from threadpoolctl import threadpool_limits

    from realsim.scanning.sfm.database import images_digest
    from realsim.scanning.sfm.pictures import write_pictures
    from realsim.scanning.sfm.result import result_json, write_result
    from realsim.store.atomic import only_run_in

    inputs = sfm_inputs(request)
    if request.dense and not inputs.has_depth:
        raise InputError(
            f"--dense was asked for, and '{request.images}' has no depth images: a mesh is fused "
            "from measured depth, not from photographs. Leave --dense out, or capture with depth."
        )
    out = request.out or request.images / (PLACE if inputs.store is not None else "sfm")
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file; give --out a folder that may be made or filled.")
    out.mkdir(parents=True, exist_ok=True)
    config = SfmConfig(seed=request.seed)
    for note in inputs.notes:
        console.say(f"note      {note}")
    with only_run_in(out), threadpool_limits(limits=1):
        result = _reconstructed(request, inputs, config, out, console)
        about = {"source": request.images.name, "images_sha256": images_digest(inputs.paths)}
        write_result(result, config, out, about)
        pictures = write_pictures(result, out)
        if request.text:
            _write_text_model(out)
        show_sfm(result, console)
        dense_good = mesh_from_depth(request, inputs, result, out, console)
    console.result(result_json(result, config) | {"folder": out, "dense_accepted": dense_good})
    console.say(f"cameras   {out / 'cameras.json'}")
    console.say(f"points    {out / 'sparse.ply'}")
    console.say(f"model     {out / 'model'} (COLMAP)")
    for picture in pictures:
        console.say(f"picture   {picture}")
    return result.verdict == "accepted" and dense_good


def _reconstructed(
    request: SfmRequest, inputs: SfmInputs, config: SfmConfig, out: Path, console: Console
) -> SfmResult:
    """Run the reconstruction."""
    from realsim.scanning.sfm.reconstruct import reconstruct, with_depth

    import_pycolmap()  # before anything else does
    with console.steps("sfm") as tell:
        result = reconstruct(
            inputs.paths, inputs.intrinsics, config, poses=inputs.poses,
            Ts_world_cam=inputs.Ts_world_cam, masks=sfm_masks(request, inputs), folder=out,
            progress=lambda step, done, total: tell(STEPS.get(step, step), done, total),
        )  # fmt: skip
    return with_depth(result, inputs.depth_of, config) if inputs.has_depth else result


def _write_text_model(out: Path) -> None:
    import pycolmap

    from realsim.scanning.sfm.mapping import save_model

    save_model(pycolmap.Reconstruction(str(out / "model")), out / "model_text", text=True)


def show_sfm(result: SfmResult, console: Console) -> None:
    """Print the tables, the verdict and why."""
    console.table("Structure from motion", ["figure", "value"], _figures(result))
    views = () if result.alignment is None else result.alignment.views
    worst = sorted(views, key=lambda v: -v.offset_mm)[:WORST_VIEWS]
    if worst:
        rows = [
            [v.name, f"{v.offset_mm:.2f}", f"{v.turn_deg:.3f}", "yes" if v.outlier else ""]
            for v in worst
        ]
        console.table(
            f"Cameras against the robot, the {len(worst)} farthest of {len(views)}",
            ["view", "[mm]", "[deg]", "outlier"], rows,
        )  # fmt: skip
    for note in result.notes:
        console.say(f"note      {note}")
    console.say(f"verdict   {result.verdict}")
    for reason in result.reasons:
        console.say(f"          {reason}")


def _figures(result: SfmResult) -> list[list[str]]:
    """Return the table's rows."""
    g, d, a = result.geometry, result.depth, result.alignment
    rows = [
        ["robot's poses", result.poses],
        ["views placed", f"{len(g.names)} of {len(result.matching.names)}"],
        ["points", f"{len(g.points)} (seen by {result.track_lengths.mean():.1f} views each)"],
        ["reprojection error, median", f"{result.reprojection_px:.2f} px"],
    ]
    if not result.is_metric:
        return [*rows, ["metric scale", "none"]]
    if result.poses == "unknown":
        rows.append(["metres per unit", f"{result.scale:.6g}"])
    rows.append(["sigma of the scale", f"{result.sigma_percent:.3f} %"])
    if a is not None and result.poses == "unknown":
        parts = ", ".join(f"{k} {v:.3f}" for k, v in a.parts_percent.items())
        rows.append(["   made of [%]", parts])
    if a is not None:
        mm = float(np.median([v.offset_mm for v in a.views]))
        deg = float(np.median([v.turn_deg for v in a.views]))
        rows.append(["cameras from the robot, median", f"{mm:.2f} mm, {deg:.3f} deg"])
    rows.append(["point sigma, median", f"{np.median(result.point_sigma_mm):.2f} mm"])
    told = "no depth" if d is None else f"{d.ratio:.4f} +- {d.sigma:.4f}"
    return [*rows, ["measured depth / reconstructed", told]]
