"""`realsim scan list`, `show` and `check`: what a model library holds."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console, shortened
from realsim.models.model_records import ModelProperties
from realsim.records import Mesh

if TYPE_CHECKING:
    from realsim.models.library_reading import LibraryEntry

SHOWN = 40
"""Findings of a check that are listed; the rest is counted (`--json` has all)."""
NEAR_SHOWN = 2
"""Refused symmetries that are listed; they come in families."""
NONE = "-"
KEPT = "(*)"
"""Mark of a model whose mesh without scale is kept."""


def list_library(folder: Path, console: Console) -> None:
    """Print a table of all models; the mesh that a model was scaled from is a mark, not a row.

    Raises:
        InputError: the folder is no library.
    """
    from realsim.models.library_files import UNSCALED
    from realsim.models.library_reading import LibraryReader, unscaled_sources

    entries = LibraryReader.open(folder).entries()
    console.result({"library": folder, "models": [_entry_document(e) for e in entries]})
    if not entries:
        console.say(f"{folder} holds no models yet; `realsim scan import MESH --library {folder}`.")
        return
    sources = unscaled_sources(entries)
    shown = [e for e in entries if e.obj_id is not None or e.name not in sources]
    header = ("name", "id", "size [mm]", "mass [g]", "symmetries", "parts", "scale sigma",
              "verdict")  # fmt: skip
    rows = [_entry_row(e, has_source=e.name in sources) for e in shown]
    console.table(f"{_counted(shown)} in {folder}", header, rows)
    if sources:
        console.say(
            f"{KEPT} {len(sources)} kept without scale, too, in {folder / UNSCALED}: `realsim scan "
            f"scale NAME SESSION --library {folder} --overwrite` scales it anew."
        )
    doubtful = [e.name for e in entries if e.properties and e.properties.verdict == "doubtful"]
    told = [f"{n} is doubtful: `realsim scan show {folder} {n}` says why." for n in doubtful]
    console.say(*shortened(told, NEAR_SHOWN, "... and so are {} more."))
    unknown = [e for e in entries if e.properties is None and e.obj_id is not None]
    if unknown:
        console.say(
            f"{len(unknown)} of them have no properties (not imported by realsim): "
            f"`realsim scan complete {folder}` computes them."
        )


def _entry_document(e: "LibraryEntry") -> dict[str, object]:
    """Return what a program wants to know of a model in the list."""
    from realsim.untrusted.own_json import to_json

    known = None if e.properties is None else to_json(e.properties)
    return {"name": e.name, "obj_id": e.obj_id, "info": e.info, "properties": known}


def _entry_row(e: "LibraryEntry", *, has_source: bool) -> tuple[str, ...]:
    """Return the row of a model in the list."""
    from realsim.models.pictures import verdict_text

    p = e.properties
    name = f"{e.name} {KEPT}" if has_source else e.name
    if p is None:
        if e.obj_id is None:
            return (name, NONE, NONE, NONE, NONE, NONE, "unscaled", "not known")
        symmetries = _info_symmetries(e.info)
        return (name, str(e.obj_id), _info_size(e.info), NONE, symmetries, NONE, NONE, "not known")
    scale = NONE if p.scale is None else "not known"
    if p.scale is not None and p.scale.sigma_percent is not None:
        scale = f"{p.scale.sigma_percent:.2g} %"
    mass = NONE if p.matter is None else f"{1e3 * p.matter.mass_kg:.4g}"
    return (
        name, NONE if e.obj_id is None else str(e.obj_id), _info_size(e.info), mass,
        _symmetries(p), NONE if p.convex is None else str(p.convex.parts),
        scale if e.obj_id is not None else "unscaled", verdict_text(p),
    )  # fmt: skip


def _counted(entries: "Sequence[LibraryEntry]") -> str:
    """Return how many models there are, and how many meshes without scale."""
    models = sum(e.obj_id is not None for e in entries)
    bare = len(entries) - models
    text = f"{models} model{'' if models == 1 else 's'}"
    return f"{text} and {bare} unscaled mesh{'' if bare == 1 else 'es'}" if bare else text


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
    from realsim.untrusted.own_json import to_json

    library = LibraryReader.open(folder)
    unscaled = (folder / files.UNSCALED / name / files.UNSCALED_REPORT).is_file()
    names = {e.name for e in library.entries() if e.obj_id is not None}
    if unscaled and name not in names:
        raw = library.load_unscaled(name)
        console.result({"name": name, "obj_id": None, "properties": to_json(raw.properties)})
        say_model(console, folder, name, None, raw.mesh, raw.properties)
        return
    found = library.load(name)
    model = found.model
    known = None if found.properties is None else to_json(found.properties)
    console.result(
        {"name": model.name, "obj_id": model.obj_id, "notes": found.notes, "properties": known}
    )
    console.say(*[f"note: {note}" for note in found.notes])
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


def run_library_check(folder: Path, console: Console) -> bool:
    """Print what of a library is not as it should be; return whether every model can be used.

    Raises:
        InputError: no library, or its list of models is damaged.
    """
    from realsim.models.library_reading import LibraryReader, check_library

    library = LibraryReader.open(folder)
    findings = check_library(library)
    sound = all(f.is_harmless for f in findings)
    console.result({"sound": sound, "findings": [asdict(f) for f in findings]})
    if console.as_json:
        return sound
    told = [f"{f.kind:<9} {f.path}: {f.text}" for f in findings]
    console.say(*shortened(told, SHOWN, "... and {} more; --json has all."))
    counted = _counted(library.entries())
    console.say(f"{counted} in {folder}: {'sound' if sound else 'not sound'}")
    return sound


# --- how one model is shown -------------------------------------------------------------------


def verdict_row(name: str, obj_id: int | None, p: ModelProperties) -> tuple[str, ...]:
    """Return a model's row: name, id, size, mass, parts, verdict."""
    from realsim.models.pictures import verdict_text

    m = p.matter
    size = "no scale" if m is None else " x ".join(f"{1e3 * x:.1f}" for x in m.extent_m)
    mass = NONE if m is None else f"{1e3 * m.mass_kg:.4g}"
    parts = NONE if p.convex is None else str(p.convex.parts)
    said = verdict_text(p)
    return (name, NONE if obj_id is None else str(obj_id), size, mass, parts, said)


def say_model(
    console: Console, folder: Path, name: str, obj_id: int | None, mesh: Mesh, p: ModelProperties
) -> None:
    """Print every figure of a model, then every problem, then where it lies."""
    from realsim.models.pictures import verdict_text

    title = f"{name}" if obj_id is None else f"{name} (object {obj_id})"
    console.table(f"{title}: {verdict_text(p)}", ("figure", "value"), _figures(mesh, p))
    said = [("repaired", a) for a in p.actions] + [("note", n) for n in p.notes]
    if p.symmetries is not None:
        near = p.symmetries.near
        said += [("nearly symmetric", n) for n in near[:NEAR_SHOWN]]
        if len(near) > NEAR_SHOWN:
            more = f"{len(near) - NEAR_SHOWN} more; all are in the properties"
            said.append(("nearly symmetric", more))
    for kind, text in [*said, *(("LOOK", r) for r in p.reasons)]:
        console.say(f"{kind}: {text}")
    if obj_id is not None:
        console.say(str(folder / "pictures" / f"{name}.png"))
        return
    console.say(f"kept as '{name}', in {folder / 'unscaled' / name}")
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
