"""`realsim render`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.option_values import Amount
from realsim.app.options import SESSIONS, Has, command, many, options, rare
from realsim.app.outputs import GOES_ON


@command(
    "render",
    "realsim render demo/session",
    "realsim render demo/session --views 3 --size 320x240 --seed 1",
)
@SESSIONS
@options(
    views=Has("real", " that are new, or real: twins of the frames", Amount(1, 100_000, "real")),
    out=Has(None, "  [SESSION/synthetic/...]", GOES_ON), renderer="embedded", depth="disparity",
    sensor=Has(None, "  [the session's, else d405]"),
    size=Has("", ", of new views  [the session's]"),
)  # fmt: skip
@many(note="; of several sessions, sessions at a time")
@rare(
    depth_model=None, radius=Has("", ", of new views  [as the real ones]"), hdri=None,
    material=Has((), "  [as in the photographs]"), seed=0,
)  # fmt: skip
def render_command(console: Console, sessions: tuple[Path, ...], **options: Any) -> None:
    """Render the registered scene of each SESSION: every real frame's twin, or new views.

    Without --views at the real cameras, raw distortion included; with it, over the hemisphere. The
    result is a session of its own, with every label, exact depth and the depth that the camera
    would report; `realsim school`, `annotate`, `review` and `report` open it. Light and table are
    matched to the photographs. A run that was interrupted goes on where it stopped.

    Exit codes: 0 done, 2 bad input.
    """
    from realsim.app.many_sessions import one_session
    from realsim.app.render.request import RenderRequest
    from realsim.app.render.run import render_document, run_render, show_render

    session = one_session(sessions, options["where"])
    outcome = run_render(session, RenderRequest(**options), console)
    show_render(outcome, console)
    console.result(render_document(outcome))
