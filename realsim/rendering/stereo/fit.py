"""The stereo simulator's noise and holes from a user's own frames of a plane.

Two knobs are turned until the simulated twins of the frames have the noise and the holes that were
measured: how much light the sensor collects (`full_well`; for stripes `stripe_noise_px`), and below
which texture a match is dropped (`least_texture_snr`; for stripes `least_signal`). Where noise
hardly falls when a projector's dots get brighter, a `noise_floor_px` is the rest. What no setting
reaches is said.

A frame of a plane and its simulated twin: the same plane before the same pixels.

Both are judged by the same figures, so that rounding, the size of the window and the errors that
are slower than noise have the same effect on both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Mask, evenly
from realsim.errors import InputError
from realsim.json_values import json_value
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.autocovariance import without_trend
from realsim.rendering.depth_sensors.plane import PlaneView, find_plane
from realsim.rendering.depth_sensors.profiles import DepthProfile, profile
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.rendering.stereo.camera import StereoCamera
from realsim.rendering.stereo.config import StereoConfig

WINDOW_PX = (288, 216)
"""Width and height of the piece of a frame that is simulated: it holds thousands of independent
places, and a search simulates it dozens of times."""
LEAST_SHARE = 0.25
"""Share of the window that the plane must fill."""
RIM_PX = 12
"""Simulated beyond the window on every side, because matching ends there."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaneFigures:
    """Noise and holes on a plane."""

    sigma_px: float
    """Standard deviation of the fast part of the disparity's residual [px]; NaN = unmeasured."""
    hole_share: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlaneTwin:
    """The window of a frame that is compared, and what is needed to simulate it."""

    name: str
    distance_m: float
    measured: PlaneFigures
    residual: Array32
    """(h, w) measured - plane [px] in the window, NaN where there is none."""
    disparity: Array32
    """(h, w) the plane's, exact [px]."""
    area: Mask
    """(h, w) the plane with its holes."""
    intrinsics: CameraIntrinsics
    """Intrinsics of the window with what lies around it."""
    corner: tuple[int, int]
    """Column and row of the window in that picture."""
    plane: PlacedMesh
    """In camera axes."""

    def simulated(
        self, config: StereoConfig, profile: DepthProfile, unit_m: float, seed: int
    ) -> tuple[PlaneFigures, Array32]:
        """Return the figures of the simulated window and its residual (h, w) [px]."""
        camera = StereoCamera([self.plane], profile, config)
        depth = camera.measure(self.intrinsics, np.eye(4), np.random.default_rng(seed)).depth_m
        column, row = self.corner
        height, width = self.area.shape
        depth = depth[row : row + height, column : column + width]
        if unit_m > 0:
            depth = np.round(depth / np.float32(unit_m)) * np.float32(unit_m)
        fB = np.float32(self.intrinsics.fx * profile.baseline_m)
        known = (depth > 0) & self.area
        found = fB / np.where(known, depth, 1)
        residual = np.where(known, found - self.disparity, np.nan).astype(np.float32)
        return _figures(residual, self.area, self.area & ~known), residual


def plane_twin(
    plane: PlaneView, intrinsics: CameraIntrinsics, baseline_m: float, name: str
) -> PlaneTwin:
    """Return the window of a frame that holds most of its plane, ready to be simulated.

    Args:
        plane: found in the frame.
        intrinsics: of the frame.
        baseline_m: of the sensor [m].
        name: of the frame, for messages.

    Raises:
        InputError: the plane fills too little of every window.
    """
    fB = intrinsics.fx * baseline_m
    band = int(np.ceil(float(np.nanmax(plane.disparity[plane.area]))))
    counted = plane.area & (plane.mask | plane.holes)
    rows, columns = _fullest(counted, band)
    if counted[rows, columns].mean() < LEAST_SHARE:
        raise InputError(
            f"{name}: the plane fills {100 * float(counted[rows, columns].mean()):.0f} % of the "
            f"best window of {WINDOW_PX[0]}x{WINDOW_PX[1]} px; {100 * LEAST_SHARE:.0f} % are "
            "needed to compare holes. Take frames in which the wall or table fills more."
        )
    area = counted[rows, columns]
    left, top = band + 2 * RIM_PX, RIM_PX
    height, width = area.shape
    crop = replace(
        intrinsics, width=width + left + RIM_PX, height=height + 2 * RIM_PX,
        cx=intrinsics.cx - columns.start + left, cy=intrinsics.cy - rows.start + top,
    )  # fmt: skip
    residual = np.where(area, plane.residual[rows, columns], np.nan).astype(np.float32)
    disparity = plane.disparity[rows, columns]
    return PlaneTwin(
        name=name,
        distance_m=fB / float(np.median(disparity[area])),
        measured=_figures(residual, area, plane.holes[rows, columns] & area),
        residual=residual, disparity=np.asarray(disparity, np.float32), area=area,
        intrinsics=crop, corner=(left, top), plane=_placed(plane.normal, crop),
    )  # fmt: skip


