"""What the reviewers of a session said, for the commands that come after them.

Moves, swaps, accepts and rejects count wherever the scene is used; excluded views and marks of
symmetry count in every command that looks at views or models.
"""

from realsim.review.journal import JOURNAL_FILE, Entry, ReviewState, read, replay
from realsim.store import SessionStore


def review_of(store: SessionStore) -> ReviewState:
    """Return what the session's journal adds up to; empty without a journal.

    Raises:
        InputError: a line is of a newer format, or no journal line.
    """
    return replay(read(store.path(JOURNAL_FILE)).entries)


def exclusion_words(entry: Entry) -> str:
    """Return why a view is left out."""
    why = f": {entry.comment}" if entry.comment else ""
    return f"it was excluded by {entry.reviewer}{why}."
