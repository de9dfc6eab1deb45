"""`realsim scan sfm`: photographs to metric cameras and points, depth images to a mesh."""

from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.app.scan.sfm.dense import mesh_from_depth
from realsim.app.scan.sfm.inputs import SfmInputs, SfmRequest, sfm_inputs, sfm_masks
from realsim.errors import InputError
from realsim.interop import import_pycolmap
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.result import SfmResult

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

    from realsim.scanning.sfm.files import result_json, write_result
    from realsim.scanning.sfm.photographs import images_digest
    from realsim.scanning.sfm.pictures import write_pictures
    from realsim.store.lock import only_run_in

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
