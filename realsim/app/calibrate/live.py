"""`realsim calibrate --live`: tell a person with a tag board in the hand what to do next."""

from pathlib import Path

from realsim.app.calibrate.folder import FolderRequest, target_of, write_calibration
from realsim.app.calibrate.show import report_document, show_report
from realsim.app.console import Console
from realsim.errors import InputError
from realsim_calibration import (
    BoardView,
    Calibration,
    CalibrationConfig,
    LiveCalibration,
    find_target,
)


def run_live(request: FolderRequest, console: Console) -> bool:
    """Watch a folder for views and say after each what is missing; return whether it was enough.

    Every view is an image and a pose file of the same stem. A known camera is needed.

    Raises:
        InputError: no camera, no target, or a folder that cannot be read.
    """
    from dataclasses import replace

    from realsim_calibration.inputs.image_files import load_image
    from realsim_calibration.inputs.pose_file import read_pose_file
    from realsim_calibration.inputs.readings import reading_from_text
    from realsim_calibration.lens.camera_files import read_camera
    from realsim_calibration.planning.live_calibration import watch_folder

    if request.intrinsics is None or not request.reading:
        raise InputError(
            "--live needs --intrinsics (factory intrinsics: two views cannot tell a lens) and "
            "--reading (such as rotvec,m: one pose cannot prove how it is to be read)."
        )
    target, camera = target_of(request.board), read_camera(request.intrinsics)
    reading = reading_from_text(request.reading)

    def read_view(index: int, image: Path, pose: Path) -> BoardView:
        T = read_pose_file(pose, key=request.key or None).poses(reading)
        found = find_target(load_image(image), target, intrinsics=camera)
        return BoardView(index=index, T_base_ee=T[0], detection=found, name=image.name)

    config = CalibrationConfig().hand_eye
    live = LiveCalibration(target, camera, calibration=replace(config, mode=request.mode))
    console.say(f"watching {request.images}; Ctrl-C ends")
    done = False
    report = None
    for status in watch_folder(request.images, live, read_view):
        console.say(status.sentence)
        done, report = status.state == "done", status.report or report
        if done:
            break
    if report is not None:
        files = write_calibration(Calibration(hand_eye=report, lens=None), request, (), console)
        show_report(report, report.checks, console)
        console.say(f"report: {files[0]}")
        console.result(report_document(report, report.checks, files))
    return done
