"""A BOP export once more as tar shards, BOP's "webdataset" layout, for reading in one stream.

    SPLIT_web/shard-000000.tar      000001_000012.rgb.png, .depth.png, .camera.json, .gt.json,
                                    .gt_info.json, .mask.json, .mask_visib.json ...
    SPLIT_web/key_to_shard.json     key -> number of the shard

A key is SCENE_IMAGE, six digits each; masks are COCO's run lengths by row of gt.json. Names and
layout: bop_toolkit, bop_imagewise.py and bop_webdataset.py. At most 1000 images a shard.
"""

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from realsim import images
from realsim.formats.bop.labels import rle_of
from realsim.formats.bop.layout import Document, ImageKind, SceneLayout, scene_number
from realsim.formats.bop.writing import SCENES
from realsim.formats.export_folder import STATE, ExportFolder
from realsim.untrusted.own_json import read_object

PER_SHARD = 1000
Json = dict[str, Any]
DOCUMENTS: tuple[tuple[str, Document], ...] = (
    ("camera.json", "scene_camera"), ("gt.json", "scene_gt"), ("gt_info.json", "scene_gt_info"),
)  # fmt: skip
KINDS: tuple[ImageKind, ...] = ("rgb", "gray", "depth")


def write_shards(folder: ExportFolder) -> int:
    """Write the shards of all scenes of an export; return how many images are in them.

    Raises:
        StorageError: the disk is full.
    """
    groups: dict[str, list[SceneLayout]] = {}
    for _, row in folder.rows(SCENES):
        layout = SceneLayout(folder=Path(row["split"]) / row["folder"], camera=row["camera_type"])
        groups.setdefault(f"{row['split']}{layout.suffix}_web", []).append(layout)
    total = 0
    for home, layouts in groups.items():
        keys: dict[str, int] = {}
        shard: list[tuple[str, dict[str, bytes]]] = []
        number = 0
        for key, files in _samples(folder.folder, layouts):
            shard.append((key, files))
            keys[key] = number
            if len(shard) == PER_SHARD:
                _write_shard(folder, home, number, shard)
                shard, number = [], number + 1
        if shard:
            _write_shard(folder, home, number, shard)
        text = json.dumps(keys, indent=0).encode("ascii")
        folder.write_piece(f"{home} keys", {f"{home}/key_to_shard.json": text})
        total += len(keys)
    return total


def _write_shard(
    folder: ExportFolder, home: str, number: int, samples: list[tuple[str, dict[str, bytes]]]
) -> None:
    """Write one tar, its members without times so that the same images are the same bytes."""
    name = f"{home}/shard-{number:06d}.tar"
    if folder.has(name):
        return
    kept = folder.folder / STATE / "shard.tar"
    with tarfile.open(kept, "w", format=tarfile.USTAR_FORMAT) as tar:
        for key, files in samples:
            for ending, data in files.items():
                member = tarfile.TarInfo(f"{key}.{ending}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
    folder.write_piece(name, {name: kept})


def _samples(root: Path, layouts: list[SceneLayout]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield key and files (ending -> bytes) of every image."""
    for layout in layouts:
        documents = {
            ending: read_object(root / layout.document(name))
            for ending, name in DOCUMENTS
            if (root / layout.document(name)).is_file()
        }  # fmt: skip
        for image in sorted(documents["camera.json"], key=int):
            key = f"{scene_number(layout.folder.name):06d}_{int(image):06d}"
            yield key, _files(root, layout, int(image), documents)


def _files(
    root: Path, layout: SceneLayout, image: int, documents: dict[str, Json]
) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for kind in KINDS:
        for path in sorted((root / layout.images(kind)).glob(f"{image:06d}.*")):
            files[f"{kind}{path.suffix}"] = path.read_bytes()
    rows = {ending: rows[str(image)] for ending, rows in documents.items() if str(image) in rows}
    files |= {ending: _json(row) for ending, row in rows.items()}
    count = len(rows.get("gt.json", ()))
    for name, visible in (("mask", False), ("mask_visib", True)):
        paths = [root / layout.mask_file(image, k, visible=visible) for k in range(count)]
        if count and all(path.is_file() for path in paths):
            masks = {str(k): rle_of(images.read_grey(path) > 0) for k, path in enumerate(paths)}
            files[f"{name}.json"] = _json(masks)
    return files


def _json(value: Any) -> bytes:
    return json.dumps(value).encode("ascii")
