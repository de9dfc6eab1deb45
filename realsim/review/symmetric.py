"""How a reviewer says that a model is symmetric, and the models with it."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel
from realsim.review.journal import ReviewState

Axes = tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
MOST_FOLD = 36
"""Turns of a regular shape; beyond that it is one of revolution."""
GRAMMAR = (
    "accepted are none, an axis of the model for a shape of revolution (z), an axis with its order "
    "(z:4 looks the same after a quarter turn), and several of them (x:2 z:2)"
)


def symmetry_of(text: str, mesh: Mesh) -> tuple[Array, Axes]:
    """Return what a mark says of a mesh.

    Args:
        text: `none`, `z`, `z:4`, or several separated by blanks. Axes are those of the model's
            frame, through the middle of its box.
        mesh: the model's.

    Returns:
        symmetries (S, 4, 4) T_obj_obj, the identity first, and the axes of revolution with a point
        on each [m]: as in `ObjectModel`.

    Raises:
        InputError: the text is not understood, or the turns it names make no finite group.
    """
    from realsim.models.symmetry_search import closed, turn

    middle = mesh.bounds.mean(0)
    words = text.split()
    if not words or (len(words) > 1 and "none" in words):
        raise InputError(f"'{text}' is no symmetry: {GRAMMAR}.")
    axes: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = []
    turns: list[Array] = []
    for word in words:
        found = re.fullmatch(r"none|([xyz])(?::(\d{1,3}))?", word)
        if found is None:
            raise InputError(f"'{text}' is no symmetry: '{word}' is not understood; {GRAMMAR}.")
        if word == "none":
            continue
        axis = AXES[found[1]]
        if found[2] is None:
            axes.append((axis, (float(middle[0]), float(middle[1]), float(middle[2]))))
            continue
        order = int(found[2])
        if not 2 <= order <= MOST_FOLD:
            raise InputError(
                f"'{text}' is no symmetry: an order of {order}; 2 to {MOST_FOLD} are accepted, and "
                f"{found[1]} alone for a shape of revolution."
            )
        turns.append(turn(axis, 2 * np.pi / order))
    rotations = closed([np.eye(3), *turns])
    return np.array([se3.from_rt(R, middle - R @ middle) for R in rotations]), tuple(axes)


def marked_models(models: Mapping[int, ObjectModel], state: ReviewState) -> dict[int, ObjectModel]:
    """Return the models, symmetric as the reviewers marked them.

    Marks of models that are not there are left out: the session may have lost an object since.

    Raises:
        InputError: a mark is not understood.
    """
    marked = dict(models)
    for obj_id, entry in state.marks().items():
        if obj_id in marked:
            symmetries, axes = symmetry_of(entry.symmetry, marked[obj_id].mesh)
            marked[obj_id] = replace(marked[obj_id], symmetries=symmetries, symmetry_axes=axes)
    return marked
