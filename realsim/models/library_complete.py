"""Properties, convex parts and a picture for models that another program has put into a library."""

from collections.abc import Callable
from dataclasses import asdict, replace

from realsim.formats.bop.models import model_file
from realsim.models import library_files as files
from realsim.models.convex import collision_obj
from realsim.models.library_files import commit, only_writer_of, sha256
from realsim.models.library_prepare import Matter, PrepareConfig, Step, prepare_as_it_is
from realsim.models.library_reading import LibraryReader
from realsim.models.model_records import LibraryModel
from realsim.models.pictures import sheet_png

COMPLETE_STEPS: tuple[Step, ...] = ("symmetries", "convex parts", "properties")
"""What is computed of a model whose mesh stays as it is."""


def complete(
    library: LibraryReader,
    wanted: str | int,
    config: PrepareConfig | None = None,
    matter: Matter | None = None,
    *,
    step: Callable[[Step], None] = lambda _: None,
) -> LibraryModel:
    """Compute what the library does not know of a model, and return the model.

    Mesh and models_info.json stay as they are; the symmetries are those of models_info.json where
    it states any, else those that are found.

    Args:
        library: where the model is.
        wanted: its id, its name, or its file.
        config: how; the time limit of the convex parts is in it.
        matter: density or mass; None = the density that models_info.json states.
        step: called when a step begins, with one of COMPLETE_STEPS.

    Raises:
        InputError: there is no such model, or its mesh cannot be used.
    """
    config = config or PrepareConfig()
    obj_id = library.find(wanted)
    model = library.load(obj_id).model
    made = prepare_as_it_is(model, config, matter or Matter(density=model.density), step=step)
    mesh_file = model_file(obj_id)
    new: dict[str, bytes] = {}
    if made.parts is not None:
        new[files.collision_file(obj_id)] = collision_obj(made.parts)
    present = [n for n in (mesh_file, files.texture_file(obj_id)) if (library.folder / n).is_file()]
    sums = {name: sha256((library.folder / name).read_bytes()) for name in present}
    sums |= {name: sha256(data) for name, data in new.items()}
    properties = replace(
        made.properties, name=model.name, obj_id=obj_id, files=sums, config=asdict(config)
    )
    new[files.picture_file(model.name)] = sheet_png(model.mesh, properties, made.parts, model.name)
    new[files.properties_file(obj_id)] = files.properties_bytes(properties)
    with only_writer_of(library.folder):
        commit(library.folder, new)
    return library.load(obj_id)
