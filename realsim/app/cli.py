"""The command line: one command per job, each importing what it needs only when it runs.

Exit codes: 0 done, 1 done but a check failed, 2 something given cannot be used, 130 interrupted.
"""

import sys
from pathlib import Path

import click

from realsim import __version__
from realsim.app.annotate.cli import annotate_command
from realsim.app.cli_capture import CAPTURE_COMMANDS
from realsim.app.demonstrations.cli import demonstrations_command
from realsim.app.depth_fit.cli import depth_fit
from realsim.app.export.cli import export_command
from realsim.app.generate.cli import generate_command
from realsim.app.register.cli import register_command
from realsim.app.render.cli import render_command
from realsim.app.scan.cli import SCAN
from realsim.app.school.cli import SCHOOL
from realsim.app.stats.cli import stats_command
from realsim.app.upgrade.cli import upgrade_command
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
    from realsim.app.calibrate.run import run_calibrate

    if not run_calibrate(source, live=live, quiet=quiet, **options):
        sys.exit(1)


@commands.command()
@click.argument("session", type=FOLDER)
@click.option("--truth", type=FOLDER, default=None, help="The simulated lab's truth folder.")
def report(session: Path, truth: Path | None) -> None:
    """Write SESSION/reports/report.html: one self-contained page with pictures."""
    from realsim.app.console import Console
    from realsim.app.report.session import write_report
    from realsim.app.stages import open_session
    from realsim.app.truth import loop_errors

    store = open_session(session)
    errors = None if truth is None else loop_errors(store, truth)
    Console().say(str(write_report(store, errors)))


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


for _command in CAPTURE_COMMANDS:
    commands.add_command(_command)
commands.add_command(SCAN)
commands.add_command(SCHOOL)
commands.add_command(register_command)
commands.add_command(annotate_command)
commands.add_command(render_command)
commands.add_command(generate_command)
commands.add_command(depth_fit)
commands.add_command(demonstrations_command)
commands.add_command(export_command)
commands.add_command(stats_command)
commands.add_command(upgrade_command)


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
