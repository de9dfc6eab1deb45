"""Runs `realsim depth-fit`: frames of a session or a folder in; a sensor's JSON and picture out."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from realsim.app.outputs import require_free_file
from realsim.arrays import Array32, evenly
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.profiles import NOMINAL_FOCAL_PX, DepthProfile, profile
from realsim.store.opening import require_header
from realsim.untrusted.arrays import read_npy

if TYPE_CHECKING:
    from realsim.rendering.depth_sensors.fit import FittedDepthModel
    from realsim.rendering.stereo.fit import FittedStereo

CAMERA_NAMES = ("camera.json", "intrinsics.json", "cam_K.txt", "camera.yaml", "intrinsics.yaml")
"""Files beside depth images that may hold their camera."""
MOST_FRAMES = 12
"""More frames take longer and say little more."""
SENSOR_MARKS = {".json": (' sensor 1"',)}
"""What every file of a sensor holds."""
OUT = {"disparity": Path("depth_sensor.json"), "stereo": Path("stereo_sensor.json")}
"""What is written where `--out` is not given."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthFrames:
    """The depth images that a sensor is fitted to."""

    depths_m: tuple[Array32, ...]
    names: tuple[str, ...]
    intrinsics: CameraIntrinsics
    unit_m: float
    """Metres per count of their files."""
    is_nominal: bool = False
    """Whether the camera is that of its kind, not the frames' own."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthFitRequest:
    """The options of `realsim depth-fit`."""

    sensor: str = "d405"
    simulator: Literal["disparity", "stereo"] = "disparity"
    out: Path | None = None
    views: tuple[int, ...] = ()
    intrinsics: Path | None = None
    depth_unit: float | None = None
    """Metres per count of a folder's images; None = the sensor's."""
    baseline_m: float | None = None


def run_depth_fit(source: Path, request: DepthFitRequest, console: Any) -> None:
    """Fit, say what was found, and write the sensor and its picture.

    Raises:
        InputError: the frames, the camera or an option cannot be used.
    """
    from realsim.rendering.depth_sensors.fit import fit_depth_model
    from realsim.rendering.depth_sensors.fit_pictures import fit_picture, stereo_fit_picture
    from realsim.rendering.stereo.fit import FittedStereo, fit_stereo
    from realsim.store.atomic import write_bytes, write_json

    simulator = request.simulator
    out = OUT[simulator] if request.out is None else request.out
    require_free_file(out, "--out", SENSOR_MARKS, "sensor", (".png",))
    kind = profile(request.sensor)
    if request.baseline_m is not None:
        kind = replace(kind, baseline_m=request.baseline_m)
    unit_m = kind.depth_unit_m if request.depth_unit is None else request.depth_unit
    frames = read_frames(source, request.views, request.intrinsics, unit_m, kind.name)
    if frames.is_nominal:
        console.say(
            f"no camera is given: the nominal focal length of a {kind.name}, "
            f"{frames.intrinsics.fx:g} px, is taken; noise and step in pixels are as far off as it."
        )
    with console.stage(f"fitting {len(frames.names)} frames") as tick:
        fit = (fit_stereo if simulator == "stereo" else fit_depth_model)(
            frames.depths_m, frames.intrinsics, kind, unit_m=frames.unit_m, names=frames.names,
            tick=tick,
        )  # fmt: skip
        picture = stereo_fit_picture(fit) if isinstance(fit, FittedStereo) else fit_picture(fit)
    if isinstance(fit, FittedStereo):
        _show_stereo(fit, kind, console)
    else:
        _show_disparity(fit, console)
    console.say(*fit.notes)
    document = fit.document()
    write_json(out, document)
    write_bytes(out.with_suffix(".png"), picture)
    console.say(f"sensor    {out}")
    console.say(f"picture   {out.with_suffix('.png')}")
    console.result(document | {"file": out, "picture": out.with_suffix(".png")})


def _show_disparity(fit: "FittedDepthModel", console: Any) -> None:
    """Say what the fit of the disparity-space model found."""
    rows = [
        (name, f"{e.value:.4g}", f"{e.uncertainty:.2g}")
        if e.determined
        else (name, f"{getattr(fit.model, name, e.value):.4g}", "not determined: kept")
        for name, e in fit.estimates.items()
    ]
    console.table("the sensor", ("parameter", "value", "uncertainty"), rows)


def _show_stereo(fit: "FittedStereo", kind: DepthProfile, console: Any) -> None:
    """Say what the fit of the stereo simulator found."""
    from realsim.rendering.stereo.fit import SEARCHED

    rows = [(name, f"{getattr(fit.config, name):.4g}") for name in SEARCHED[kind.second_eye]]
    console.table("the simulator", ("setting", "value"), rows)
    rows = [
        (f.name, f"{f.distance_m:.3f}", f"{f.measured.sigma_px:.3f}", f"{f.simulated.sigma_px:.3f}",
         f"{100 * f.measured.hole_share:.1f}", f"{100 * f.simulated.hole_share:.1f}")
        for f in fit.frames
    ]  # fmt: skip
    head = ("frame", "distance [m]", "noise [px]", "simulated", "holes [%]", "simulated")
    console.table("the frames and their twins", head, rows)


def read_frames(
    source: Path, views: tuple[int, ...], camera: Path | None, unit_m: float, kind: str
) -> DepthFrames:
    """Return the depth images of a session or of a folder, by a kind of camera.

    Raises:
        InputError: there are none, or the camera is not known.
    """
    require_header(source)
    if (source / "session.json").is_file():
        return _of_session(source, views)
    if not source.is_dir():
        raise InputError(
            f"'{source}' is no folder; a session (it holds session.json) or a folder of 16-bit "
            "depth images (PNG or NPY) is taken."
        )
    return _of_folder(source, views, camera, unit_m, kind)


def _of_session(source: Path, wanted: tuple[int, ...]) -> DepthFrames:
    from realsim.store import SessionStore

    with SessionStore.open(source) as store:
        indices = [
            i for i in sorted(store.completed) if store.has_depth(i) and (not wanted or i in wanted)
        ]
        if not indices:
            raise InputError(f"{source} has no views with depth{' among them' if wanted else ''}.")
        indices = indices if wanted else evenly(indices, MOST_FRAMES)
        return DepthFrames(
            depths_m=tuple(store.depth_m(i) for i in indices),
            names=tuple(f"view {i}" for i in indices),
            intrinsics=store.session.intrinsics,
            unit_m=store.session.depth_unit_m,
        )


def _of_folder(
    source: Path, wanted: tuple[int, ...], camera: Path | None, unit_m: float, kind: str
) -> DepthFrames:
    from realsim.app.importing.folder import camera_of_file

    place = source / "depth" if (source / "depth").is_dir() else source
    # Arrays are depth; beside them PNGs are the colour.
    paths = sorted(place.glob("*.npy")) or sorted(place.glob("*.png"))
    if not paths:
        raise InputError(
            f"{place} holds no PNG and no NPY; 16-bit depth images of a plane are looked for."
        )
    if wanted:
        paths = [p for k, p in enumerate(paths) if k in wanted]
        if not paths:
            raise InputError(f"--only-views names none of the images of {place} (from 0 on).")
    paths = paths if wanted else evenly(paths, MOST_FRAMES)
    depths = tuple(_depth_of(p, unit_m) for p in paths)
    height, width = depths[0].shape
    beside = [f / n for f in (source, place) for n in CAMERA_NAMES if (f / n).is_file()]
    camera = camera or next(iter(beside), None)
    nominal = NOMINAL_FOCAL_PX.get(kind, {}).get((width, height))
    if camera is not None:
        intrinsics = camera_of_file(camera, (width, height))
    elif nominal is not None:
        intrinsics = CameraIntrinsics(
            width=width, height=height, fx=nominal, fy=nominal,
            cx=(width - 1) / 2, cy=(height - 1) / 2,
        )  # fmt: skip
    else:
        raise InputError(
            f"the camera of {source} is not known: give --intrinsics FILE, or put a camera.json "
            "beside the images."
        )
    for path, depth in zip(paths, depths, strict=True):
        if depth.shape != (intrinsics.height, intrinsics.width):
            raise InputError(
                f"{path.name} is {depth.shape[1]}x{depth.shape[0]}, and the camera "
                f"of {camera.name if camera else paths[0].name} is "
                f"{intrinsics.width}x{intrinsics.height}: the intrinsics of another resolution or "
                "stream do not fit. Give those of the depth images."
            )
    return DepthFrames(
        depths_m=depths, names=tuple(p.name for p in paths), intrinsics=intrinsics, unit_m=unit_m,
        is_nominal=camera is None,
    )  # fmt: skip


def _depth_of(path: Path, unit_m: float) -> Array32:
    """Return a depth image of counts, PNG or NPY [m]."""
    from realsim.images import read_depth

    if path.suffix != ".npy":
        return read_depth(path, unit_m)
    counts = read_npy(path)
    if counts.ndim != 2 or counts.dtype != np.uint16:
        raise InputError(
            f"{path} has the shape {counts.shape} and the type {counts.dtype}; depth counts of "
            "(rows, columns) and the type uint16 are taken."
        )
    return (counts * np.float64(unit_m)).astype(np.float32)
