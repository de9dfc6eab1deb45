"""`realsim demonstrations`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.options import SOURCE, Has, Where, command, many, options, rare
from realsim.app.outputs import GOES_ON


@command(
    "demonstrations",
    "realsim demonstrations demo/session --out demonstrations --limit 2",
    "realsim demonstrations demo/session --out good --outcome success --fps 10 --limit 1",
)
@SOURCE
@options(
    out=Has(kind=GOES_ON, note="; new, or to go on in", required=True), task="grasp", fps=20,
    outcome="all", limit=None, width=320, height=240, with_depth=False,
)  # fmt: skip
@many(None, "; all give the same bytes  [one a core]")
@options(title="", licence="", models_licence="", attribution="")
@rare(
    grasp=(), view=Has(None, "  [beside the table]"), hand_eye=False,
    weighed=Has((), ", as the school was told"), episodes_per_file=50,
)  # fmt: skip
def demonstrations_command(
    console: Console, source: Path, out: Path, where: Where, **options: Any
) -> None:
    """Replay the school's attempts on SOURCE and write them as a LeRobot v3.0 data set.

    SOURCE is a session, or a folder of results of `realsim school`. Every attempt that the arm
    made is replayed, successful or failed, with its physics: joints, actions, the object, and
    pictures from a fixed camera and one in the hand, and where the cameras are. Interrupted, the
    same command goes on.

    Writes meta/, data/ and videos/ (LeRobot), realsim/episodes.jsonl, demonstrations.html.
    """
    from realsim.app.demonstrations.run import (
        DemonstrationRequest,
        export_demonstrations,
        show_demonstrations,
    )

    result = export_demonstrations(source, out, DemonstrationRequest(**options), console, where)
    show_demonstrations(result, console)
    console.result(result)
