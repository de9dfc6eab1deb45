"""OpenCV's seven hand-eye closed forms on the folds of another program: the referee.

    uv run --no-project --isolated --with "opencv-python-headless<5" --with numpy \
        python calibration_referee.py IN.npz OUT.json

OpenCV 5 has no calibrateHandEye, hence an environment of its own; nothing of realsim is used. Per
fold: lens by calibrateCamera on the training views, board poses by solvePnP, X (and Z, by
averaging where the method gives none), then every test view's points through its robot pose; all
with each of the usual lenses, so that whoever asks may choose the best afterwards. The pose-only
set is left out one by one. Input, per set S: S_A (n, 4, 4), S_points (m, 3), S_ids and S_uv of all
views one after the other, S_start (n + 1,), S_size (2,), S_folds (seeds, n); and poses_A, poses_C
(n, 4, 4). Output: {"px": {S: {"method, lens": [px per seed]}}, "poses_mm": {method: [mm per
view]}}.
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
cv: Any = cv2
HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
ROBOT_WORLD = ("SHAH", "LI")
LENSES = {
    "none": cv.CALIB_ZERO_TANGENT_DIST | cv.CALIB_FIX_K1 | cv.CALIB_FIX_K2 | cv.CALIB_FIX_K3,
    "k1": cv.CALIB_ZERO_TANGENT_DIST | cv.CALIB_FIX_K2 | cv.CALIB_FIX_K3,
    "k1 k2": cv.CALIB_ZERO_TANGENT_DIST | cv.CALIB_FIX_K3,
    "k1 k2 p1 p2": cv.CALIB_FIX_K3,
    "k1 k2 p1 p2 k3": 0,
}
"""Distortion terms, and the flags of calibrateCamera that leave the others out."""
MIN_POINTS = 8
"""Fewest points of a training view, as in the package."""


def rigid(R: Array, t: Array) -> Array:
    """Return (4, 4) of a rotation matrix or vector and a translation."""
    T = np.eye(4)
    R = np.asarray(R, dtype=np.float64)
    T[:3, :3] = R if R.shape == (3, 3) else cv.Rodrigues(R)[0]
    T[:3, 3] = np.ravel(t)
    return T


def inverse_of(T: Array) -> Array:
    """Return the inverse pose."""
    return np.asarray(np.linalg.inv(T), dtype=np.float64)


def mean_pose(Ts: Array) -> Array:
    """Return the chordal mean of rotations and the mean of translations."""
    u, _, v = np.linalg.svd(Ts[:, :3, :3].sum(0))
    return rigid(u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v, Ts[:, :3, 3].mean(0))


def closed_forms(A: Array, C: Array) -> dict[str, tuple[Array, Array] | None]:
    """Return X = T_ee_cam and Z = T_base_board of every method; None where it fails."""
    found: dict[str, tuple[Array, Array] | None] = {}
    inverse = np.linalg.inv(A)
    # The keyword matters: a fifth positional argument is an output, and Tsai runs in silence.
    for name in HAND_EYE:
        try:
            R, t = cv.calibrateHandEye(
                list(A[:, :3, :3]), list(A[:, :3, 3]), list(C[:, :3, :3]), list(C[:, :3, 3]),
                method=getattr(cv, f"CALIB_HAND_EYE_{name}"),
            )  # fmt: skip
            X = rigid(R, t)
            found[name.lower()] = (X, mean_pose(A @ X @ C))
        except (cv.error, np.linalg.LinAlgError):
            found[name.lower()] = None
    for name in ROBOT_WORLD:
        try:
            Rw, tw, Rc, tc = cv.calibrateRobotWorldHandEye(
                list(C[:, :3, :3]), list(C[:, :3, 3]), list(inverse[:, :3, :3]),
                list(inverse[:, :3, 3]), method=getattr(cv, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}"),
            )  # fmt: skip
            found[name.lower()] = (inverse_of(rigid(Rc, tc)), inverse_of(rigid(Rw, tw)))
        except (cv.error, np.linalg.LinAlgError):
            found[name.lower()] = None
    return found


class ImageSet:
    """One set of detected views."""

    def __init__(self, data: Any, name: str) -> None:
        self.A, self.board = data[f"{name}_A"], data[f"{name}_points"]
        start, ids, uv = (data[f"{name}_{k}"] for k in ("start", "ids", "uv"))
        spans = [slice(start[k], start[k + 1]) for k in range(len(self.A))]
        self.points = [np.ascontiguousarray(self.board[ids[s]], dtype=np.float32) for s in spans]
        self.uv = [np.ascontiguousarray(uv[s], dtype=np.float32) for s in spans]
        self.size = tuple(int(v) for v in data[f"{name}_size"])
        self.folds = data[f"{name}_folds"]

    def fold_px(self, train: Any, test: Any) -> dict[str, list[float]]:
        """Return the RMS [px] of every test view for every method with every lens."""
        out: dict[str, list[float]] = {}
        for name, flags in LENSES.items():
            for method, px in self._lens_px(train, test, flags).items():
                out[f"{method}, {name}"] = px
        return out

    def _lens_px(self, train: Any, test: Any, flags: int) -> dict[str, list[float]]:
        """Return every method's RMS [px] of every test view with one lens."""
        train = [k for k in train if len(self.uv[k]) >= MIN_POINTS]
        _, K, lens, _, _ = cv.calibrateCamera(
            [self.points[k] for k in train], [self.uv[k] for k in train], self.size, None, None,
            flags=flags,
        )  # fmt: skip
        poses = [cv.solvePnP(self.points[k], self.uv[k], K, lens)[1:] for k in train]
        C = np.array([rigid(np.ravel(r), t) for r, t in poses])
        out: dict[str, list[float]] = {}
        for name, solution in closed_forms(self.A[train], C).items():
            out[name] = [
                np.inf if solution is None else self._view_px(k, *solution, K, lens) for k in test
            ]
        return out

    def _view_px(self, k: int, X: Array, Z: Array, K: Array, lens: Array) -> float:
        T = np.linalg.inv(self.A[k] @ X) @ Z
        if not np.all(np.isfinite(T)):
            return float("inf")
        points = self.points[k].astype(np.float64)
        uv = cv.projectPoints(points, cv.Rodrigues(T[:3, :3])[0], T[:3, 3], K, lens)[0]
        off = uv.reshape(-1, 2) - self.uv[k]
        return float(np.sqrt(np.mean(np.sum(off**2, -1))))

    def held_out_px(self) -> dict[str, list[float]]:
        """Return every method's held-out RMS [px], one figure per seed of the folds."""
        out: dict[str, list[float]] = {}
        for folds in self.folds:
            px: dict[str, list[float]] = {}
            for fold in np.unique(folds):
                parts = self.fold_px(np.flatnonzero(folds != fold), np.flatnonzero(folds == fold))
                for name, values in parts.items():
                    px.setdefault(name, []).extend(values)
            for name, values in px.items():
                out.setdefault(name, []).append(float(np.sqrt(np.mean(np.square(values)))))
        return out


def left_out_mm(A: Array, C: Array) -> dict[str, list[float]]:
    """Return how far every left-out view sees the board from where the others do [mm]."""
    out: dict[str, list[float]] = {}
    for k in range(len(A)):
        rest = np.arange(len(A)) != k
        for name, solution in closed_forms(A[rest], C[rest]).items():
            off = np.inf
            if solution is not None:
                X, Z = solution
                off = 1e3 * float(np.linalg.norm((A[k] @ X @ C[k])[:3, 3] - Z[:3, 3]))
            out.setdefault(name, []).append(off)
    return out


def main() -> None:
    """Read the sets, write the figures."""
    data = np.load(sys.argv[1])
    names = sorted(k.removesuffix("_folds") for k in data.files if k.endswith("_folds"))
    document: dict[str, Any] = {"opencv": cv.__version__, "px": {}, "poses_mm": {}}
    for name in names:
        document["px"][name] = ImageSet(data, name).held_out_px()
    if "poses_A" in data.files:
        document["poses_mm"] = left_out_mm(data["poses_A"], data["poses_C"])
    Path(sys.argv[2]).write_text(json.dumps(document))


if __name__ == "__main__":
    main()
