"""A campaign as it runs: first its scenes, then each one's stages, then what is made of all."""

import gc
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from shlex import quote
from typing import Any

from realsim.app.console import Console
from realsim.app.pipeline import chain
from realsim.app.pipeline.campaign import Campaign, Step
from realsim.app.pipeline.chain import Command, Ended, run_command
from realsim.errors import InputError, RealsimError
from realsim.formats.export_folder import FINISHED
from realsim.many import Outcome, PoolConfig, Task, Worked, open_pool, run_many
from realsim.store import provenance
from realsim.store.atomic import only_run_in, storing, write_bytes, write_json
from realsim.untrusted.own_json import read_object, to_json

SCENES, RECORDS, LOGS = "scenes", "records", "logs"
DOCUMENT, PAGE = "campaign.json", "campaign.html"
CAMPAIGN = "campaign"
"""Key of the document: the campaign's file."""
RENEWED_S = 10.0
"""Least time between two writings of the page [s]."""
LEAST_FREE_MB = 200
"""With less room on the disk [MB] no further command is begun."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneState:
    """A scene of a campaign."""

    name: str
    folder: Path
    ends: tuple[Ended, ...] = ()
    """How each command that ran ended."""
    note: str = ""
    """What was found of its results that this campaign did not leave so."""

    @property
    def failure(self) -> Ended | None:
        """Return the command that failed, if one did."""
        return next((end for end in self.ends if not end.is_done), None)


@dataclass(eq=False, kw_only=True, slots=True)
class PipelineResult:
    """What became of a campaign."""

    scenes: list[SceneState]
    of_all: list[Ended] = field(default_factory=list[Ended])
    """Commands that made the scenes, and those over all of them."""
    kept: int = 0
    """Scenes that an earlier run had finished."""
    waiting: tuple[str, ...] = ()
    """Stages over all scenes that were not begun, because a scene failed."""
    stages: tuple[str, ...] = ()

    def is_done(self, scene: SceneState) -> bool:
        """Return whether a scene went through all its stages."""
        return scene.failure is None and len(scene.ends) == len(self.stages)

    @property
    def failed(self) -> dict[str, str]:
        """Return scene or stage -> why it failed."""
        failures = {s.name: s.failure for s in self.scenes}
        found = {name: f"{end.stage}: {end.told}" for name, end in failures.items() if end}
        return found | {e.stage: e.told for e in self.of_all if not e.is_done}

    @property
    def told(self) -> dict[str, Any]:
        """Return the document of the campaign."""
        return {
            "scenes": len(self.scenes),
            "done": sum(self.is_done(s) for s in self.scenes),
            "kept": self.kept,
            "failed": self.failed,
            "stages": list(self.stages),
            "commands": {s.name: to_json(s.ends) for s in self.scenes if s.ends},
            "of_all": to_json(self.of_all),
            "waiting": list(self.waiting),
        }  # fmt: skip


def run_pipeline(
    campaign: Campaign, where: PoolConfig, console: Console, *, without_failed: bool = False
) -> PipelineResult:
    """Run what a campaign has not done yet.

    A scene that fails is listed, and the others go on.

    Args:
        campaign: what its file asks for.
        where: its scenes are worked at.
        console: for progress.
        without_failed: whether stages over all scenes take those that are done, into a folder that
            says how many; else they wait for all.

    Raises:
        InputError: OUT is a file, or of another campaign, or another run works there.
        RealsimError: the disk has no room.
    """
    out = _own_folder(campaign)
    with only_run_in(out), storing(out, "the campaign's records"):
        (out / LOGS).mkdir(exist_ok=True)
        result = PipelineResult(scenes=[], stages=tuple(s.stage for s in campaign.of_a_scene))
        _write(campaign, result)
        unmade = _make_scenes(campaign, where, console, result)
        result.scenes = [
            replace(state, ends=(unmade[name],)) if name in unmade else state
            for name, place in scenes_of(campaign)
            for state in [_known(campaign, name, place)]
        ]
        result.kept = sum(result.is_done(s) for s in result.scenes)
        for scene in result.scenes:
            if scene.note:
                console.warn(f"{scene.name}: {scene.note}")
        _write(campaign, result)
        _run_scenes(campaign, where, console, result)
        done = [s for s in result.scenes if result.is_done(s)]
        if not result.failed or without_failed:
            _run_of_all(campaign, where, console, result, done)
        else:
            result.waiting = tuple(step.stage for step in campaign.of_all)
        _write(campaign, result)
    return result


def _run_of_all(
    campaign: Campaign, where: PoolConfig, console: Console, result: PipelineResult,
    done: Sequence[SceneState],
) -> None:  # fmt: skip
    """Run the stages over all scenes, or over those that are done."""
    part = f"_{len(done)}_of_{len(result.scenes)}" if result.failed else ""
    for step in campaign.of_all if done else ():
        _require_room(campaign.out)
        with console.stage(step.stage, f"{len(done)} scenes"):
            out = campaign.out.resolve() / f"{step.stage}{part}"
            words = [*(str(s.folder.resolve()) for s in done), "--out", str(out)]
            before = out.with_name(f"{out.name}.before")
            end = _run(campaign, step, words, where.processes)
            is_refused = not end.is_done and (out / FINISHED).is_file() and not before.exists()
            if is_refused:  # it is of other options, or of scenes as they were
                out.rename(before)  # kept until there is a new one
                end = _run(campaign, step, words, where.processes)
            result.of_all.append(end)
            for note in end.notes:
                console.warn(f"{step.stage}: {note}")
            if not end.is_done and before.is_dir():
                place = before if out.exists() else before.rename(out)
                console.warn(f"the earlier {out.name} stays in {place}.")
            if end.is_done and before.is_dir():
                kept = chain.take_away(before, out)
                if kept is not None:
                    console.warn(
                        f"files in the earlier {out.name} that no command wrote, or that were "
                        f"changed since, stay in {kept}."
                    )


def scenes_of(campaign: Campaign) -> list[tuple[str, Path]]:
    """Return names and folders of a campaign's scenes.

    Raises:
        InputError: two sources would be imported as the same scene.
    """
    if campaign.source == "generate":
        made = sorted((campaign.out / SCENES).glob("scene_*/session.json"))
        return [(p.parent.name, p.parent) for p in made[: campaign.scenes]]
    names = [p.stem if p.is_file() else p.name for p in campaign.places]
    for k, name in enumerate(names):
        if name in names[:k]:
            first = campaign.places[names.index(name)]
            raise InputError(
                f"{campaign.file}: {first} and {campaign.places[k]} would both be the scene "
                f"'{name}'; rename one, or make a campaign of each."
            )
    at = [campaign.out / SCENES / n for n in names]
    return list(zip(names, campaign.places if campaign.source == "sessions" else at, strict=True))


def show_plan(campaign: Campaign, console: Console) -> None:
    """Print what would run."""
    rows = [] if campaign.first is None else [[campaign.first.stage, _line(campaign.first, "")]]
    rows += [[s.stage, _line(s, "SCENE")] for s in campaign.of_a_scene]
    rows += [[s.stage, _line(s, "SCENE...")] for s in campaign.of_all]
    console.table(f"Campaign {campaign.file.name} in {campaign.out}", ["stage", "command"], rows)
    console.result({"out": campaign.out, "commands": {name: line for name, line in rows}})


def show_pipeline(campaign: Campaign, result: PipelineResult, console: Console) -> None:
    """Print what became of a campaign."""
    from realsim.app.pipeline.page import STAGE_HEADER, TO_LOOK_AT, stage_rows, verdicts_of

    ends = [e for s in result.scenes for e in s.ends] + result.of_all
    rows = stage_rows(result.stages, ends)
    console.table(f"Campaign {campaign.file.name}", STAGE_HEADER, rows)
    for name, why in result.failed.items():
        console.warn(f"{name}: {why}")
    verdicts = sum((verdicts_of(result, s) for s in result.scenes), Counter[str]())
    if TO_LOOK_AT & set(verdicts):
        told = ", ".join(f"{n} {word}" for word, n in sorted(verdicts.items()))
        console.warn(f"objects: {told}; `realsim review` shows those that need a person.")
    done = sum(result.is_done(s) for s in result.scenes)
    if campaign.first is not None and campaign.first.stage in result.failed:
        console.warn(f"{campaign.first.stage} failed: the scenes below are those of earlier runs.")
    console.say(f"{done} of {len(result.scenes)} scenes done, {result.kept} of them before")
    if result.waiting:
        console.warn(
            f"not begun, because something failed: {', '.join(result.waiting)}. "
            "`--without-failed` takes the scenes that are done."
        )
    console.say(f"page      {campaign.out / PAGE}")
    if result.failed:
        console.say(
            f"next      realsim pipeline {quote(str(campaign.file))}   (what failed is tried again)"
        )


def _own_folder(campaign: Campaign) -> Path:
    """Return OUT, made if it is not there.

    Raises:
        InputError: it is a file, or holds something else.
    """
    out = campaign.out
    if out.exists() and not out.is_dir():
        raise InputError(f"{campaign.file}: out = '{out}' is a file; give a folder.")
    if out.is_dir() and any(out.iterdir()) and not (out / DOCUMENT).is_file():
        raise InputError(
            f"{campaign.file}: out = '{out}' holds something else (no {DOCUMENT}); give a new "
            "folder, or one of an earlier run."
        )
    out.mkdir(parents=True, exist_ok=True)
    of = _said_from(campaign)
    if not (out / DOCUMENT).is_file():
        write_json(out / DOCUMENT, {CAMPAIGN: of, "scenes": 0})
    with suppress(InputError):  # damaged: it is written anew
        of = read_object(out / DOCUMENT).get(CAMPAIGN, of)
    if of != _said_from(campaign):
        raise InputError(
            f"{campaign.file}: out = '{out}' is of another campaign, {of}; its results and page "
            "would be mixed with this one's. Give another folder, or go on with that file."
        )
    return out


def _said_from(campaign: Campaign) -> str:
    """Return a campaign's file as it is reached from OUT: both may be moved together."""
    return os.path.relpath(campaign.file.resolve(), campaign.out.resolve())


