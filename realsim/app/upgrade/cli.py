"""`realsim upgrade`: the command line."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.option_values import numbers_of
from realsim.app.options import FOLDER, JSON, QUIET, many
from realsim.app.outputs import GOES_ON


@click.command(
    "upgrade",
    cls=Command,
    examples=(
        "realsim upgrade dataset --out upgraded --scenes 1 --grasps 4",
        "realsim upgrade dataset --out upgraded_gt --views 1 --grasps 2 --workers 1 --json",
    ),
)
@click.argument("dataset", type=FOLDER)
@click.option(
    "--out",
    type=GOES_ON,
    required=True,
    help="Folder for the upgraded BOP dataset.",
)
@click.option("--kind", default="auto", show_default=True,
              type=click.Choice(["auto", "bop", "graspnet"]), help="What DATASET is.")  # fmt: skip
@click.option("--camera", default="", metavar="NAME",
              help="kinect or realsense, of GraspNet; a camera of BOP.  [all]")  # fmt: skip
@click.option(
    "--start",
    default="gt",
    show_default=True,
    help="Start poses: 'gt' (the annotations) or a folder under keyframe_poses/.",
)
@click.option("--scenes", default="", help="Scene numbers, such as 1-3,7; all by default.")
@click.option("--views", type=click.IntRange(1), default=None,
              help="At most so many images of each scene, spread evenly.  [all]")  # fmt: skip
@click.option("--models", type=FOLDER, default=None, help="Models folder, if not DATASET/models.")
@click.option("--grasps", default=60, show_default=True, type=click.IntRange(1, 2000),
              help="Candidates to try on each object, at most.")  # fmt: skip
@click.option("--analytic", default=0, show_default=True, type=click.IntRange(0, 2000),
              help="Analytic grasps to try on each object beside these.")  # fmt: skip
@many(None, "Scenes at a time, or processes of the only one.  [one a core]")
@JSON
@QUIET
def upgrade_command(
    dataset: Path, out: Path, scenes: str, as_json: bool, quiet: bool, **options: Any
) -> None:
    """Refine the poses of a BOP or GraspNet data set, try grasps, write it out with labels.

    DATASET is a BOP root, a split or one scene; or a GraspNet root, a scene, one camera of it
    or one image (color.png, depth.png, meta.mat).
    Nothing in it is changed: what it had goes along to OUT/SPLIT/SCENE/imported. Run again, it goes
    on where it stopped; finished scenes are not done again.

    Writes OUT/upgrade.html (before and after, worst objects first), upgrade.json and upgrade.csv.

    Exit codes: 0 done, 1 a scene was left out, 2 bad input.
    """
    from realsim.app.console import Console
    from realsim.app.upgrade.dataset import UpgradeConfig
    from realsim.app.upgrade.run import run_upgrade, show_upgrade

    config = UpgradeConfig(
        scenes=numbers_of(scenes), grasps_per_object=options.pop("grasps"), **options
    )
    console = Console(quiet=quiet, as_json=as_json)
    result = run_upgrade(config, dataset, out, console)
    show_upgrade(result, console)
    console.result(result)
    if result.failed:
        sys.exit(1)
