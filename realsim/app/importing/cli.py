"""`realsim import`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.meanings import one_of
from realsim.app.options import SOURCE, Has, command, options, rare
from realsim.app.outputs import GOES_ON

KINDS = one_of("auto bag folder bop graspnet colmap nerfstudio realsense")


@command(
    "import",
    "realsim import dataset --list",
    "realsim import dataset imported --scene 1",
    "realsim import frames imported --intrinsics camera.json --depth-unit 0.001 --no-poses",
)
@SOURCE
@click.argument("out", type=GOES_ON, required=False)
@options(
    kind=Has("auto", kind=KINDS), list=False, intrinsics=None, depth_unit=None, poses=None,
    no_poses=None, scene=None, camera_name=None, models=None, overwrite=False,
)  # fmt: skip
@rare(
    depth_coding=Has(None, "  [auto]"), no_depth=None, images=None, depths=None,
    poses_of=Has(None, "  [tool]"), reading=None, key=None, arm=Has(None, "  [of a bag a UR]"),
    colour_topic=None, depth_topic=None, joints_topic=None, camera_info_topic=None,
    depth_camera_info_topic=None, joint_prefix=None, base_frame=None, ee_frame=None,
    world_frame=None, clock=Has(None, "  [header]"), max_pair_gap=None, only_still=None,
    no_labels=None, camera_id=None, scale=None,
)  # fmt: skip
def import_command(
    console: Console, source: Path, out: Path | None, list_only: bool, overwrite: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Turn a recording, a folder of images or a data set into the session OUT.

    SOURCE is a ROS or RealSense bag, a folder of images, a BOP or GraspNet scene, a COLMAP project,
    a nerfstudio folder, or an archive of one. What belongs together is joined by time stamp or by
    name, never by order; what is missing is named. Poses, masks and models of a data set come too.
    """
    from realsim.app.importing.listing import list_source
    from realsim.app.importing.source import request_of, run_import

    request = request_of(source, **options)
    if list_only:
        list_source(request, console)
    elif out is None:
        raise click.UsageError("the folder OUT of the session is missing (or say --list).")
    else:
        console.result(run_import(request, out, console, overwrite=overwrite))
