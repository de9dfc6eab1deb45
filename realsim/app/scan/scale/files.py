"""What `realsim scan scale` writes: the model in millimetres, pictures, a page and scale.json."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.scan.scale.inputs import NamedMesh
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records import Mesh
from realsim.scanning.scale.files import ScaleRecord, json_lines, load_record, record_to_json
from realsim.scanning.scale.measured import smallest_box
from realsim.scanning.scale.result import ScaleFit
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import to_json

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
    from realsim.app.scan.scale.page import page_bytes

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
