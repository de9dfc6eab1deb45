"""Whether a session's depth lies on its photographs: labels are made in depth, and used there."""

from collections.abc import Sequence

from realsim.app.register.results import Remark
from realsim.app.stages import evenly
from realsim.store import SessionStore

VIEWS = 5
"""So many views, spread over the session, are held against their photographs: a third of a second
each where they do not fit, a tenth where they do."""
QUIET_KINDS = ("aligned", "unknown")
"""Kinds of findings that need no words."""


def colour_remark(store: SessionStore, views: Sequence[int]) -> Remark | None:
    """Return what is wrong with how depth lies on colour; None = nothing, or it cannot be told.

    Args:
        store: the session.
        views: numbers of views with depth.
    """
    from realsim.registration.depth_alignment import (
        AlignmentFinding,
        check_alignment,
        pooled_alignment,
    )

    findings: list[AlignmentFinding] = []
    for index in evenly(views, VIEWS):
        rgb = store.rgb(index)
        if rgb.min() < rgb.max():  # else no colour was recorded
            findings.append(check_alignment(rgb, store.depth_m(index), store.session.intrinsics))
    if not findings:
        return None
    found = pooled_alignment(findings)
    return (
        None if found.kind in QUIET_KINDS else Remark(view=None, kind=found.kind, words=found.words)
    )
