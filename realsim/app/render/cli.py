"""`realsim render`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, many, seed
from realsim.app.outputs import GOES_ON


@click.command(
    "render",
    cls=Command,
    examples=(
        "realsim render demo/session",
        "realsim render demo/session --views 3 --size 320x240 --seed 1",
    ),
)
@click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@click.option("--views", default="real", show_default=True, metavar="real|N",
              help="Twins of the real frames, or N new views.")  # fmt: skip
@click.option("--out", type=GOES_ON, default=None, help="Folder.  [SESSION/synthetic/...]")
@click.option("--renderer", default="embedded", show_default=True,
              type=click.Choice(["embedded", "photoreal"]),
              help="Rasterised here, or ray-traced by Mitsuba.")  # fmt: skip
@click.option("--depth", default="disparity", show_default=True,
              type=click.Choice(["stereo", "disparity", "clean"]),
              help="How the depth camera is simulated.")  # fmt: skip
@click.option("--camera", default="", metavar="NAME",
              help="d405, d415, d435, structured_light.  [the session's, else d405]")  # fmt: skip
@click.option("--depth-model", type=FOLDER, default=None, metavar="FILE",
              help="Of `realsim depth-fit`: noise and holes as your own camera's.")  # fmt: skip
@click.option("--radius", default="", metavar="A-B",
              help="Distance of new views [m].  [as the real ones]")  # fmt: skip
@click.option("--size", default="", metavar="WxH", help="Of new views [px].  [the session's]")
@click.option("--hdri", type=FOLDER, default=None, help="Panorama (.hdr, .exr) around the scene.")
@click.option("--material", "materials", multiple=True, metavar="table=KIND",
              help="Another table: oak, marble, ...  [as in the photographs]")  # fmt: skip
@seed("Of new views and of the camera's noise.")
@many(help="Frames at a time; of several sessions, sessions.")
@JSON
@QUIET
def render_command(sessions: tuple[Path, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Render the registered scene of each SESSION: every real frame's twin, or new views.

    Without --views at the real cameras, raw distortion included; with it, over the hemisphere. The
    result is a session of its own, with every label, exact depth and the depth that the camera
    would report; `realsim school`, `annotate`, `review` and `report` open it. Light and table are
    matched to the photographs. A run that was interrupted goes on where it stopped.

    Exit codes: 0 done, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.many_sessions import one_session
    from realsim.app.render.request import RenderRequest
    from realsim.app.render.run import render_document, run_render, show_render

    session = one_session(sessions, options["where"])
    request = RenderRequest(**options)
    console = Console(quiet=quiet, as_json=as_json)
    outcome = run_render(session, request, console)
    show_render(outcome, console)
    console.result(render_document(outcome))
