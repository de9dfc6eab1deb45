"""`realsim reproduce`: its options."""

from math import isfinite
from pathlib import Path

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import command, options


@command(
    "reproduce",
    "realsim reproduce demo/session annotate",
    "realsim reproduce demo/session register --json",
)
@click.argument("result", type=FOLDER)
@click.argument("stage", default="", metavar="[STAGE]")
@options(workers=2)
def reproduce_command(console: Console, result: Path, stage: str, workers: int) -> bool:
    """Make RESULT again from its record and compare, file by file and value by value.

    RESULT is a session with a STAGE (register, school, annotate), or the folder of an export. What
    is there is only read: the stage runs in a copy, in a temporary folder (TMPDIR). The record
    (SESSION/stages/STAGE.json, OUT/provenance.json) says what was asked for, every setting, and
    the sha256 of all inputs; inputs that have changed are named. Of other versions it is told.

    Exit codes: 0 equal, 1 something differs, 2 it cannot be made again.
    """
    from realsim.app.reproduce.run import reproduce

    found = reproduce(result, stage, console, workers)
    for d in found.differing:
        size = f" (by at most {d.greatest:.3g})" if isfinite(d.greatest) else ""
        console.warn(f"{d.path} differs{size}: {'; '.join(d.words)}")
    counts = f"{found.files} files"
    if found.equal:
        console.say(f"{found.stage}: equal, {counts}")
    else:
        console.say(f"{found.stage}: {len(found.differing)} of {counts} differ")
    console.result({
        "stage": found.stage, "equal": found.equal, "files": found.files,
        "differing": found.differing, "other_versions": list(found.other_versions),
    })  # fmt: skip
    return found.equal
