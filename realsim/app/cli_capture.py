"""The commands that make a session: plan, capture, check, import."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.option_values import numbers_of, port_in_use

FOLDER = click.Path(path_type=Path)
ROBOT = click.Choice(["UR5", "UR5e"], case_sensitive=False)


@click.command()
@click.option("--views", type=click.IntRange(1, 4096), default=None, help="[256; 24 of a board]")
@click.option("--robot", type=ROBOT, default="UR5", show_default=True, help="The arm's model.")
@click.option(
    "--calibration", type=FOLDER, default=None,
    help="The arm's own calibration: the controller's calibration.conf, or ROS's YAML.",
)  # fmt: skip
@click.option("--mount", type=FOLDER, default=None, help="Mount file.  [a D405 on a bracket]")
@click.option("--center", default="", help="Scene centre x,y,z in base [m].  [0.40,0, 0.05 up]")
@click.option("--table-height", type=float, default=None, help="z of the table's top [m].  [0]")
@click.option("--keep-out", default="", help="Box of the objects x,y,z [m].  [0.3,0.3,0.12]")
@click.option("--obstacles", type=FOLDER, default=None, help="TOML file of named boxes in base.")
@click.option("--radius", default="", help="Camera to centre, least,greatest [m].")
@click.option("--elevation", default="", help="Camera above the table, least,greatest [degrees].")
@click.option("--seed", default=0, show_default=True, help="Another seed, another plan.")
@click.option("--board", is_flag=True, help="Views of a board, to calibrate with.")
@click.option("--advise", is_flag=True, help="Say where the centre is best put; plan nothing.")
@click.option("--out", type=FOLDER, default=Path("plan.json"), show_default=True, help="File.")
@click.option("--overwrite", is_flag=True, help="Replace a plan of the same name.")
@click.option("--no-pictures", is_flag=True, help="The plan file alone.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def plan(advise: bool, quiet: bool, **options: Any) -> None:
    """Plan the views of a scene, or of a board: where the arm goes, in which order.

    Writes the plan file and pictures beside it. Ends with exit code 1 when a move of it collides.
    """
    from realsim.app.plan.request import PlanRequest
    from realsim.app.plan.run import run_plan

    if not run_plan(PlanRequest.of(options), advise=advise, quiet=quiet):
        sys.exit(1)


@click.command("plan-show")
@click.argument("source", metavar="PLAN")
@click.option("--replay", is_flag=True, help="Drive it on the screen, in the browser.")
@click.option("--replay-file", type=FOLDER, default=None, help="Write the replay as a file.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address of the replay.")
@click.option(
    "--port", default=8080, show_default=True, type=click.IntRange(0, 65535),
    help="Port of the replay.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace the file of the replay.")
@click.option("--no-pictures", is_flag=True, help="The table alone.")
def plan_show(
    source: str, replay: bool, replay_file: Path | None, host: str, port: int, overwrite: bool,
    no_pictures: bool,
) -> None:  # fmt: skip
    """Show how good a plan is, with pictures and a replay.

    PLAN is a plan file, or shipped:ur5_d405_hemisphere_256. Ends with exit code 1 when a move
    collides.
    """
    from realsim.app.plan.run import run_show
    from realsim.errors import InputError

    if replay_file is not None and replay_file.exists() and not overwrite:
        raise InputError(
            f"{replay_file} is there already. Name another file, or replace it with --overwrite."
        )
    if replay and port and port_in_use(host, port):
        click.echo(f"note: port {port} is in use; another one will be taken.", err=True)
    if not run_show(
        source, pictures=not no_pictures, replay=replay, replay_file=replay_file, host=host,
        port=port,
    ):  # fmt: skip
        sys.exit(1)


@click.command("plan-convert")
@click.argument("source")
@click.argument("dest", type=FOLDER)
@click.option("--robot", type=ROBOT, default=None, help="Arm of a path without tool poses.")
@click.option("--calibration", type=FOLDER, default=None, help="The arm's own calibration.")
@click.option("--mount", type=FOLDER, default=None, help="Mount file.  [a D405 on a bracket]")
@click.option("--center", default="", help="Scene centre x,y,z [m].  [where the cameras look]")
@click.option("--table-height", type=float, default=None, help="z of the table's top [m].  [0]")
@click.option("--keep-out", default="", help="Box of the objects x,y,z [m].")
@click.option("--obstacles", type=FOLDER, default=None, help="TOML file of named boxes in base.")
@click.option(
    "--joints-unit", type=click.Choice(["deg", "rad"]), default=None,
    help="Unit of joints that say none.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace DEST.")
def plan_convert(
    source: str, dest: Path, joints_unit: Any, overwrite: bool, robot: str | None, **place: Any
) -> None:
    """Read other people's joint paths, and write plans for other programs.

    \b
    SOURCE  a realsim plan (.json or shipped:NAME), a joint path with tool poses (.json), or
            a table (.csv with q1_rad ... q6_rad or q1_deg ..., and via)
    DEST    .json    realsim plan
            .csv     table of joints and expected camera poses
            .script  URScript program
            FOLDER   GraspNet's camera_poses.npy and cam0_wrt_table.npy

    Robot, units and tool offset of a path are proven from its tool poses. Ends with exit code 1
    when a move of an imported path collides.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.plan.request import Place
    from realsim.app.plan.run import run_convert

    where = Place(robot=robot or "", **place)
    if not run_convert(source, dest, where, joints_unit=joints_unit, overwrite=overwrite):
        sys.exit(1)


