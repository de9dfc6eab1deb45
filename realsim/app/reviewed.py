"""What the reviewers of a session said, for the commands that come after them.

Moves, swaps, accepts and rejects count wherever the scene is used; excluded views and marks of
symmetry count in every command that looks at views or models.
"""

from collections.abc import Collection, Iterator

from realsim.app.console import Console
from realsim.review.journal import JOURNAL_FILE, Entry, ReviewState, read, replay
from realsim.store import SessionStore

_told: set[str] = set()
"""Journals whose damage this process has told."""


def review_of(store: SessionStore) -> ReviewState:
    """Return what the session's journal adds up to; empty without a journal.

    Lines that are damaged are told once: what they said does not count.

    Raises:
        InputError: a line is of a newer format, or no journal line.
    """
    found = read(store.path(JOURNAL_FILE))
    if found.damaged and str(store.folder) not in _told:
        _told.add(str(store.folder))
        Console(quiet=True).warn(damage_words(store))
    return replay(found.entries)


def damage_words(store: SessionStore) -> str:
    """Return what is wrong with the lines of the journal; '' = nothing."""
    lines = read(store.path(JOURNAL_FILE)).damaged
    if not lines:
        return ""
    listed = ", ".join(map(str, lines[:12])) + (" ..." if len(lines) > 12 else "")
    return (
        f"line {listed} of {store.path(JOURNAL_FILE)} is not whole, and what it said does not "
        "count: look at it, and decide again where something is missing."
    )


def stray_words(
    state: ReviewState, instances: Collection[int], views: Collection[int], models: Collection[int]
) -> Iterator[str]:
    """Return, of every line about what is not in the session, that it counts for nothing.

    Args:
        state: the review.
        instances: those that the scene has or had.
        views: the session's.
        models: ids of its models.
    """
    for entry in state.standing:
        by = f"{entry.action} by {entry.reviewer}, {entry.time[:16]}"
        if entry.view is not None and entry.view not in views:
            yield f"{by}: there is no view {entry.view}, so it counts for nothing."
        elif entry.action == "symmetric" and entry.obj_id not in models:
            yield f"{by}: there is no model {entry.obj_id}, so it counts for nothing."
        elif entry.instance is not None and entry.instance not in instances:
            yield f"{by}: there is no instance {entry.instance}, so it counts for nothing."


def exclusion_words(entry: Entry) -> str:
    """Return why a view is left out."""
    why = f": {entry.comment}" if entry.comment else ""
    return f"it was excluded by {entry.reviewer}{why}."
