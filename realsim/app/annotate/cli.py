"""`realsim annotate`: masks, maps, poses, visibility and grasps on every frame of a session."""

from pathlib import Path

from realsim.app.console import Console
from realsim.app.options import SESSIONS, Has, Where, command, many, options, rare


@command(
    "annotate", "realsim annotate demo/session", "realsim annotate demo/session --maps all --json"
)
@SESSIONS
@options(maps=Has("", "  [instance,depth, and those that are there]"))
@many(1, "; of several sessions, sessions at a time")
@rare(no_depth_check=False)
def annotate_command(
    console: Console, sessions: tuple[Path, ...], maps: str, where: Where, no_depth_check: bool
) -> None:
    """Write masks, maps, poses, visibility and grasps for every frame of each SESSION.

    Where the measured depth shows something in front of an object that is not in the scene (a hand,
    a cable), it leaves the object's visible mask, and the frame is named. Frames whose inputs are
    the same as of an earlier run are kept.

    SESSION/reports/annotated.html shows the frames, those that need a look first; annotated.png
    beside it is a contact sheet of them.
    """
    from realsim.app.annotate.run import run_annotate
    from realsim.app.many_sessions import one_session

    session = one_session(sessions, where)
    console.result(
        run_annotate(session, console, maps=maps, workers=where, check_depth=not no_depth_check)
    )
