"""`realsim depth-fit`: a depth camera's noise and holes from frames of a wall or a bare table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.profiles import PROFILES, profile

Item = TypeVar("Item")
FOLDER = click.Path(path_type=Path)
CAMERA_NAMES = ("camera.json", "intrinsics.json", "cam_K.txt", "camera.yaml", "intrinsics.yaml")
"""Files beside depth images that may hold their camera."""


@click.command("depth-fit")
@click.argument("source", type=FOLDER)
@click.option("--profile", "profile_name", default="d405", show_default=True,
              type=click.Choice(sorted(PROFILES)), help="The kind of camera.")  # fmt: skip
@click.option("--out", type=FOLDER, default=Path("depth_sensor.json"), show_default=True,
              help="The model; a picture of the fit is written beside it.")  # fmt: skip
@click.option("--views", default="", help="Only these views, such as 1-8.  [all, at most 12]")
@click.option("--camera", type=FOLDER, default=None, help="File with the intrinsics, for a FOLDER.")
@click.option("--unit", "unit_m", type=float, default=None,
              help="Metres per count of a FOLDER's depth images.  [the profile's]")  # fmt: skip
@click.option("--baseline", "baseline_m", type=float, default=None,
              help="Distance of the eyes [m].  [the profile's]")  # fmt: skip
@click.option("--quiet", is_flag=True, help="No progress bars.")
def depth_fit(source: Path, quiet: bool, **options: Any) -> None:
    """Fit the depth camera's noise and holes to frames of a wall or a bare table.

    \b
    SOURCE  a session with depth, or a folder of 16-bit depth PNGs of a plane

    Three to twelve frames from different distances and angles say the most; the plane should fill
    most of each. What the frames do not determine is said and kept from the profile. The file can
    be given wherever depth is simulated.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console

    run_depth_fit(source, Console(quiet=quiet), **options)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthFrames:
    """The depth images that a sensor is fitted to."""

    depths_m: tuple[NDArray[np.float32], ...]
    names: tuple[str, ...]
    intrinsics: CameraIntrinsics
    unit_m: float
    """Metres per count of their files."""


MOST_FRAMES = 12
"""More frames take longer and say little more."""


def run_depth_fit(
    source: Path,
    console: Any,
    *,
    profile_name: str,
    out: Path,
    views: str,
    camera: Path | None,
    unit_m: float | None,
    baseline_m: float | None,
) -> None:
    """Fit, say what was found, and write the model and its picture.

    Raises:
        InputError: the frames, the camera or an option cannot be used.
    """
    from dataclasses import replace

    from realsim.rendering.depth_sensors.fit import fit_depth_model
    from realsim.rendering.depth_sensors.fit_picture import fit_picture
    from realsim.store.atomic import write_bytes, write_json

    kind = profile(profile_name)
    if baseline_m is not None:
        kind = replace(kind, baseline_m=baseline_m)
    frames = read_frames(source, views, camera, kind.depth_unit_m if unit_m is None else unit_m)
    with console.stage(f"fitting {len(frames.names)} frames"):
        fit = fit_depth_model(
            frames.depths_m, frames.intrinsics, kind, unit_m=frames.unit_m, names=frames.names
        )
        picture = fit_picture(fit)
    rows = [
        (name, f"{e.value:.4g}", f"{e.uncertainty:.2g}" if e.determined else "not determined")
        for name, e in fit.estimates.items()
    ]
    console.table("the sensor", ("parameter", "value", "uncertainty"), rows)
    for note in fit.notes:
        console.say(note)
    write_json(out, fit.document())
    write_bytes(out.with_suffix(".png"), picture)
    console.say(f"{out} and {out.with_suffix('.png').name} are written.")


def read_frames(source: Path, views: str, camera: Path | None, unit_m: float) -> DepthFrames:
    """Return the depth images of a session or of a folder.

    Raises:
        InputError: there are none, or the camera is not known.
    """
    if (source / "session.json").is_file():
        return _of_session(source, views)
    if not source.is_dir():
        raise InputError(
            f"'{source}' is no folder; a session (it holds session.json) or a folder of 16-bit "
            "depth PNGs is taken."
        )
    return _of_folder(source, views, camera, unit_m)


def _of_session(source: Path, views: str) -> DepthFrames:
    from realsim.app.option_values import numbers_of
    from realsim.store import SessionStore

    with SessionStore.open(source) as store:
        wanted = numbers_of(views)
        indices = [
            i for i in sorted(store.completed) if store.has_depth(i) and (not wanted or i in wanted)
        ]
        if not indices:
            raise InputError(
                f"{source} has no views with depth{' among ' + views if views else ''}."
            )
        indices = _spread(indices, bool(wanted))
        return DepthFrames(
            depths_m=tuple(store.depth_m(i) for i in indices),
            names=tuple(f"view {i}" for i in indices),
            intrinsics=store.session.intrinsics,
            unit_m=store.session.depth_unit_m,
        )


def _of_folder(source: Path, views: str, camera: Path | None, unit_m: float) -> DepthFrames:
    from realsim.app.import_folder import camera_of_file
    from realsim.app.option_values import numbers_of
    from realsim.formats.images import image_size, read_depth

    place = source / "depth" if (source / "depth").is_dir() else source
    paths = sorted(place.glob("*.png"))
    if not paths:
        raise InputError(f"{place} holds no PNG; 16-bit depth images of a plane are looked for.")
    wanted = numbers_of(views)
    if wanted:
        paths = [p for k, p in enumerate(paths) if k in wanted]
        if not paths:
            raise InputError(f"--views {views} names none of the images of {place} (from 0 on).")
    paths = _spread(paths, bool(wanted))
    if camera is None:
        beside = [f / n for f in (source, place) for n in CAMERA_NAMES if (f / n).is_file()]
        if not beside:
            raise InputError(
                f"the camera of {source} is not known: give --camera FILE, or put a camera.json "
                "beside the images."
            )
        camera = beside[0]
    return DepthFrames(
        depths_m=tuple(read_depth(p, unit_m) for p in paths),
        names=tuple(p.name for p in paths),
        intrinsics=camera_of_file(camera, image_size(paths[0])),
        unit_m=unit_m,
    )


def _spread(items: Sequence[Item], chosen: bool) -> list[Item]:
    """Return all items that were asked for, otherwise at most MOST_FRAMES evenly among them."""
    if chosen or len(items) <= MOST_FRAMES:
        return list(items)
    places = np.linspace(0, len(items) - 1, MOST_FRAMES).round().astype(int)
    return [items[k] for k in places]
