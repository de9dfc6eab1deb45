"""What the views of a session measured, read once and kept: what corrections are checked against.

A spread of at most 24 views, their depth as the registration took it: bias taken out, cameras
refined, views that took no part left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.errors import InputError, RealsimError
from realsim.records import Scene
from realsim.records.calibration import DepthBias
from realsim.registration.compare import Comparer, make_comparer, spread_frames
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import (
    Cloud,
    DepthFrame,
    LazyFrame,
    measure_noise,
    read_frame,
    seen_cloud,
)
from realsim.registration.intake import sampling
from realsim.registration.views import ViewPoints, sample_view
from realsim.store import SessionStore

REPORT_FILE = "registration/report.json"
MOST_VIEWS = 24
"""Views that are looked at: more of a spread add nothing that a person would see."""
EYE_M = 0.3
"""How far in front of the cameras things are taken to be if no object says [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MeasuredViews:
    """What the chosen views measured."""

    comparer: Comparer
    """On all of them."""
    views: tuple[ViewPoints, ...]
    points: Array32
    """(N, 3) of all views in world [m]."""
    view: Int32
    """(N,) which of the views saw it."""
    sigmas: Array32
    """(N,) 1-sigma [m]."""

    @property
    def stride_px(self) -> int:
        """Every how many pixels one was used."""
        return round(float(np.sqrt(self.views[0].area_px)))

    def cloud(self, index: Int64) -> Cloud:
        """Return some of the points with their directions and sigmas."""
        points = self.points[index].astype(np.float64)
        eyes = np.stack([v.T_world_cam[:3, 3] for v in self.views])
        return seen_cloud(points, eyes[self.view[index]], self.sigmas[index].astype(np.float64))

    def views_with(self, index: Int64) -> list[ViewPoints]:
        """Return the views with only some of the points."""
        ends = np.cumsum([len(v.points) for v in self.views])
        out: list[ViewPoints] = []
        for n, v in enumerate(self.views):
            k = index[self.view[index] == n] - (ends[n] - len(v.points))
            out.append(replace(v, points=v.points[k], pixels=v.pixels[k]))
        return out


def usable_views(store: SessionStore, excluded: Sequence[int] = ()) -> list[int]:
    """Return the views with a camera and depth that the registration used, if it tells.

    Raises:
        InputError: there is none.
    """
    used: set[int] | None = None
    if store.has(REPORT_FILE):
        frames: Any = store.read_json(REPORT_FILE).get("frames")
        used = set(frames) if frames else None
    numbers = [
        v.index
        for v in store.session.views
        if v.T_world_cam is not None
        and v.index not in excluded
        and store.has_depth(v.index)
        and (used is None or v.index in used)
    ]
    if not numbers:
        raise InputError(
            f"no view of session '{store.session.name}' has both a camera pose and depth"
            f"{' but for excluded ones' if excluded else ''}; nothing can be snapped to."
        )
    return numbers


def measured_views(
    store: SessionStore,
    numbers: Sequence[int],
    scene: Scene,
    config: RegistrationConfig,
    tick: Callable[[], None],
) -> MeasuredViews:
    """Return what a spread of the views measured.

    Args:
        store: the session.
        numbers: views that may be looked at.
        scene: what they look at.
        config: of the registration.
        tick: called after each view.
    """
    bias = depth_bias_of(store)
    lazy = [_frame(store, k, bias) for k in numbers]
    frames = [read_frame(f) for f in spread_frames(lazy, _middle(scene, lazy), MOST_VIEWS)]
    noise = measure_noise(frames, config.evidence)
    intrinsics = store.session.intrinsics
    sample = sampling(intrinsics, len(frames), config)
    views: list[ViewPoints] = []
    for frame in frames:
        views.append(sample_view(intrinsics, frame, noise, sample))
        tick()
    counts = [len(v.points) for v in views]
    return MeasuredViews(
        comparer=make_comparer(intrinsics, frames, noise, scene.plane),
        views=tuple(views),
        points=np.concatenate([v.world().astype(np.float32) for v in views]),
        view=np.repeat(np.arange(len(views), dtype=np.int32), counts),
        sigmas=np.concatenate([noise.sigma(v.points[:, 2]) for v in views]).astype(np.float32),
    )


def _frame(store: SessionStore, index: int, bias: DepthBias) -> DepthFrame:
    """Return one view's frame, its image read when asked."""
    T = store.session.view(index).T_world_cam
    assert T is not None, "only views with a camera are asked for"
    return LazyFrame(index, T, lambda: bias.corrected(store.depth_m(index)).astype(np.float32))


def _middle(scene: Scene, frames: Sequence[DepthFrame]) -> Array:
    """Return what the cameras look at (3,) [m]: the objects, or what is in front of them."""
    if scene.objects:
        return np.mean([o.T_world_obj[:3, 3] for o in scene.objects], axis=0)
    return np.mean([f.T_world_cam[:3, 3] + EYE_M * f.T_world_cam[:3, 2] for f in frames], axis=0)


def depth_bias_of(store: SessionStore) -> DepthBias:
    """Return the depth's bias as the registration took it out: the calibration's and its own.

    A session that was not registered, or whose report does not tell, has none.
    """
    if not store.has(REPORT_FILE):
        return DepthBias.none()
    report: Any = store.read_json(REPORT_FILE)
    try:
        first: Any = report.get("asked", {}).get("depth_bias_taken_out", {})
        then: Any = report.get("refinement", {})
        s1, o1 = float(first.get("scale", 1.0)), float(first.get("offset_per_m", 0.0))
        s2, o2 = float(then.get("depth_scale", 1.0)), float(then.get("depth_offset_per_m", 0.0))
        # 1 / z2 = s2 (s1 / z + o1) + o2
        return DepthBias(scale=s1 * s2, offset_per_m=s2 * o1 + o2)
    except (AttributeError, TypeError, ValueError, RealsimError) as error:
        raise InputError(
            f"'{store.folder / REPORT_FILE}' does not tell the depth's bias ({error!r}); register "
            "the session again."
        ) from error
