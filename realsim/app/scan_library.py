"""`realsim scan list`, `show`, `check` and `complete`: what a model library holds."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.errors import InputError, RealsimError
from realsim.models.library_records import ModelProperties
from realsim.records import Mesh

SHOWN = 40
"""Findings of a check that are listed; the rest is counted (`--json` has all)."""
NEAR_SHOWN = 2
"""Refused symmetries that are listed; they come in families."""
NONE = "-"


def list_library(folder: Path, console: Console) -> None:
    """Print a table of all models.

    Raises:
        InputError: the folder is no library.
    """
    from realsim.models.library_reading import LibraryEntry, LibraryReader

    def row(e: LibraryEntry) -> tuple[str, ...]:
        p = e.properties
        size = _info_size(e.info)
        if p is None:
            return (
                e.name,
                str(e.obj_id),
                size,
                NONE,
                _info_symmetries(e.info),
                NONE,
                NONE,
                "not known",
            )
        scale = NONE if p.scale is None else "not known"
        if p.scale is not None and p.scale.sigma_percent is not None:
            scale = f"{p.scale.sigma_percent:.2g} %"
        mass = NONE if p.matter is None else f"{1e3 * p.matter.mass_kg:.4g}"
        return (
            e.name, NONE if e.obj_id is None else str(e.obj_id), size, mass,
            _symmetries(p), NONE if p.convex is None else str(p.convex.parts),
            scale if e.obj_id is not None else "unscaled", p.verdict,
        )  # fmt: skip

    entries = LibraryReader.open(folder).entries()
    if not entries:
        console.say(f"{folder} holds no models yet; `realsim scan import MESH --library {folder}`.")
        return
    header = (
        "name",
        "id",
        "size [mm]",
        "mass [g]",
        "symmetries",
        "parts",
        "scale sigma",
        "verdict",
    )
    console.table(f"{len(entries)} models in {folder}", header, [row(e) for e in entries])
    unknown = [e for e in entries if e.properties is None]
    if unknown:
        console.say(
            f"{len(unknown)} of them have no properties (not imported by realsim): "
            f"`realsim scan complete {folder}` computes them."
        )


def _info_size(info: Any) -> str:
    sizes = [info.get(f"size_{a}") for a in "xyz"]
    is_there = all(isinstance(s, int | float) for s in sizes)
    return " x ".join(f"{s:.1f}" for s in sizes) if is_there else NONE


def _info_symmetries(info: Any) -> str:
    discrete, axes = info.get("symmetries_discrete", ()), info.get("symmetries_continuous", ())
    return _symmetry_words(len(discrete) + 1, len(axes))


def _symmetries(p: ModelProperties) -> str:
    s = p.symmetries
    return NONE if s is None else _symmetry_words(len(s.discrete), len(s.axes))


def _symmetry_words(discrete: int, axes: int) -> str:
    said = [f"{axes} axes" if axes > 1 else "axis"] if axes else []
    said += [f"{discrete}-fold"] if discrete > 1 else []
    return " + ".join(said) or "none"


def show_model(folder: Path, name: str, console: Console) -> None:
    """Print what is known of a model, and make its picture where there is none.

    Raises:
        InputError: there is no such model.
    """
    from realsim.models import library_files as files
    from realsim.models.library_reading import LibraryReader
    from realsim.models.pictures import sheet_png
    from realsim.store import atomic

    library = LibraryReader.open(folder)
    unscaled = (folder / files.UNSCALED / name / files.UNSCALED_REPORT).is_file()
    names = {e.name for e in library.entries() if e.obj_id is not None}
    if unscaled and name not in names:
        raw = library.load_unscaled(name)
        say_model(console, folder, name, None, raw.mesh, raw.properties)
        return
    found = library.load(name)
    model = found.model
    for note in found.notes:
        console.say(f"note: {note}")
    if found.properties is None:
        size = " x ".join(f"{1e3 * x:.1f}" for x in model.mesh.extent)
        console.say(
            f"{model.name} (object {model.obj_id}): {size} mm, {len(model.mesh.faces)} faces, "
            f"{_symmetry_words(len(model.symmetries), len(model.symmetry_axes))} symmetries. "
            f"`realsim scan complete {folder} {model.name}` computes the rest."
        )
        return
    picture = folder / files.picture_file(model.name)
    if not picture.is_file():
        atomic.write_bytes(
            picture, sheet_png(model.mesh, found.properties, found.parts, model.name)
        )
    say_model(console, folder, model.name, model.obj_id, model.mesh, found.properties)


def run_library_check(folder: Path, console: Console, *, as_json: bool) -> bool:
    """Print what of a library is not as it should be; return whether every model can be used.

    Raises:
        InputError: no library, or its list of models is damaged.
    """
    from realsim.models.library_check import check_library
    from realsim.models.library_reading import LibraryReader

    library = LibraryReader.open(folder)
    findings = check_library(library)
    sound = all(f.is_harmless for f in findings)
    if as_json:
        print(json.dumps({"sound": sound, "findings": [asdict(f) for f in findings]}, indent=1))
        return sound
    for f in findings[:SHOWN]:
        console.say(f"{f.kind:<9} {f.path}: {f.text}")
    if len(findings) > SHOWN:
        console.say(f"... and {len(findings) - SHOWN} more; --json has all.")
    count = len(library.entries())
    console.say(f"{count} models in {folder}: {'sound' if sound else 'not sound'}")
    return sound


def run_complete(
    folder: Path,
    names: Sequence[str],
    console: Console,
    *,
    mass_kg: float | None,
    density: float | None,
) -> bool:
    """Compute what is not known of models; return whether no person needs to look at any.

    Raises:
        InputError: no library, no such model, or a mass for several models.
    """
    from realsim.models.library_complete import complete
    from realsim.models.library_prepare import Matter
    from realsim.models.library_reading import LibraryReader

    library = LibraryReader.open(folder)
    wanted = list(names)
    if not wanted:
        wanted = [str(e.obj_id) for e in library.entries() if e.obj_id and e.properties is None]
    if mass_kg is not None and len(wanted) != 1:
        raise InputError(f"--mass is of one model, but {len(wanted)} are completed.")
    matter = None
    if mass_kg is not None or density is not None:
        matter = Matter(density=density, mass_kg=mass_kg)
    fine, rows = True, list[tuple[str, ...]]()
    with console.stage("complete", f"{len(wanted)} models") as tick:
        for k, name in enumerate(wanted):
            tick(k, len(wanted))
            try:
                found = complete(library, name, matter=matter)
            except RealsimError as error:
                if len(wanted) == 1:
                    raise
                console.say(f"{name}: {error}")
                fine = False
                continue
            p = found.properties
            if p is not None:
                rows.append(verdict_row(found.model.name, found.model.obj_id, p))
                fine = fine and p.verdict == "accepted"
                for reason in p.reasons:
                    console.say(f"{found.model.name}: look: {reason}")
    header = ("model", "id", "size [mm]", "mass [g]", "parts", "verdict")
    console.table(f"{len(rows)} models completed in {folder}", header, rows)
    return fine


# --- how one model is shown -------------------------------------------------------------------


def verdict_row(name: str, obj_id: int | None, p: ModelProperties) -> tuple[str, ...]:
    """Return a model's row: name, id, size, mass, parts, verdict."""
    m = p.matter
    size = "no scale" if m is None else " x ".join(f"{1e3 * x:.1f}" for x in m.extent_m)
    mass = NONE if m is None else f"{1e3 * m.mass_kg:.4g}"
    parts = NONE if p.convex is None else str(p.convex.parts)
    return (name, NONE if obj_id is None else str(obj_id), size, mass, parts, p.verdict)


