"""Pose files of numpy: npy and npz, without pickled objects."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim_calibration.inputs.columns import ACCEPTED, LABEL_NAMES, WIDTHS, PoseTable

MAX_BYTES = 256 * 2**20
"""Unpacked size of an array file; poses take a few kilobytes."""
_JOINT_NAMES = ("joints", "joint", "q", "joint_positions", "joints_rad", "joints_deg")


def table_from_npy(path: Path) -> PoseTable:
    """Return the table of an npy file.

    Raises:
        InputError: damaged, pickled, or not an array of poses.
    """
    try:
        # mapped, so that a header that promises gigabytes allocates nothing
        array: Any = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError, TypeError, OverflowError) as error:
        raise InputError(f"{path} is not a readable npy file ({_reason(error)}).") from error
    return _table(path, np.asarray(array), "")


def table_from_npz(path: Path, key: str | None) -> PoseTable:
    """Return the table of an npz file; `key` names the array where there are several.

    Raises:
        InputError: damaged, pickled, too large, or not exactly one array of poses.
    """
    arrays = _members(path)
    if key is not None and key not in arrays:
        raise InputError(f"{path}: the array '{key}' was asked for; it has {', '.join(arrays)}.")
    extra = {
        k: v for k, v in arrays.items() if k.lower() in _JOINT_NAMES or v.dtype.kind in ("U", "S")
    }
    poses = {k: v for k, v in arrays.items() if k not in extra and _rows(v) is not None}
    chosen = [key] if key is not None else list(poses)
    if len(chosen) != 1:
        what = f"{len(chosen)} arrays of poses" if chosen else "no array of poses"
        shapes = ", ".join(f"{k} {v.shape}" for k, v in arrays.items())
        raise InputError(f"{path} holds {what} ({shapes}). Say which one is meant by its key.")
    table = _table(path, arrays[chosen[0]], chosen[0])
    for name, array in extra.items():
        if name == chosen[0] or len(array) != len(table.values):
            continue
        if array.dtype.kind in ("U", "S") and name.lower().rstrip("s") in LABEL_NAMES:
            table.labels = [
                v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v)
                for v in array.ravel().tolist()
            ]
        elif array.ndim == 2 and array.dtype.kind == "f":
            unit = name.lower().removeprefix("joints")
            table.names += tuple(f"joint{k + 1}{unit}" for k in range(array.shape[1]))
            table.values = np.concatenate([table.values, array], axis=1)
    return table


def _reason(error: Exception) -> str:
    """Return what numpy says, without its advice to unpickle."""
    text = str(error).split("\n", maxsplit=1)[0]
    return "it holds pickled Python objects, which are never run" if "pickle" in text else text


def _members(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file."""
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > MAX_BYTES:
                raise InputError(
                    f"{path} unpacks to {size / 2**20:.0f} MB; at most {MAX_BYTES / 2**20:.0f} MB "
                    "are accepted. Store the poses in a file of their own."
                )
            for info in archive.infolist():
                data = archive.read(info)
                array: Any = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
                arrays[info.filename.removesuffix(".npy")] = array
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, MemoryError, RuntimeError) as error:
        raise InputError(f"{path} is not a readable npz file ({_reason(error)}).") from error
    except (NotImplementedError, SyntaxError, TypeError, OverflowError) as error:
        raise InputError(f"{path} is not a readable npz file ({_reason(error)}).") from error
    return arrays


def _rows(array: NDArray[Any]) -> tuple[int, int] | None:
    """Return how many poses of how many numbers an array holds, None where it holds none."""
    shape = array.shape
    if array.dtype.kind not in ("f", "i", "u"):
        return None
    if len(shape) == 3 and shape[1:] in ((4, 4), (3, 4)):
        return shape[0], shape[1] * 4
    if shape in ((4, 4), (3, 4)):
        return 1, shape[0] * 4
    if len(shape) == 2 and (shape[1] in WIDTHS or shape[1] - 1 in WIDTHS):
        return shape[0], shape[1]
    return (1, shape[0]) if len(shape) == 1 and shape[0] in WIDTHS else None


def _table(path: Path, array: NDArray[Any], name: str) -> PoseTable:
    """Return the table of an array of rows, of matrices, or with named fields."""
    names: tuple[str, ...] = ()
    if array.dtype.names and array.ndim == 1:
        fields = [str(n) for n in array.dtype.names]
        if all(array.dtype[n].kind in ("f", "i", "u") and not array.dtype[n].shape for n in fields):
            names = tuple(fields)
            array = np.stack([array[n].astype(np.float64) for n in fields], axis=-1)
    rows = array.shape if names else _rows(array)
    if rows is None:
        raise InputError(
            f"{path}: the array {name or 'in it'} has the shape {array.shape} and the type "
            f"{array.dtype}, which are no poses. {ACCEPTED}; or an array (n, 4, 4)."
        )
    if array.size * 8 > MAX_BYTES:
        raise InputError(f"{path} holds {array.size} numbers, too many to be poses.")
    is_3x4 = array.shape[-2:] == (3, 4) and array.ndim >= 2
    values = np.array(array, dtype=np.float64).reshape(rows)
    if is_3x4:
        names = tuple(f"m{r}{c}" for r in range(3) for c in range(4))
    return PoseTable(
        path=path,
        names=names or ("",) * values.shape[1],
        values=values,
        labels=[None] * len(values),
        stems=[""] * len(values),
        where=[f"row {k}" for k in range(len(values))],
        notes=[f"The poses are taken from '{name}'."] if name else [],
    )
