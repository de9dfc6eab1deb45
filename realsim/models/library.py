"""The library of object models on disk, which every stage reads as a BOP models folder.

Its layout is in `library_files`. Models are added whole or not at all (`library_commit`), by one
writer at a time; an id never changes, and nothing is replaced unless that is asked for.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim import images
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, info_of, model_files
from realsim.geometry.mesh import mass_properties, ply_bytes
from realsim.models import library_files as files
from realsim.models.convex import collision_obj
from realsim.models.library_files import commit, only_writer_of, read_info, require_name, sha256
from realsim.models.library_prepare import Matter, PrepareConfig, PreparedModel, prepare_mesh
from realsim.models.library_reading import LibraryReader
from realsim.models.model_records import LibraryModel, ScaleNote, UnscaledModel
from realsim.records import ObjectModel
from realsim.store import atomic

ID_DIGITS = 6


class ModelLibrary(LibraryReader):
    """A folder of models; made by `create` or `open`, not directly."""

    @classmethod
    def create(cls, folder: Path | str) -> "ModelLibrary":
        """Open the library of this folder; make one where there is nothing yet.

        Raises:
            InputError: the folder holds something else.
        """
        folder = Path(folder)
        if (folder / INFO_FILE).is_file():
            return cls.open(folder)
        if folder.exists() and not folder.is_dir():
            raise InputError(f"'{folder}' is a file; a folder for the model library is needed.")
        others = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        if others:
            raise InputError(
                f"'{folder}' holds {', '.join(others[:3])}{' ...' if len(others) > 3 else ''} and "
                f"no {INFO_FILE}, so it is not a model library. Give a new or an empty folder."
            )
        with atomic.storing(folder.parent, f"the model library {folder}"):
            atomic.write_json(folder / INFO_FILE, {})
        return cls(folder)

    # --- adding -------------------------------------------------------------------------------

    def add(
        self,
        prepared: PreparedModel,
        name: str,
        *,
        obj_id: int | None = None,
        overwrite: bool = False,
        picture: bytes | None = None,
    ) -> LibraryModel:
        """Add a model, all of its files or none.

        Args:
            prepared: what `prepare_mesh` made.
            name: unique in the library.
            obj_id: its id; None = that of the model of this name where it is replaced, else the
                next free one.
            overwrite: whether a model of the same name or id is replaced.
            picture: its sheet as PNG.

        Raises:
            InputError: name or id is taken, or another run is writing to the library.
            StorageError: the disk is full or refuses; the library is as it was.
        """
        if prepared.properties.matter is None:
            raise InputError(
                f"'{name}' has no metric scale, and a library's models are in millimetres; add it "
                "by add_unscaled, and find its scale with `realsim scan scale`."
            )
        with only_writer_of(self.folder):
            obj_id, gone = self.place_for(name, obj_id, overwrite=overwrite)
            model = self._object_model(prepared, name, obj_id)
            new = _files_of(prepared, model)
            if picture is not None:
                new[files.picture_file(name)] = picture
            info = {str(i): entry for i, entry in read_info(self.folder).items()}
            info[str(obj_id)] = info_of(model)
            info = dict(sorted(info.items(), key=lambda item: int(item[0])))
            commit(
                self.folder,
                {**new, INFO_FILE: atomic.json_bytes(info)},
                [g for g in gone if g not in new],
            )
        return self.load(obj_id)

    def place_for(self, name: str, obj_id: int | None, *, overwrite: bool) -> tuple[int, list[str]]:
        """Return the id a model would get, and the files of the one that it replaces.

        Raises:
            InputError: name or id is taken, or not accepted.
        """
        require_name(name)
        entries = {e.obj_id: e.name for e in self.entries() if e.obj_id is not None}
        same = next((i for i, n in entries.items() if n == name), None)
        if obj_id is None:
            obj_id = self.next_id() if same is None else same
        elif not 0 < obj_id < 10**ID_DIGITS:
            raise InputError(f"the id {obj_id} is not accepted; ids are from 1 to 999999.")
        if same is not None and same != obj_id:
            raise InputError(
                f"'{name}' is already object {same} of the library {self.folder} and is not "
                f"renumbered to {obj_id}: stored scenes name it by its id. Leave --id away to "
                "replace it (with --overwrite), or give another --name."
            )
        if obj_id in entries and not overwrite:
            raise InputError(
                f"object {obj_id} of the library {self.folder} is '{entries[obj_id]}'. Say "
                "--overwrite to replace it, or give another --name or --id."
            )
        if obj_id not in entries:
            return obj_id, []
        old = [files.collision_file(obj_id), files.texture_file(obj_id)]
        return obj_id, [*old, files.picture_file(entries[obj_id])]

    @staticmethod
    def _object_model(prepared: PreparedModel, name: str, obj_id: int) -> ObjectModel:
        p = prepared.properties
        symmetries = np.eye(4)[None] if p.symmetries is None else p.symmetries.discrete
        return ObjectModel(
            obj_id=obj_id,
            name=name,
            mesh=prepared.mesh,
            symmetries=symmetries,
            symmetry_axes=() if p.symmetries is None else p.symmetries.axes,
            density=stage_density(prepared),
        )

    def unscaled_place_for(self, name: str, *, overwrite: bool) -> str:
        """Return the folder, in the library, that a model without metric scale would get.

        Raises:
            InputError: the name is taken, or not accepted.
        """
        place = f"{files.UNSCALED}/{require_name(name)}"
        if (self.folder / place / files.UNSCALED_REPORT).is_file() and not overwrite:
            raise InputError(
                f"'{name}' is already in {self.folder / files.UNSCALED}. Say --overwrite to "
                "replace it, or give another --name."
            )
        return place

    def add_unscaled(
        self,
        prepared: PreparedModel,
        name: str,
        *,
        overwrite: bool = False,
        picture: bytes | None = None,
    ) -> UnscaledModel:
        """Add a model without metric scale, in its own units.

        Raises:
            InputError: there is one of this name, or another run is writing to the library.
        """
        place, new = self.unscaled_place_for(name, overwrite=True), dict[str, bytes]()
        mesh, texture = prepared.mesh, ""
        if mesh.texture is not None:
            texture = files.UNSCALED_TEXTURE
            new[f"{place}/{texture}"] = images.png_bytes(mesh.texture)
        # 'm' writes the numbers as they are: they have no unit.
        new[f"{place}/{files.UNSCALED_MESH}"] = ply_bytes(mesh, "m", texture_file=texture)
        sums = {path: sha256(data) for path, data in new.items()}
        if picture is not None:
            new[f"{place}/{files.UNSCALED_PICTURE}"] = picture
        properties = replace(prepared.properties, name=name, files=sums)
        # Last: a folder with its report is complete.
        new[f"{place}/{files.UNSCALED_REPORT}"] = files.properties_bytes(properties)
        with only_writer_of(self.folder):
            self.unscaled_place_for(name, overwrite=overwrite)
            old = f"{place}/{files.UNSCALED_TEXTURE}"
            commit(self.folder, new, [] if old in new else [old])
        return self.load_unscaled(name)

    def promote(
        self,
        name: str,
        scale: ScaleNote,
        config: PrepareConfig | None = None,
        matter: Matter | None = None,
        *,
        obj_id: int | None = None,
        overwrite: bool = False,
    ) -> LibraryModel:
        """Give a model without metric scale its scale, and add it to the models.

        Its folder in unscaled/ stays: the model can be promoted again by a better session.

        Raises:
            InputError: there is no such model, its scaled mesh cannot be used, or as `add`.
        """
        from realsim.models.pictures import sheet_png

        raw = self.load_unscaled(name)
        mesh = replace(raw.mesh, vertices=raw.mesh.vertices * scale.scale)
        source, before = raw.properties.source, raw.properties
        made = prepare_mesh(mesh, config or PrepareConfig(), matter, source=source, scale=scale)
        # The mesh was repaired when it was imported: what was found then is its history.
        properties = replace(
            made.properties, before=before.before, actions=before.actions + made.properties.actions
        )
        made = replace(made, properties=properties)
        picture = sheet_png(made.mesh, properties, made.parts, name)
        return self.add(made, name, obj_id=obj_id, overwrite=overwrite, picture=picture)


def stage_density(prepared: PreparedModel) -> float:
    """Return the density by which every stage gets the model's mass from its mesh [kg/m^3].

    The stages take the volume of the mesh, and of its hull where it is open; the mass that is known
    of the object, or that of its convex parts, has to come out all the same.
    """
    matter = prepared.properties.matter
    if matter is None:
        raise InputError("a mesh without metric scale has no mass.")
    return matter.mass_kg / mass_properties(prepared.mesh, 1.0).volume_m3


def _files_of(prepared: PreparedModel, model: ObjectModel) -> dict[str, bytes]:
    """Return every file of a model but models_info.json: those it is made of, then the mesh."""
    new: dict[str, bytes] = {}
    if prepared.parts is not None:
        new[files.collision_file(model.obj_id)] = collision_obj(prepared.parts)
    new |= model_files(model)
    properties = replace(
        prepared.properties,
        name=model.name,
        obj_id=model.obj_id,
        files={path: sha256(data) for path, data in new.items()},
    )
    return {files.properties_file(model.obj_id): files.properties_bytes(properties), **new}
