"""The results of the stages in a session's folder: hand-eye, board, scene and grasps."""

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.records import STAGES, GraspSet, HandEye, Scene, TagBoard
from realsim.records.grasps import MEASURES
from realsim.store import atomic
from realsim.store.session_store import SessionStore
from realsim.untrusted.arrays import read_npz
from realsim.untrusted.own_json import REMEDY, read_own, to_json

HAND_EYE_FILE = "calibration/hand_eye.json"
BOARD_FILE = "calibration/board.json"
SCENE_FILE = "registration/scene.json"
GRASP_FOLDER = "grasps"
ARRAYS = ("Ts_obj_grasp", "widths_m", "scores", "base_scores", "slip_m", "slip_rad", "reachable")
MEASURE_PREFIX = "measure."
"""Before the name of a measure in the npz file, so that no array of the set is shadowed."""
GRASP_FORMAT_VERSION = 2
"""Version 1 has no measures; it is still read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspsHead:
    """What is read of the readable side of a grasp set."""

    obj_id: int
    instance: int
    parameters: dict[str, Any]
    format_version: int = 1


# --- one record, one file ---------------------------------------------------------------------


def save_hand_eye(store: SessionStore, result: HandEye) -> None:
    """Write the calibration into the session."""
    store.write_json(HAND_EYE_FILE, hand_eye_to_json(result))


def hand_eye_to_json(result: HandEye) -> dict[str, Any]:
    """Return a hand-eye calibration as JSON values; sigma_deg and sigma_mm are for the reader."""
    return to_json(result) | to_json({"sigma_deg": result.sigma_deg, "sigma_mm": result.sigma_mm})


def load_hand_eye(store: SessionStore, name: str = HAND_EYE_FILE) -> HandEye:
    """Return the calibration of the session.

    Raises:
        InputError: the file is damaged, or how sure it is has NaN.
    """
    found = read_own(store.path(name), HandEye)
    for what in ("covariance", "intrinsics_sd"):
        if not np.isfinite(getattr(found, what)).all():
            raise InputError(f"{store.path(name)}: {what} has NaN or infinite numbers. {REMEDY}")
    return found


def save_board(store: SessionStore, board: TagBoard) -> None:
    """Write the calibration board into the session."""
    store.write_json(BOARD_FILE, to_json(board))


def load_board(store: SessionStore) -> TagBoard:
    """Return the calibration board of the session."""
    return read_own(store.path(BOARD_FILE), TagBoard)


def save_scene(store: SessionStore, scene: Scene) -> None:
    """Write the registered scene into the session."""
    store.write_json(SCENE_FILE, to_json(scene))


def load_scene(store: SessionStore | Path | str, name: str = SCENE_FILE) -> Scene:
    """Return the registered scene of a session, or of its folder.

    Raises:
        InputError: there is no session, the file is damaged, or is not the one that was written.
    """
    if not isinstance(store, SessionStore):
        store = SessionStore.open(store)
    scene = read_own(store.path(name), Scene)
    if not store.is_as_written(name):
        raise InputError(
            f"{store.path(name)} was changed after it was written: its verdicts and sigmas may be "
            f"those of other poses. Restore it, or `realsim check {store.folder} --repair` moves "
            "it to damaged/ and the step that wrote it (`realsim register`) writes it again. "
            "Objects are moved by hand in `realsim review`."
        )
    return scene


# --- grasps -----------------------------------------------------------------------------------


def grasp_stem(grasps: GraspSet) -> str:
    """Return the file name of a grasp set without its ending."""
    return f"{grasps.instance:06d}_obj{grasps.obj_id:06d}"


def grasp_counts(grasps: GraspSet) -> dict[str, Any]:
    """Return how many candidates got how far, and why the others did not."""
    tried = ~np.isnan(grasps.base_scores)
    passed = {
        stage: int(np.count_nonzero(grasps.base_scores[tried] >= (k + 1) / len(STAGES)))
        for k, stage in enumerate(STAGES)
    }
    failures = Counter(f.partition(":")[0] for f in grasps.failures if f)
    return {
        "candidates": len(grasps),
        "reachable": int(np.count_nonzero(grasps.reachable)),
        "tried": int(np.count_nonzero(tried)),
        "passed": passed,
        "good": int(np.count_nonzero(grasps.good)),
        "failures": dict(sorted(failures.items())),
    }


def grasps_to_json(grasps: GraspSet) -> dict[str, Any]:
    """Return the readable side of a grasp set; the arrays are in the npz file beside it."""
    rows: list[dict[str, Any]] = [
        {
            "index": i,
            "score": to_json(grasps.scores[i]),
            "base_score": to_json(grasps.base_scores[i]),
            "reachable": bool(grasps.reachable[i]),
            "failure": grasps.failures[i],
            "slip_mm": _by_stage(1e3 * grasps.slip_m[i]),
            "slip_deg": _by_stage(np.degrees(grasps.slip_rad[i])),
        }
        for i in range(len(grasps))
    ]
    for name, values in grasps.measures.items():
        for row, value in zip(rows, values, strict=True):
            row.setdefault("measures", {})[name] = _measure_to_json(name, value)
    return {
        "format_version": GRASP_FORMAT_VERSION,
        "obj_id": int(grasps.obj_id),
        "instance": int(grasps.instance),
        "counts": grasp_counts(grasps),
        "measures": {
            name: {"unit": MEASURES[name].unit, "meaning": MEASURES[name].meaning}
            for name in grasps.measures
        },
        "parameters": grasps.parameters,
        "grasps": rows,
    }


def _measure_to_json(name: str, value: Any) -> Any:
    if MEASURES[name].by_stage:
        return {s: to_json(v) for s, v in zip(STAGES, value, strict=True)}
    return to_json(value)


def _by_stage(values: Any) -> dict[str, Any]:
    rounded = (float(v) if not math.isfinite(v) else round(float(v), 6) for v in values)
    return {stage: to_json(v) for stage, v in zip(STAGES, rounded, strict=True)}


def save_grasps(store_or_folder: SessionStore | Path | str, grasps: GraspSet) -> Path:
    """Write a grasp set as npz (exact) and JSON (readable), and return the npz file's path.

    Args:
        store_or_folder: a session, whose folder grasps/ is used, or the folder itself.
        grasps: the grasp set.
    """
    arrays: dict[str, Any] = {name: getattr(grasps, name) for name in ARRAYS}
    arrays |= {MEASURE_PREFIX + name: values for name, values in grasps.measures.items()}
    arrays["failures"] = np.array(grasps.failures, dtype=np.str_).reshape(len(grasps))
    stem = grasp_stem(grasps)
    # The npz comes last: a set whose npz is there is complete.
    write_beside_grasps(store_or_folder, f"{stem}.json", atomic.json_bytes(grasps_to_json(grasps)))
    return write_beside_grasps(store_or_folder, f"{stem}.npz", atomic.npz_bytes(**arrays))


def write_beside_grasps(place: SessionStore | Path | str, name: str, data: bytes) -> Path:
    """Write a file into a session's folder grasps/, or into the folder itself; return its path."""
    if isinstance(place, SessionStore):
        place.write_bytes(f"{GRASP_FOLDER}/{name}", data)
        return place.folder / GRASP_FOLDER / name
    path = Path(place) / name
    atomic.write_bytes(path, data)
    return path


