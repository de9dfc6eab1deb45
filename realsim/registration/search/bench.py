"""Everything that a search looks at, made once: points, heights, lattices, models."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, SupportPlane
from realsim.registration.body import make_body
from realsim.registration.compare import spread
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.find_table import region_of_interest
from realsim.registration.near_start import perturbed_starts
from realsim.registration.search.candidates import (
    Candidate,
    Fused,
    Sought,
    candidates,
    fuse,
    make_sameness,
)
from realsim.registration.search.height_grid import HeightGrid, height_grid
from realsim.registration.search.matching import match_templates
from realsim.registration.search.near_symmetry import NearSymmetryConfig, near_symmetries
from realsim.registration.search.polish import LATTICE
from realsim.registration.search.records import Region, Wanted
from realsim.registration.search.scoring import Canvas, ScoreConfig, make_canvas, without_far
from realsim.registration.search.templates import ModelTemplates, TemplateConfig, model_templates
from realsim.registration.views import ViewPoints, world_cloud


@dataclass(frozen=True, kw_only=True, slots=True)
class FindConfig:
    """How objects are found."""

    views: int = 40
    """Views whose points are fused, spread over the session: more change the poses by 0.1 mm."""
    far_sigma_m: float = 0.003
    """Depth with a larger 1-sigma is not looked at [m]: far parts of the table rise and sink with
    it, and flat things are found in them."""
    far_ratio: float = 2.5
    """It is looked at where the typical depth's sigma is only so many times smaller."""
    area: float = 1.4
    """Points further than so many times that from there are not looked at: there the table is seen
    at grazing angles only and rises by centimetres with the tilt of the cameras."""
    field_cells: int = 96
    """Cells of a distance field along a model's longest side: thin walls need them."""
    samples: int = 200
    """Surface samples of a model; the search itself needs none."""
    region_slack_m: float = 0.010
    """A fitted pose may leave the region that was given by this [m]."""
    region_slack_deg: float = 10.0
    """The same for its turn [deg]."""
    seed: int = 0
    """Seed of the random turns at clusters."""
    templates: TemplateConfig = field(default_factory=TemplateConfig)
    """How models look from above."""
    near: NearSymmetryConfig = field(default_factory=NearSymmetryConfig)
    """Turns after which a model looks nearly the same."""
    score: ScoreConfig = field(default_factory=ScoreConfig)
    """Render and compare."""


class Stopwatch:
    """CPU seconds of the parts of a search."""

    def __init__(self) -> None:
        """Start."""
        self.seconds: dict[str, float] = {}
        self._since = time.process_time()

    def lap(self, name: str) -> None:
        """Book the CPU time since the last lap under a name."""
        now = time.process_time()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now


@dataclass(frozen=True, eq=False, kw_only=True)
class Bench:
    """What one search works with."""

    config: FindConfig
    plane: SupportPlane
    fused: Fused
    grid: HeightGrid
    canvas: Canvas
    """For the search."""
    close: Canvas
    """Denser and with more frames, for near-symmetric poses."""
    sought: Mapping[int, Sought]
    templates: Mapping[int, ModelTemplates]
    field_folder: Path | None
    """Where what is derived from meshes is kept between runs."""
    looked_at: Region
    """What the views look at: no object is sought beyond it."""
    watch: Stopwatch
    _near: dict[int, Array] = field(default_factory=dict[int, Array])

    def near(self, obj_id: int) -> Array:
        """Return the near-symmetries (N, 4, 4) of a model: only what is found is asked for them."""
        if obj_id not in self._near:
            model = self.sought[obj_id].body.model
            self._near[obj_id] = near_symmetries(model, self.config.near, self.field_folder)
        return self._near[obj_id]


def make_bench(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    views: Sequence[ViewPoints],
    seen: tuple[SupportPlane, DepthNoise],
    models: Mapping[int, ObjectModel],
    config: FindConfig,
    field_folder: Path | None,
    told: Callable[[str], None] | None = None,
) -> Bench:
    """Return all that a search needs; models are prepared once and kept in the folder.

    Args:
        intrinsics: the camera.
        frames: depth images to render into; only some are looked at.
        views: thinned points of all views.
        seen: the table and the depth noise.
        models: those that may be there.
        config: settings.
        field_folder: where what is derived from meshes is kept between runs; None = in memory.
        told: called with words for what is being done.

    Raises:
        InputError: there are no frames or no views.
    """
    if len(frames) == 0 or len(views) == 0:
        raise InputError(
            f"{len(frames)} depth frames and {len(views)} views were given; a search needs both."
        )
    plane, noise = seen
    watch = Stopwatch()
    sought: dict[int, Sought] = {}
    templates: dict[int, ModelTemplates] = {}
    for n, (obj_id, model) in enumerate(sorted(models.items())):
        if told is not None:
            told(f"preparing model {n + 1} of {len(models)}: {model.name}")
        start = ObjectPose(obj_id=obj_id, instance=0, T_world_obj=np.eye(4))
        body = make_body(start, model, config.field_cells, config.samples, field_folder)
        sought[obj_id] = Sought(body=body, sameness=make_sameness(model))
        templates[obj_id] = model_templates(model, config.templates, field_folder)
    watch.lap("models")
    used = [views[int(n)] for n in np.linspace(0, len(views) - 1, min(config.views, len(views)))]
    far = _far(used, noise, config)
    middle, radius = region_of_interest(views, plane)
    used = [_within(v, far, middle, config.area * radius) for v in used]
    fused = fuse(used, noise, plane)
    watch.lap("fuse")
    grid = height_grid(world_cloud(used, noise), plane)
    watch.lap("heights")
    center = fused.coarse.points.mean(0) if len(fused.coarse.points) else plane.T_world_table[:3, 3]
    shown = _shown(frames, views, center, config)
    close = without_far(make_canvas(intrinsics, shown, noise, plane, LATTICE), far)
    shown = shown[: config.score.frames]
    canvas = without_far(make_canvas(intrinsics, shown, noise, plane, config.score), far)
    watch.lap("canvas")
    return Bench(
        config=config, plane=plane, fused=fused, grid=grid, canvas=canvas, close=close,
        sought=sought, templates=templates, field_folder=field_folder, watch=watch,
        looked_at=Region(center_world=middle, radius_m=config.area * radius),
    )  # fmt: skip


