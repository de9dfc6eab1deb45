"""`realsim annotate`: masks, maps, poses, visibility and grasps on every frame of a session."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, many

if TYPE_CHECKING:
    from realsim.many import PoolConfig


@click.command(
    "annotate", cls=Command,
    examples=("realsim annotate demo/session", "realsim annotate demo/session --maps all --json"),
)  # fmt: skip
@click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@click.option("--maps", default="instance,depth", show_default=True,
              metavar="all|none|LIST",
              help="Maps of each frame: instance, depth, coordinates, normals.")  # fmt: skip
@many(1, "Frames at a time; of several sessions, sessions.")
@click.option("--no-depth-check", is_flag=True,
              help="Do not look for unknown things in the measured depth.")  # fmt: skip
@JSON
@QUIET
def annotate_command(
    sessions: tuple[Path, ...],
    maps: str,
    where: "PoolConfig",
    no_depth_check: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write masks, maps, poses, visibility and grasps for every frame of each SESSION.

    Where the measured depth shows something in front of an object that is not in the scene (a hand,
    a cable), it leaves the object's visible mask, and the frame is named. Frames whose inputs are
    the same as of an earlier run are kept.

    SESSION/reports/annotated.html shows the frames, those that need a look first; annotated.png
    beside it is a contact sheet of them.
    """
    from realsim.app.annotate.run import run_annotate
    from realsim.app.console import Console
    from realsim.app.many_sessions import one_session

    session = one_session(sessions, where)
    console = Console(quiet=quiet, as_json=as_json)
    summary = run_annotate(
        session, console, maps=maps, workers=where, check_depth=not no_depth_check
    )
    console.result(summary)
