"""How a record takes its arrays: a private copy, its shape checked, made read-only."""

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3

Record = TypeVar("Record")
FARTHEST_M = 1000.0
"""Distance from the origin of anything that an arm or its camera has to do with [m]: beyond, a file
is damaged or of another unit, and float32 of the engines has steps of 0.1 mm."""
MOST_ID = 999_999_999
"""Largest number of a view, an object or an instance."""


def frozen(value: ArrayLike, dtype: Any, shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    """Return a read-only copy of `value`, its shape checked (None = any length)."""
    array = numbers(value, dtype, name)
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        wanted = tuple("N" if n is None else n for n in shape)
        raise InputError(f"{name} has shape {array.shape}; the shape must be {wanted}.")
    array.setflags(write=False)
    return array


def numbers(value: ArrayLike, dtype: Any, name: str) -> NDArray[Any]:
    """Return a copy as an array of numbers.

    Raises:
        InputError: it holds something else.
    """
    try:
        return np.array(value, dtype=dtype)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} is {value!r:.80}; numbers are expected.") from None


def freeze(record: Any, dtype: Any = np.float64, /, **shapes: tuple[int | None, ...]) -> None:
    """Put read-only arrays of known shapes in the place of a record's fields; None stays None."""
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is not None:
            object.__setattr__(record, name, frozen(value, dtype, shape, name))


def rigid(value: ArrayLike, name: str) -> Array:
    """Return a read-only rigid (4, 4) copy of `value`."""
    T = se3.check_rigid(value, name)
    far = float(np.abs(T[..., :3, 3]).max(initial=0.0))
    if far > FARTHEST_M:
        raise InputError(
            f"{name} is {far:.3g} m from the origin; at most {FARTHEST_M:g} m are accepted. Is it "
            "in metres? Restore the file, or run the step that writes it again."
        )
    return frozen(T, np.float64, (4, 4), name)


def whole(value: Any, low: int, high: int) -> bool:
    """Return whether it is a whole number in a range."""
    return isinstance(value, int | np.integer) and low <= int(value) <= high


def numbered(value: int, name: str, low: int = 0) -> None:
    """Check that a number names something: a view, an object, an instance.

    Raises:
        InputError: it is no whole number between `low` and a billion.
    """
    if not whole(value, low, MOST_ID):
        raise InputError(
            f"{name} is {value!r}; a whole number from {low} to {MOST_ID} is expected."
        )


def rows_of(record: Record, rows: NDArray[Any] | slice) -> Record:
    """Return a record of some rows (n,) of each of its arrays (N, ...); its other fields stay."""
    values = {f.name: getattr(record, f.name) for f in fields(record)}  # pyright: ignore[reportArgumentType]
    arrays = {name: v[rows] for name, v in values.items() if isinstance(v, np.ndarray)}
    return replace(record, **arrays)  # pyright: ignore[reportArgumentType, reportCallIssue, reportUnknownVariableType]
