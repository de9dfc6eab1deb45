"""The command line: one command per job, each importing what it needs only when it runs.

Exit codes: 0 done, 1 done but a check failed, 2 something given cannot be used, 130 interrupted.
"""

import sys
from pathlib import Path
from typing import Any

import click

from realsim import __version__
from realsim.errors import RealsimError

FOLDER = click.Path(path_type=Path)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="realsim")
def commands() -> None:
    """Turn robot captures into grasping data that one can trust.

    Start with `realsim demo`: the whole loop in a simulated lab, no hardware needed. Every command
    goes on where it stopped when it is run again.
    """


@commands.command()
@click.option("--out", type=FOLDER, default=Path("demo"), show_default=True, help="Folder to fill.")
@click.option("--views", default=24, show_default=True, type=click.IntRange(4, 1024))
@click.option("--objects", default=5, show_default=True, type=click.IntRange(1, 40))
@click.option("--seed", default=0, show_default=True, help="Another seed, another scene.")
@click.option(
    "--grasps",
    default=60,
    show_default=True,
    type=click.IntRange(1, 2000),
    help="Candidates to try on each object, at most.",
)
@click.option("--workers", default=2, show_default=True, type=click.IntRange(1, 64))
@click.option("--quiet", is_flag=True, help="No progress bars.")
def demo(
    out: Path, views: int, objects: int, seed: int, grasps: int, workers: int, quiet: bool
) -> None:  # fmt: skip
    """Run the whole loop in a simulated lab and compare it with the truth."""
    from realsim.app.console import Console
    from realsim.app.demo import DemoConfig, run_demo, show_demo

    config = DemoConfig(
        views=views, objects=objects, seed=seed, grasps_per_object=grasps, workers=workers
    )
    console = Console(quiet=quiet)
    show_demo(run_demo(config, out, console), console)


@commands.command()
@click.argument("dataset", type=FOLDER)
@click.option("--out", type=FOLDER, required=True, help="Folder for the upgraded BOP dataset.")
@click.option(
    "--start",
    default="gt",
    show_default=True,
    help="Start poses: 'gt' (scene_gt.json) or a folder under keyframe_poses/.",
)
@click.option("--scenes", default="", help="Scene numbers, comma-separated; all by default.")
@click.option("--models", type=FOLDER, default=None, help="Models folder, if not DATASET/models.")
@click.option("--grasps", default=60, show_default=True, type=click.IntRange(1, 2000))
@click.option("--workers", default=2, show_default=True, type=click.IntRange(1, 64))
@click.option("--quiet", is_flag=True, help="No progress bars.")
def upgrade(
    dataset: Path, out: Path, start: str, scenes: str, models: Path | None, grasps: int,
    workers: int, quiet: bool,
) -> None:  # fmt: skip
    """Refine the poses of a BOP dataset, try grasps on it, and write it out with labels.

    DATASET is a BOP root, a split, or one scene folder; nothing in it is changed.
    """
    from realsim.app.console import Console
    from realsim.app.upgrade import UpgradeConfig, run_upgrade, show_upgrade

    config = UpgradeConfig(
        start=start, scenes=_numbers(scenes), models=models, grasps_per_object=grasps,
        workers=workers,
    )  # fmt: skip
    console = Console(quiet=quiet)
    result = run_upgrade(config, dataset, out, console)
    show_upgrade(result, console)
    if result.failed:
        sys.exit(1)


