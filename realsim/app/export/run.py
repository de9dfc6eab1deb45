"""`realsim export`: scene by scene into one folder; interrupted, the same command goes on."""

import itertools
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from realsim.app.annotate.current import refresh_labels
from realsim.app.check.checksums import require_as_written
from realsim.app.console import Console
from realsim.app.export import sources
from realsim.app.export.card import (
    CARD_FILE,
    CROISSANT_FILE,
    DatasetCard,
    SceneFacts,
    card_bytes,
    croissant_bytes,
    options_told,
)
from realsim.app.export.data_set_targets import DATA_SETS
from realsim.app.export.scene_targets import GRASPS, SCENES
from realsim.app.export.target import (
    TABLE,
    TRIED,
    ExportRequest,
    RootJob,
    SceneJob,
    ScenePlace,
    Target,
)
from realsim.app.outputs import require_outside
from realsim.app.stages import changed_fields, made_of, open_session
from realsim.errors import InputError
from realsim.formats.bop.labelled import BopLabelledScene
from realsim.formats.export_folder import CONTENT, STATE, ExportFolder
from realsim.formats.grasps.scene_grasps import executed
from realsim.formats.labelled_scene import (
    LabelledScene,
    RenumberedScene,
    WrittenScene,
    ids_without_mesh,
    shared_ids,
)
from realsim.formats.session_scene import SessionScene
from realsim.records import ObjectModel
from realsim.store import provenance
from realsim.store.atomic import only_run_in
from realsim.store.cameras import camera_folders

ALWAYS = ("sources", "target", "scenes", "name", "licence", "models_licence", "attribution")
"""Options of every format."""
OPTION_NAMES = {"masks": "no-masks", "camera": "camera-name", "scenes": "only-scenes",
                "points": "colmap-points", "name": "title"}  # fmt: skip
TARGETS: dict[str, Target] = {**DATA_SETS, **SCENES, **GRASPS}
"""Formats by the name that the command line gives them; its own list must be the same."""
HOLD_OBJECTS = ("dataset", "scene")
"""Kinds of formats that have a place for objects and their poses."""
LABELS = {"annotated": "computed by realsim", "imported": "as imported, unchecked", "none": "none"}
OWN_LABELS = "the data set's own, unchecked"


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportResult:
    """What an export did."""

    folder: Path
    card: Path
    scenes: tuple[WrittenScene, ...]
    was_finished: bool = False
    """Whether all of it was there already."""


def run_export(request: ExportRequest, out: Path, console: Console) -> ExportResult:
    """Write the scenes of all sources in another format.

    Raises:
        InputError: a source cannot be read, an option says nothing of the format, `out` holds
            something else, or two scenes would have one name.
    """
    target = target_of(request)
    scenes = sources.source_scenes(request, all_cameras=target.holds_cameras)
    require_outside(out, request.sources)
    _tell_left_out(scenes, target, console)
    places = scene_places(scenes, target)
    if request.labels in ("auto", "annotated"):
        for folder in dict.fromkeys(s.folder for s in scenes if s.kind == "session"):
            refresh_labels(open_session(folder), console)
    asked = request.asked() | {CONTENT: sources.content_of(scenes)}
    if ExportFolder.is_finished(out, asked) or _is_of(out, request):
        require_as_written(out, console)
        shutil.rmtree(out / STATE, ignore_errors=True)  # left by a run that ended just there
        return ExportResult(folder=out, card=out / CARD_FILE, scenes=(), was_finished=True)
    folder = ExportFolder.begin(out, asked)
    if folder.resumed:
        console.say(f"going on with the export in {out}.")
    facts: list[SceneFacts] = []
    models: dict[int, ObjectModel] = {}
    infos: dict[int, Mapping[str, Any]] = {}
    all_ids: list[dict[int, int]] = []
    bare: dict[tuple[object, int], int] = {}
    with only_run_in(out):
        try:
            for source, place in zip(scenes, places, strict=True):
                opened = source.open()
                ids = shared_ids(models, opened.models(), bare.values())
                owner = source.folder if source.kind == "session" else source.source
                ids |= (without := ids_without_mesh(opened, owner, models, bare))
                if isinstance(opened, BopLabelledScene):
                    infos |= {ids.get(i, i): info for i, info in opened.models_info().items()}
                given = _as_asked(_numbered(opened, ids), target, request, out)
                all_ids.append(ids)
                written = _write(given, place, target, folder, request, console)
                known = _facts(source, opened, written, target)
                told = [*_bare_words(without, target), *_unsure_words(known, target)]
                facts.append(_with_notes(known, told))
        except InputError:
            folder.abandon()
            raise
        if target.write_root is not None:
            with console.stage("models and root"):
                again = [
                    (place.number, partial(_opened, source, ids))
                    for source, place, ids in zip(scenes, places, all_ids, strict=True)
                ]
                job = RootJob(request=request, models=models, infos=infos, scenes=again)
                told = target.write_root(folder, job)
                facts[-1] = _with_notes(facts[-1], told)
        licences = sources.licence_files(request.sources)
        folder.write_piece("licences", licences)
        card = _card(request, out, target, facts, models, licences)
        record, run = made_of("export", console, request=request, inputs=_hashes(request))
        folder.finish(
            {
                CARD_FILE: card_bytes(card),
                CROISSANT_FILE: croissant_bytes(
                    card, {name: (size, digest) for name, size, digest in folder.written()}
                ),
                provenance.FOLDER_FILE: provenance.record_bytes(record),
            }
        )
        provenance.write(out, record, run)
    return ExportResult(folder=out, card=out / CARD_FILE, scenes=tuple(f.written for f in facts))


