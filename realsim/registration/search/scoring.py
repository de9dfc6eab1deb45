"""Render and compare many poses cheaply: a lattice of pixels in a few frames, and z-buffers on it.

A pose is rendered once, by ray casting in the object's frame, and kept as cells of the lattice
with depths. What it gains is then a sum over its cells:
    gain = sum of l(measured, min(z, buffer)) - l(measured, buffer),
    l(m, z) = max(floor, 1 - 2 ((m - z) / tau)^2),
the floor -1 where the camera saw through the surface and -0.3 where something stands in front of
it. The buffer holds the table and the other objects, so occlusion is accounted for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.geometry.mesh import box_corners
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body
from realsim.registration.compare import FRONT_PENALTY, TAU_BIAS_PER_M, TAU_M, TAU_SIGMAS
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.table_planes import table_depth
from realsim.registration.views import SampleConfig, sample_view

FAR = np.float32(1e6)
"""Depth of a buffer's cell in which nothing is rendered [m]."""
BORDER = 1
"""Cells around an object's box that are looked at too."""
NEAREST_M = 1e-3
"""A box that reaches nearer to the camera than this covers the whole image."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreConfig:
    """On which pixels poses are compared."""

    columns: int = 160
    """Pixels of the lattice along a row: every 8th of 1280. A 60-mm object at 35 cm covers 190."""
    frames: int = 12
    """Frames in which poses are rendered, spread in direction."""
    edge_jump_m: float = 0.006
    """Span of depth around a pixel beyond which it is not compared [m]: flying pixels."""
    edge_slope: float = 8.0
    """Plus so many pixel pitches: what a surface seen at 75 degrees spans."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Canvas:
    """The lattice of pixels of all frames, one after the other, and what was measured there."""

    intrinsics: CameraIntrinsics
    Ts_world_cam: Array
    """(F, 4, 4) [m]."""
    stride: int
    """Pixels between the lattice's rows and columns."""
    rays: Array32
    """(h, w, 3) of the lattice's pixels in camera axes, z = 1; NaN = none."""
    measured: Array32
    """(F h w,) depth [m]; 0 = not compared."""
    tau: Array32
    """(F h w,) difference of depth that agrees [m]."""
    table: Array32
    """(F h w,) depth of the table [m]; `FAR` = the ray never meets it."""
    table_likelihood: Array32
    """(F h w,) how well the table explains what was measured: l of the measured point's height over
    it. At a grazing view a camera that is tilted by 0.1 deg moves the table's depth by millimetres,
    but not its height."""
    front_penalty: float
    """Penalty for a pixel with something measured in front."""

    @property
    def cells_per_frame(self) -> int:
        """Cells of one frame."""
        return self.rays.shape[0] * self.rays.shape[1]

    def empty(self) -> Array32:
        """Return a new buffer (F h w,) that holds the table alone."""
        return self.table.copy()


class Render(NamedTuple):
    """Where one pose is seen, were there nothing but the table: only cells that are compared."""

    cells: Int32
    """(N,) cells of the canvas."""
    z: Array32
    """(N,) depth of the surface [m]."""


class Score(NamedTuple):
    """What a rendered pose gains over a buffer, in cells."""

    gain: float
    cells: int
    """Cells in which nothing in the buffer hides it."""
    agree: float
    """Share of these, without those where something measured stands in front, that agree."""

    @property
    def per_cell(self) -> float:
        """Gain per visible cell; 1 at most when nothing was there before."""
        return self.gain / max(self.cells, 1)


