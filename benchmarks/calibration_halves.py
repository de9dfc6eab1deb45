"""Whether sigma says what another session would say: disjoint halves of a set against each other.

Imported by `calibration.py`. A set's views are cut into two halves by chance; each is calibrated as
if it were a session of its own. How far their X for this arm are apart, over what their sigmas
promise for that, is 1 where sigma is right. The command itself is run on the whole sets, too.
The leverage bound of 0.9, and CR3 instead of CR2 (ratios of 0.55 to 0.74), were chosen on eight
cuts of the same sets.
"""

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from calibration_real import SOURCES, ImageSet, PoseSet
from figures import children_cpu_s

from realsim.arrays import Rows
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim_calibration import BoardView, HandEyeReport, calibrate, calibrate_from_poses


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Halves:
    """One cut of one set."""

    data: ImageSet | PoseSet
    seed: int

    @property
    def name(self) -> str:
        """Name of the set."""
        return self.data.name if isinstance(self.data, ImageSet) else "koch"


@dataclass(frozen=True, kw_only=True, slots=True)
class Apart:
    """Two halves against each other."""

    name: str
    mm: float
    """How far the two X are apart [mm]."""
    stated_mm: float
    """Square root of the expected square by both covariances [mm]."""
    deg: float
    stated_deg: float
    said: str = ""
    """The refusal, where there was one."""


def _calibrated(data: ImageSet | PoseSet, views: Rows) -> HandEyeReport:
    """Return the calibration of some views, joints left aside."""
    if isinstance(data, PoseSet):
        return calibrate_from_poses(data.A[views], data.C[views])
    return calibrate(
        [
            BoardView(
                index=int(k), T_base_ee=data.Ts[k], detection=data.detections[k],
                name=data.labels[k],
            )
            for k in views
        ],
        data.target,
    ).hand_eye  # fmt: skip


def halves_apart(task: Halves) -> Apart:
    """Return how far the halves of a set are apart, and how far they should be."""
    data = task.data
    count = len(data.A if isinstance(data, PoseSet) else data.Ts)
    order = np.random.default_rng([task.seed, 5]).permutation(count)
    try:
        a, b = (_calibrated(data, np.sort(h)) for h in (order[: count // 2], order[count // 2 :]))
    except RealsimError as error:
        nan = float("nan")
        return Apart(
            name=task.name, mm=nan, stated_mm=nan, deg=nan, stated_deg=nan, said=str(error)
        )
    X = [r.X if r.X_here is None else r.X_here for r in (a, b)]
    off, C = se3.log(se3.invert(X[0]) @ X[1]), a.place_covariance + b.place_covariance
    return Apart(
        name=task.name,
        mm=1e3 * float(np.linalg.norm(off[3:])),
        stated_mm=1e3 * float(np.sqrt(np.trace(C[3:, 3:]))),
        deg=float(np.degrees(np.linalg.norm(off[:3]))),
        stated_deg=float(np.degrees(np.sqrt(np.trace(C[:3, :3])))),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """`realsim calibrate` on a set."""

    data: Path
    name: str
    views: int = 0
    """How many of the set's images are given; 0 = all."""


def run_command(task: Command) -> tuple[int, float]:
    """Return the exit code of `realsim calibrate` on a set, and its CPU time [s]."""
    folder = task.data / "handeye"
    with tempfile.TemporaryDirectory() as place:
        if task.name == "koch":
            koch = folder / "koch_ur5"
            words = [str(koch), "--poses", "robot_poses.yaml", "--board-poses",
                     str(koch / "cam_poses.yaml"), "--reading", "matrix,mm"]  # fmt: skip
        else:
            source = SOURCES[task.name]
            images = folder / source.images
            if task.views:
                images = _some(images, task.views, Path(place) / "images")
            poses = images if source.poses == source.images else folder / source.poses
            words = [str(images), "--poses", str(poses), "--board", source.target,
                     "--reading", source.reading]  # fmt: skip
        program = str(Path(sys.executable).with_name("realsim"))
        command = [program, "calibrate", *words, "--out", str(Path(place) / "calibration")]
        before = children_cpu_s()
        code = subprocess.run(command, check=False, capture_output=True).returncode
    return code, children_cpu_s() - before


def _some(images: Path, views: int, to: Path) -> Path:
    """Return a folder with the first images of a set and their poses beside them."""
    to.mkdir()
    for image in sorted(images.glob("*.jpg"))[:views]:
        for beside in images.glob(f"{image.stem}.*"):
            (to / beside.name).symlink_to(beside)
    return to
