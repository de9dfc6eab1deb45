"""A scale fit as one JSON file: everything that was found, from what, with which settings."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError, NotRigidError
from realsim.geometry import se3
from realsim.scanning.scale.measured import Measurement
from realsim.scanning.scale.measured_check import MeasuredCheck
from realsim.scanning.scale.result import Limit, ScaleFit, Similarity, ViewAgreement
from realsim.store import atomic
from realsim.store.records_json import (
    array_from_json,
    array_to_json,
    need,
    number_from_json,
    number_to_json,
    plane_from_json,
    plane_to_json,
)
from realsim.untrusted.own_json import read_object

Json = dict[str, Any]
FORMAT = "realsim scale"
FORMAT_VERSION = 1
VERSIONS_OF = ("realsim", "numpy", "scipy", "open3d", "trimesh")
VERDICTS = ("accepted", "doubtful", "rejected", "unchecked")
UNITS = {"scale": "metres per unit of the mesh", "T": "m", "residual_mm": "mm, null = unseen"}
FIT_FLOATS = ("scale", "sigma", "cpu_s")
VIEW_FLOATS = ("agree", "iou", "rms_mm", "shift_mm", "turn_deg")


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
    """Of the libraries that made it."""


def installed_versions() -> dict[str, str]:
    """Return the versions of the libraries that a fit depends on."""
    found: dict[str, str] = {}
    for name in VERSIONS_OF:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


# --- the fit ----------------------------------------------------------------------------------


def similarity_to_json(s: Similarity) -> Json:
    """Return a similarity as JSON values."""
    return {
        "scale": s.scale, "T_world_obj": array_to_json(s.T_world_obj),
        "score": number_to_json(s.score), "source": s.source,
    }  # fmt: skip


def similarity_from_json(data: Any, what: str = "similarity") -> Similarity:
    """Return the similarity of JSON values.

    Raises:
        InputError: something is missing, or the scale is no positive number.
        NotRigidError: T_world_obj is not rigid.
    """
    d = need(data, ("scale", "T_world_obj"), what)
    scale = d["scale"]
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < np.inf:
        raise InputError(f"{what} has the scale {scale!r}; metres per unit of the mesh, a positive "
                         "number, is expected.")  # fmt: skip
    T = _matrix(d["T_world_obj"], (4, 4), f"T_world_obj of {what}")
    try:
        se3.check_rigid(T, f"T_world_obj of {what}")
    except NotRigidError as error:
        raise NotRigidError(
            f"{error} The scale of the mesh stands beside it, as 'scale', never inside it."
        ) from error
    return Similarity(
        scale=float(scale), T_world_obj=T, score=number_from_json(d.get("score")),
        source=str(d.get("source", "")),
    )  # fmt: skip


def fit_to_json(fit: ScaleFit) -> Json:
    """Return a fit as JSON values; NaN becomes null."""
    views = [
        {"index": v.index, "points": v.points, "used": v.used}
        | {name: number_to_json(getattr(v, name)) for name in VIEW_FLOATS}
        for v in fit.views
    ]
    limits = [{"name": k.name, "percent": number_to_json(k.percent), "text": k.text}
              for k in fit.limits]  # fmt: skip
    low, high = fit.interval
    return {
        "verdict": fit.verdict,
        "reasons": list(fit.reasons),
        "scale": number_to_json(fit.scale),
        "sigma": number_to_json(fit.sigma),
        "derived": {
            "sigma_percent": number_to_json(fit.sigma_percent),
            "interval_95": [number_to_json(low), number_to_json(high)],
        },
        "extent_mm": array_to_json(fit.extent_mm),
        "T_world_obj": array_to_json(fit.T_world_obj),
        "covariance": array_to_json(fit.covariance),
        "checks": {name: number_to_json(float(x)) for name, x in fit.checks.items()},
        "limits": limits,
        "views": views,
        "plane": plane_to_json(fit.plane),
        "candidates": [similarity_to_json(s) for s in fit.candidates],
        "history": _plain(fit.history),
        "cpu_s": number_to_json(fit.cpu_s),
        "notes": list(fit.notes),
        "residual_mm": array_to_json(fit.residual_mm),
    }


FIT_KEYS = (
    "verdict", "reasons", "scale", "sigma", "extent_mm", "T_world_obj", "covariance", "checks",
    "limits", "views", "plane", "candidates", "history", "cpu_s", "notes", "residual_mm",
)  # fmt: skip


def fit_from_json(data: Any) -> ScaleFit:
    """Return the fit of `fit_to_json`, bit for bit.

    Raises:
        InputError: something is missing or is not what it should be.
    """
    d = need(data, FIT_KEYS, "a scale fit")
    if d["verdict"] not in VERDICTS:
        raise InputError(f"a scale fit has the verdict {d['verdict']!r}; {', '.join(VERDICTS)} "
                         "are known.")  # fmt: skip
    try:
        numbers: dict[str, float] = {name: number_from_json(d[name]) for name in FIT_FLOATS}
        return ScaleFit(
            **numbers,
            verdict=d["verdict"],
            reasons=tuple(str(r) for r in d["reasons"]),
            extent_mm=_matrix(d["extent_mm"], (3,), "extent_mm"),
            T_world_obj=_matrix(d["T_world_obj"], (4, 4), "T_world_obj"),
            covariance=_matrix(d["covariance"], (7, 7), "covariance"),
            checks={str(k): number_from_json(x) for k, x in d["checks"].items()},
            limits=tuple(
                Limit(name=str(k["name"]), percent=number_from_json(k["percent"]), text=k["text"])
                for k in d["limits"]
            ),
            views=tuple(_view(v) for v in d["views"]),
            plane=plane_from_json(d["plane"]),
            candidates=tuple(similarity_from_json(s, "a candidate") for s in d["candidates"]),
            history=tuple(d["history"]),
            notes=tuple(str(n) for n in d["notes"]),
            residual_mm=np.array([number_from_json(x) for x in d["residual_mm"]], dtype=np.float64),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"a scale fit is damaged ({type(error).__name__}: {error}). Restore the file, or make "
            "it anew with `realsim scan scale --overwrite`."
        ) from error


def _view(data: Any) -> ViewAgreement:
    """Return the agreement of one view."""
    d = need(data, ("index", "points", "used", *VIEW_FLOATS), "a view of a scale fit")
    floats: dict[str, float] = {name: number_from_json(d[name]) for name in VIEW_FLOATS}
    return ViewAgreement(
        index=int(d["index"]), points=int(d["points"]), used=bool(d["used"]), **floats
    )


def _matrix(values: Any, shape: tuple[int, ...], what: str) -> Any:
    """Return an array of JSON numbers of this shape."""
    try:
        array = array_from_json(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is no array of numbers ({error}).") from error
    if array.shape != shape:
        raise InputError(f"{what} has the shape {array.shape}; {shape} is expected.")
    return array


def _plain(value: Any) -> Any:
    """Return plain JSON values: numpy's numbers and arrays become lists, NaN becomes null."""
    if isinstance(value, Mapping):
        items: Any = value.items()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        return {str(k): _plain(v) for k, v in items}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, float):
        return number_to_json(value)
    return str(value) if isinstance(value, Path) else value


