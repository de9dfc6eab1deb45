"""`realsim demo`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.options import Has, command, options
from realsim.app.outputs import GOES_ON, OutputFolder

SITE = OutputFolder(
    ("index.html", "scene.html", "report.html", "school.html", "statistics.html"),
    own=("index.html", ("realsim demo --site",)),
)


@command(
    "demo",
    "realsim demo",
    "realsim demo --quick --out small --site site",
    "realsim demo --arm panda --out panda --views 12 --objects 2 --grasps 20",
)
@options(
    out=Has(Path("demo"), kind=GOES_ON), quick=False, site=Has(None, kind=SITE), arm="ur5",
    views=Has(None, " of the scene  [24; 8 with --quick]", click.IntRange(4, 1024)),
    objects=Has(None, "  [5; 2 with --quick]"), seed=0,
    grasps=Has(None, "  [60; 12 with --quick]"), workers=Has(2, " of the Robot School"),
)  # fmt: skip
def demo_command(
    console: Console, out: Path, quick: bool, site: Path | None, grasps: int | None, **setup: Any
) -> None:
    """Run the whole loop in a simulated lab and compare it with the truth.

    With --site, write the session's pages as a folder that any file server hosts.
    """
    from realsim.app.demo.run import (
        QUICK,
        DemoConfig,
        demo_document,
        run_demo,
        show_demo,
        write_site,
    )

    setup = {k: v for k, v in (setup | {"grasps_per_object": grasps}).items() if v is not None}
    result = run_demo(DemoConfig(**(QUICK if quick else {}) | setup), out, console)
    page = None if site is None else write_site(result.store, result.errors, site, console)
    show_demo(result, console, page)
    console.result(demo_document(result) | {"site": page})
