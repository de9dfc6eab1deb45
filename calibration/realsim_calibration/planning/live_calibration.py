"""Calibrate while capturing: after every view what is missing, where to go next, when to stop."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError, RealsimError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.fit.view_system import planar_poses
from realsim_calibration.hand_eye import calibrate_hand_eye_report
from realsim_calibration.planning.next_view import NextView, predicted_boards, rank_next_views
from realsim_calibration.planning.view_proposals import (
    Need,
    SeenBoard,
    ViewLimits,
    describe_move,
    missing,
    propose_views,
)
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView

State = Literal["collecting", "improving", "done", "bad"]


Solve = Callable[[Sequence[BoardView], Target, CameraIntrinsics, Any], HandEyeReport]
"""A hand-eye calibration."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveConfig:
    """When a calibration is tried, and when it is good enough."""

    sigma_mm: float = 0.5
    """Wanted 1-sigma of the camera's place [mm]."""
    sigma_deg: float = 0.1
    """Wanted 1-sigma of the camera's rotation [deg]."""
    min_views: int = 6
    """Views from which a calibration is tried: fewer leave nothing to judge it by."""
    min_views_to_stop: int = 10
    """Fewest views with which the run may end: a sigma from fewer is itself unsure by a third."""
    stable_views: int = 3
    """Views over which the held-out error must not change."""
    stable_share: float = 0.15
    """Share by which it counts as changed."""
    least_gain: float = 0.02
    """The run ends when the best next view lowers the expected error by less than this share."""
    hidden_factor: float = 2.0
    """While roll, tilt or the hand's second axis lack, both sigmas must be this many times better
    than wanted: errors of arm and lens then hide in the camera's place, and sigma knows of none."""
    min_points: int = 4
    """Fewest points of a usable view."""
    same_deg: float = 2.0
    """A hand turned by less than this [deg]."""
    same_m: float = 0.01
    """A hand that turned so little and moved by less than this [m] has taken the same view
    again."""
    limits: ViewLimits = field(default_factory=ViewLimits)
    """Where the next view may be, where no plan is given."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LiveStatus:
    """Where the run stands after a view."""

    state: State
    """collecting: no calibration yet; improving; done: stop; bad: something is wrong."""
    sentence: str
    """All of it for the operator, in one line."""
    views: int
    """Views taken, unusable ones included."""
    usable: int
    note: str = ""
    """What is to be said of the last view; empty where it is fine."""
    needs: tuple[str, ...] = ()
    """What further views should do, the most useful first."""
    next_view: NextView | None = None
    """The best next pose; None before the first calibration and after the last view."""
    move: str = ""
    """How to get there from the last view, in words."""
    report: HandEyeReport | None = None
    """The calibration so far."""

    @property
    def stop(self) -> bool:
        """Whether the run may end."""
        return self.state == "done"


class LiveCalibration:
    """A calibration that grows view by view."""

    def __init__(
        self,
        target: Target,
        intrinsics0: CameraIntrinsics,
        *,
        config: LiveConfig | None = None,
        plan: ArrayLike | None = None,
        calibration: Any = None,
        solve: Solve | None = None,
    ) -> None:
        """Begin without views.

        Args:
            target: the target.
            intrinsics0: the camera as known before.
            config: when to stop.
            plan: (n, 4, 4) poses T_base_ee that the arm can reach [m]; None = they are proposed.
            calibration: configuration handed to `solve`.
            solve: the calibration; None = `hand_eye.calibrate_hand_eye_report`.

        Raises:
            NotRigidError: a planned pose is not rigid.
        """
        self.target, self.intrinsics0 = target, intrinsics0
        self.config = config or LiveConfig()
        self._plan = None if plan is None else se3.check_rigid(plan, "planned T_base_ee")
        self._calibration = calibration
        self._solve: Solve = solve or calibrate_hand_eye_report
        self._views: list[BoardView] = []
        self._seen: list[SeenBoard] = []
        self._held_out: list[float] = []
        self.status = LiveStatus(
            state="collecting", sentence="No views yet: show the target to the camera.", views=0,
            usable=0, needs=("show the target to the camera",),
        )  # fmt: skip

    @property
    def views(self) -> tuple[BoardView, ...]:
        """All views that were added."""
        return tuple(self._views)

    def add(self, view: BoardView) -> LiveStatus:
        """Take a view, calibrate if there are enough, and return where the run stands.

        Raises:
            InputError: a view of this number was added before, or its image is of another size.
        """
        if any(v.index == view.index for v in self._views):
            raise InputError(f"view {view.index} was added before; view numbers must be unique.")
        size = (self.intrinsics0.width, self.intrinsics0.height)
        if view.detection.image_size != size:
            raise InputError(
                f"the image of view {view.label} is {view.detection.image_size[0]}x"
                f"{view.detection.image_size[1]}, the camera {size[0]}x{size[1]}. Give the "
                "intrinsics of the resolution at which the images are taken."
            )
        note = self._accept(view)
        needs = missing(self._seen, self.target, self.intrinsics0)
        if len(self._seen) < self.config.min_views:
            self.status = self._collecting(note, needs)
        else:
            self.status = self._calibrated(note, needs)
        return self.status

    def _accept(self, view: BoardView) -> str:
        """Keep the view and return what is to be said of it."""
        self._views.append(view)
        found = len(view.detection)
        if found < self.config.min_points:
            return f"view {view.label} is of no use: {found} points of the target were found"
        drawn = view.detection.points(self.target)
        poses = planar_poses(drawn, view.detection.uv, self.intrinsics0)
        if not poses:
            return f"view {view.label} is of no use: no pose of the target fits its points"
        for other in self._seen:
            step = se3.invert(other.view.T_base_ee) @ view.T_base_ee
            turned = float(np.degrees(se3.angle(step)))
            moved = float(np.linalg.norm(step[:3, 3]))
            if turned < self.config.same_deg and moved < self.config.same_m:
                self._seen.append(SeenBoard(view=view, T_cam_board=poses[0][1]))
                return f"view {view.label} repeats view {other.view.label}: turn the hand more"
        self._seen.append(SeenBoard(view=view, T_cam_board=poses[0][1]))
        return ""

    def _collecting(self, note: str, needs: tuple[Need, ...], why: str = "") -> LiveStatus:
        n, least = len(self._seen), self.config.min_views
        todo = needs[0].sentence if needs else "go on with other poses"
        count = f"{n} of {least} views for a first result" if n < least else f"{n} views"
        return self._status("collecting", note, needs, f"{count}. {why}Next: {todo}.")

    def _status(
        self, state: State, note: str, needs: tuple[Need, ...], sentence: str, **more: Any
    ) -> LiveStatus:
        said = f"{note[0].upper()}{note[1:]}. {sentence}" if note else sentence
        return LiveStatus(
            state=state, sentence=said, views=len(self._views), usable=len(self._seen), note=note,
            needs=tuple(n.sentence for n in needs), **more,
        )  # fmt: skip

    def _calibrated(self, note: str, needs: tuple[Need, ...]) -> LiveStatus:
        """Calibrate, and return where the run stands."""
        usable = [s.view for s in self._seen]
        try:
            report = self._solve(usable, self.target, self.intrinsics0, self._calibration)
        except DegenerateError as error:
            return self._collecting(note, needs, f"No result yet: {error} ")
        except RealsimError as error:
            return self._status("bad", note, needs, f"Something is wrong: {error}")
        self._held_out.append(report.held_out_px)
        last = usable[-1].index
        if not note:
            dropped = dict(report.rejected).get(last, "")
            note = f"view {usable[-1].label} was not used: {dropped}" if dropped else ""
        figures = (
            f"{len(report.used)} views: camera known to {report.here_mm:.2f} mm, "
            f"{report.here_deg:.3f} deg (wanted {self.config.sigma_mm:g} mm, "
            f"{self.config.sigma_deg:g} deg)"
        )
        bad = [c for c in report.checks if c.verdict == "bad"]
        best = self._best(report)
        move = "" if best is None else self._move(report, best)
        more = {"report": report, "next_view": best, "move": move}
        if bad:
            told = bad[0].words
            return self._status("bad", note, needs, f"Something is wrong: {told}", **more)
        # Told beside the next pose, not in its place: sentence and `next_view` must agree.
        lacking = f" Still missing: {needs[0].sentence}." if needs else ""
        end = self._end(report, best)
        hidden = self._hidden(report, needs)
        if end and not hidden:
            more |= {"next_view": None, "move": ""}
            return self._status("done", note, needs, f"Done. {figures}. {end}{lacking}", **more)
        if end:
            lacking = f" Before you stop: {hidden}, because no view so far shows these errors."
        todo = move or (needs[0].sentence if needs else "go on with other poses")
        said = f"{figures}. Next: {todo}.{lacking if move or end else ''}"
        return self._status("improving", note, needs, said, **more)

    def _hidden(self, report: HandEyeReport, needs: tuple[Need, ...]) -> str:
        """Return what must be done before the run may end, '' where nothing must."""
        c = self.config
        told = next((n.sentence for n in needs if n.hidden), "")
        worst = max(report.here_mm / c.sigma_mm, report.here_deg / c.sigma_deg)
        return told if worst * c.hidden_factor > 1 else ""

    def _end(self, report: HandEyeReport, best: NextView | None) -> str:
        """Return why the run may end, '' where it may not."""
        c = self.config
        if len(report.used) < c.min_views_to_stop:
            return ""
        reached = report.here_mm <= c.sigma_mm and report.here_deg <= c.sigma_deg
        recent = np.array(self._held_out[-c.stable_views :])
        stable = len(recent) == c.stable_views and bool(
            np.ptp(recent) <= c.stable_share * recent.mean()
        )
        if reached and stable:
            return f"The error on unseen views is steady at {report.held_out_px:.2f} px."
        if best is not None and best.gain < c.least_gain and not reached:
            return (
                f"Further views gain less than {c.least_gain:.0%} each, though the goal is not "
                "reached. To improve further, measure the board or calibrate the arm."
            )
        if best is not None and best.gain < c.least_gain:
            return f"Further views gain less than {c.least_gain:.0%} each."
        return ""

    def _best(self, report: HandEyeReport) -> NextView | None:
        """Return the best pose of what is left of the plan, or of the proposals."""
        try:
            if self._plan is None:
                Ts = propose_views(report, self.config.limits)
            else:
                Ts = self._not_taken(self._plan)
            if not len(Ts):
                return None
            best = rank_next_views(report, Ts)[0]
        except DegenerateError:
            return None
        return best if best.visible else None

    def _not_taken(self, Ts: Array) -> Array:
        """Return the planned poses (k, 4, 4) at which no view has been taken."""
        taken = np.stack([v.T_base_ee for v in self._views])
        step = se3.invert(taken)[:, None] @ Ts
        near = np.degrees(se3.angle(step)) < self.config.same_deg
        near &= np.linalg.norm(step[..., :3, 3], axis=-1) < self.config.same_m
        return Ts[~near.any(0)]

    def _move(self, report: HandEyeReport, best: NextView) -> str:
        """Return in words how to get to the next pose from the last view."""
        wanted = predicted_boards(report, best.T_base_ee)[0]
        return describe_move(self._seen[-1].T_cam_board, wanted, self.target)


# ---- a folder that fills


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
POSE_SUFFIXES = (".json", ".yaml", ".yml", ".txt", ".csv")
POLL_S = 0.5
"""Time between two looks [s]: less than an arm needs to move."""
IDLE_S = 600.0
"""Time without a new pair after which watching ends [s]."""


def find_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """Return (image, pose) files of the same stem, in the natural order of their names."""
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    poses = {p.stem: p for p in files if p.suffix.lower() in POSE_SUFFIXES}
    pairs = [
        (p, poses[p.stem]) for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.stem in poses
    ]
    return sorted(pairs, key=lambda pair: (len(pair[0].stem), pair[0].stem))


def watch_folder(
    folder: Path | str,
    live: LiveCalibration,
    read_view: Callable[[int, Path, Path], BoardView],
    *,
    idle_s: float = IDLE_S,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[LiveStatus]:
    """Yield a status for every new image and pose that appears in a folder.

    A pair is read once its files have kept their size from one look to the next, so that none is
    read half-written. A pair that cannot be read is told in `note` and `sentence`, and watching
    goes on.

    Args:
        folder: where images and poses appear.
        live: the calibration that they are added to.
        read_view: makes a view of (number, image, pose file); raises InputError for a bad file.
        idle_s: time without a new pair after which watching ends [s]; infinite = never.
        sleep: waits [s].
        clock: time [s].

    Raises:
        InputError: the folder does not exist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; make it, or check the path.")
    done: set[Path] = set()
    sizes: dict[Path, tuple[int, int]] = {}
    last = clock()
    number = max((v.index for v in live.views), default=-1) + 1
    while clock() - last <= idle_s:
        for image, pose in find_pairs(folder):
            if image in done:
                continue
            size = (image.stat().st_size, pose.stat().st_size)
            settled = sizes.get(image) == size and min(size) > 0
            sizes[image] = size
            if not settled:
                continue
            done.add(image)
            last = clock()
            try:
                status = live.add(read_view(number, image, pose))
                number += 1
            except InputError as error:
                note = f"{image.name} was not used: {error}"
                status = replace(live.status, note=note, sentence=f"{note} {live.status.sentence}")
            yield status
            if status.stop:
                return
        sleep(POLL_S)