def say_model(
    console: Console, folder: Path, name: str, obj_id: int | None, mesh: Mesh, p: ModelProperties
) -> None:
    """Print every figure of a model, then every problem, then where it lies."""
    title = f"{name}" if obj_id is None else f"{name} (object {obj_id})"
    console.table(f"{title}: {p.verdict}", ("figure", "value"), _figures(mesh, p))
    said = [("repaired", a) for a in p.actions] + [("note", n) for n in p.notes]
    if p.symmetries is not None:
        near = p.symmetries.near
        said += [("nearly symmetric", n) for n in near[:NEAR_SHOWN]]
        if len(near) > NEAR_SHOWN:
            more = f"{len(near) - NEAR_SHOWN} more; all are in the properties"
            said.append(("nearly symmetric", more))
    for kind, text in [*said, *(("LOOK", r) for r in p.reasons)]:
        console.say(f"{kind}: {text}")
    where = folder / ("unscaled" if obj_id is None else "pictures")
    console.say(str(where / (name if obj_id is None else f"{name}.png")))
    if obj_id is None:
        console.say(
            f"no metric scale yet: `realsim scan scale {name} SESSION --library {folder}` finds it."
        )


def _figures(mesh: Mesh, p: ModelProperties) -> list[tuple[str, str]]:
    """Return every figure of a model with its name and unit."""
    from realsim.models.pictures import scale_text, symmetry_text

    rows: list[tuple[str, str]] = []
    if p.source is not None:
        s = p.source
        rows += [("file", s.file), ("its unit", s.unit)]
        rows += [("it states", ", ".join(f"{k} {v}" for k, v in s.declared.items()) or "nothing")]
    rows.append(("scale", scale_text(p)))
    before, after = p.before, p.after
    if before is not None and after is not None:
        pairs = (
            ("vertices", before.vertices, after.vertices),
            ("faces", before.faces, len(mesh.faces)),
            ("bodies", before.bodies, after.bodies),
            ("boundary edges", before.boundary_edges, after.boundary_edges),
            ("watertight", _yes(before.is_watertight), _yes(after.is_watertight)),
            ("outward", _yes(before.is_outward), _yes(after.is_outward)),
        )
        rows += [(n, f"{a}" if a == b else f"{a} -> {b}") for n, a, b in pairs]
    paint = NONE if mesh.colors is None else "colours"
    if mesh.texture is not None:
        paint = f"texture {mesh.texture.shape[1]} x {mesh.texture.shape[0]} px"
    rows.append(("appearance", paint))
    if p.matter is None:
        return [*rows, ("size [units]", " x ".join(f"{x:.4g}" for x in mesh.extent))]
    rows += _matter_rows(p)
    rows.append(("symmetries", symmetry_text(p)))
    if p.convex is None:
        return [*rows, ("convex parts", "none")]
    c = p.convex
    return [
        *rows,
        ("convex parts", f"{c.parts} ({c.method}), volume {c.volume_ratio:.3f} of the mesh"),
    ]


