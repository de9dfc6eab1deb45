"""A scaled model goes into the library, with the note of who says how large it is."""

from dataclasses import replace
from typing import TYPE_CHECKING

from realsim.app.console import Console
from realsim.app.scan.scale.inputs import NamedMesh, ScaleRequest

if TYPE_CHECKING:
    from realsim.models.library import ModelLibrary
    from realsim.models.library_records import LibraryModel, ScaleNote


def promote(request: ScaleRequest, named: NamedMesh, note: "ScaleNote", console: Console) -> None:
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
    library: "ModelLibrary", request: ScaleRequest, named: NamedMesh, note: "ScaleNote"
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
