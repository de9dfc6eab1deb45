"""`realsim register`: its options."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, many

if TYPE_CHECKING:
    from realsim.many import PoolConfig

LARGEST = 100_000
"""More views than this are a typing error."""


def views_of(text: str) -> int | None:
    """Return the greatest number of views, None for all.

    Raises:
        click.BadParameter: it is neither a number nor `all`.
    """
    if text == "all":
        return None
    if text.isdecimal() and 1 <= int(text) <= LARGEST:
        return int(text)
    raise click.BadParameter(f"'{text}' is no number of views; a number from 1 on, or all, is one.")


@click.command(
    "register",
    cls=Command,
    examples=(
        "realsim register demo/session --views 4",
        "realsim register demo/session --object mug --object wedge --json",
        "realsim register demo/session --from-review",
    ),
)
@click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
@click.option("--object", "objects", metavar="SPEC", multiple=True,
              help="What is there, and where, as far as you know; repeat it.")  # fmt: skip
@click.option("--find-all", is_flag=True, help="Find out which of the models are there.")
@click.option("--from-review", is_flag=True, help="Start from what reviewers moved and decided.")
@click.option("--library", type=FOLDER, default=None, help="Models the session has not: see scan.")
@click.option("--method", default="joint", show_default=True,
              type=click.Choice(["joint", "top-down"]),
              help="All views and cameras together, or ICP in one view from above.")  # fmt: skip
@click.option("--views", default="all", show_default=True, help="At most so many, spread evenly.")
@click.option("--no-cameras", is_flag=True, help="Take the claimed camera poses at their word.")
@click.option("--hand-held", is_flag=True, help="Without a robot: cameras from the depth alone.")
@click.option("--odometry", is_flag=True, help="Check the robot's poses by the depth alone.")
@click.option("--depth-bias", default="", metavar="FILE|off",
              help="Depth camera's bias.  [that of the session's calibration]")  # fmt: skip
@many(help="Sessions at a time.")
@JSON
@QUIET
def register_command(
    sessions: tuple[Path, ...], where: "PoolConfig", as_json: bool, quiet: bool, **options: Any
) -> None:
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
    from realsim.app.console import Console
    from realsim.app.many_sessions import one_session
    from realsim.app.register.config import RegisterRequest
    from realsim.app.register.run import run_register
    from realsim.app.register.tables import as_json as json_of
    from realsim.app.register.tables import show_registered
    from realsim.app.stages import open_session, session_models
    from realsim.store.lock import only_run_in

    session = one_session(sessions, where, whole=True)
    request = RegisterRequest(
        method=options["method"], objects=options["objects"], find_all=options["find_all"],
        from_review=options["from_review"],
        library=options["library"], views=views_of(options["views"]),
        refine_cameras=not options["no_cameras"], hand_held=options["hand_held"],
        depth_bias=options["depth_bias"], odometry=options["odometry"],
    )  # fmt: skip
    console = Console(quiet=quiet, as_json=as_json)
    store = open_session(session)
    with only_run_in(session):
        result = run_register(store, console, request)
    models = session_models(store)
    console.result(json_of(result, models))
    if not as_json:
        show_registered(session, result, models, console)
    if not result.is_usable:
        sys.exit(1)
