"""What an upgrade leaves beside its scenes: what the data set had, records, models, BOP's files.

OUT/SPLIT/SCENE/imported/     the data set's own annotations, byte by byte, and source.json
OUT/SPLIT/SCENE/stages/upgrade.json   what came of the scene, and the key of its inputs
OUT/models/                   the models of all scenes
OUT/camera.json, OUT/SPLIT_targets_bop19.json
"""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from realsim import __version__
from realsim.app.register.from_review import UPGRADE_FILE
from realsim.app.upgrade.dataset import SceneRef, UpgradeConfig
from realsim.errors import InputError
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import noted, read_object

RECORD = 2
"""Number of the records' layout: those of another are made again."""
IMPORTED = "imported"
NOTE = UPGRADE_FILE
IMAGE_FOLDERS = ("mask", "mask_visib", "label", "rect", "meta")
"""Folders of a scene: not read, and no reason to upgrade it again."""
DOCUMENTS = {
    "bop": ("scene_gt*.json", "scene_camera*.json"),
    "graspnet": ("annotations/*.xml", "*.npy", "meta.mat"),
}
"""Copied to imported/: small, and all that before and after can be compared by."""
COLLISIONS = "collision_label/scene_{:04d}/collision_labels.npz"


def key_of(ref: SceneRef, config: UpgradeConfig) -> str:
    """Return a hash of everything a scene's result depends on: files by name, size and time.

    Contents are compared by every stage itself; this is to know in no time that nothing changed.
    """
    digest = hashlib.sha256(json.dumps([__version__, RECORD, config.result_key()]).encode())
    files = [p for p in sorted(ref.folder.rglob("*")) if p.is_file()]
    files = [p for p in files if p.relative_to(ref.folder).parts[0] not in IMAGE_FOLDERS]
    if ref.models.is_dir():
        files += [p for p in sorted(ref.models.rglob("*")) if p.is_file()]
    for path in files:
        about = path.stat()
        digest.update(f"{path.name} {about.st_size} {about.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def finished_record(folder: Path, key: str) -> dict[str, Any] | None:
    """Return what came of a scene, where it has been upgraded with these inputs."""
    note = noted(folder / NOTE)
    is_current = note.get("key") == key and (folder / "session.json").is_file()
    return note.get("record") if is_current else None


def all_records(out: Path) -> Iterator[dict[str, Any]]:
    """Return what came of every scene that has been upgraded into a folder."""
    for path in sorted(out.glob(f"*/*/{NOTE}")):
        try:
            yield dict(read_object(path)["record"])
        except (InputError, KeyError, TypeError, ValueError):
            continue


def labels_of(ref: SceneRef) -> tuple[str, ...]:
    """Return the files of grasp labels that a scene's data set has, as paths in it."""
    if ref.kind != "graspnet":
        return ()
    labels = [ref.root / COLLISIONS.format(ref.number)]
    labels += sorted((ref.root / "grasp_label").glob("*_labels.npz"))
    return tuple(str(p.relative_to(ref.root)) for p in labels if p.is_file())


def keep_imported(
    store: SessionStore, ref: SceneRef, at: SceneRef, labels: Sequence[str], digests: dict[int, str]
) -> None:
    """Copy the data set's annotations beside the new ones, and say where they came from.

    Args:
        store: the session.
        ref: the scene.
        at: where its files are on this machine.
        labels: the data set's files of grasp labels.
        digests: of the images.

    Raises:
        InputError: the session was made from other images.
    """
    source = f"{IMPORTED}/source.json"
    said = {str(k): digests[k] for k in sorted(digests)}
    if store.has(source):
        before = store.read_json(source).get("images", {})
        differing = [k for k in before if said.get(k) != before[k]]
        if differing:
            raise InputError(
                f"'{store.folder}' holds an upgrade of other images (image {differing[0]} has "
                "changed, or is not asked for). Give another --out, or delete that folder."
            )
    files = [p for pattern in DOCUMENTS[ref.kind] for p in sorted(at.folder.glob(pattern))]
    for path in files:
        relative = f"{IMPORTED}/{path.relative_to(at.folder).as_posix()}"
        data = path.read_bytes()
        if not store.has(relative) or store.path(relative).read_bytes() != data:
            store.write_bytes(relative, data)
    record = {
        "kind": ref.kind, "dataset": str(ref.root.resolve()), "scene": str(ref.folder.resolve()),
        "grasp_labels": list(labels),
        "images": said,
    }  # fmt: skip
    if not store.has(source) or store.read_json(source) != record:
        store.write_json(source, record)


def require_one_data_set(out: Path, refs: Sequence[SceneRef]) -> None:
    """Refuse a folder that another data set has been upgraded into.

    A data set elsewhere is the same one, moved, if what it says of a scene is what was imported.

    Raises:
        InputError: the folder holds scenes of another one.
    """
    there = {str(p.parents[1].relative_to(out)): p for p in out.glob(f"*/*/{IMPORTED}/source.json")}
    told = {k: str(read_object(p).get("dataset", "another folder")) for k, p in there.items()}
    root = refs[0].root.resolve()
    known = {str(root), os.path.abspath(refs[0].root)}
    others = {k: of for k, of in sorted(told.items()) if os.path.abspath(of) not in known}
    here = [ref for ref in refs if ref.place in others]
    if others and not (here and all(_is_imported(ref, there[ref.place].parent) for ref in here)):
        place, of = next(iter(others.items()))
        raise InputError(
            f"'{out}' holds an upgrade of another data set: {place} is of {of}. Its labels, "
            f"models and review would be mixed up with those of {root}. Give another --out."
        )


def _is_imported(ref: SceneRef, imported: Path) -> bool:
    """Return whether a scene's annotations are those that were imported, byte by byte."""
    files = [p for pattern in DOCUMENTS[ref.kind] for p in ref.folder.glob(pattern)]
    copies = [(p, imported / p.relative_to(ref.folder)) for p in files]
    return bool(copies) and all(c.is_file() and c.read_bytes() == p.read_bytes() for p, c in copies)


def gather_models(out: Path, places: Sequence[str]) -> list[str]:
    """Copy the models of all scenes into one models folder, as BOP has it.

    Returns:
        The models that are not those of an earlier scene, which are kept: "object 4 of PLACE".
    """
    info: dict[str, Any] = {}
    differing: list[str] = []
    home = out / "models"
    for place in places:
        models = out / place / "models"
        if not (models / "models_info.json").is_file():
            continue
        for obj_id, entry in read_object(models / "models_info.json").items():
            if obj_id in info:
                if entry != info[obj_id]:
                    differing.append(f"object {obj_id} of {place}")
                continue
            info[obj_id] = entry
            for path in sorted(models.glob(f"obj_{int(obj_id):06d}.*")):
                data = path.read_bytes()
                if not (home / path.name).is_file() or (home / path.name).read_bytes() != data:
                    atomic.write_bytes(home / path.name, data)
    ordered = {k: info[k] for k in sorted(info, key=int)}
    atomic.write_json(home / "models_info.json", ordered)
    return differing


def write_root_files(out: Path, places: Sequence[str]) -> None:
    """Write what BOP's tools look for at a data set's root: the camera and each split's targets."""
    targets: dict[str, list[dict[str, int]]] = {}
    for k, place in enumerate(places):
        store = SessionStore.open(out / place)
        session, i = store.session, store.session.intrinsics
        if k == 0:
            camera = {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy, "width": i.width,
                      "height": i.height, "depth_scale": 1e3 * session.depth_unit_m}  # fmt: skip
            atomic.write_json(out / "camera.json", camera)
        name = store.folder.name
        number = int(name) if name.isdecimal() else 0
        for image, rows in store.read_json("scene_gt.json").items():
            counts = Counter(int(row["obj_id"]) for row in rows)
            targets.setdefault(store.folder.parent.name, []).extend(
                {"scene_id": number, "im_id": int(image), "obj_id": o, "inst_count": n}
                for o, n in sorted(counts.items())
            )
    for split, rows in targets.items():
        atomic.write_json(out / f"{split}_targets_bop19.json", rows)