def _make_scenes(
    campaign: Campaign, where: PoolConfig, console: Console, result: PipelineResult
) -> dict[str, Ended]:
    """Generate or import the scenes; return those that could not be imported."""
    step, out, unmade = campaign.first, campaign.out.resolve(), dict[str, Ended]()
    if step is None:
        return unmade
    _require_room(out)
    if campaign.source == "generate":
        with console.stage("generate", "scenes"):
            result.of_all.append(_run(campaign, step, [str(out / SCENES)], where.processes))
        return unmade
    missing = [
        (name, source, place)
        for (name, place), source in zip(scenes_of(campaign), campaign.places, strict=True)
        if not (place / "session.json").is_file()
    ]
    with console.stage("import", f"{len(missing)} recordings") as tick:
        for k, (name, source, place) in enumerate(missing):
            tick(k, len(missing))
            end = _run(campaign, step, [str(source.resolve()), str(place)], where.processes)
            if not end.is_done:
                unmade[name] = end
    return unmade


def _run_scenes(
    campaign: Campaign, where: PoolConfig, console: Console, result: PipelineResult
) -> None:
    """Take scenes through their stages, as many at a time as there are workers."""
    place = {s.name: k for k, s in enumerate(result.scenes)}
    due = [s for s in result.scenes if not result.is_done(s) and s.folder.is_dir()]
    kept = {s.name: tuple(takewhile(lambda e: e.is_done, s.ends)) for s in due}
    total, ended, written = len(due), 0, time.monotonic()
    share = max(1, where.processes // max(1, total))
    commands = [_command(step, [chain.SCENE], share) for step in campaign.of_a_scene]

    def tasks() -> Iterator[Task]:
        for s in due:
            _require_room(campaign.out)
            log = _log(campaign, s.name)
            record = chain.ends_of(campaign.out / RECORDS / f"{s.name}.json")
            left = chain.begun_anew(commands, campaign.of_a_scene, record)[len(kept[s.name]) :]
            args = (left, Worked(s.folder.resolve()), _folder(campaign), log)
            yield Task(name=s.name, fn=chain.run_chain, args=args)

    def keep(outcome: Outcome) -> None:
        nonlocal ended, written
        ended += 1
        k = place[outcome.task.name]
        ends: tuple[Ended, ...] = (
            *kept[outcome.task.name], *(outcome.value or (_lost(outcome),))
        )  # fmt: skip
        write_json(campaign.out / RECORDS / f"{outcome.task.name}.json", to_json(ends))
        result.scenes[k] = replace(result.scenes[k], ends=ends)
        if time.monotonic() - written > RENEWED_S:  # a thousand scenes have a long page
            _write(campaign, result)
            written = time.monotonic()

    with console.stage("scenes", " ".join(result.stages)) as tick, open_pool(where) as pool:

        def tell(names: Sequence[str]) -> None:
            console.doing(", ".join(names))
            tick(ended, total)

        if due and campaign.of_a_scene:
            run_many(tasks(), pool, keep, tick=tell)


def _lost(outcome: Outcome) -> Ended:
    """Return the end of a scene that its worker did not live to tell."""
    return Ended(
        stage="worker", words=(), code=-1, wall_s=0.0, cpu_s=0.0, peak_mb=0.0, told=outcome.why
    )


def _command(step: Step, words: Sequence[str], workers: int) -> Command:
    share = ["--workers", str(workers)] if step.has_workers else []
    return Command(
        stage=step.stage, words=(*step.command, *words, *step.options, *share, "--quiet", "--json")
    )


def _run(campaign: Campaign, step: Step, words: Sequence[str], workers: int) -> Ended:
    folder = _folder(campaign)
    command = _command(step, words, workers)
    return run_command(command, folder, folder, _log(campaign, step.stage))


def _known(campaign: Campaign, name: str, place: Path) -> SceneState:
    """Return a scene as an earlier run left it, with those commands that are still asked for."""
    scene = SceneState(name=name, folder=place)
    if not place.is_dir():
        return scene
    ends = chain.ends_of(campaign.out / RECORDS / f"{name}.json")
    commands = [_command(step, [chain.SCENE], 1) for step in campaign.of_a_scene]
    same = chain.are_same(commands, ends)
    ends = ends[: same.index(False)] if False in same else ends[: len(same)]
    for k, end in enumerate(ends):
        now = chain.result_of(place, end.stage) if end.result else ""
        if now == end.result:
            continue
        if now.split()[:1] in ([], end.result.split()[:1]):  # no record, or that of this campaign
            (place / provenance.file_of(end.stage)).unlink(missing_ok=True)
            note = f"files that {end.stage} left are gone or others: this and the rest is redone."
            return replace(scene, ends=ends[:k], note=note)
        note = f"{end.stage} was run outside this campaign: it stays, the rest is done again."
        return replace(scene, ends=(*ends[:k], replace(end, result=now)), note=note)
    return replace(scene, ends=ends)


def _write(campaign: Campaign, result: PipelineResult) -> None:
    """Write the campaign's document and page."""
    from realsim.app.pipeline.page import page_of

    write_json(campaign.out / DOCUMENT, {CAMPAIGN: _said_from(campaign)} | result.told)
    write_bytes(campaign.out / PAGE, page_of(campaign, result).encode())
    gc.collect()  # a template holds its page, and the pictures there, in a circle


def _require_room(out: Path) -> None:
    """Raise where the disk is nearly full: all further commands would break in the middle.

    Raises:
        RealsimError: less than `LEAST_FREE_MB` are free.
    """
    free = shutil.disk_usage(out).free / 1e6
    if free < LEAST_FREE_MB:
        raise RealsimError(
            f"the disk of '{out}' has {free:.0f} MB left; {LEAST_FREE_MB} are needed. What is done "
            "is kept. Make room, then run the same command: it goes on from here."
        )


def _folder(campaign: Campaign) -> Path:
    return campaign.file.resolve().parent


def _log(campaign: Campaign, name: str) -> Path:
    return campaign.out.resolve() / LOGS / f"{name}.log"


def _line(step: Step, what: str) -> str:
    """Return a command as people type it."""
    return " ".join(["realsim", *step.command, what, *step.options]).replace("  ", " ")
