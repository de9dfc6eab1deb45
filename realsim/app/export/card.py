"""The card of an exported data set: counts, conventions, what was lost, licences, checksums.

A README.md whose head is that of Hugging Face's dataset cards, so that a folder can be uploaded as
it is. What nobody stated is written as "not stated", never left out.

The card once more for machines: Croissant 1.0 (mlcommons.org/croissant), JSON-LD.

Every document of the export is a file with its checksum; what comes in thousands (images, masks)
is a set of files, whose checksums are in SHA256SUMS. Data set search and loaders read it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from realsim import __version__
from realsim.app.console import shortened
from realsim.app.stages import changed_fields
from realsim.formats.labelled_scene import WrittenScene
from realsim.pages import counted

CARD_FILE = "README.md"
NOT_STATED = "not stated: ask the source before publishing"
STATED = ("name", "licence", "models_licence", "attribution")
"""Options that the card tells elsewhere."""
CHECKED = "checked:"
"""How notes begin that say what was held against what, and agreed."""
LICENCE_IDS = (
    "mit", "apache-2.0", "bsd-2-clause", "bsd-3-clause", "gpl-3.0", "lgpl-3.0", "cc0-1.0",
    "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc-by-nc-sa-4.0", "cc-by-nd-4.0",
)  # fmt: skip
"""Licences that Hugging Face knows by name."""
SIZES = (
    (1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
)  # fmt: skip
"""Hugging Face's size categories, by the number of frames."""


MOST_NOTES = 60
"""Notes that a card has; the rest is counted."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneTrust:
    """What registration and review say of a session."""

    verdicts: Mapping[str, int] = field(default_factory=dict[str, int])
    """Verdict of registration and review -> objects."""
    findings: Sequence[str] = ()
    """What registration found out about the scene as a whole."""
    pose_sigma_mm: float | None = None
    """Median standard deviation of the objects' positions [mm]."""
    instances: int | None = None
    """Things that stand in it; None = nobody has said."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneFacts:
    """What is known of one scene beside what its writer says."""

    written: WrittenScene
    labels: str
    """Where its labels come from: 'annotated by realsim', 'as imported', 'the data set's own'."""
    instances: int
    """Things that stand in it."""
    trust: SceneTrust = field(default_factory=SceneTrust)
    grasps_tried: int = 0
    grasps_good: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class DatasetCard:
    """What stands on a card."""

    name: str
    format: str
    """Name of the format, as people call it."""
    conventions: Sequence[tuple[str, str]]
    """(what, convention) of the format as it was written here."""
    scenes: Sequence[SceneFacts]
    objects: Mapping[int, str]
    """Object id -> name."""
    loading: str
    """Python that opens the data set."""
    command: Sequence[tuple[str, str]]
    """(option, value) that it was made with."""
    sources: Sequence[str]
    """Names of the sources."""
    licence: str
    models_licence: str
    attribution: str
    licence_files: Sequence[str] = ()
    """Licences that lay beside the sources and were copied along."""


def options_told(request: Any, plain: Any) -> list[tuple[str, str]]:
    """Return the options of a request that a card tells under 'Made with', with their values."""
    said = changed_fields(request, plain).items()
    return [(name.replace("_", "-"), str(value)) for name, value in said if name not in STATED]


def card_bytes(card: DatasetCard) -> bytes:
    """Return the card as Markdown."""
    frames = sum(s.written.frames for s in card.scenes)
    parts = [_head(card, frames), f"# {card.name}\n", _summary(card, frames)]
    parts.append(_section("Counts", _counts(card)))
    parts.append(_section("Conventions", _table(("what", "convention"), card.conventions)))
    parts.append(_section("How far to trust it", _trust(card)))
    notes = [
        f"- {s.written.name}: {n}"
        for s in card.scenes
        for n in s.written.notes
        if not n.startswith(CHECKED)
    ]
    parts.append(_section("What was changed or lost on the way", _joined(notes)))
    if card.objects:
        parts.append(_section("Objects", _table(("id", "name"), sorted(card.objects.items()))))
    parts.append(_section("Loading", f"```python\n{card.loading.strip()}\n```\n"))
    parts.append(_section("Licence", _licence(card)))
    parts.append(_section("Made with", _made_with(card)))
    sums = "`sha256sum -c SHA256SUMS` compares every file with what was written.\n"
    parts.append(_section("Checksums", sums))
    return "\n".join(parts).encode("utf-8")


