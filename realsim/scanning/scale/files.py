"""A scale fit as one JSON file: everything that was found, from what, with which settings."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError, NotRigidError
from realsim.geometry import se3
from realsim.scanning.scale.measured import Measurement
from realsim.scanning.scale.measured_check import MeasuredCheck
from realsim.scanning.scale.result import ScaleFit, Similarity
from realsim.store import provenance
from realsim.untrusted.own_json import from_json, read_object, to_json
from realsim.untrusted.values import need

Json = dict[str, Any]
FORMAT = "realsim scale"
FORMAT_VERSION = 1
VERSIONS_OF = ("realsim", "numpy", "scipy", "open3d-cpu", "trimesh")
SHAPES = {"T_world_obj": (4, 4), "covariance": (7, 7), "extent_mm": (3,)}
"""Shapes of a fit's arrays."""
FIRST = ("verdict", "reasons", "scale", "sigma")
"""What a person looks for stands first."""
TOLD = ("derived", "smallest_box_mm")
"""What is told for other programs, and follows from the rest."""
UNITS = {"scale": "metres per unit of the mesh", "T": "m", "residual_mm": "mm, null = unseen"}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScaleRecord:
    """What scale.json holds."""

    fit: ScaleFit
    inputs: Json = field(default_factory=dict[str, Any])
    """What it was made from: names and hashes; `key` is the hash of everything."""
    config: Json = field(default_factory=dict[str, Any])
    """The settings, plain JSON values."""
    measured: tuple[MeasuredCheck, ...] = ()
    """Lengths measured by hand, against the fit alone."""
    poses: tuple[Json, ...] = ()
    """Per view, for machines: `index`, `T_world_cam`, `T_cam_obj` (of the scaled mesh) [m]."""
    versions: dict[str, str] = field(default_factory=dict[str, str])
    """Versions of the libraries that made it."""


def installed_versions() -> dict[str, str]:
    """Return the versions of the libraries that a fit depends on."""
    return provenance.versions(VERSIONS_OF)


def similarity_from_json(data: Any, what: str = "similarity") -> Similarity:
    """Return the similarity of JSON values.

    Raises:
        InputError: something is missing, or the scale is no positive number.
        NotRigidError: T_world_obj is not rigid.
    """
    d = need(data, ("scale", "T_world_obj"), what)
    if (
        isinstance(d["scale"], bool)
        or not isinstance(d["scale"], int | float)
        or not d["scale"] > 0
    ):
        raise InputError(f"{what} has the scale {d['scale']!r}; metres per unit of the mesh, a "
                         "positive number, is expected.")  # fmt: skip
    found = from_json({k: d[k] for k in ("scale", "T_world_obj")}, Similarity, what)
    _require_shape(found.T_world_obj, (4, 4), f"T_world_obj of {what}")
    try:
        se3.check_rigid(found.T_world_obj, f"T_world_obj of {what}")
    except NotRigidError as error:
        raise NotRigidError(
            f"{error} The scale of the mesh stands beside it, as 'scale', never inside it."
        ) from error
    return found


def fit_to_json(fit: ScaleFit) -> Json:
    """Return a fit as JSON values; NaN becomes null."""
    values = to_json(fit)
    derived = {"sigma_percent": fit.sigma_percent, "interval_95": list(fit.interval)}
    return {k: values[k] for k in FIRST} | {"derived": to_json(derived)} | values


def fit_from_json(data: Any) -> ScaleFit:
    """Return the fit of `fit_to_json`, bit for bit.

    Raises:
        InputError: something is missing or is not what it should be.
    """
    values = {k: v for k, v in need(data, (), "a scale fit").items() if k not in TOLD}
    try:
        fit = from_json(values, ScaleFit, "a scale fit")
        for name, shape in SHAPES.items():
            _require_shape(getattr(fit, name), shape, name)
    except InputError as error:
        raise InputError(
            f"{error} Restore the file, or make it anew with `realsim scan scale --overwrite`."
        ) from error
    return fit


