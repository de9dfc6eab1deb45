"""The models folder of GraspNet-1Billion: one folder an object, named by its number, in metres."""

from collections.abc import Collection
from pathlib import Path

from realsim.geometry.mesh import load_mesh
from realsim.records import ObjectModel

MESH_FILES = ("nontextured.ply", "textured.ply", "textured.obj", "nontextured_simplified.ply")
"""Looked for in a model's folder, in this order."""


def mesh_file(models: Path, number: int) -> Path | None:
    """Return the mesh of an object, None where there is none."""
    home = models / f"{number:03d}"
    return next((home / name for name in MESH_FILES if (home / name).is_file()), None)


def load_models(models: Path, numbers: Collection[int], notes: list[str]) -> dict[int, ObjectModel]:
    """Return the models by id (number + 1); those without a mesh are not there.

    Args:
        models: folder of the models.
        numbers: of the objects.
        notes: what is missing of a model's look is added to it.

    Raises:
        InputError: a mesh is broken.
        UnitError: a mesh is not in metres.
    """
    found: dict[int, ObjectModel] = {}
    for number in sorted(numbers):
        file = mesh_file(models, number)
        if file is not None:
            mesh = load_mesh(file, "m", notes)
            found[number + 1] = ObjectModel(obj_id=number + 1, name=f"{number:03d}", mesh=mesh)
    return found
