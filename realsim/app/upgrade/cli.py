"""`realsim upgrade`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.meanings import one_of
from realsim.app.option_values import FOLDER
from realsim.app.options import Has, command, many, options, rare
from realsim.app.outputs import GOES_ON


@command(
    "upgrade",
    "realsim upgrade dataset --out upgraded --only-scenes 1 --grasps 4",
    "realsim upgrade dataset --out upgraded_gt --views 1 --grasps 2 --workers 1 --json",
)
@click.argument("dataset", type=FOLDER)
@options(
    out=Has(kind=GOES_ON, note=": a folder", required=True), only_scenes="",
    views=Has(None, " of each scene at most, spread evenly  [all]"), grasps=60,
    models=Has(None, "  [DATASET/models]"),
)  # fmt: skip
@many(None, "; scenes at a time, or of the only one  [one a core]")
@rare(
    kind=Has("auto", kind=one_of("auto bop graspnet")), camera_name=Has("", "  [all]"), start="gt",
    analytic=0,
)  # fmt: skip
def upgrade_command(
    console: Console, dataset: Path, out: Path, grasps: int, camera_name: str, **options: Any
) -> bool:
    """Refine the poses of a BOP or GraspNet data set, try grasps, write it out with labels.

    DATASET is a BOP root, a split or one scene; or a GraspNet root, a scene, one camera of it
    or one image (color.png, depth.png, meta.mat).
    Nothing in it is changed: what it had goes along to OUT/SPLIT/SCENE/imported. Run again, it goes
    on where it stopped; finished scenes are not done again.

    Writes OUT/upgrade.html (before and after, worst objects first), upgrade.json and upgrade.csv.

    Exit codes: 0 done, 1 a scene was left out, 2 bad input.
    """
    from realsim.app.upgrade.dataset import UpgradeConfig
    from realsim.app.upgrade.run import run_upgrade, show_upgrade

    config = UpgradeConfig(camera=camera_name, grasps_per_object=grasps, **options)
    result = run_upgrade(config, dataset, out, console)
    show_upgrade(result, console)
    console.result(result)
    return not result.failed