@click.command("capture")
@click.argument("out", type=FOLDER)
@click.option("--plan", required=True, help="Plan file, or shipped:ur5_d405_hemisphere_256.")
@click.option("--robot-host", default="", help="IP address of the UR5's controller.")
@click.option("--simulated", is_flag=True, help="The simulated lab instead of a robot.")
@click.option("--camera", default=None, help="Serial number of the RealSense.  [the only one]")
@click.option("--board", default="", help="Capture board views: target file, or one line.")
@click.option("--dry-run", is_flag=True, help="Drive at a quarter of the speed, store nothing.")
@click.option("--speed", type=float, default=None, help="Share of the plan's speed.  [1]")
@click.option("--settle", type=float, default=None, help="Wait after a move [s].  [the plan's]")
@click.option("--views", default="", help="Only these views, such as 1-3,7.")
@click.option("--retake", default="", help="Take these (1-3,7) again; earlier ones are kept aside.")
@click.option("--no-input", is_flag=True, help="Ask nobody: trouble ends the run.")
@click.option("--seed", default=0, show_default=True, help="Of the simulated lab.")
@click.option("--objects", default=5, show_default=True, type=click.IntRange(1, 40))
@click.option("--quiet", is_flag=True, help="Trouble and the result only.")
def capture_command(
    out: Path, settle: float | None, views: str, retake: str, quiet: bool, **options: Any
) -> None:
    """Drive a plan and store its views in the session OUT; the same command goes on after a stop.

    Keys: p pause, r redo the last view, s skip, q stop, space go on. Ends with exit code 1 when
    views are missing at the end.
    """
    from realsim.app.capture.run import CaptureRequest, run_capture
    from realsim.app.console import Console

    request = CaptureRequest(
        out=out, settle_s=settle, views=numbers_of(views), retake=numbers_of(retake), **options
    )
    if not run_capture(request, Console(quiet=quiet)):
        sys.exit(1)


@click.command()
@click.argument("session", type=FOLDER)
@click.option("--repair", is_flag=True, help="Move what is damaged to SESSION/damaged.")
@click.option("--decode", is_flag=True, help="Decode every image, too (slow).")
@click.option("--json", "as_json", is_flag=True, help="The report as JSON on stdout.")
def check(session: Path, repair: bool, decode: bool, as_json: bool) -> None:
    """Verify every checksum of SESSION and say what is missing or damaged.

    Sessions inside it (calibration/capture) are checked, too. Nothing is changed without --repair,
    which takes out what is damaged, and only that: the views concerned can be captured again.

    SESSION may also be a BOP or GraspNet data set: masks, boxes, counts, poses and depth are held
    against each other, image against image, and against the rendered models; or any export of
    `realsim export`: its SHA256SUMS are verified.

    Exit codes: 0 sound, 1 damaged or contradictory, 2 none of these.
    """
    from realsim.app.check.session import run_check

    if not run_check(session, repair=repair, decode=decode, as_json=as_json):
        sys.exit(1)