def _matter_rows(p: ModelProperties) -> list[tuple[str, str]]:
    """Return size and matter."""
    m = p.matter
    assert m is not None, "asked for only where there is matter"

    def triple(v: Any, factor: float) -> str:
        return ", ".join(f"{round(factor * float(x), 2) + 0.0:.2f}" for x in v)

    weighed = "weighed" if m.mass_from == "weighed" else "from the density, not weighed"
    return [
        ("size [mm]", " x ".join(f"{1e3 * x:.2f}" for x in m.extent_m)),
        ("diameter [mm]", f"{1e3 * m.diameter_m:.2f}"),
        ("centroid of the surface [mm]", triple(m.centroid, 1e3)),
        ("volume [cm³]", f"{1e6 * m.volume_m3:.4g} (of the {m.volume_of})"),
        ("share of the hull's volume", f"{m.hull_volume_fraction:.3f}"),
        ("density [kg/m³]", f"{m.density:.5g}"),
        ("mass [g]", f"{1e3 * m.mass_kg:.5g} ({weighed})"),
        ("centre of mass [mm]", triple(m.center_of_mass, 1e3)),
        ("principal inertia [g cm²]", ", ".join(
            f"{1e7 * x:.4g}" for x in np.linalg.eigvalsh(m.inertia))),
    ]  # fmt: skip


def _yes(value: bool) -> str:
    return "yes" if value else "no"