def _require_shape(array: Any, shape: tuple[int, ...], what: str) -> None:
    if np.shape(array) != shape:
        raise InputError(f"{what} has the shape {np.shape(array)}; {shape} is expected.")


def check_to_json(check: MeasuredCheck) -> Json:
    """Return a measured length against the fit as JSON values, all on one level."""
    values = to_json(check)
    return values.pop("measurement") | values


def check_from_json(data: Any) -> MeasuredCheck:
    """Return the measured length of `check_to_json`."""
    d = need(data, (), "a measured length")
    own = Measurement.__dataclass_fields__
    nested = {"measurement": {k: v for k, v in d.items() if k in own}}
    rest = {k: v for k, v in d.items() if k not in own}
    return from_json(nested | rest, MeasuredCheck, "a measured length")


def record_to_json(record: ScaleRecord) -> Json:
    """Return what scale.json holds."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "units": UNITS,
        "inputs": to_json(record.inputs),
        "config": to_json(record.config),
        "versions": dict(record.versions),
        "measured": [check_to_json(c) for c in record.measured],
        "poses": to_json(record.poses),
        "fit": fit_to_json(record.fit),
    }


def record_from_json(data: Any, what: str = "scale.json") -> ScaleRecord:
    """Return the record of `record_to_json`.

    Raises:
        InputError: another format, a newer one, or damaged.
    """
    d = need(data, ("format", "format_version", "fit"), what)
    if d["format"] != FORMAT:
        raise InputError(f"{what} says format {d['format']!r}; '{FORMAT}' is expected.")
    if d["format_version"] != FORMAT_VERSION:
        raise InputError(
            f"{what} is of format version {d['format_version']}; this realsim reads "
            f"{FORMAT_VERSION}. Update realsim, or make the file anew."
        )
    return ScaleRecord(
        fit=fit_from_json(d["fit"]),
        inputs=dict(d.get("inputs", {})),
        config=dict(d.get("config", {})),
        measured=tuple(check_from_json(c) for c in d.get("measured", ())),
        poses=tuple(d.get("poses", ())),
        versions=dict(d.get("versions", {})),
    )


def load_record(path: Path | str) -> ScaleRecord:
    """Return the record in a file.

    Raises:
        InputError: it is missing, no JSON, of another format, or damaged.
    """
    return record_from_json(read_object(Path(path)), str(path))


def load_start(path: Path | str) -> Similarity:
    """Return the start of a fit from a file: {"scale", "T_world_obj"}, or a scale.json.

    Raises:
        InputError: the file holds neither.
        NotRigidError: its pose is not rigid.
    """
    data = read_object(Path(path))
    inner = data["fit"] if data.get("format") == FORMAT and "fit" in data else data
    start = similarity_from_json(inner, str(path))
    return Similarity(scale=start.scale, T_world_obj=start.T_world_obj, source="given")


def json_lines(value: Any, depth: int = 0) -> str:
    """Return JSON text in which an object has a line per key, and a list of plain values one line.

    Floats come back bit for bit: Python writes the shortest text that reads as the same number.
    """
    pad, end = " " * (depth + 1), "\n" if depth == 0 else ""
    if isinstance(value, dict) and value:
        items: Any = value.items()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        rows = [f"{pad}{json.dumps(str(k))}: {json_lines(v, depth + 1)}" for k, v in items]
        return "{\n" + ",\n".join(rows) + "\n" + " " * depth + "}" + end
    if isinstance(value, list) and any(isinstance(v, dict | list) for v in value):  # pyright: ignore[reportUnknownVariableType]
        items = value  # pyright: ignore[reportUnknownVariableType]
        rows = [pad + json_lines(v, depth + 1) for v in items]
        return "[\n" + ",\n".join(rows) + "\n" + " " * depth + "]" + end
    return json.dumps(value, allow_nan=False) + end