@click.command("import")
@click.argument("source", type=FOLDER)
@click.argument("out", type=FOLDER, required=False)
@click.option(
    "--kind",
    default="auto",
    show_default=True,
    type=click.Choice(
        ["auto", "bag", "folder", "bop", "graspnet", "colmap", "nerfstudio", "realsense"]
    ),
)
@click.option("--list", "list_only", is_flag=True, help="Say what is inside; import nothing.")
@click.option("--camera", type=FOLDER, default=None, help="File with the intrinsics.")
@click.option("--depth-unit", type=float, default=None, help="Metres per count: 0.001, 0.0001 ...")
@click.option("--depth-coding", default=None, type=click.Choice(["auto", "plain", "apc"]))
@click.option("--no-depth", is_flag=True, default=None, help="Colour only.")
@click.option("--images", default=None, help="Folder of the colour images.")
@click.option("--depths", default=None, help="Folder of the depth images.")
@click.option("--poses", type=FOLDER, default=None, help="Pose file or folder.")
@click.option("--no-poses", is_flag=True, default=None, help="Images only.")
@click.option("--poses-of", default=None, type=click.Choice(["tool", "camera"]), help="[tool]")
@click.option("--reading", default=None, help="How poses are read: rotvec,m  quat_xyzw,mm  ...")
@click.option("--key", default=None, help="Entry of the pose file, where there are several.")
@click.option("--colour-topic", default=None)
@click.option("--depth-topic", default=None)
@click.option("--joints-topic", default=None)
@click.option("--camera-info-topic", default=None)
@click.option("--depth-camera-info-topic", default=None)
@click.option("--joint-prefix", default=None, help="Before shoulder_pan_joint, with two arms.")
@click.option("--base-frame", default=None, help="tf frame of the robot's base.")
@click.option("--ee-frame", default=None, help="tf frame of the flange.")
@click.option("--world-frame", default=None, help="tf frame to give camera poses in.")
@click.option("--clock", default=None, type=click.Choice(["header", "receive"]))
@click.option("--max-pair-gap", type=float, default=None, help="Colour to depth at most [s].")
@click.option("--only-still", is_flag=True, default=None, help="Leave out frames in motion.")
@click.option("--scene", type=int, default=None, help="Scene of a BOP or GraspNet data set.")
@click.option("--camera-name", default=None, help="Of its several cameras: kinect, cam1 ...")
@click.option("--models", type=FOLDER, default=None, help="Models, if not in the data set.")
@click.option("--no-labels", is_flag=True, default=None, help="Leave its poses and masks there.")
@click.option("--camera-id", type=int, default=None, help="Camera of COLMAP or nerfstudio.")
@click.option("--scale", type=float, default=None, help="Metres per unit of their world.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier import in OUT.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def import_command(
    source: Path, out: Path | None, list_only: bool, overwrite: bool, quiet: bool, **options: object
) -> None:
    """Turn a recording, a folder of images or a data set into the session OUT.

    SOURCE is a ROS or RealSense bag, a folder of images, a BOP or GraspNet scene, a COLMAP project,
    a nerfstudio folder, or an archive of one. What belongs together is joined by time stamp or by
    name, never by order; what is missing is named. Poses, masks and models of a data set come too.
    """
    from realsim.app.console import Console
    from realsim.app.importing.listing import list_source
    from realsim.app.importing.source import request_of, run_import

    console = Console(quiet=quiet)
    request = request_of(source, **options)
    if list_only:
        list_source(request, console)
    elif out is None:
        raise click.UsageError("the folder OUT of the session is missing (or say --list).")
    else:
        run_import(request, out, console, overwrite=overwrite)


CAPTURE_COMMANDS = (plan, plan_show, plan_convert, capture_command, check, import_command)
"""What `cli` adds to the group."""
