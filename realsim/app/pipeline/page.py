"""The page of a campaign: how far it is, what failed and why, what it costs."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.app.console import duration
from realsim.app.pipeline.campaign import Campaign
from realsim.app.pipeline.chain import LOOK, Ended
from realsim.errors import InputError
from realsim.pages import Page, View
from realsim.pages.page import Cell
from realsim.pages.pictures import spread
from realsim.untrusted.own_json import read_object

STAGE_HEADER = ("stage", "done", "a check failed", "failed", "CPU", "longest", "peak MB")
if TYPE_CHECKING:
    from realsim.app.pipeline.run import PipelineResult, SceneState

PICTURES = 24
"""Scenes shown with a picture."""
REPORTS = {
    "register": "registration/register.html",
    "school": "reports/school.html",
    "annotate": "reports/annotated.html",
    "report": "reports/report.html",
}
"""Page that a stage leaves in a scene."""

PAGES = ("scenes/index.html", "stats/statistics.html")
"""Pages of the generator and of the statistics."""


TO_LOOK_AT = {"doubtful", "rejected", "not placed"}
"""What a person has to look at."""


def verdicts_of(result: "PipelineResult", scene: "SceneState") -> Counter[str]:
    """Return how many objects of a scene have which verdict, or are not placed.

    Nothing is told of a scene that waits for its registration: generated ones have poses before.
    """
    if "register" in {*result.stages} - {e.stage for e in scene.ends}:
        return Counter()
    try:
        found: Any = read_object(scene.folder / "registration/scene.json")["objects"]
        report = scene.folder / "registration/report.json"  # a generated scene has none
        missing = read_object(report).get("not_placed", ()) if report.is_file() else ()
        return Counter(str(o["verdict"]) for o in found) + Counter({"not placed": len(missing)})
    except (InputError, KeyError, TypeError):
        return Counter()


def page_of(campaign: Campaign, result: "PipelineResult") -> Page:
    """Return the page of a campaign as it stands."""
    done = sum(result.is_done(s) for s in result.scenes)
    total, failed = len(result.scenes), result.failed
    page = Page(
        title=f"Campaign {campaign.file.name}",
        about=f"Scenes from {campaign.source}.",
        hidden={f"{campaign.out.resolve()}/": ""},
    )
    if failed:
        page.verdict("bad", f"{len(failed)} failed", "the other scenes went on",
                     rows=[[Cell(name, "bad"), why] for name, why in failed.items()])  # fmt: skip
    elif total and done == total:
        unsure = sum(bool(TO_LOOK_AT & set(verdicts_of(result, s))) for s in result.scenes)
        look = f"; objects of {unsure} need a look" if unsure else ""
        kind = "warn" if unsure else "good"
        page.verdict(kind, "Done", f"{total} scenes went through all stages{look}")
    else:
        page.verdict("off", "Under way", f"{done} of {total} scenes went through all stages")
    ends = [e for s in result.scenes for e in s.ends] + result.of_all
    page.cards([
        (f"{done} of {total}", "scenes done"),
        (duration(sum(e.cpu_s for e in ends)), "CPU time of each command's last run"),
        (f"{max((e.peak_mb for e in ends), default=0):.0f} MB", "largest memory of a process"),
    ])  # fmt: skip
    page.section("Stages")
    page.table(STAGE_HEADER, stage_rows(result.stages, ends))
    page.section("Scenes", "Seconds by the clock; a link opens the stage's own page.")
    header = ["scene", *result.stages, "objects"]
    page.table(header, [_row(campaign, result, s) for s in result.scenes])
    made = [Cell(p, href=f"./{p}") for p in PAGES if (campaign.out / p).is_file()]
    made += [
        Cell(f"{p.parent.name}/{p.name}", href=f"./{p.parent.name}/{p.name}")
        for p in sorted(campaign.out.glob("export*/README.md"))
    ]
    if made:
        page.section("Results")
        page.table(["page"], [[cell] for cell in made])
    shown = [result.scenes[k] for k in sorted(list(spread(total))[:PICTURES])]
    views = [View(s.name, {"": p.read_bytes()}) for s in shown if (p := _photograph(s)) is not None]
    if views:
        page.section("Pictures", "The first photograph of each scene.")
        page.sheet(views)
    page.document = result.told
    return page


def stage_rows(stages: Sequence[str], ends: Sequence[Ended]) -> list[list[object]]:
    """Return a row for each stage: how often it ran, how it ended, and what it took."""
    of_all = [name for name in dict.fromkeys(e.stage for e in ends) if name not in stages]
    order = sorted((*stages, *of_all), key=lambda name: name != "generate")
    return [_stage_row(name, [e for e in ends if e.stage == name]) for name in order]


def _stage_row(stage: str, ends: Sequence[Ended]) -> list[object]:
    return [
        stage,
        sum(e.is_done for e in ends),
        sum(e.code == LOOK for e in ends),
        sum(not e.is_done for e in ends),
        duration(sum(e.cpu_s for e in ends)),
        duration(max((e.wall_s for e in ends), default=0.0)),
        round(max((e.peak_mb for e in ends), default=0.0)),
    ]


def _row(campaign: Campaign, result: "PipelineResult", scene: "SceneState") -> list[Cell]:
    ends = {e.stage: e for e in scene.ends}
    verdicts = verdicts_of(result, scene)
    told = ", ".join(f"{n} {word}" for word, n in sorted(verdicts.items()))
    kind = "warn" if TO_LOOK_AT & set(verdicts) else "good"
    return [
        Cell(scene.name),
        *(_cell(campaign, scene, ends.get(name)) for name in result.stages),
        Cell(told or "-", kind if told else "off"),
    ]


def _cell(campaign: Campaign, scene: "SceneState", end: Ended | None) -> Cell:
    if end is None:
        return Cell("-", "off")
    if not end.is_done:
        return Cell("failed", "bad", hover=end.told)
    report = scene.folder / REPORTS.get(end.stage, "-")
    href = os.path.relpath(report, campaign.out) if report.is_file() else ""
    words = {True: "a check failed"}.get(end.code == LOOK, "")
    return Cell(f"{end.wall_s:.0f} s", "warn" if words else "good", hover=words, href=href)


def _photograph(scene: "SceneState") -> Path | None:
    return next(iter(sorted((scene.folder / "rgb").glob("*.*"))), None)
