"""Where a rig's joint fit starts: closed forms, what follows from them, and which views agree.

1. the board's pose in every view; too few points: left out
2. closed-form hand-eyes of every camera and board that the arm moves against each other, with all
   their gates (`screening`); the one of most views is the anchor
3. every other camera and board follows from those that are known, over the views that show both
4. views that do not fit their camera's others are left out. Where most views of an instant that
   the arm moves are off, and agree about another pose of the arm, it is the arm's that is wrong:
   it is estimated, and the cameras that see boards then still tie each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Check
from realsim_calibration.cameras.rig import MOUNTS, PLACES, Rig, Sighting
from realsim_calibration.faults.gates import PX_FLOOR, PX_RATIO
from realsim_calibration.screening import HandEyeConfig, board_pose, screen
from realsim_calibration.views import BoardView

MOST_OFF = 0.1
"""Views of a camera and a board that are off by more than this share of the image's width (median)
are of something else."""
BEHIND_PX = 1e4
"""Error of a view whose board would be behind the camera [px]."""


@dataclass(eq=False, kw_only=True, slots=True)
class Start:
    """What is known before the joint fit."""

    rig: Rig
    """With the sightings that take part."""
    taken: list[int]
    """Their places among the sightings that were given."""
    rejected: dict[int, str]
    """Reason of every other sighting, by its place."""
    X: Array
    Z: Array
    A: Array
    """(I, 4, 4) the arm's poses; of instants without a known one, estimated."""
    known: Mask
    """(I,) whether the arm's pose is believed."""
    loose: dict[tuple[int, int], Array]
    bad_arm: list[int] = field(default_factory=list[int])
    """Instants whose arm pose was given and is not believed."""
    checks: list[tuple[int, Check]] = field(default_factory=list[tuple[int, Check]])
    """(camera, what its own screening found)."""


def find_start(
    rig: Rig, lenses: Sequence[CameraIntrinsics], config: HandEyeConfig, arm: DhArm | None
) -> Start:
    """Return the start of a rig's joint fit.

    Raises:
        InputError: a camera sees nothing, nothing ties it to the others, or poses and images do
            not belong together.
        DegenerateError: the motion of the arm does not determine the cameras.
    """
    finder = _Finder(rig, lenses, config, arm)
    finder.anchor()
    finder.spread()
    finder.gate()
    return finder.start()


def board_poses(
    rig: Rig, lenses: Sequence[CameraIntrinsics], config: HandEyeConfig
) -> tuple[dict[int, Array], dict[int, str]]:
    """Return T_cam_board of every sighting, by its place, and why the others have none."""
    found: dict[int, Array] = {}
    rejected: dict[int, str] = {}
    for k, s in enumerate(rig.sightings):
        pose = board_pose(s.detection, rig.boards[s.board].target, lenses[s.camera], config)
        if isinstance(pose, str):
            rejected[k] = pose
        else:
            found[k] = pose.T_cam_board
    return found, rejected


