"""`realsim import`: its options."""

from pathlib import Path

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, arm, overwrite
from realsim.app.outputs import GOES_ON


@click.command(
    "import",
    cls=Command,
    examples=(
        "realsim import dataset --list",
        "realsim import dataset imported --scene 1",
        "realsim import frames imported --camera camera.json --depth-unit 0.001 --no-poses",
    ),
)
@click.argument("source", type=FOLDER)
@click.argument("out", type=GOES_ON, required=False)
@click.option(
    "--kind",
    default="auto",
    show_default=True,
    type=click.Choice(
        ["auto", "bag", "folder", "bop", "graspnet", "colmap", "nerfstudio", "realsense"]
    ),
    help="What SOURCE is.",
)
@click.option("--list", "list_only", is_flag=True, help="Say what is inside; import nothing.")
@click.option("--camera", type=FOLDER, default=None, help="File with the intrinsics.")
@click.option("--depth-unit", type=click.FloatRange(1e-6, 0.01), default=None,
              help="Metres per count: 0.001, 0.0001 ...")  # fmt: skip
@click.option("--depth-coding", default=None, type=click.Choice(["auto", "plain", "apc"]),
              help="How depth is packed into the images.  [auto]")  # fmt: skip
@click.option("--no-depth", is_flag=True, default=None, help="Colour only.")
@click.option("--images", default=None, help="Folder of the colour images.")
@click.option("--depths", default=None, help="Folder of the depth images.")
@click.option("--poses", type=FOLDER, default=None, help="Pose file or folder.")
@click.option("--no-poses", is_flag=True, default=None, help="Images only.")
@click.option("--poses-of", default=None, type=click.Choice(["tool", "camera"]), help="[tool]")
@click.option("--reading", default=None, help="How poses are read: rotvec,m  quat_xyzw,mm  ...")
@click.option("--key", default=None, help="Entry of the pose file, where there are several.")
@arm("Name or folder of the arm.  [of a bag a UR]")
@click.option("--colour-topic", default=None, help="ROS topic of the colour images.")
@click.option("--depth-topic", default=None, help="ROS topic of the depth images.")
@click.option("--joints-topic", default=None, help="ROS topic of the joint states.")
@click.option("--camera-info-topic", default=None, help="ROS topic of the colour camera's values.")
@click.option("--depth-camera-info-topic", default=None, help="The same of the depth camera.")
@click.option("--joint-prefix", default=None, help="Before the joints' names, with two arms.")
@click.option("--base-frame", default=None, help="tf frame of the robot's base.")
@click.option("--ee-frame", default=None, help="tf frame of the flange.")
@click.option("--world-frame", default=None, help="tf frame to give camera poses in.")
@click.option("--clock", default=None, type=click.Choice(["header", "receive"]),
              help="Time stamps of the messages, or of their arrival.  [header]")  # fmt: skip
@click.option("--max-pair-gap", type=float, default=None, help="Colour to depth at most [s].")
@click.option("--only-still", is_flag=True, default=None, help="Leave out frames in motion.")
@click.option("--scene", type=int, default=None, help="Scene of a BOP or GraspNet data set.")
@click.option("--camera-name", default=None, help="Of its several cameras: kinect, cam1 ...")
@click.option("--models", type=FOLDER, default=None, help="Models, if not in the data set.")
@click.option("--no-labels", is_flag=True, default=None, help="Leave its poses and masks there.")
@click.option("--camera-id", type=int, default=None, help="Camera of COLMAP or nerfstudio.")
@click.option("--scale", type=float, default=None, help="Metres per unit of their world.")
@overwrite("Replace an earlier import in OUT.")
@JSON
@QUIET
def import_command(
    source: Path, out: Path | None, list_only: bool, overwrite: bool, as_json: bool, quiet: bool,
    **options: object,
) -> None:  # fmt: skip
    """Turn a recording, a folder of images or a data set into the session OUT.

    SOURCE is a ROS or RealSense bag, a folder of images, a BOP or GraspNet scene, a COLMAP project,
    a nerfstudio folder, or an archive of one. What belongs together is joined by time stamp or by
    name, never by order; what is missing is named. Poses, masks and models of a data set come too.
    """
    from realsim.app.console import Console
    from realsim.app.importing.listing import list_source
    from realsim.app.importing.source import request_of, run_import

    console = Console(quiet=quiet, as_json=as_json)
    request = request_of(source, **options)
    if list_only:
        list_source(request, console)
    elif out is None:
        raise click.UsageError("the folder OUT of the session is missing (or say --list).")
    else:
        console.result(run_import(request, out, console, overwrite=overwrite))