def _figures(residual: Array32, area: Mask, holes: Mask) -> PlaneFigures:
    """Return noise and holes of a window (h, w)."""
    measured = np.isfinite(residual)
    share = float(holes.sum()) / max(int(area.sum()), 1)
    if measured.sum() < 0.02 * area.size:
        return PlaneFigures(sigma_px=float("nan"), hole_share=share)
    return PlaneFigures(sigma_px=float(np.nanstd(without_trend(residual)[0])), hole_share=share)


def _fullest(counted: Mask, band: int) -> tuple[slice, slice]:
    """Return rows and columns of the window that holds most counted pixels.

    Left of `band` px the second eye sees nothing: no window begins there if there is room.
    """
    import cv2

    height, width = counted.shape
    w, h = min(WINDOW_PX[0], width), min(WINDOW_PX[1], height)
    share = np.asarray(cv2.blur(counted.astype(np.float32), (w, h), anchor=(0, 0)))
    share = share[: height - h + 1, : width - w + 1].copy()
    first = min(band, share.shape[1] - 1)
    share[:, :first] *= 0.5
    top, left = np.unravel_index(int(np.argmax(share)), share.shape)
    return slice(int(top), int(top) + h), slice(int(left), int(left) + w)


def _placed(normal: Array, i: CameraIntrinsics) -> PlacedMesh:
    """Return the plane n . X = 1 about what a camera sees of its middle, wider than its picture."""
    n = normal / np.linalg.norm(normal)
    ray = np.array([(i.width / 2 - i.cx) / i.fx, (i.height / 2 - i.cy) / i.fy, 1.0])
    middle = ray / float(ray @ normal)
    x = np.cross([0.0, 1.0, 0.0], n)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(n, x), n], 1), middle
    half = 4 * abs(float(middle[2])) * max(i.width / i.fx, i.height / i.fy)
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    paint = Material(base_color=(0.5, 0.5, 0.5), roughness=1.0, name="grey card")
    return PlacedMesh(BACKGROUND, mesh, T, paint)


