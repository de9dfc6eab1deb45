"""`realsim scan scale`: the metric scale of a mesh from a session, or from a measured length.

The result lies in SESSION/scans/NAME: scale.json is written last, so where it is, everything is.

What `realsim scan scale` writes: the model in millimetres, pictures, a page and scale.json.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.scan.scale.inputs import (
    NamedMesh,
    ScaleRequest,
    fit_config,
    inputs_of,
    read_mesh,
    usable_views,
)
from realsim.app.scan.scale.show import CALIPER, model_lines, show_fit, show_measured
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.json_values import json_value
from realsim.models.model_records import ScaleNote
from realsim.records import Mesh, View
from realsim.scanning.scale.files import (
    ScaleRecord,
    installed_versions,
    json_lines,
    load_record,
    record_to_json,
)
from realsim.scanning.scale.measured import smallest_box
from realsim.scanning.scale.result import ScaleFit
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import to_json

if TYPE_CHECKING:
    from realsim.models.library import ModelLibrary
    from realsim.models.model_records import LibraryModel


FILE = "scale.json"
MODEL_FILE = "model.ply"
"""The mesh at metric scale, in millimetres as every model file (BOP)."""


class Place:
    """The folder of a result: in the session, where its checksums are kept, or anywhere."""

    def __init__(self, store: SessionStore, folder: Path) -> None:
        """Name the folder; it is made by the first file."""
        self._store, self.folder = store, folder
        root, here = store.folder.resolve(), folder.resolve()
        self._inside = here.relative_to(root).as_posix() if here.is_relative_to(root) else None

    def record(self, key: str) -> ScaleRecord | None:
        """Return the result that is there if it was made from these inputs."""
        path = self.folder / FILE
        if not path.is_file():
            return None
        try:
            record = load_record(path)
        except InputError:
            return None  # a damaged result is none: it is made again
        return record if record.inputs.get("key") == key else None

    def write(self, name: str, data: bytes) -> None:
        """Write one file whole or not at all."""
        if self._inside is not None:
            self._store.write_bytes(f"{self._inside}/{name}", data)
        else:
            write_file(self.folder / name, data)


def write_file(path: Path, data: bytes) -> None:
    """Write one file whole or not at all."""
    with atomic.storing(path.parent, path.name):
        atomic.write_bytes(path, data)


def write_result(place: Place, record: ScaleRecord, named: NamedMesh, store: SessionStore) -> None:
    """Write the scaled model, the pictures, the page and, last, scale.json.

    First it stands there without its inputs: the folder is this command's, and not finished.
    """
    from realsim.app.scan.scale.show import page_bytes

    box_mm = 1e3 * record.fit.scale * smallest_box(named.mesh)
    place.write(FILE, result_bytes(replace(record, inputs={}), box_mm))
    for name, data in model_files(named.mesh, record.fit.scale).items():
        place.write(name, data)
    # The titles name one size: that of the object, which a caliper finds, not of the mesh's axes.
    titled = replace(record.fit, extent_mm=box_mm)
    pictures = _pictures(titled, named.mesh, store)
    for name, data in pictures.items():
        place.write(name, data)
    place.write("scale.html", page_bytes(record, pictures, place.folder, box_mm))
    place.write(FILE, result_bytes(record, box_mm))


def result_bytes(record: ScaleRecord, box_mm: Array) -> bytes:
    """Return the bytes of scale.json, with the smallest box (3,) [mm] beside the extents."""
    values = record_to_json(record)
    fit: dict[str, Any] = {}
    for key, value in values["fit"].items():
        fit[key] = value
        if key == "extent_mm":
            fit["smallest_box_mm"] = to_json(box_mm)
    return json_lines(values | {"fit": fit}).encode("utf-8")


def model_files(mesh: Mesh, scale: float) -> dict[str, bytes]:
    """Return the mesh at metric scale as PLY [mm], and its texture beside it."""
    from realsim import images
    from realsim.geometry.mesh import ply_bytes

    texture = Path(MODEL_FILE).with_suffix(".png").name if mesh.texture is not None else ""
    scaled = replace(mesh, vertices=scale * mesh.vertices)
    files = {} if mesh.texture is None else {texture: images.png_bytes(mesh.texture)}
    return files | {MODEL_FILE: ply_bytes(scaled, "mm", texture_file=texture)}


def _pictures(fit: ScaleFit, mesh: Mesh, store: SessionStore) -> dict[str, bytes]:
    """Return every picture that can be drawn of the fit."""
    from realsim.scanning.scale.picture_overlays import Photograph, chosen_views, overlays_png
    from realsim.scanning.scale.pictures import candidates_png, residuals_png, views_png

    made: dict[str, Callable[[], bytes]] = {"residuals.png": lambda: residuals_png(mesh, fit)}
    if fit.views:
        made["views.png"] = lambda: views_png(fit)
    if any(np.isfinite(c.score) for c in fit.candidates):
        made["candidates.png"] = lambda: candidates_png(fit)
    cameras = store.session.Ts_world_cam
    photographs = [
        Photograph(index=k, rgb=store.rgb(k), depth_m=store.depth_m(k), T_world_cam=cameras[k])
        for k in chosen_views(fit) if k in cameras
    ]  # fmt: skip
    if photographs:
        made["overlays.png"] = lambda: overlays_png(
            mesh, fit, store.session.intrinsics, photographs
        )
    return {name: draw() for name, draw in made.items()}


FOLDER = "scans"
"""Where in a session the results lie."""
ROUGH = 0.3
"""A rough size may be off by this share; beyond, one of both is wrong."""
MEASURED_FORMAT = "realsim scale by measurement"


def run_scale(request: ScaleRequest, console: Console) -> bool:
    """Find the scale, show it, write it; return whether it is accepted.

    Raises:
        InputError: the mesh, the session or what was typed cannot be used.
        DegenerateError: the session does not determine a scale.
    """
    from realsim.app.stages import open_session, require_sound

    if request.session is None:
        return _by_measurement(request, console)
    store = open_session(request.session)
    views = usable_views(store, request.views)
    named = read_mesh(request)
    require_sound(store)
    inputs = inputs_of(request, named, store, views, fit_config(store))
    place = Place(store, request.out or store.folder / FOLDER / named.name)
    known = None if request.overwrite else place.record(inputs["key"])
    record = known or _fitted(request, named, store, views, inputs, console)
    if known is None:
        write_result(place, record, named, store)
    fit, box_mm = record.fit, 1e3 * record.fit.scale * smallest_box(named.mesh)
    show_fit(named.name, fit, record.measured, box_mm, console)
    console.say(*[f"note: {note}" for note in named.notes])
    _say_of_model(named, fit, console)
    if known is not None:
        console.say(f"nothing has changed since {place.folder / FILE} was written; --overwrite "
                    "does it again.")  # fmt: skip
    console.say(f"result    {place.folder}")
    found = ScaleNote(
        scale=fit.scale, sigma_percent=fit.sigma_percent, verdict=fit.verdict, reasons=fit.reasons,
        session=store.session.name, how="fit and measured" if record.measured else "fit",
    )  # fmt: skip
    result = result_bytes(record, box_mm)
    _finish(request, named, result, place.folder / MODEL_FILE, found, console)
    is_accepted = fit.verdict == "accepted"
    if is_accepted and not record.measured:
        console.say(CALIPER)
    return is_accepted


# --- the fit ----------------------------------------------------------------------------------


def _fitted(
    request: ScaleRequest,
    named: NamedMesh,
    store: SessionStore,
    views: Sequence[View],
    inputs: Mapping[str, Any],
    console: Console,
) -> ScaleRecord:
    """Fit the scale, and take in what was measured by hand."""
    from realsim.registration.evidence import DepthFrame
    from realsim.scanning.scale.fit import fit_scale
    from realsim.scanning.scale.measured_check import with_measurements

    config = fit_config(store)
    frames = [
        DepthFrame(index=v.index, depth_m=store.depth_m(v.index), T_world_cam=v.T_world_cam)
        for v in views
        if v.T_world_cam is not None
    ]
    with console.stage("scale", f"{named.name}, {len(frames)} views") as tick:
        fit = fit_scale(
            named.mesh, store.session.intrinsics, frames, config,
            start=request.start, at=request.at, size_m=request.size_m, progress=tick,
        )  # fmt: skip
    fit = with_rough_size(fit, named.mesh, request.size_m)
    fit, checks = with_measurements(fit, named.mesh, request.measured)
    return ScaleRecord(
        fit=fit, inputs=dict(inputs), config=asdict(config), measured=checks,
        poses=view_poses(fit, views), versions=installed_versions(),
    )  # fmt: skip


def with_rough_size(fit: ScaleFit, mesh: Mesh, size_m: float | None) -> ScaleFit:
    """Return the fit, doubtful where it contradicts the rough size that was typed."""
    from realsim.scanning.scale.measured import Measurement, length_of, typo

    if size_m is None:
        return fit
    rough = Measurement(kind="longest", value_m=size_m, sigma_m=ROUGH * size_m)
    fitted_m = fit.scale * length_of(mesh, rough)
    ratio = size_m / fitted_m
    if abs(np.log(ratio)) <= np.log1p(ROUGH):
        return fit
    slip = typo(ratio)
    reason = (
        f"the longest side was said to be about {1e3 * size_m:.4g} mm and was fitted as "
        f"{1e3 * fitted_m:.4g} mm{f' ({slip})' if slip else ''}."
    )
    verdict = "doubtful" if fit.verdict == "accepted" else fit.verdict
    return replace(fit, verdict=verdict, reasons=(*fit.reasons, reason))


def view_poses(fit: ScaleFit, views: Sequence[View]) -> tuple[dict[str, Any], ...]:
    """Return per view where the camera stood, and the scaled mesh in it, for other programs."""
    return tuple(
        {
            "index": v.index,
            "T_world_cam": v.T_world_cam.tolist(),
            "T_cam_obj": (se3.invert(v.T_world_cam) @ fit.T_world_obj).tolist(),
        }
        for v in views
        if v.T_world_cam is not None
    )


def _say_of_model(named: NamedMesh, fit: ScaleFit, console: Console) -> None:
    """Say what the fit means for a model that has a scale already."""
    if named.origin != "model":
        return
    off, sigmas = 100 * (fit.scale - 1), abs(fit.scale - 1) / fit.sigma
    console.say(
        f"the library's model {named.where} has a metric scale: by this session its size is "
        f"{off:+.2f} % off ({sigmas:.1f} sigma). It was not changed."
    )


def _finish(
    request: ScaleRequest, named: NamedMesh, result: bytes, model: Path | None, note: ScaleNote,
    console: Console,
) -> None:  # fmt: skip
    """Hand the result on, say where the scaled model lies, and put it into the library."""
    if request.json is not None:
        write_file(request.json, result)
    console.result(json.loads(result))
    stored = request.library is not None or named.origin == "model"
    console.say(*model_lines(named, model, note.verdict, is_stored=stored))
    promote(request, named, note, console)


# --- without a session ------------------------------------------------------------------------


def _by_measurement(request: ScaleRequest, console: Console) -> bool:
    """Take the scale from measured lengths alone; it is 'unchecked' and never accepted."""
    from realsim.scanning.scale.measured import scale_from

    if not request.measured:
        raise InputError(
            f"'{request.mesh}' needs something that knows metres: a SESSION with depth images, or "
            "a measured length such as --measured longest=120.4mm."
        )
    for option, value in (
        ("--start-file", request.start), ("--at", request.at), ("--only-views", request.views),
        ("--rough-size", request.size_m),
    ):  # fmt: skip
        if value:
            raise InputError(f"{option} speaks of a session; give SESSION, or leave it away.")
    named = read_mesh(request)
    scale, sigma, each = scale_from(named.mesh, request.measured)
    size_mm = [1e3 * scale * float(e) for e in named.mesh.extent]
    box_mm = [float(side) for side in 1e3 * scale * smallest_box(named.mesh)]
    show_measured(named.name, (scale, sigma), each, (box_mm, size_mm), console)
    console.say(*[f"note: {note}" for note in named.notes])
    reason = "the scale rests on a length measured by hand; no session has checked it."
    values: dict[str, Any] = {
        "format": MEASURED_FORMAT, "format_version": 1, "verdict": "unchecked",
        "reasons": [reason], "scale": scale, "sigma": sigma,
        "interval_95": [scale - 1.96 * sigma, scale + 1.96 * sigma], "extent_mm": size_mm,
        "smallest_box_mm": box_mm,
        "measured": [asdict(e) | {"text": e.measurement.text} for e in each],
        "mesh": {"name": named.name, "where": named.where, "sha256": named.sha256},
        "versions": installed_versions(),
    }  # fmt: skip
    text = json_lines(json_value(values)).encode("utf-8")
    if request.out is not None:
        files = {FILE: text} | model_files(named.mesh, scale)  # a run that is ended leaves no model
        if all((request.out / name).exists() for name in files) and not request.overwrite:
            raise InputError(f"{request.out / FILE} exists; --overwrite replaces it.")
        for name, data in files.items():
            write_file(request.out / name, data)
        console.say(f"result    {request.out}")
    model = None if request.out is None else request.out / MODEL_FILE
    found = ScaleNote(
        scale=scale, sigma_percent=100 * sigma / scale, verdict="unchecked", reasons=(reason,),
        session="", how="measured",
    )  # fmt: skip
    _finish(request, named, text, model, found, console)
    return False


# --- into the library -------------------------------------------------------------------------


def promote(request: ScaleRequest, named: NamedMesh, note: ScaleNote, console: Console) -> None:
    """Put the scaled model into the library that is named, if its scale may be used.

    Raises:
        InputError: the folder is no library, another model has the name, or the mesh is unusable.
    """
    from realsim.models.library import ModelLibrary

    if request.library is None or named.origin == "model":
        return
    if note.verdict != "accepted" and not request.accept_doubtful:
        console.warn(
            f"{named.name} was not put into the library {request.library}: its scale "
            f"is {note.verdict}. --accept-doubtful puts it there all the same."
        )
        return
    library = ModelLibrary.create(request.library)
    for e in library.entries():
        scale = None if e.properties is None else e.properties.scale
        is_same = e.name == named.name and scale is not None and scale.scale == note.scale
        if is_same and e.obj_id is not None and not request.overwrite:
            console.say(f"library   {request.library}: {e.name} ({e.obj_id}) is there already")
            return
    with console.stage("library", named.name):
        added = _added(library, request, named, note)
    console.say(f"library   {request.library}: {added.model.name} ({added.model.obj_id})")


def _added(
    library: "ModelLibrary", request: ScaleRequest, named: NamedMesh, note: ScaleNote
) -> "LibraryModel":
    """Return the model in the library: promoted where it waits there, else made from the mesh."""
    from realsim.models.library_prepare import Matter, PrepareConfig, prepare_mesh
    from realsim.models.pictures import sheet_png

    matter = Matter(density=request.density, mass_kg=request.mass)
    waits_here = named.library is not None and named.library.resolve() == library.folder.resolve()
    if named.origin == "unscaled" and waits_here and named.entry == named.name:
        return library.promote(
            named.name, note, matter=matter, obj_id=request.obj_id, overwrite=request.overwrite
        )
    scaled = replace(named.mesh, vertices=note.scale * named.mesh.vertices)
    made = prepare_mesh(scaled, PrepareConfig(), matter, source=named.source, scale=note)
    picture = sheet_png(made.mesh, made.properties, made.parts, named.name)
    return library.add(
        made, named.name, obj_id=request.obj_id, overwrite=request.overwrite, picture=picture
    )
