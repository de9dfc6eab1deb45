"""`realsim register`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.option_values import Amount
from realsim.app.options import SESSIONS, Has, Where, command, many, options, rare


@command(
    "register",
    "realsim register demo/session --views 4",
    "realsim register demo/session --object mug --object wedge --json",
    "realsim register demo/session --from-review",
)
@SESSIONS
@options(
    object=(), find_all=False, from_review=False, library=Has(None, ", for missing models"),
    views=Has("all", " at most, spread evenly", Amount(1, 100_000, "all")), hand_held=False,
)  # fmt: skip
@many(note="; sessions at a time")
@rare(
    method="joint", no_cameras=False, odometry=False,
    depth_bias=Has("", "  [that of the session's calibration]"),
)  # fmt: skip
def register_command(
    console: Console, sessions: tuple[Path, ...], where: Where, no_cameras: bool,
    views: int | str, **options: Any,
) -> bool:  # fmt: skip
    """Find the pose of every object of each SESSION in every view, with its uncertainty.

    \b
    What is on the table is said in one of four ways:
      --object SPEC    5 or mug (anywhere), 5x2 (two of them),
                       5@view3:640,360 (a click), 5@view3:100,80,60x40 (a box)
      SESSION/registration/starts.json   rough poses, clicks, boxes or masks
      --find-all       it is found out which of the models are there
      --from-review    the reviewed scene: moved objects from where they were
                       moved to, rejected ones left out; the earlier scene
                       stays in registration/earlier/

    Writes registration/ with scene.json, register.html and pictures, and replaces the session's
    camera poses by refined ones (the claimed ones are kept in registration/cameras.json). With the
    same inputs nothing is computed again.

    Exit codes: 0 done, 1 nothing was placed or everything is rejected, 2 bad input.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.annotate.current import is_annotated, what_is_stale
    from realsim.app.many_sessions import one_session
    from realsim.app.register.config import RegisterRequest
    from realsim.app.register.run import run_register
    from realsim.app.register.tables import as_json, show_registered
    from realsim.app.stages import open_session, session_models
    from realsim.store.atomic import only_run_in

    session = one_session(sessions, where, whole=True)
    most = None if isinstance(views, str) else views
    request = RegisterRequest(refine_cameras=not no_cameras, views=most, **options)
    store = open_session(session)
    with only_run_in(session):
        result = run_register(store, console, request)
    models = session_models(store)
    console.result(as_json(result, models))
    if not console.as_json:
        show_registered(session, result, models, console)
        if is_annotated(store) and (why := what_is_stale(store)):
            console.say(f"labels    are of the scene before ({why}): realsim annotate {session}")
    return result.is_usable
