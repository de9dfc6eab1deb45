"""The card once more for machines: Croissant 1.0 (mlcommons.org/croissant), JSON-LD.

Every document of the export is a file with its checksum; what comes in thousands (images, masks)
is a set of files, whose checksums are in SHA256SUMS. Data set search and loaders read it.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from realsim.app.export.card import NOT_STATED, DatasetCard

CROISSANT_FILE = "croissant.json"
SPEC = "http://mlcommons.org/croissant/1.0"
ENCODINGS = {
    ".json": "application/json", ".png": "image/png", ".jpg": "image/jpeg", ".ply": "model/ply",
    ".npz": "application/x-npz", ".npy": "application/x-npy", ".tar": "application/x-tar",
    ".xml": "application/xml", ".mat": "application/x-matlab-data", ".txt": "text/plain",
    ".md": "text/markdown", ".obj": "model/obj", ".h5": "application/x-hdf5",
    ".parquet": "application/x-parquet", ".yaml": "application/yaml", ".csv": "text/csv",
}  # fmt: skip
FEW = 64
"""A folder's files of one kind up to so many are listed one by one; more are a set."""
CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "citeAs": "cr:citeAs",
    "column": "cr:column", "conformsTo": "dct:conformsTo", "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/", "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"}, "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract",
    "field": "cr:field", "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet", "format": "cr:format", "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key",
    "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path",
    "recordSet": "cr:recordSet", "references": "cr:references", "regex": "cr:regex",
    "repeated": "cr:repeated", "replace": "cr:replace", "sc": "https://schema.org/",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField",
    "transform": "cr:transform",
}  # fmt: skip


def croissant_bytes(card: DatasetCard, sums: Mapping[str, tuple[int, str]]) -> bytes:
    """Return the description of an export.

    Args:
        card: its card.
        sums: path -> (bytes, SHA-256) of every file that is described.
    """
    distribution, images = _distribution(sums)
    frames = sum(s.written.frames for s in card.scenes)
    document: dict[str, Any] = {
        "@context": CONTEXT, "@type": "sc:Dataset", "conformsTo": SPEC,
        "name": "".join(c if c.isalnum() or c in "-_ " else "-" for c in card.name),
        "description": f"{len(card.scenes)} scenes, {frames} frames, {len(card.objects)} object "
                       f"models in the format {card.format}. {card.loading.strip()}",
        "license": card.licence or NOT_STATED,
        "creator": {"@type": "sc:Organization", "name": card.attribution or NOT_STATED},
        "version": "1.0.0",
        "keywords": ["robotics", "grasping", "6d-pose", "rgb-d", card.format.lower()],
        "distribution": distribution,
    }  # fmt: skip
    if images:
        document["recordSet"] = [_records(images)]
    return (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode("utf-8")


def _distribution(sums: Mapping[str, tuple[int, str]]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return files and sets of files, and the sets that are colour images."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for name in sums:
        path = PurePosixPath(name)
        kinds.setdefault((path.parent.name or "files", path.suffix), []).append(name)
    found: list[dict[str, Any]] = []
    images: list[str] = []
    for (kind, suffix), names in sorted(kinds.items()):
        encoding = ENCODINGS.get(suffix, "application/octet-stream")
        if len(names) <= FEW and kind not in ("rgb", "gray", "depth", "mask", "mask_visib"):
            found += [
                {
                    "@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name,
                    "contentSize": f"{sums[name][0]} B", "encodingFormat": encoding,
                    "sha256": sums[name][1],
                }
                for name in sorted(names)
            ]  # fmt: skip
            continue
        identity = f"{kind}{suffix.replace('.', '-')}"
        found.append(
            {
                "@type": "cr:FileSet", "@id": identity, "name": identity,
                "encodingFormat": encoding, "includes": _pattern(names, kind, suffix),
                "description": f"{len(names)} files",
            }
        )  # fmt: skip
        if kind in ("rgb", "gray") and encoding.startswith("image/"):
            images.append(identity)
    return found, images


def _pattern(names: Sequence[str], kind: str, suffix: str) -> str:
    """Return what finds the files of a kind: as many folders above as the first has."""
    above = len(PurePosixPath(names[0]).parts) - 2
    return "*/" * above + f"{kind}/*{suffix}"


def _records(images: Sequence[str]) -> dict[str, Any]:
    """Return one record an image: its path and pixels."""
    first = images[0]

    def field(name: str, kind: str, part: str) -> dict[str, Any]:
        return {
            "@type": "cr:Field", "@id": f"images/{name}", "name": name, "dataType": kind,
            "source": {"fileSet": {"@id": first}, "extract": {"fileProperty": part}},
        }  # fmt: skip

    return {
        "@type": "cr:RecordSet", "@id": "images", "name": "images", "key": {"@id": "images/path"},
        "field": [
            field("path", "sc:Text", "fullpath"), field("image", "sc:ImageObject", "content"),
        ],
    }  # fmt: skip
