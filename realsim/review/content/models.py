"""The models of a session: those of the scene at once, the others when they are asked for."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from realsim.errors import InputError
from realsim.formats.bop.models import load_models, model_file
from realsim.records import ObjectModel


class SessionModels(Mapping[int, ObjectModel]):
    """The models of a BOP models folder by obj_id, each read once.

    A data set has tens of models and a scene a few of them; reading all would be most of the time
    that opening a scene takes. Which there are is known from the start.
    """

    def __init__(self, folder: Path, wanted: set[int]) -> None:
        """Read the models that are wanted for certain.

        Args:
            folder: of the models.
            wanted: obj_ids of the scene's objects.

        Raises:
            InputError: one of them has no mesh, or a file is damaged.
        """
        self._folder = folder
        files = {int(p.stem[4:]): p for p in folder.glob("obj_*.ply") if p.stem[4:].isdecimal()}
        self._ids = sorted(i for i, p in files.items() if p.name == model_file(i))
        missing = sorted(wanted - set(self._ids))
        if missing:
            raise InputError(
                f"the scene holds objects {', '.join(map(str, missing))}, but {folder} has no "
                f"model of them; it has {', '.join(map(str, self._ids)) or 'none'}. Copy their "
                "meshes there, or register the session again."
            )
        self._read = load_models(folder, wanted) if wanted else {}

    def __getitem__(self, obj_id: int) -> ObjectModel:
        """Return a model, reading it if it was not asked for before."""
        if obj_id not in self._read:
            if obj_id not in self._ids:
                raise KeyError(obj_id)
            # Two browsers may read it at once; they read the same, and one is kept.
            self._read.setdefault(obj_id, load_models(self._folder, [obj_id])[obj_id])
        return self._read[obj_id]

    def __contains__(self, obj_id: object) -> bool:
        """Return whether there is such a model, without reading it."""
        return obj_id in self._ids

    def __iter__(self) -> Iterator[int]:
        """Return the obj_ids in ascending order."""
        return iter(self._ids)

    def __len__(self) -> int:
        """Return how many models there are."""
        return len(self._ids)