def _head(card: DatasetCard, frames: int) -> str:
    size = next((name for limit, name in SIZES if frames < limit), "n>10M")
    fields: dict[str, object] = {
        "pretty_name": card.name,
        **_licence_fields(card.licence),
        "size_categories": [size],
        "tags": ["robotics", "grasping", "6d-pose", "rgb-d", card.format.lower()],
    }
    # JSON is YAML, and quotes what YAML would take for something else.
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items()]
    return "\n".join(["---", *lines, "---", ""])


def _licence_fields(licence: str) -> dict[str, str]:
    known = licence.strip().lower().replace(" ", "-")
    if known in LICENCE_IDS:
        return {"license": known}
    return {"license": "other", "license_name": licence or "not stated"}


def _summary(card: DatasetCard, frames: int) -> str:
    text = f"{counted(len(card.scenes), 'scene')}, {frames} frames"
    if card.objects:
        objects = sum(s.written.objects for s in card.scenes)
        text += f", {objects} object poses in them, {len(card.objects)} object models"
    return f"{text}. Format: {card.format}.\n"


def _section(title: str, body: str) -> str:
    return f"## {title}\n\n{body.strip() or 'Nothing.'}\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    def line(cells: Sequence[object]) -> str:
        escaped = [str(c).replace("|", r"\|").replace("\n", " ") for c in cells]
        return f"| {' | '.join(escaped)} |"

    return "\n".join([line(header), line(["---"] * len(header)), *(line(r) for r in rows)]) + "\n"


def _counts(card: DatasetCard) -> str:
    extra = sorted({k for s in card.scenes for k in s.written.counts})
    columns: list[tuple[str, list[int]]] = [
        ("frames", [s.written.frames for s in card.scenes]),
        ("things", [s.instances for s in card.scenes]),
        ("poses", [s.written.objects for s in card.scenes]),
        *((k, [s.written.counts.get(k, 0) for s in card.scenes]) for k in extra),
        ("grasps tried", [s.grasps_tried for s in card.scenes]),
        ("good", [s.grasps_good for s in card.scenes]),
    ]
    shown = [(name, values) for name, values in columns if any(values)]
    rows: list[list[object]] = [
        [s.written.name, s.written.folder.as_posix(), *(values[k] for _, values in shown)]
        for k, s in enumerate(card.scenes)
    ]
    if len(rows) > 1:
        rows.append(["all", "", *(sum(values) for _, values in shown)])
    return _table(["scene", "folder", *(name for name, _ in shown)], rows)


def _trust(card: DatasetCard) -> str:
    rows: list[list[object]] = []
    for s in card.scenes:
        trust = s.trust
        verdicts = ", ".join(f"{n} {v}" for v, n in sorted(trust.verdicts.items())) or "none given"
        sigma = "not known" if trust.pose_sigma_mm is None else f"{trust.pose_sigma_mm:.2f}"
        rows.append([s.written.name, s.labels, verdicts, sigma])
    text = _table(("scene", "labels", "verdicts", "1 sigma of positions [mm], median"), rows)
    found = [f"- {s.written.name}: {n}" for s in card.scenes for n in s.trust.findings]
    checked = [
        f"- {s.written.name}: {n.removeprefix(CHECKED).strip()}"
        for s in card.scenes
        for n in s.written.notes
        if n.startswith(CHECKED)
    ]
    meaning = (
        "\nA verdict is that of the registration's own checks, or of the person who reviewed "
        "it: `accepted`, `doubtful` (somebody should look), `unchecked` (nothing was asked).\n"
    )
    more = _listed("Found by the registration", found) + _listed("Checked on reading", checked)
    return text + meaning + more


def _listed(title: str, lines: Sequence[str]) -> str:
    return f"\n{title}:\n\n{_joined(lines)}\n" if lines else ""


def _joined(notes: Sequence[str]) -> str:
    return "\n".join(shortened(list(dict.fromkeys(notes)), MOST_NOTES, "- and {} more notes."))


def _licence(card: DatasetCard) -> str:
    rows = [
        ("images and labels", card.licence or NOT_STATED),
        ("object models", card.models_licence or NOT_STATED),
        ("attribution", card.attribution or NOT_STATED),
    ]
    copied = "".join(f"- [{name}]({name})\n" for name in card.licence_files)
    beside = f"\nFound beside the sources, and copied:\n\n{copied}" if copied else ""
    return _table(("of", "licence"), rows) + beside


def _made_with(card: DatasetCard) -> str:
    rows = [("realsim", __version__), ("sources", ", ".join(card.sources)), *card.command]
    return _table(("what", "value"), rows)


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