MOST_TWINS = 5
"""Frames that are simulated: evenly over the measured distances."""
ROUNDS = 5
"""Times that noise and holes are fitted in turn: each changes the other a little."""
NOISE_STEPS, HOLE_STEPS = 2, 7
"""Simulations per round for either."""
SEED = 0
"""The seed of the simulations; those of the result have the next one."""
WELL = (50.0, 1e7)
"""Electrons at white that are tried: a phone's smallest pixel in the dark, and no noise."""
STRIPE_NOISE = (1e-4, 2.0)
THRESHOLD = {"camera": ("least_texture_snr", 12.0), "projector": ("least_signal", 6.0)}
"""What drops pixels, and the greatest value that is tried."""
SEARCHED = {
    "camera": ("full_well", "noise_floor_px", "least_texture_snr"),
    "projector": ("stripe_noise_px", "noise_floor_px", "least_signal"),
}
"""Fields of the configuration that a fit sets, by the second eye."""
APART = 1.3
"""Farthest over nearest plane, from which on the law of noise and distance is checked."""
EXPLAINED = 1.12
"""Light alone explains frames that it leaves within this factor, as a standard deviation."""
HOLE_TOLERANCE = 0.003
"""Difference of the mean share of holes that is none."""
NOISE_FACTOR = 1.2
HOLE_FACTOR, HOLE_SHARE = 1.5, 0.01
"""What counts as met: noise within a factor; holes within a factor, or within a share."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TwinFigures:
    """A frame and what the fitted simulator makes of it."""

    name: str
    distance_m: float
    measured: PlaneFigures
    simulated: PlaneFigures

    @property
    def noise_met(self) -> bool:
        """Whether the noise agrees."""
        ratio = self.simulated.sigma_px / max(self.measured.sigma_px, 1e-9)
        return 1 / NOISE_FACTOR <= ratio <= NOISE_FACTOR

    @property
    def holes_met(self) -> bool:
        """Whether the holes agree."""
        a, b = self.measured.hole_share, self.simulated.hole_share
        return abs(a - b) <= HOLE_SHARE or max(a, b) <= HOLE_FACTOR * min(a, b)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FittedStereo:
    """A fitted stereo simulator, and how well it agrees with the frames."""

    config: StereoConfig
    profile: str
    frames: tuple[TwinFigures, ...]
    twins: tuple[PlaneTwin, ...]
    residuals: tuple[Array32, ...]
    """(h, w) simulated - plane [px] of each twin."""
    notes: tuple[str, ...]
    """What could not be reached or told, in sentences."""

    def document(self) -> dict[str, Any]:
        """Return what `StereoConfig.load` reads, with what is known of the fit."""
        return {
            **self.config.document(),
            "fit": {
                "profile": self.profile,
                "frames": json_value(self.frames),
                "notes": list(self.notes),
            },
        }


def fit_stereo(
    frames: Sequence[ArrayLike],
    intrinsics: CameraIntrinsics,
    profile_: DepthProfile | str,
    *,
    unit_m: float | None = None,
    names: Sequence[str] | None = None,
    tick: Callable[[int, int], None] | None = None,
) -> FittedStereo:
    """Return the stereo simulator whose planes are as noisy and torn as the measured ones.

    Args:
        frames: (H, W) measured depth [m] each, 0 = no measurement.
        intrinsics: the camera of the depth images.
        profile_: the kind of camera.
        unit_m: metres per count of the depth files; None = the profile's.
        names: of the frames, for messages.
        tick: called with (done, total).

    Raises:
        InputError: no frames, sizes or units that do not fit, or a frame without a plane.
    """
    kind = profile(profile_) if isinstance(profile_, str) else profile_
    names = names or [f"frame {k}" for k in range(len(frames))]
    if len(frames) == 0 or len(names) != len(frames):
        raise InputError(
            f"there are {len(frames)} frames and {len(names)} names to fit a stereo simulator to; "
            "one frame or more of a plane are needed, each with its name."
        )
    total = len(frames) + ROUNDS
    twins: list[PlaneTwin] = []
    for k, frame in enumerate(frames):
        plane = find_plane(frame, intrinsics, kind.baseline_m, name=names[k])
        twins.append(plane_twin(plane, intrinsics, kind.baseline_m, names[k]))
        if tick:
            tick(k + 1, total)
    search = _Search(_over_distances(twins), kind, kind.depth_unit_m if unit_m is None else unit_m)
    config = StereoConfig()
    for step in range(ROUNDS):
        config = search.holes_fitted(search.noise_fitted(config))
        if tick:
            tick(len(frames) + step + 1, total)
    results = [t.simulated(config, kind, search.unit_m, SEED + 1) for t in search.twins]
    shown = tuple(
        TwinFigures(name=t.name, distance_m=t.distance_m, measured=t.measured, simulated=r[0])
        for t, r in zip(search.twins, results, strict=True)
    )
    return FittedStereo(
        config=config, profile=kind.name, frames=shown, twins=tuple(search.twins),
        residuals=tuple(r[1] for r in results), notes=tuple(_notes(shown, config, kind)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class _Search:
    """The twins that a configuration is tried on."""

    twins: list[PlaneTwin]
    profile: DepthProfile
    unit_m: float

    def _tried(self, config: StereoConfig) -> list[PlaneFigures]:
        """Return the figures of every twin."""
        return [t.simulated(config, self.profile, self.unit_m, SEED)[0] for t in self.twins]

    def _holes(self, config: StereoConfig) -> float:
        """Return the mean share of holes over the twins."""
        return float(np.mean([f.hole_share for f in self._tried(config)]))

    def noise_fitted(self, config: StereoConfig) -> StereoConfig:
        """Return the configuration with the noise of the frames.

        Photon noise falls with the root of the electrons, so each trial says how many are needed:
        measured^2 = a simulated^2 + floor^2 over all frames, by non-negative least squares.
        """
        real = np.array([t.measured.sigma_px for t in self.twins])
        for _ in range(NOISE_STEPS):
            own = np.array([f.sigma_px for f in self._tried(replace(config, noise_floor_px=0.0))])
            known = np.isfinite(own) & np.isfinite(real) & (own > 0) & (real > 0)
            if not known.any():
                # Everything was lost in noise: more light is the only way back.
                config = replace(config, full_well=min(10 * config.full_well, WELL[1]))
                continue
            growth, floor = _growth_and_floor(own[known], real[known])
            if self.profile.second_eye == "projector":
                size = float(np.clip(config.stripe_noise_px * np.sqrt(growth), *STRIPE_NOISE))
                config = replace(config, stripe_noise_px=size)
            else:
                well = float(np.clip(config.full_well / max(growth, 1e-6), *WELL))
                config = replace(config, full_well=well)
            config = replace(config, noise_floor_px=floor)
        return config

    def holes_fitted(self, config: StereoConfig) -> StereoConfig:
        """Return the configuration that drops as many pixels as the frames lack, by bisection.

        A threshold that the frames do not contradict stays: a plane without holes does not tell how
        dark or blank a thing may be.
        """
        name, high = THRESHOLD[self.profile.second_eye]
        wanted = float(np.mean([t.measured.hole_share for t in self.twins]))
        if abs(self._holes(config) - wanted) <= HOLE_TOLERANCE:
            return config
        low = 0.0
        for _ in range(HOLE_STEPS):
            middle = (low + high) / 2
            if self._holes(replace(config, **{name: middle})) > wanted:
                high = middle
            else:
                low = middle
        return replace(config, **{name: (low + high) / 2})


def _growth_and_floor(own: Array, real: Array) -> tuple[float, float]:
    """Return a and floor of real^2 = a own^2 + floor^2, each frame counting alike.

    A floor is taken only where the light alone does not explain the frames: the two are hard to
    tell apart, and without sensor noise no surface would be too dark or too blank.
    """
    from scipy.optimize import nnls

    ratio = np.log(real / own)
    if len(own) < 2 or float(ratio.std()) < np.log(EXPLAINED):
        return float(np.exp(2 * ratio.mean())), 0.0
    A = np.stack([np.square(own / real), 1 / np.square(real)], 1)
    x, _ = nnls(A, np.ones(len(own)))
    return float(x[0]), float(np.sqrt(x[1]))


def _over_distances(twins: Sequence[PlaneTwin]) -> list[PlaneTwin]:
    """Return at most MOST_TWINS of the twins, from the nearest to the farthest."""
    return evenly(sorted(twins, key=lambda t: t.distance_m), MOST_TWINS)


def _notes(frames: Sequence[TwinFigures], config: StereoConfig, kind: DepthProfile) -> list[str]:
    """Return what the fit could not reach or tell."""
    notes: list[str] = []
    off = [f for f in frames if not f.noise_met]
    if off:
        worst = max(off, key=lambda f: abs(np.log(f.simulated.sigma_px / f.measured.sigma_px)))
        at = "its greatest" if config.full_well == WELL[0] else "its least"
        limit = (
            f" The light stands at the end of its range: this is {at} noise."
            if config.full_well in WELL
            else ""
        )
        notes.append(
            f"the noise cannot be met in {len(off)} of {len(frames)} frames: {worst.name} at "
            f"{worst.distance_m:.2f} m measured {worst.measured.sigma_px:.3f} px, simulated "
            f"{worst.simulated.sigma_px:.3f} px.{limit} The disparity-space model (--simulator "
            "disparity) has no such limit."
        )
    off = [f for f in frames if not f.holes_met]
    if off:
        worst = max(off, key=lambda f: abs(f.simulated.hole_share - f.measured.hole_share))
        notes.append(
            f"the holes cannot be met in {len(off)} of {len(frames)} frames: {worst.name} at "
            f"{worst.distance_m:.2f} m lacks {100 * worst.measured.hole_share:.1f} %, simulated "
            f"{100 * worst.simulated.hole_share:.1f} %. Holes of another cause than too little "
            "texture or light (glare, reflections) are no setting of this simulator."
        )
    z = [f.distance_m for f in frames]
    if max(z) / min(z) < APART:
        notes.append(
            f"the planes lie at {min(z):.2f} to {max(z):.2f} m: how noise changes with distance is "
            f"the simulator's own, not measured; add frames at {1.5 * max(z):.2f} m."
        )
    if kind.second_eye == "camera":
        notes.append(
            "only texture and light together set the noise: texture_contrast keeps its value, and "
            "full_well stands for both."
        )
    return notes
