"""The mesh of `realsim scan sfm`: depth images fused at the reconstructed cameras."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.scan_sfm_inputs import SfmInputs
from realsim.errors import RealsimError
from realsim.scanning.sfm.result import SfmResult

if TYPE_CHECKING:
    from realsim.scanning.fusion.result import FusedObject

MESH, FUSION = "dense.ply", "dense.json"


def mesh_from_depth(
    asked: bool | None, inputs: SfmInputs, result: SfmResult, out: Path, console: Console
) -> bool:
    """Fuse the depth images at the reconstructed cameras; return whether nothing speaks against."""
    wanted = inputs.has_depth if asked is None else asked
    if not wanted:
        return True
    if not result.is_metric or result.verdict == "rejected":
        console.warn("no mesh: depth is fused at metric cameras that were not rejected.")
        return asked is None
    try:
        with console.stage("sfm", "mesh from depth") as tick:
            tick(0, 1)
            fused = _fused(inputs, result)
    except RealsimError as error:
        if asked:
            raise
        console.warn(f"no mesh: {error}")
        return True
    _write_dense(fused, out)
    _show_dense(fused, console)
    console.say(f"mesh      {out / MESH}")
    return fused.verdict == "accepted"


def _fused(inputs: SfmInputs, result: SfmResult) -> "FusedObject":
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
    return fuse_object(result.geometry.intrinsics, frames, None, FusionConfig())


def _write_dense(fused: "FusedObject", out: Path) -> None:
    """Write the mesh [m] in world, its report and its picture."""
    from realsim.geometry.mesh import ply_bytes
    from realsim.scanning.fusion.picture import fusion_picture
    from realsim.store.atomic import write_bytes, write_json

    write_bytes(out / MESH, ply_bytes(fused.mesh, "m"))
    write_bytes(out / "dense.png", fusion_picture(fused))
    document: dict[str, Any] = {
        "verdict": fused.verdict, "reasons": list(fused.reasons), "notes": list(fused.notes),
        "report": fused.report,
    }  # fmt: skip
    write_json(out / FUSION, document)


def _show_dense(fused: "FusedObject", console: Console) -> None:
    extent = 1e3 * fused.mesh.extent
    c = fused.coverage
    console.table(
        "Mesh from depth", ["figure", "value"],
        [
            ["size (world axes)", " x ".join(f"{x:.1f}" for x in extent) + " mm"],
            ["faces", str(len(fused.mesh.faces))],
            ["surface measured", f"{c.measured:.0%}, above the table's edge "
                                 f"{c.measured_above_cut:.0%}"],
            ["sigma along the normal, median", f"{1e3 * np.nanmedian(fused.sigma_m):.2f} mm"],
            ["verdict", fused.verdict],
        ],
    )  # fmt: skip
    for text in (*fused.notes, *fused.reasons):
        console.say(f"          {text}")
