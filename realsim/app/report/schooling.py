"""The section on the Robot School: stages, scores, slips, failures."""

from collections import Counter

import numpy as np

from realsim.app.report import plots as drawing
from realsim.app.report.figures import MEDIAN_SCATTER, Figure, count, mean_error, share
from realsim.app.report.section import Section, drawn
from realsim.app.school.tables import p_hold_line, school_table, why_no_grasp
from realsim.formats.grasps.scene_grasps import labelled
from realsim.records import GraspSet
from realsim.store import SessionStore

SLIPS_NOTE = (
    "p_hold: probability that a robot lifts the object and holds it; the label to use where there "
    "is one. Score, one nominal attempt: 0.25 for each stage passed, less 1/12 for each stage in "
    "which the object slipped by more than the bound. Shares: of the tried grasps, ± 1 sigma of "
    "the binomial."
)
MEASURED = (
    "school.mean_score", "school.mean_p_hold", "school.p_hold_entropy_bits", "school.slip_mm"
)  # fmt: skip
SHEET, SETTLED = "reports/school.html", "reports/settle.png"


def school_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the Robot School."""
    from realsim.app.stages import session_models
    from realsim.store import load_grasps

    if not any((store.folder / "grasps").glob("*_obj*.npz")):
        section.missing("No grasp has been tried.")
        return
    sets, models = load_grasps(store), session_models(store)
    _figures(section, sets)
    f = section.figures
    if "school.good_share" in f:
        good, tried = f["school.good"].value, sum(int(np.isfinite(s.scores).sum()) for s in sets)
        section.headline = f"{good:.0f} good of {tried} tried grasps"
    else:
        section.headline = "no grasp could be tried"
        section.say("warn", "Robot School: no grasp could be tried.")
    for s in sets:
        if not s.good.any():
            name = models[s.obj_id].name if s.obj_id in models else f"object {s.obj_id}"
            why = "none of them is good" if np.isfinite(s.scores).any() else why_no_grasp(s)
            section.say("note", f"Robot School: {s.instance} {name} has no good grasp: {why}.")
    section.page.text(SLIPS_NOTE)
    section.page.table(*school_table(sets, models))
    if line := p_hold_line(sets):
        section.page.text(line)
    shares = [x for n, x in f.items() if n.endswith("_share") or n in MEASURED]
    rows = [[x.meaning.text, f"{x.shown} {x.meaning.unit}".strip()] for x in shares]
    if rows:
        section.page.table(["figure", "value"], rows)
    drawn(section, "the plots", lambda: _plots(section, sets))
    drawn(section, "the pictures", lambda: _pictures(section, store))


def _kept(sets: list[GraspSet]) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest slip [mm] and turn [deg] of every grasp that never lost its object."""
    mm = np.concatenate([1e3 * s.slip_m for s in sets]) if sets else np.zeros((0, 4))
    deg = np.concatenate([np.degrees(s.slip_rad) for s in sets]) if sets else np.zeros((0, 4))
    whole = np.isfinite(mm).all(1) & np.isfinite(deg).all(1)
    return mm[whole].max(1, initial=0.0), deg[whole].max(1, initial=0.0)


def _figures(section: Section, sets: list[GraspSet]) -> None:
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    scores = np.concatenate([s.scores for s in sets])
    base = np.concatenate([s.base_scores for s in sets])
    reach = np.concatenate([s.reachable for s in sets])
    tried = np.isfinite(scores)
    good = int(np.sum(scores[tried] >= 0.5))
    section.add(
        count("school.candidates", len(scores)),
        count("school.good", good),
        count("school.objects_without_grasp", sum(not s.good.any() for s in sets)),
    )
    n = int(tried.sum())
    if n == 0:
        return
    scores, base, reach = scores[tried], base[tried], reach[tried]
    section.add(
        share("school.reachable_share", int(reach.sum()), n),
        share("school.close_share", int(np.sum(base >= 0.25)), n),
        share("school.pendulum_share", int(np.sum(base >= 1.0)), n),
        share("school.good_share", good, n),
        Figure(name="school.mean_score", value=float(scores.mean()), sigma=mean_error(scores)),
    )
    mm, _ = _kept(sets)
    if len(mm):
        sigma = MEDIAN_SCATTER * mean_error(mm)
        section.add(Figure("school.slip_mm", float(np.median(mm)), sigma))
    section.series["school.scores"] = [round(float(v), 4) for v in scores]
    if (p := p_hold_spread(sets)) is not None:
        told = np.concatenate([s.labels[labelled(s)] for s in sets if s.label == "p_hold"])
        section.add(
            Figure(name="school.mean_p_hold", value=p.mean, sigma=mean_error(told)),
            Figure(name="school.p_hold_entropy_bits", value=p.entropy_bits),
        )
        section.series["school.p_hold"] = [round(float(v), 4) for v in told]


def _plots(section: Section, sets: list[GraspSet]) -> None:
    base = np.concatenate([s.base_scores for s in sets])
    reach = np.concatenate([s.reachable for s in sets])
    tried = np.isfinite(base)
    if not tried.any():
        return
    failed = Counter(f.partition(":")[0] for s in sets for f in s.failures if f)
    picture = drawing.stages(int(tried.sum()), int(reach[tried].sum()), base[tried])
    plots = [
        (picture, "A grasp is tried even where the arm does not reach it."),
        (drawing.labels(sets), "Red: below 0.5. Without those that the arm does not reach."),
    ]
    mm, deg = _kept(sets)
    if len(mm):
        plots.append((drawing.slips(mm, deg), "Linear below 0.1, logarithmic above."))
    if failed:
        plots.append((drawing.failures(failed), "The first thing that stopped each grasp."))
    section.page.plots(plots)


def _pictures(section: Section, store: SessionStore) -> None:
    if store.has(SHEET):
        section.page.text(f"The grasps of every object, drawn: {SHEET}.")
    if store.path(SETTLED).is_file():
        section.page.picture(
            store.path(SETTLED).read_bytes(), "How the objects settled in the simulation."
        )