def _far(views: Sequence[ViewPoints], noise: DepthNoise, config: FindConfig) -> float:
    """Return the depth [m] beyond which nothing is looked at."""
    z = np.concatenate([v.points[::16, 2] for v in views])
    if len(z) == 0:
        raise InputError("none of the views holds a measured point; is the depth image empty?")
    limit = max(config.far_sigma_m, config.far_ratio * float(np.median(noise.sigma(z))))
    return float(np.sqrt(limit / noise.per_m)) if noise.per_m > 0 else np.inf


def _within(view: ViewPoints, far: float, middle: Array, radius: float) -> ViewPoints:
    """Return a view without the points beyond a depth, and out of a ball about the middle [m]."""
    center = se3.transform(se3.invert(view.T_world_cam), middle[None])[0].astype(np.float32)
    near = np.sum(np.square(view.points - center), axis=1) < radius**2
    keep = near & (view.points[:, 2] < far)
    return replace(view, points=view.points[keep], pixels=view.pixels[keep])


def _shown(
    frames: Sequence[DepthFrame], views: Sequence[ViewPoints], center: Array, config: FindConfig
) -> list[DepthFrame]:
    """Return the frames to render into; those of a lazy sequence that are not used stay unread."""
    count = max(config.score.frames, LATTICE.frames)
    if len(frames) == len(views):
        Ts = np.stack([v.T_world_cam for v in views])
        shown = [frames[n] for n in spread(Ts, center, count)]
        if {f.index for f in shown} <= {v.index for v in views}:
            return shown
    Ts = np.stack([f.T_world_cam for f in frames])
    return [frames[n] for n in spread(Ts, center, count)]


def resting_starts(
    bench: Bench, obj_id: int, region: Region | None, taken: Mask | None = None
) -> list[tuple[Array, str]]:
    """Return where a model may rest on the table: poses (4, 4) and their names."""
    found = match_templates(
        bench.grid, bench.templates[obj_id],
        region=region, plane=bench.plane, taken=taken,
    )  # fmt: skip
    bench.watch.lap("match")
    return [(h.T_world_obj, h.source) for h in found]


def claimed_starts(bench: Bench, wanted: Wanted) -> list[tuple[Array, str]]:
    """Return the pose that someone claims; its neighbours too unless a region is searched."""
    if wanted.T_start is None:
        return []
    pose = ObjectPose(obj_id=wanted.obj_id, instance=0, T_world_obj=wanted.T_start)
    if wanted.region is not None:
        return [(pose.T_world_obj, "start")]
    body = replace(bench.sought[wanted.obj_id].body, start=pose)
    near = perturbed_starts(body, bench.plane.T_world_table[:3, 2])
    return [(T, "start" if n == 0 else f"start, neighbour {n}") for n, T in enumerate(near)]


def fitted_candidates(
    bench: Bench,
    obj_id: int,
    starts: Sequence[tuple[Array, str]],
    region: Region | None,
    left: tuple[Fused, Array32] | None = None,
) -> list[Candidate]:
    """Return the distinct poses that starts lead to, those outside of the region left out.

    Args:
        bench: what the search works with.
        obj_id: the model.
        starts: poses (4, 4) and their names.
        region: where the object may be.
        left: points that sure objects leave over, and the buffer that holds these; None = all
            points and the bare table.
    """
    sought = bench.sought[obj_id]
    fused, buffer = left or (bench.fused, bench.canvas.table)
    found = candidates(sought, fused, bench.canvas, starts, buffer)
    bench.watch.lap("fit and render")
    where = bench.looked_at if region is None else region
    return [c for c in found if within(bench, sought, c.T_world_obj, where)]


def within(bench: Bench, sought: Sought, T_world_obj: Array, region: Region) -> bool:
    """Return whether a fitted pose (4, 4) lies in a region, with some slack."""
    config = bench.config
    off = np.linalg.norm(sought.body.center(T_world_obj) - region.center_world)
    if off > region.radius_m + config.region_slack_m:
        return False
    if region.R_world_obj is None:
        return True
    turn = sought.sameness.angle_deg(region.R_world_obj, T_world_obj[:3, :3])
    return turn <= region.turn_deg + config.region_slack_deg
