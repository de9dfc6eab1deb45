"""The files of a BOP data set beside its scenes: models, cameras, targets, a description."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from realsim.formats.bop.layout import scene_number
from realsim.formats.bop.models import INFO_FILE, info_of, model_file, model_files
from realsim.formats.bop.writing import SCENES
from realsim.formats.export_folder import ExportFolder
from realsim.geometry.mesh import ply_bytes
from realsim.records import ObjectModel

Json = dict[str, Any]
MODELS, MODELS_EVAL = "models", "models_eval"
BOP19, BOP24 = "test_targets_bop19.json", "test_targets_bop24.json"
"""What the data set asks to be found: localisation, detection."""
SAME_SHARE = 1e-4
"""Share of the diameter: numbers of models_info.json that differ by less from what the mesh has are
kept as the source wrote them, to the last digit."""
SYMMETRIES = ("symmetries_discrete", "symmetries_continuous")


def write_bop_models(
    models: Mapping[int, ObjectModel],
    folder: ExportFolder,
    *,
    infos: Mapping[int, Mapping[str, Any]] | None = None,
) -> None:
    """Write models/ and models_eval/.

    BOP evaluates with models_eval: the same surfaces without looks. They are written as they are,
    not decimated: errors are greatest distances of vertices, which more vertices only make truer.

    Args:
        models: by object id.
        folder: the export.
        infos: the source's rows of models_info.json: their numbers are kept where they hold, and
            so are keys that are not known here.
    """
    rows: dict[str, Json] = {}
    for obj_id in sorted(models):
        model = models[obj_id]
        piece = f"{MODELS}/{model_file(obj_id)}"
        rows[str(obj_id)] = kept_info(info_of(model), (infos or {}).get(obj_id))
        if not folder.has(piece):
            files: dict[str, Any] = {f"{MODELS}/{k}": v for k, v in model_files(model).items()}
            bare = replace(model.mesh, colors=None, uv=None, texture=None)
            files[f"{MODELS_EVAL}/{model_file(obj_id)}"] = ply_bytes(bare, "mm")
            folder.write_piece(piece, files)
    text = json.dumps(rows, indent=1, allow_nan=False) + "\n"
    folder.write_document(f"{MODELS}/{INFO_FILE}", [text])
    folder.write_document(f"{MODELS_EVAL}/{INFO_FILE}", [text])


def kept_info(computed: Json, source: Mapping[str, Any] | None) -> Json:
    """Return a row of models_info.json: the source's numbers where they hold."""
    if source is None:
        return computed
    limit = SAME_SHARE * float(computed["diameter"])
    row = dict(source)
    for key, value in computed.items():
        said = source.get(key)
        if isinstance(value, float) and key != "density":
            holds = type(said) in (int, float) and abs(float(said or 0.0) - value) <= limit
            row[key] = said if holds else value
        elif key in SYMMETRIES:
            row[key] = said if _same_numbers(said, value, limit) else value
        else:
            row[key] = value
    for key in SYMMETRIES:
        if key in source and key not in computed:
            del row[key]
    return row


def _same_numbers(said: Any, value: Any, limit: float) -> bool:
    """Return whether two lists of matrices, or of axes with offsets, are the same."""
    try:
        a, b = (
            np.array(
                [
                    [*s["axis"], *s["offset"]] if isinstance(s, dict) else np.ravel(s)
                    for s in listed
                ],
                dtype=np.float64,
            )
            for listed in (said, value)
        )
    except (TypeError, ValueError, KeyError):
        return False
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= max(limit, 1e-9)))


def write_bop_root(folder: ExportFolder, *, name: str) -> None:
    """Write camera.json, dataset_info.md and the lists of targets of the scenes that are whole.

    The lists are of one split, as BOP's are (the only one, else the first that begins with 'test'):
    every image of it, and of its objects those that are visible to a tenth or more (or whose
    visibility is not known).

    Args:
        folder: the export, all scenes and models written.
        name: of the data set.
    """
    scenes: list[Json] = [row for _, row in folder.rows(SCENES)]
    cameras: dict[str, Json] = {}
    for scene in scenes:
        if scene["camera"] is not None:
            cameras.setdefault(scene["camera_type"], scene["camera"])
    for camera_type, camera in cameras.items():
        suffix = f"_{camera_type}" if camera_type else ""
        text = json.dumps(camera, indent=1) + "\n"
        folder.write_document(f"camera{suffix}.json", [text])
    folder.write_document("dataset_info.md", _description(name, scenes))
    splits = sorted({s["split"] for s in scenes if not s["split"].startswith("onboarding")})
    test = [s for s in splits if s.startswith("test")]
    chosen = splits[0] if len(splits) == 1 else test[0] if test else None
    if chosen is None:
        return
    seen: dict[str, Json] = {}
    for scene in scenes:
        # Of a scene with several cameras the first one's images are asked for.
        if scene["split"] == chosen:
            seen.setdefault(scene["folder"], scene)
    listed = list(seen.values())
    # BOP's own lists are of tests; those of another split say which.
    first = "" if chosen.startswith("test") else chosen
    lists = ((BOP19, _localisation(folder, listed)), (BOP24, _detection(folder, listed)))
    for usual, rows in lists:
        file = usual.replace("test", first, 1) if first else usual
        folder.write_document(file, _json_list(rows))


def _localisation(folder: ExportFolder, scenes: Sequence[Json]) -> Iterator[Json]:
    for scene in scenes:
        for image, fact in folder.rows(scene["facts"]):
            for obj_id in sorted(fact["asked"], key=int):
                yield {
                    "im_id": int(image),
                    "inst_count": fact["asked"][obj_id],
                    "obj_id": int(obj_id),
                    "scene_id": scene_number(scene["folder"]),
                }


def _detection(folder: ExportFolder, scenes: Sequence[Json]) -> Iterator[Json]:
    for scene in scenes:
        for image, _ in folder.rows(scene["facts"]):
            yield {"im_id": int(image), "scene_id": scene_number(scene["folder"])}


def _json_list(rows: Iterator[Json]) -> Iterator[str]:
    yield "[\n"
    for k, row in enumerate(rows):
        yield (",\n" if k else "") + json.dumps(row)
    yield "\n]\n"


def _description(name: str, scenes: Sequence[Json]) -> Iterator[str]:
    yield f"# {name}\n\n"
    yield (
        "Format: BOP scenewise (bop_toolkit, docs/bop_datasets_format.md). Lengths in mm, poses "
        "row by row: cam_R_m2c and cam_t_m2c from model to camera, cam_R_w2c and cam_t_w2c from "
        "world to camera; cameras as in OpenCV. models_eval holds the models without their "
        "looks, not decimated.\n\n"
    )
    counts: dict[str, int] = {}
    for scene in scenes:
        key = scene["split"] + (f", camera {scene['camera_type']}" if scene["camera_type"] else "")
        counts[key] = counts.get(key, 0) + 1
    for key, count in counts.items():
        yield f"- {key}: {count} scene{'s' if count > 1 else ''}\n"