def make_canvas(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    noise: DepthNoise,
    plane: SupportPlane,
    config: ScoreConfig,
) -> Canvas:
    """Return the canvas of these frames."""
    stride = max(1, intrinsics.width // config.columns)
    rays = np.ascontiguousarray(ray_table(intrinsics)[::stride, ::stride])
    sampling = SampleConfig(
        stride=stride, edge_jump_m=config.edge_jump_m, edge_slope=config.edge_slope
    )
    flat = rays.reshape(-1, 3)
    measured = np.zeros((len(frames), len(flat)), dtype=np.float32)
    table, height = np.empty_like(measured), np.empty_like(measured)
    for n, frame in enumerate(frames):
        view = sample_view(intrinsics, frame, noise, sampling)
        column, row = view.pixels[:, 0] // stride, view.pixels[:, 1] // stride
        measured[n, row * rays.shape[1] + column] = view.points[:, 2]
        depth = table_depth(plane, frame.T_world_cam, np.nan_to_num(flat))
        table[n] = np.minimum(depth, FAR)
        camera = se3.invert(plane.T_world_table)[2] @ frame.T_world_cam[:, 3]
        # The height falls from the camera's to 0 along the ray, in proportion to depth.
        height[n] = np.where(table[n] < FAR, camera * (1.0 - measured[n] / table[n]), 0.0)
    z = measured.ravel().astype(np.float64)
    tau = TAU_M + TAU_SIGMAS * noise.sigma(z) + TAU_BIAS_PER_M * np.square(z)
    floor = np.where(height.ravel() > 0, -FRONT_PENALTY, -1.0)
    of_table = np.maximum(1.0 - 2.0 * np.square(height.ravel() / tau), floor)
    return Canvas(
        intrinsics=intrinsics,
        Ts_world_cam=np.stack([f.T_world_cam for f in frames]),
        stride=stride,
        rays=rays,
        measured=measured.ravel(),
        tau=tau.astype(np.float32),
        table=table.ravel(),
        table_likelihood=np.where(table.ravel() < FAR, of_table, 0.0).astype(np.float32),
        front_penalty=FRONT_PENALTY,
    )


def without_far(canvas: Canvas, far_m: float) -> Canvas:
    """Return the canvas with nothing compared beyond a depth."""
    near = np.where(canvas.measured < far_m, canvas.measured, np.float32(0))
    return replace(canvas, measured=near)


def first_frames(canvas: Canvas, count: int) -> Canvas:
    """Return the canvas of its first frames only."""
    n = min(count, len(canvas.Ts_world_cam)) * canvas.cells_per_frame
    return replace(
        canvas,
        Ts_world_cam=canvas.Ts_world_cam[:count],
        measured=canvas.measured[:n],
        tau=canvas.tau[:n],
        table=canvas.table[:n],
        table_likelihood=canvas.table_likelihood[:n],
    )


def render(canvas: Canvas, body: Body, T_world_obj: Array) -> Render:
    """Return where the body would be seen at a pose, by ray casting its box in every frame."""
    from realsim.interop import import_open3d

    o3d = import_open3d()
    T_obj_world = se3.invert(T_world_obj)
    Ts_obj_cam = np.ascontiguousarray(T_obj_world @ canvas.Ts_world_cam)
    boxes = _boxes(canvas, body, Ts_obj_cam)
    rays, cells = _box_rays(boxes, canvas.rays, Ts_obj_cam, canvas.measured)
    if len(cells) == 0:
        return Render(cells, np.zeros(0, dtype=np.float32))
    t = body.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    seen = t < canvas.table[cells]
    return Render(cells[seen], t[seen])


def score(canvas: Canvas, rendered: Render, buffer: Array32) -> Score:
    """Return what a rendered pose gains over a buffer that does not hold it."""
    gain, cells, agree, behind = _gain(
        rendered.cells, rendered.z, buffer, _known(canvas), canvas.front_penalty
    )
    return Score(gain=gain, cells=cells, agree=agree / max(behind, 1))


def compose(buffer: Array32, rendered: Sequence[Render]) -> Array32:
    """Return a new buffer with these poses in it, the nearest surface in front."""
    out = buffer.copy()
    for r in rendered:
        out[r.cells] = np.minimum(out[r.cells], r.z)
    return out


def likelihoods(canvas: Canvas, buffer: Array32, cells: Int32) -> Array:
    """Return l (N,) of the buffer at cells (N,); 0 where nothing is rendered or compared."""
    return _likelihoods(cells, buffer, _known(canvas), canvas.front_penalty)


def _known(canvas: Canvas) -> tuple[Array32, Array32, Array32, Array32]:
    """Return what is known of the cells, as the kernels take it."""
    return canvas.measured, canvas.tau, canvas.table, canvas.table_likelihood


def _boxes(canvas: Canvas, body: Body, Ts_obj_cam: Array) -> Int64:
    """Return the lattice boxes (F, 4) top, bottom, left, right (exclusive) that hold the body."""
    corners = se3.transform(se3.invert(Ts_obj_cam), box_corners(*body.bounds_obj))  # (F, 8, 3)
    uv = project(canvas.intrinsics, corners) / canvas.stride
    height, width = canvas.rays.shape[:2]
    nearest, farthest = corners[..., 2].min(1), corners[..., 2].max(1)
    uv = np.where((nearest > NEAREST_M)[:, None, None], uv, 0.0)
    low_uv = np.floor(uv.min(1)).astype(np.int64) - BORDER
    high_uv = np.ceil(uv.max(1)).astype(np.int64) + BORDER + 1
    boxes = np.stack([
        np.clip(low_uv[:, 1], 0, height), np.clip(high_uv[:, 1], 0, height),
        np.clip(low_uv[:, 0], 0, width), np.clip(high_uv[:, 0], 0, width),
    ], axis=-1)  # fmt: skip
    boxes[nearest <= NEAREST_M] = [0, height, 0, width]
    boxes[farthest <= 0] = 0
    return boxes


@njit
def _box_rays(
    boxes: Int64, table: Array32, Ts_obj_cam: Array, measured: Array32
) -> tuple[Array32, Int32]:
    """Return rays (N, 6) in the object's frame, and their cells, of the boxes' compared cells."""
    height, width = table.shape[:2]
    most = 0
    for f in range(len(boxes)):
        most += max(0, boxes[f, 1] - boxes[f, 0]) * max(0, boxes[f, 3] - boxes[f, 2])
    rays, cells = np.empty((most, 6), np.float32), np.empty(most, np.int32)
    n = 0
    for f in range(len(boxes)):
        T = Ts_obj_cam[f]
        for i in range(boxes[f, 0], boxes[f, 1]):
            for j in range(boxes[f, 2], boxes[f, 3]):
                cell = (f * height + i) * width + j
                if measured[cell] <= 0.0:
                    continue
                x, y = table[i, j, 0], table[i, j, 1]
                for a in range(3):
                    rays[n, a] = T[a, 3]
                    rays[n, 3 + a] = T[a, 0] * x + T[a, 1] * y + T[a, 2]
                cells[n] = cell
                n += 1
    return rays[:n].copy(), cells[:n].copy()


@njit(inline="always")
def _likelihood(m: float, z: float, tau: float, front: float) -> float:
    """Return l of one pixel; 0 if nothing is rendered there."""
    if z >= 0.1 * FAR:
        return 0.0
    d = (m - z) / tau
    return max(1.0 - 2.0 * d * d, -front if d < 0.0 else -1.0)


@njit
def _likelihoods(
    cells: Int32, buffer: Array32, known: tuple[Array32, Array32, Array32, Array32], front: float
) -> Array:
    """Return l (N,) of the buffer at cells."""
    measured, tau, table, table_likelihood = known
    out = np.zeros(len(cells))
    for n in range(len(cells)):
        c = cells[n]
        if measured[c] > 0.0:
            of_table = table_likelihood[c]
            on_table = buffer[c] == table[c]
            z, m, t = float(buffer[c]), float(measured[c]), float(tau[c])
            out[n] = of_table if on_table else _likelihood(m, z, t, front)
    return out


@njit
def _gain(
    cells: Int32,
    z: Array32,
    buffer: Array32,
    known: tuple[Array32, Array32, Array32, Array32],
    front: float,
) -> tuple[float, int, int, int]:
    """Return gain, visible cells, cells that agree, and cells with nothing measured in front."""
    measured, tau, table, table_likelihood = known
    gain, visible, agree, behind = 0.0, 0, 0, 0
    for n in range(len(cells)):
        c = cells[n]
        if z[n] >= buffer[c]:
            continue
        m, t = float(measured[c]), float(tau[c])
        gain += _likelihood(m, float(z[n]), t, front)
        if buffer[c] == table[c]:
            gain -= float(table_likelihood[c])
        else:
            gain -= _likelihood(m, float(buffer[c]), t, front)
        visible += 1
        if m >= z[n] - t:
            behind += 1
            agree += m <= z[n] + t
    return gain, visible, agree, behind