@commands.command()
@click.argument("what", metavar="TARGET")
@click.option("--out", type=FOLDER, default=Path("boards"), show_default=True, help="Folder.")
@click.option("--paper", default="A4", show_default=True, help="A5 to A0, letter, 300x400mm, auto.")
@click.option("--preview", is_flag=True, help="A PNG beside the PDF.")
@click.option("--cut-marks", is_flag=True)
@click.option("--overwrite", is_flag=True, help="Replace a sheet of the same name.")
def board(
    what: str, out: Path, paper: str, preview: bool, cut_marks: bool, overwrite: bool
) -> None:
    """Print a calibration target: a PDF at exact scale with a ruler, and its target file.

    TARGET is one line, or a target file:

    \b
      aprilgrid:6x4,tag=30mm,gap=10mm           AprilTags, 6 columns x 4 rows
      charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11
      chessboard:9x6,square=20mm                inner corners
      circles:9x9,pitch=18mm,large-origin
      tag:7,size=80mm                           one AprilTag
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim_calibration.sheets import make_board

    for path in make_board(
        what, out, paper, preview=preview, cut_marks=cut_marks, overwrite=overwrite
    ):
        click.echo(path)


@commands.command()
@click.argument("source", type=FOLDER)
@click.option("--board", default="", help="Target: one line (see `realsim board`) or a file.")
@click.option("--poses", type=FOLDER, default=None, help="Pose file or folder.  [SOURCE]")
@click.option("--reading", default="", help="How poses are read: rotvec,m  quat_xyzw,mm  ...")
@click.option("--key", default="", help="Entry of the pose file, where there are several.")
@click.option("--board-poses", type=FOLDER, default=None, help="Camera poses instead of images.")
@click.option("--camera", type=FOLDER, default=None, help="File with known intrinsics.")
@click.option("--eye-to-hand", is_flag=True, help="The camera stands still, the target moves.")
@click.option("--robot", default="", help="UR5 or UR5e; found out where joints are given.")
@click.option("--out", type=FOLDER, default=Path("calibration"), show_default=True)
@click.option("--live", is_flag=True, help="Watch SOURCE for new views and say when to stop.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def calibrate(source: Path, quiet: bool, live: bool, **options: object) -> None:
    """Calibrate lens and hand-eye: SOURCE is a session, or a folder of images with poses.

    Ends with exit code 1 when a check of the result is bad.
    """
    from realsim.app.calibrate import run_calibrate

    if not run_calibrate(source, live=live, quiet=quiet, **options):
        sys.exit(1)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--quiet", is_flag=True)
def register(session: Path, quiet: bool) -> None:
    """Find the pose of every object from SESSION/registration/starts.json."""
    from realsim.app.console import Console
    from realsim.app.show import show_scene
    from realsim.app.stages import open_session, register_session

    console = Console(quiet=quiet)
    store = open_session(session)
    show_scene(store, register_session(store, console), console)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--grasps", default=60, show_default=True, type=click.IntRange(1, 2000))
@click.option("--seed", default=0, show_default=True)
@click.option("--workers", default=2, show_default=True, type=click.IntRange(1, 64))
@click.option("--quiet", is_flag=True)
def school(session: Path, grasps: int, seed: int, workers: int, quiet: bool) -> None:
    """Try grasps on the registered objects of SESSION in the Robot School."""
    from realsim.app.console import Console
    from realsim.app.show import show_grasps
    from realsim.app.stages import open_session, school_session

    console = Console(quiet=quiet)
    store = open_session(session)
    sets = school_session(store, console, grasps_per_object=grasps, seed=seed, workers=workers)
    show_grasps(store, sets, console)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--quiet", is_flag=True)
def annotate(session: Path, quiet: bool) -> None:
    """Write masks, poses, visibility and grasps for every frame of SESSION."""
    from realsim.app.console import Console
    from realsim.app.stages import annotate_session, open_session

    console = Console(quiet=quiet)
    summary = annotate_session(open_session(session), console)
    console.say(str(summary))


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--truth", type=FOLDER, default=None, help="The simulated lab's truth folder.")
def report(session: Path, truth: Path | None) -> None:
    """Write SESSION/reports/report.html: one self-contained page with pictures."""
    from realsim.app.console import Console
    from realsim.app.report import write_report
    from realsim.app.stages import open_session
    from realsim.app.truth import loop_errors

    store = open_session(session)
    errors = None if truth is None else loop_errors(store, truth)
    Console().say(str(write_report(store, errors)))


@commands.command("import")
@click.argument("source", type=FOLDER)
@click.argument("out", type=FOLDER, required=False)
@click.option(
    "--kind",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "bag", "folder", "bop", "colmap", "realsense"]),
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
@click.option("--scene", type=int, default=None, help="Scene of a BOP dataset.")
@click.option("--camera-id", type=int, default=None, help="Camera of a COLMAP model.")
@click.option("--scale", type=float, default=None, help="Metres per unit of a COLMAP model.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier import in OUT.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def import_command(
    source: Path, out: Path | None, list_only: bool, overwrite: bool, quiet: bool, **options: object
) -> None:
    """Turn a recording, a folder of images or a data set into the session OUT.

    SOURCE is a ROS or RealSense bag, a folder of images, a BOP scene or a COLMAP project. What
    belongs together is joined by time stamp or by name, never by order; what is missing is named.
    """
    from realsim.app.console import Console
    from realsim.app.import_source import list_source, request_of, run_import

    console = Console(quiet=quiet)
    request = request_of(source, **options)
    if list_only:
        list_source(request, console)
    elif out is None:
        raise click.UsageError("the folder OUT of the session is missing (or say --list).")
    else:
        run_import(request, out, console, overwrite=overwrite)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--host", default="127.0.0.1", show_default=True)
@click.option("--port", default=8080, show_default=True, type=click.IntRange(0, 65535))
def review(session: Path, host: str, port: int) -> None:
    """Look at SESSION in the browser; accept or reject each object."""
    import time

    from realsim.app.stages import open_session
    from realsim.review import ReviewServer

    server = ReviewServer(open_session(session), host=host, port=port)
    server.start()
    if port and f":{port}" not in server.url:
        click.echo(f"note: port {port} is in use; another one was taken.", err=True)
    click.echo(f"reviewing {session} at {server.url} (Ctrl-C ends)")
    try:
        while True:
            time.sleep(1.0)
    finally:
        server.stop()


ROBOT = click.Choice(["UR5", "UR5e"], case_sensitive=False)


@commands.command()
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
    from realsim.app.plan import run_plan
    from realsim.app.plan_request import PlanRequest

    if not run_plan(PlanRequest.of(options), advise=advise, quiet=quiet):
        sys.exit(1)


@commands.command("plan-show")
@click.argument("source", metavar="PLAN")
@click.option("--replay", is_flag=True, help="Drive it on the screen, in the browser.")
@click.option("--replay-file", type=FOLDER, default=None, help="Write the replay as a file.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address of the replay.")
@click.option(
    "--port", default=8080, show_default=True, type=click.IntRange(0, 65535),
    help="Port of the replay.",
)  # fmt: skip
@click.option("--no-pictures", is_flag=True, help="The table alone.")
def plan_show(
    source: str, replay: bool, replay_file: Path | None, host: str, port: int, no_pictures: bool
) -> None:  # fmt: skip
    """Show how good a plan is, with pictures and a replay.

    PLAN is a plan file, or shipped:ur5_d405_hemisphere_256. Ends with exit code 1 when a move
    collides.
    """
    from realsim.app.plan import run_show

    if not run_show(
        source, pictures=not no_pictures, replay=replay, replay_file=replay_file, host=host,
        port=port,
    ):  # fmt: skip
        sys.exit(1)


@commands.command("plan-convert")
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
    from realsim.app.plan import run_convert
    from realsim.app.plan_request import Place

    where = Place(robot=robot or "", **place)
    if not run_convert(source, dest, where, joints_unit=joints_unit, overwrite=overwrite):
        sys.exit(1)


@commands.command("capture")
@click.argument("out", type=FOLDER)
@click.option("--plan", required=True, help="Plan file, or shipped:ur5_d405_hemisphere_256.")
@click.option("--robot-host", default="", help="IP address of the UR5's controller.")
@click.option("--simulated", is_flag=True, help="The simulated lab instead of a robot.")
@click.option("--camera", default=None, help="Serial number of the RealSense.  [the only one]")
@click.option("--board", default="", help="Capture board views: target file, or one line.")
@click.option("--dry-run", is_flag=True, help="Drive at a quarter of the speed, store nothing.")
@click.option("--speed", type=float, default=None, help="Share of the plan's speed.  [1]")
@click.option("--settle", type=float, default=None, help="Wait after a move [s].  [the plan's]")
@click.option("--views", default="", help="Only these views, comma-separated.")
@click.option("--retake", default="", help="Take these again; the earlier ones are kept aside.")
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
    from realsim.app.capture import CaptureRequest, run_capture
    from realsim.app.console import Console

    request = CaptureRequest(
        out=out, settle_s=settle, views=_numbers(views), retake=_numbers(retake), **options
    )
    if not run_capture(request, Console(quiet=quiet)):
        sys.exit(1)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--repair", is_flag=True, help="Move what is damaged to SESSION/damaged.")
@click.option("--decode", is_flag=True, help="Decode every image, too (slow).")
@click.option("--json", "as_json", is_flag=True, help="The report as JSON on stdout.")
def check(session: Path, repair: bool, decode: bool, as_json: bool) -> None:
    """Verify every checksum of SESSION and say what is missing or damaged.

    Sessions inside it (calibration/capture) are checked, too. Nothing is changed without --repair,
    which takes out what is damaged, and only that: the views concerned can be captured again.

    Exit codes: 0 sound, 1 damaged, 2 not a session.
    """
    from realsim.app.check import run_check

    if not run_check(session, repair=repair, decode=decode, as_json=as_json):
        sys.exit(1)


def _numbers(text: str) -> tuple[int, ...]:
    """Return the numbers of a comma-separated list."""
    try:
        return tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise click.BadParameter(f"'{text}' is not a comma-separated list of numbers") from None


def main() -> None:
    """Run the command line; end with exit code 2 and one paragraph on bad input."""
    try:
        commands(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted; the same command goes on from here.", err=True)
        sys.exit(130)
    except RealsimError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        click.echo(
            f"error: the system refused a file operation: {error.strerror or error}{where}. "
            "Check that the path exists, that it may be written, and that the disk is not full.",
            err=True,
        )
        sys.exit(2)
