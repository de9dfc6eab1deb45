"""The mesh of `realsim scan sfm`: depth images fused at the reconstructed cameras."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.scan.sfm.inputs import SfmInputs, SfmRequest
from realsim.arrays import Array
from realsim.errors import RealsimError
from realsim.scanning.sfm.result import SfmResult

if TYPE_CHECKING:
    from realsim.scanning.fusion.result import FusedObject

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
    console.say(f"next      realsim scan import {out / MESH} --unit m --name NAME")
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