# --- the record -------------------------------------------------------------------------------


def check_to_json(check: MeasuredCheck) -> Json:
    """Return a measured length against the fit as JSON values."""
    m = check.measurement
    return {
        "kind": m.kind, "value_m": m.value_m, "sigma_m": m.sigma_m,
        "points": None if m.points is None else [list(p) for p in m.points],
        "length": check.length, "scale": check.scale, "sigma": check.sigma,
        "fitted_mm": check.fitted_mm, "difference_percent": check.difference_percent,
        "z": check.z, "agrees": check.agrees, "text": check.text,
    }  # fmt: skip


CHECK_FLOATS = ("length", "scale", "sigma", "fitted_mm", "difference_percent", "z")


def check_from_json(data: Any) -> MeasuredCheck:
    """Return the measured length of `check_to_json`."""
    keys = ("kind", "value_m", "sigma_m", "points", *CHECK_FLOATS, "agrees", "text")
    d = need(data, keys, "a measured length")
    ends = d["points"]
    m = Measurement(
        kind=d["kind"], value_m=d["value_m"], sigma_m=d["sigma_m"],
        points=None if ends is None else (tuple(ends[0]), tuple(ends[1])),
    )  # fmt: skip
    floats: dict[str, float] = {name: d[name] for name in CHECK_FLOATS}
    return MeasuredCheck(measurement=m, agrees=d["agrees"], text=d["text"], **floats)


def record_to_json(record: ScaleRecord) -> Json:
    """Return what scale.json holds."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "units": UNITS,
        "inputs": _plain(record.inputs),
        "config": _plain(record.config),
        "versions": dict(record.versions),
        "measured": [check_to_json(c) for c in record.measured],
        "poses": _plain(record.poses),
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


def record_bytes(record: ScaleRecord) -> bytes:
    """Return the bytes of scale.json: lists of numbers on one line each."""
    return json_lines(record_to_json(record)).encode("utf-8")


def save_record(
    path: Path | str, record: ScaleRecord, write: Callable[[Path, bytes], None] | None = None
) -> None:
    """Write scale.json whole or not at all."""
    path = Path(path)
    with atomic.storing(path.parent, path.name):
        (write or atomic.write_bytes)(path, record_bytes(record))


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