def _hashes(request: ExportRequest) -> dict[str, str]:
    """Return the sha256 of all sources, by the fields of the request that give them."""
    return {
        f"{provenance.GIVEN}sources.{k}": provenance.sha256_of(source)
        for k, source in enumerate(request.sources)
    }


def _is_of(out: Path, request: ExportRequest) -> bool:
    """Return whether a finished export is of this request, and its sources hold the same bytes.

    Times of files change when they are copied or touched.
    """
    if not ExportFolder.is_whole(out) or not (out / provenance.FOLDER_FILE).is_file():
        return False
    try:
        record, _ = provenance.read(out)
    except InputError:
        return False
    asked, _ = provenance.plain_request(request)
    return record.request == asked and record.inputs == _hashes(request)


def _bare_words(without: Mapping[int, int], target: Target) -> list[str]:
    if not without or target.kind not in HOLD_OBJECTS:
        return []
    here = ", ".join(f"{i} (here {k})" for i, k in without.items())
    return [f"there is no mesh of object {here}: it is exported without a model."]


def _unsure_words(facts: SceneFacts, target: Target) -> list[str]:
    unsure = [f"{n} {v}" for v, n in sorted(facts.trust.verdicts.items()) if v != "accepted"]
    if not unsure or target.kind == "cameras" or facts.labels == LABELS["imported"]:
        return []
    return [f"not accepted by checks or reviewers: objects that are {', '.join(unsure)}."]


def _with_notes(facts: SceneFacts, told: Sequence[str]) -> SceneFacts:
    written = replace(facts.written, notes=(*facts.written.notes, *told))
    return replace(facts, written=written)


def target_of(request: ExportRequest) -> Target:
    """Return the format that was asked for.

    Raises:
        InputError: there is none of this name, or an option says nothing of it.
    """
    if request.target not in TARGETS:
        raise InputError(f"there is no format '{request.target}'; there are {', '.join(TARGETS)}.")
    target = TARGETS[request.target]
    plain = ExportRequest(sources=request.sources, target=request.target)
    given = changed_fields(request, plain)
    wrong = [name for name in given if name not in (*ALWAYS, *target.options)]
    if wrong:
        options = ", ".join(map(option_name, wrong))
        raise InputError(
            f"{options} says nothing of {target.name}; leave it away. Options of this format: "
            f"{', '.join(map(option_name, target.options)) or 'none'}."
        )
    return target


def option_name(field: str) -> str:
    """Return what a field of the request is called on the command line."""
    return "--" + OPTION_NAMES.get(field, field).replace("_", "-")


def scene_places(scenes: Sequence[sources.SourceScene], target: Target) -> list[ScenePlace]:
    """Return what each scene is called in the export: numbers in data sets, else its own name.

    Raises:
        InputError: two scenes of other formats have one name.
    """
    if target.kind == "dataset":
        own = [(s.number, s.camera) for s in scenes]
        numbers = [s.number for s in scenes]
        if len(set(own)) < len(own):  # sources that count alike are counted anew
            folders = list(dict.fromkeys(s.folder for s in scenes))
            numbers = [folders.index(s.folder) for s in scenes]
        shared = len(set(numbers)) < len(numbers)
        return [
            ScenePlace(number=n, name=f"{n:06d}", camera=s.camera if shared else "")
            for n, s in zip(numbers, scenes, strict=True)
        ]
    names = [s.name for s in scenes]
    twice = [n for k, n in enumerate(names) if n in names[:k]]
    if twice:
        raise InputError(
            f"two scenes are called '{twice[0]}' and would be one folder; export them one by one."
        )
    return [ScenePlace(number=k, name=n, camera="") for k, n in enumerate(names)]


def _tell_left_out(scenes: Sequence[sources.SourceScene], target: Target, console: Console) -> None:
    """Tell which cameras the format has no place for."""
    folders = [] if target.holds_cameras else [s.folder for s in scenes if s.kind == "session"]
    left = sorted({name for folder in folders for name in camera_folders(folder)})
    if left:
        console.warn(
            f"{target.name} gets what the camera in the hand saw; {', '.join(left)} stay out "
            "(--to bop takes all cameras)."
        )