class _Finder:
    """The search for a start: what is known of every camera, board and instant so far."""

    def __init__(
        self, rig: Rig, lenses: Sequence[CameraIntrinsics], config: HandEyeConfig, arm: DhArm | None
    ) -> None:
        self.lenses, self.config, self.arm = lenses, config, arm
        self.sightings = list(rig.sightings)
        self.rig = rig
        self.C, self.rejected = board_poses(rig, lenses, config)
        self.X: dict[int, Array] = {}
        self.Z: dict[int, Array] = {}
        self.loose: dict[tuple[int, int], Array] = {}
        self.A = {i: t.T_base_ee for i, t in enumerate(rig.instants) if t.T_base_ee is not None}
        self.bad_arm: list[int] = []
        self.screened: dict[int, str] = {}
        self.checks: list[tuple[int, Check]] = []
        self.refusals: list[str] = []

    def told(self, k: int) -> str:
        """Return a sighting's name for messages."""
        s = self.sightings[k]
        return s.name or f"{self.rig.cameras[s.camera].name}/{self.rig.instants[s.instant].name}"

    # --- closed forms -----------------------------------------------------------------------

    def anchor(self) -> None:
        """Find the closed forms of all pairs that the arm moves; note the best ones."""
        pairs: dict[tuple[int, int], list[int]] = {}
        for k in self.C:
            s = self.sightings[k]
            place = self.rig.boards[s.board].place
            if self.rig.moves(s.camera, s.board) and place != "free" and s.instant in self.A:
                pairs.setdefault((s.camera, s.board), []).append(k)
        solved: list[tuple[int, int, int, Array, Array]] = []
        for (c, b), ks in sorted(pairs.items()):
            found = self._screened(c, b, ks)
            if found is not None:
                solved.append((len(ks), c, b, *found))
        for _, c, b, X, Z in sorted(solved, key=lambda row: -row[0]):
            if c not in self.X and b not in self.Z:
                self.X[c], self.Z[b] = X, Z
        if not pairs:
            self.X[0] = np.eye(4)
        elif not solved:
            raise DegenerateError(
                "cameras: no camera can be placed on the robot: " + " ".join(self.refusals)
            )

    def _screened(self, c: int, b: int, ks: list[int]) -> tuple[Array, Array] | None:
        """Return (X, Z) of a pair's closed form, None where its motion does not tell."""
        fixed = self.rig.cameras[c].mount == "fixed"
        config = replace(self.config, mode="eye_to_hand" if fixed else "eye_in_hand")
        views: list[BoardView] = []
        for k in ks:
            s = self.sightings[k]
            joints = self.rig.instants[s.instant].joints
            views.append(
                BoardView(index=k, T_base_ee=self.A[s.instant], detection=s.detection,
                          name=self.told(k), joints=joints)
            )  # fmt: skip
        name = self.rig.cameras[c].name
        try:
            found = screen(views, self.rig.boards[b].target, self.lenses[c], config, self.arm)
        except DegenerateError as error:
            self.refusals.append(f"Camera '{name}': {error}")
            return None
        except InputError as error:
            raise type(error)(f"camera '{name}': {error}") from error
        self.screened |= found.rejected
        self.checks += [(c, check) for check in found.checks]
        for candidate in found.candidates:
            k = candidate.view.index
            if candidate.view.detection is not self.sightings[k].detection:
                self.sightings[k] = replace(self.sightings[k], detection=candidate.view.detection)
                self.C[k] = candidate.pose.T_cam_board
        return found.start

    # --- what follows -----------------------------------------------------------------------

    def spread(self) -> None:
        """Place every camera and board by those that are known.

        Raises:
            InputError: nothing ties a camera or a board to the others.
        """
        while True:
            votes: dict[tuple[str, int, int], list[Array]] = {}
            for k in self.C:
                if k not in self.screened:
                    self._vote(k, votes)
            if not votes:
                break
            (kind, a, b), best = max(votes.items(), key=lambda item: (len(item[1]), item[0][0]))
            T = central_pose(best)
            if kind == "camera":
                self.X[a] = T
            elif kind == "board":
                self.Z[a] = T
            elif kind == "loose":
                self.loose[a, b] = T
            else:
                self.A[b] = T
        for c, camera in enumerate(self.rig.cameras):
            if c not in self.X:
                raise InputError(self._untied("camera", camera.name))
        for b, board in enumerate(self.rig.boards):
            if board.place != "free" and b not in self.Z:
                raise InputError(self._untied("board", board.name))

    def _untied(self, what: str, name: str) -> str:
        seen = sorted(self.rig.cameras[c].name for c in self.X)
        return (
            f"cameras: nothing ties {what} '{name}' to the robot or to the other cameras (placed: "
            f"{', '.join(seen)}). Show the same board to it and to one of them at the same "
            "instant, or let the arm carry a board in its view."
        )

    def _vote(self, k: int, votes: dict[tuple[str, int, int], list[Array]]) -> None:
        """Add what a sighting says of the one thing in it that is not known yet."""
        s, C = self.sightings[k], self.C[k]
        c, b, i = s.camera, s.board, s.instant
        moved = self.rig.moves(c, b)
        A = self.A.get(i) if moved else np.eye(4)
        free = self.rig.boards[b].place == "free"
        Z = self.loose.get((b, i)) if free else self.Z.get(b)
        X = self.X.get(c)
        if [A is None, Z is None, X is None].count(True) != 1:
            return
        # A maps what the hand carries into the base: the camera, or the board.
        carries_camera = moved and self.rig.cameras[c].mount == "hand"
        if X is None:
            assert A is not None and Z is not None
            to = se3.invert(A) @ Z if carries_camera else A @ Z
            votes.setdefault(("camera", c, 0), []).append(to @ se3.invert(C))
        elif Z is None:
            assert A is not None
            place = (A if carries_camera else se3.invert(A)) @ X @ C
            votes.setdefault(("loose", b, i) if free else ("board", b, 0), []).append(place)
        elif carries_camera:
            votes.setdefault(("arm", 0, i), []).append(Z @ se3.invert(X @ C))
        else:
            votes.setdefault(("arm", 0, i), []).append(X @ C @ se3.invert(Z))

    # --- views that do not agree ------------------------------------------------------------

    def px(self, k: int, A: Array | None = None, other: Sighting | None = None) -> float:
        """Return a view's error through what is known [px], or that of another one in its place."""
        s = self.sightings[k]
        seen = (other or s).detection
        moved = self.rig.moves(s.camera, s.board)
        arm = np.eye(4) if not moved else self.A[s.instant] if A is None else A
        free = self.rig.boards[s.board].place == "free"
        Z = self.loose[s.board, s.instant] if free else self.Z[s.board]
        X = self.X[s.camera]
        if moved and self.rig.cameras[s.camera].mount == "hand":
            T = se3.invert(arm @ X) @ Z
        else:
            T = se3.invert(X) @ arm @ Z
        target = self.rig.boards[(other or s).board].target
        error = project(self.lenses[s.camera], se3.transform(T, seen.points(target))) - seen.uv
        worst = float(np.sqrt(np.mean(np.sum(error**2, -1)))) if len(error) else BEHIND_PX
        return worst if np.isfinite(worst) else BEHIND_PX

    def gate(self) -> None:
        """Leave out the views that do not fit; doubt the arm where all views of an instant do."""
        px = {k: self.px(k) for k in self.C}
        groups: dict[tuple[int, int], list[int]] = {}
        for k in self.C:
            groups.setdefault((self.sightings[k].camera, self.sightings[k].board), []).append(k)
        limits: dict[int, float] = {}
        for ks in groups.values():
            usual = float(np.median([px[k] for k in ks]))
            most = MOST_OFF * self.sightings[ks[0]].detection.image_size[0]
            limit = max(PX_RATIO * usual, PX_FLOOR) if usual < most else most
            limits |= dict.fromkeys(ks, limit)
        bad = {k for k in self.C if k in self.screened or px[k] > limits[k]}
        for i in sorted({self.sightings[k].instant for k in bad}):
            here = [k for k in self.C if self.sightings[k].instant == i]
            moved = [k for k in here if self._moved(k)]
            odd = sum(k in bad for k in moved)
            if odd > 1 and 2 * odd > len(moved) and i in self.A:
                agree = self._without_arm(i, moved, limits)
                if agree:
                    bad = (bad | set(moved)) - agree
        for k in sorted(bad):
            limit = limits[k]
            said = self.screened.get(k) or (
                f"its board is {px[k]:.1f} px from where the other views and cameras put it; the "
                f"limit is {limit:.1f} px."
            )
            other = self._exchanged_with(k, sorted(bad), limits)
            if other is not None:
                said = (
                    f"it fits in the place of {self.told(other)}, and that one here: the images of "
                    "the two cameras are exchanged at this instant. Exchange the two files. " + said
                )
            self.rejected[k] = said
            del self.C[k]
        self._require_views_left()

    def _moved(self, k: int) -> bool:
        s = self.sightings[k]
        return self.rig.moves(s.camera, s.board) and self.rig.boards[s.board].place != "free"

    def _without_arm(self, i: int, moved: list[int], limits: dict[int, float]) -> set[int]:
        """Return the views of an instant that agree about an arm pose, which is then not the one
        given; empty where no two do.
        """  # noqa: D205
        best, A_best = set[int](), self.A[i]
        for k in moved:
            votes: dict[tuple[str, int, int], list[Array]] = {}
            given = self.A.pop(i)
            self._vote(k, votes)
            self.A[i] = given
            (A,) = votes["arm", 0, i]
            agree = {m for m in moved if self.px(m, A) <= limits[m]}
            if len(agree) > max(len(best), 1):
                best, A_best = agree, A
        if best:
            self.A[i] = A_best
            self.bad_arm.append(i)
        return best

    def _exchanged_with(self, k: int, bad: list[int], limits: dict[int, float]) -> int | None:
        """Return the view of another camera that was exchanged with this one, None where none."""
        s = self.sightings[k]
        for m in bad:
            o = self.sightings[m]
            same_size = o.detection.image_size == s.detection.image_size
            if o.camera == s.camera or o.instant != s.instant or not same_size:
                continue
            fits = self.px(k, other=o) <= limits[k]
            if fits and self.px(m, other=s) <= limits[m]:
                return m
        return None

    def _require_views_left(self) -> None:
        for c, camera in enumerate(self.rig.cameras):
            if not any(self.sightings[k].camera == c for k in self.C):
                why = next((r for k, r in self.rejected.items() if self.sightings[k].camera == c),
                           "")  # fmt: skip
                raise InputError(
                    f"camera '{camera.name}': none of its views agrees with the other cameras and "
                    f"the robot, with it {MOUNTS[camera.mount]}. {why}"
                )
        for b, board in enumerate(self.rig.boards):
            if not any(self.sightings[k].board == b for k in self.C):
                raise InputError(
                    f"board '{board.name}': no view of it agrees with the others, with it "
                    f"{PLACES[board.place]}. Say where it really is, or leave it out."
                )

    def start(self) -> Start:
        """Return what was found."""
        n = len(self.rig.instants)
        known = np.array([i in self.A and i not in self.bad_arm for i in range(n)])
        known &= np.array([t.T_base_ee is not None for t in self.rig.instants])
        for k in list(self.C):
            s = self.sightings[k]
            free = self.rig.boards[s.board].place == "free"
            if free and self.rig.moves(s.camera, s.board) and not known[s.instant]:
                self.rejected[k] = "neither the arm's pose nor the board's is known."
                del self.C[k]
        taken = sorted(self.C)
        eye = np.eye(4)
        boards = [self.Z.get(b, eye) for b in range(len(self.rig.boards))]
        return Start(
            rig=self.rig.only([self.sightings[k] for k in taken]), taken=taken,
            rejected=self.rejected, X=np.stack([self.X[c] for c in range(len(self.rig.cameras))]),
            Z=np.stack(boards), A=np.stack([self.A.get(i, eye) for i in range(n)]), known=known,
            loose=self.loose, bad_arm=self.bad_arm, checks=self.checks,
        )  # fmt: skip


def central_pose(Ts: Sequence[Array]) -> Array:
    """Return the mean (4, 4) of the half of some poses that lies nearest to their middle one."""
    stack = np.array(Ts)
    if len(stack) == 1:
        return stack[0]
    apart = np.stack([np.linalg.norm(se3.log(se3.invert(T) @ stack), axis=-1) for T in stack])
    middle = apart[int(np.argmin(np.median(apart, axis=1)))]
    near = stack[middle <= np.median(middle)]
    return se3.from_rt(se3.mean_rotation(near[:, :3, :3]), near[:, :3, 3].mean(0))