def grasp_folder(place: SessionStore | Path | str) -> Path:
    """Return the folder in which the grasps of a session, or of a folder, are looked for."""
    folder = place.folder if isinstance(place, SessionStore) else Path(place)
    return folder / GRASP_FOLDER if (folder / GRASP_FOLDER).is_dir() else folder


def load_grasps(folder: SessionStore | Path | str) -> list[GraspSet]:
    """Return all complete grasp sets of a session or of a folder, by instance number.

    Raises:
        InputError: the folder is not there, or a file is broken, or of a newer format.
    """
    if not (where := grasp_folder(folder)).is_dir():
        raise InputError(f"'{where}' is not a folder; give a session, or a folder of grasp files.")
    return [_load_grasp_set(file) for file in sorted(where.glob("*_obj*.npz"))]


def grasps_on(scene: Scene, sets: Iterable[GraspSet]) -> list[GraspSet]:
    """Return the sets of those objects that the scene has under the same instance.

    A registration may number the objects anew: an instance is then another object.
    """
    there = {o.instance: o.obj_id for o in scene.objects}
    return [s for s in sets if there.get(s.instance) == s.obj_id]


def _load_grasp_set(file: Path) -> GraspSet:
    head = read_own(file.with_suffix(".json"), GraspsHead)
    if not 1 <= head.format_version <= GRASP_FORMAT_VERSION:
        raise InputError(
            f"{file.stem}.json has the format version {head.format_version}; this realsim reads 1 "
            f"to {GRASP_FORMAT_VERSION}. Read it with the version that wrote it, or a newer one."
        )
    try:
        npz = read_npz(file, texts=True)
        return GraspSet(
            obj_id=head.obj_id,
            instance=head.instance,
            failures=tuple(str(f) for f in npz["failures"].tolist()),
            measures={
                name.removeprefix(MEASURE_PREFIX): values
                for name, values in npz.items()
                if name.startswith(MEASURE_PREFIX)
            },
            parameters=head.parameters,
            **{name: npz[name] for name in ARRAYS},
        )
    except (InputError, ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{file} is not a complete grasp file ({error}). Delete it and its .json, and run the "
            "school again for this object."
        ) from error