def _as_asked(
    scene: LabelledScene, target: Target, request: ExportRequest, out: Path
) -> LabelledScene:
    """Return the scene undistorted, where that was asked for or the format knows no lens."""
    from realsim_sim_bridge.annotation.undistorted import UndistortedScene

    if request.undistort or (target.is_pinhole and not request.keep_distortion):
        counted = request.target == "bop"
        return UndistortedScene(scene, out / STATE / "undistorted", counted=counted)
    return scene


def _write(
    scene: LabelledScene,
    place: ScenePlace,
    target: Target,
    folder: ExportFolder,
    request: ExportRequest,
    console: Console,
) -> WrittenScene:
    total, done = len(scene.indices), itertools.count(1)
    if not total and target.kind in ("dataset", "cameras"):
        raise InputError(f"{scene.name} has no views; there is nothing to write as {target.name}.")
    with console.stage("export", f"{scene.name} to {target.name}") as tick:
        job = SceneJob(request=request, place=place, tick=lambda: tick(next(done), total))
        written = target.write_scene(scene, folder, job)
    has = {TABLE: scene.T_world_table is not None, TRIED: scene.grasps() is not None}
    lost = [what for what in target.no_place if has[what]]
    told = [f"{target.name} has no place for {' and '.join(lost)}: left out."] if lost else []
    if target.is_pinhole and request.keep_distortion:
        from realsim_sim_bridge.annotation.undistorted import cost_of_the_lens

        told.append(cost_of_the_lens(scene))
    notes = tuple(n for n in dict.fromkeys((*scene.notes, *written.notes, *told)) if n)
    if target.kind == "dataset":
        return replace(written, notes=notes)
    # It has a folder of its own, and no place for objects and their poses.
    objects = written.objects if target.kind in HOLD_OBJECTS else 0
    return replace(written, notes=notes, folder=folder.folder / place.name, objects=objects)


def _numbered(scene: LabelledScene, ids: Mapping[int, int]) -> LabelledScene:
    """Return a scene with the ids of the data set, itself where they are its own."""
    return scene if all(i == new for i, new in ids.items()) else RenumberedScene(scene, ids)


def _opened(source: sources.SourceScene, ids: Mapping[int, int]) -> LabelledScene:
    return _numbered(source.open(), ids)


def _facts(
    source: sources.SourceScene, scene: LabelledScene, written: WrittenScene, target: Target
) -> SceneFacts:
    trust, things = sources.trust_in(source), 0
    grasps = scene.grasps() if target.holds_grasps else None
    sets = () if grasps is None else grasps.sets
    words = LABELS[scene.labels] if isinstance(scene, SessionScene) else OWN_LABELS
    if trust.instances is None and scene.indices:
        things = len(scene.frame(scene.indices[0]).objects)
    return SceneFacts(
        written=written,
        labels=words,
        instances=things if trust.instances is None else trust.instances,
        trust=trust,
        grasps_tried=sum(int(executed(s).sum()) for s in sets),
        grasps_good=sum(int(s.good.sum()) for s in sets),
    )


def _card(
    request: ExportRequest,
    out: Path,
    target: Target,
    facts: Sequence[SceneFacts],
    models: dict[int, ObjectModel],
    licences: dict[str, Path],
) -> DatasetCard:
    plain = ExportRequest(sources=request.sources, target="")
    inside = facts[0].written.folder.relative_to(out)
    return DatasetCard(
        name=request.name or out.resolve().name,
        format=target.name,
        conventions=target.conventions,
        scenes=[
            replace(f, written=replace(f.written, folder=f.written.folder.relative_to(out)))
            for f in facts
        ],
        objects={i: m.name for i, m in models.items()} if target.kind in HOLD_OBJECTS else {},
        loading=_loading(target, out, inside),
        command=options_told(request, plain),
        sources=[s.resolve().name for s in request.sources],
        licence=request.licence,
        models_licence=request.models_licence,
        attribution=request.attribution,
        licence_files=sorted(licences),
    )


def _loading(target: Target, out: Path, scene: Path) -> str:
    """Return Python that opens what was written: its first scene, the first file of a kind."""

    def first(pattern: re.Match[str]) -> str:
        found = sorted((out / scene).glob(pattern[1]))
        return found[0].name if found else pattern[1]

    return re.sub(r"\{file:([^}]+)\}", first, target.loading.replace("{scene}", scene.as_posix()))


def show_export(result: ExportResult, console: Console) -> None:
    """Print what was written, and what was lost on the way."""
    if result.was_finished:
        console.say(f"this export is finished already: {result.folder}; nothing was written.")
        return
    rows: list[list[object]] = []
    for s in result.scenes:
        more = ", ".join(f"{v} {k}" for k, v in s.counts.items())
        rows.append([s.name, s.frames, s.frames_written, s.objects, more])
    header = ("scene", "frames", "written now", "poses", "more")
    console.table(f"exported into {result.folder}", header, rows)
    console.warn(*dict.fromkeys(f"{s.name}: {n}" for s in result.scenes for n in s.notes))
    console.say(f"card      {result.card}")
