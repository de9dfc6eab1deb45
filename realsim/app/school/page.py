"""The page of one school: counts, reasons, margins and pictures in one file that prints well."""

from collections.abc import Mapping, Sequence

from realsim.app.school import tables
from realsim.app.school.tables import Names
from realsim.geometry import se3
from realsim.pages import Page
from realsim.pages.plots import png
from realsim.records import STAGES, GraspSet, Scene

SHEET, MARGINS = "school_sheet.png", "school_margins.png"


def sheet_png(sets: Sequence[GraspSet], models: Names, scene: Scene) -> bytes:
    """Return all objects as they stand, with their grasps by p_hold or score; b'' without any.

    Of a scene of more objects than a sheet takes, the first are shown.
    """
    from realsim_sim_bridge.school.sheet import MOST_OBJECTS, school_sheet

    shown = [s for s in sets if s.obj_id in models][:MOST_OBJECTS]
    if not shown:
        return b""
    # An object upside down on its table is drawn so: grasps from below are told from those above.
    T_up_world = se3.invert(scene.plane.T_world_table) if scene.plane else None
    poses = {} if T_up_world is None else {
        o.instance: T_up_world @ o.T_world_obj for o in scene.objects
    }  # fmt: skip
    title = f"Robot School: {scene.name}"
    return school_sheet(shown, models, title=title, Ts_up_obj=poses)


def margins_png(sets: Sequence[GraspSet], models: Names) -> bytes:
    """Return the share of each object's tested grasps that pass, by friction and by force.

    What a run's score says is one point of each curve; b'' where nothing was swept.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), dpi=110, layout="constrained")
    axes = [figure.add_subplot(1, len(tables.LEVELS), k + 1) for k in range(len(tables.LEVELS))]
    drawn = 0
    for ax, (measure, levels_of, what) in zip(axes, tables.LEVELS, strict=True):
        every: list[float] = []
        for s in sets:
            levels, share = tables.survivors(s, measure, levels_of)
            if len(levels):
                ax.plot(
                    levels, share, "o-", label=tables.named(s, models), linewidth=1.2, markersize=3
                )
                every += levels.tolist()
                drawn += 1
        ax.set_xscale("log")
        ticks = sorted(set(every))[::-1][::2]  # every second level: all do not fit side by side
        ax.set_xticks(ticks, [f"{v:g}" for v in ticks])
        ax.set_xticks([], minor=True)
        ax.set_ylim(-2, 102)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
        ax.set_xlabel(what, fontsize=8)
        ax.set_title(f"Grasps [%] that pass all {len(STAGES)} stages", fontsize=9, loc="left")
    if not drawn:
        return b""
    axes[0].legend(fontsize=7, frameon=False)
    return png(figure)


# --- The page of one school: counts, reasons, margins and pictures in one file that prints well --


MEANING = (
    "The score is one nominal attempt: what a simulated hand does at one force, one friction and "
    "one mass. How likely a real hand holds is p_hold, the label to use where there is one. Of "
    "grasps that all pass, the margin tells which would with less force or friction."
)
SUMMARY = (
    "As in the paper's table, by its limits. Counts of good grasps differ from those above, which "
    "the rows of the nominal score have."
)
CAPTIONS: dict[str, tuple[str, str]] = {
    SHEET: (
        "The grasps",
        "Above, how many candidates are left after each stage; below, every object as it stands "
        "with its grasps.",
    ),
    MARGINS: (
        "What is left with less friction and less force",
        "The farther left a curve keeps its height, the safer are the object's grasps.",
    ),
}
"""Title and caption of every picture, in the order of the page."""


def page_bytes(
    name: str, sets: Sequence[GraspSet], models: Names, pictures: Mapping[str, bytes]
) -> bytes:
    """Return the page.

    Args:
        name: of the scene.
        sets: the grasps.
        models: the objects by id.
        pictures: file name -> PNG; empty and missing ones are left out.
    """
    from realsim_sim_bridge.school.summary import summarise

    page = Page(
        title=f"Robot School of {name}",
        about=f"{sum(len(s) for s in sets)} grasps on {len(sets)} objects",
    )
    page.section("Objects", " ".join([*tables.setting_lines(sets), MEANING]))
    page.table(*tables.school_table(sets, models))
    for words in (
        tables.agreement_line(sets),
        tables.p_hold_line(sets),
        *tables.not_tried(sets, models),
        *tables.doubts(sets, models),
    ):
        if words:
            page.text(words, "note")
    for file, (title, caption) in CAPTIONS.items():
        if pictures.get(file):
            page.section(title)
            page.picture(pictures[file], caption)
    for what, header, rows in tables.level_tables(sets, models):
        page.section(f"Share [%] of the tested grasps that pass, by {what}")
        page.table(header, rows)
    page.section("Why grasps stopped")
    page.table(tables.REASON_HEADER, tables.reason_rows(sets))
    page.section("What the filters took", "Candidates before the arm and physics had their say.")
    page.table(tables.FILTER_HEADER, tables.filter_rows(sets, models))
    page.section("Summary", SUMMARY)
    page.table(tables.SUMMARY_HEADER, summarise(sets).to_rows())
    return page.encode()
