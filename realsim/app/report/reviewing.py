"""The section on the review: who decided what, when, and what is still open."""

from collections.abc import Sequence
from typing import Any

from realsim.app.report.figures import count
from realsim.app.report.section import READING, Section
from realsim.app.reviewed import review_of
from realsim.pages import Cell
from realsim.review.journal import JOURNAL_FILE, Entry, ReviewState, read, replay
from realsim.store import SessionStore

CORRECTIONS = ("move", "swap", "symmetric")


def review_state(store: SessionStore) -> ReviewState:
    """Return what the journal adds up to; nothing where it cannot be read."""
    try:
        return review_of(store)
    except READING:
        return ReviewState()  # the section on the review says what is wrong with it


def review_section(
    section: Section, store: SessionStore, objects: Sequence[dict[str, Any]]
) -> None:
    """Fill the section on the review.

    Args:
        section: to fill.
        store: the session.
        objects: the placed objects as the section on registration has them.
    """
    undecided = [o for o in objects if o["verdict"] != "accepted" and not o["decided_by"]]
    decided = sum(bool(o["decided_by"]) for o in objects)
    if objects:
        section.add(count("review.decided", decided), count("review.open", len(undecided)))
    if not store.has(JOURNAL_FILE):
        section.missing("Nobody has reviewed it.")
        _open(section, undecided)
        return
    content = read(store.path(JOURNAL_FILE))
    state = replay(content.entries)
    standing = state.standing
    if content.damaged:
        lines = ", ".join(map(str, content.damaged))
        section.say("warn", f"Review: lines {lines} of the journal are not whole.")
    corrected = [e for e in standing if e.action in CORRECTIONS]
    excluded = state.excluded_views()
    section.add(
        count("review.corrections", len(corrected)), count("review.excluded_views", len(excluded))
    )
    people = sorted({e.reviewer for e in content.entries})
    section.headline = f"{decided} of {len(objects)} objects decided by {', '.join(people)}"
    if undecided:
        section.headline += f", {len(undecided)} open"
    _open(section, undecided)
    if corrected or excluded:
        section.page.text(
            "Corrections count when they are applied: `realsim register SESSION --from-review`."
        )
    ids = {e.id for e in standing}
    rows = [_row(e, ids) for e in content.entries]
    section.page.table(["when (UTC)", "who", "what", "about", "comment", "state"], rows)


def _open(section: Section, undecided: Sequence[dict[str, Any]]) -> None:
    if undecided:
        names = ", ".join(f"{o['instance']} {o['name']}" for o in undecided)
        section.page.text(f"Not accepted, and nobody has decided: {names}.")


def _row(e: Entry, standing: set[str]) -> list[object]:
    about = f"object {e.instance}" if e.instance is not None else ""
    if e.view is not None:
        about = f"view {e.view}"
    elif e.action == "symmetric":
        about = f"model {e.obj_id}: {e.symmetry}"
    elif e.action == "swap":
        about += f", is model {e.obj_id}"
    what = e.action + (f" ({e.how})" if e.how else "")
    taken = e.action != "undo" and e.id not in standing
    state = Cell(text="taken back", kind="off") if taken else ""
    return [e.time[:19].replace("T", " "), e.reviewer, what, about, e.comment, state]
