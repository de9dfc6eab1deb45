"""Simulated depth against a real D405's: noise on flat patches, and holes.

Figures (simulated over real; 1 = alike; the median over frames that the sensor was not fitted to):
  d405_noise_ratio      median rms of small planes fitted to inverse depth, 9, 15 and 25 px wide,
                        on the frame's main plane; the simulation measures the same plane
  d405_holes_ratio      pixels without depth: border, shadows, edges, specks. The scene is the
                        frame's own depth with its holes filled by the farther side; holes wider
                        than any shadow beside them (what is too near, or moves) are not judged
With the seven frames of d405/open the sensor is fitted to FIRST and judged on the rest, and the
other way round. Another folder (--frames) is judged by the shipped profile, as it is.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from figures import Figure, Found, Goal, run

from realsim.app.depth_fit.run import DepthFrames, read_frames
from realsim.arrays import Array32
from realsim.errors import InputError
from realsim.rendering.depth_sensors.edges import FilledView, filled
from realsim.rendering.depth_sensors.fit import fit_depth_model
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.plane import find_plane
from realsim.rendering.depth_sensors.statistics import local_noise

FIGURES = {
    "d405_noise_ratio": Figure(unit="", goal=Goal(low=0.9, high=1.1)),
    "d405_holes_ratio": Figure(unit="", goal=Goal(low=0.85, high=1.15)),
}
FIRST = (0, 3, 6)
"""The frames that the shipped profile is fitted to."""
WINDOWS_PX = (9, 15, 25)
UNIT_M = 1e-4


def depth_d405(arguments: argparse.Namespace) -> Found:
    """Return both ratios over frames that the judging sensor was not fitted to."""
    found = Found()
    given: Path | None = getattr(arguments, "frames", None)
    folder = given or found.real_data("d405", "d405/open")
    if folder is None:
        return found
    frames = read_frames(folder, "", None, UNIT_M, "d405")
    shipped = DepthSensorModel.from_profile("d405")
    count = len(frames.names)
    groups = [(shipped, range(count))]
    if given is None:
        rest = [k for k in range(count) if k not in FIRST]
        groups = [(_fitted(frames, FIRST), rest), (_fitted(frames, rest), FIRST)]
    rows: list[tuple[float, float]] = []
    for model, judged in groups:
        for k in judged:
            rows.append(ratios(frames, k, model, arguments.seed))
            found.notes.append(
                f"{frames.names[k]}: noise {rows[-1][0]:.2f}, holes {rows[-1][1]:.2f}"
            )
    over = f"median of {len(rows)} frames, " + ("shipped profile" if given else "fitted to others")
    noise, holes = np.nanmedian(rows, axis=0)
    found.add("d405_noise_ratio", float(noise), over)
    found.add("d405_holes_ratio", float(holes), over)
    return found


def _fitted(frames: DepthFrames, to: "tuple[int, ...] | list[int]") -> DepthSensorModel:
    depths = [frames.depths_m[k] for k in to]
    return fit_depth_model(depths, frames.intrinsics, "d405", unit_m=frames.unit_m).model


def ratios(frames: DepthFrames, k: int, model: DepthSensorModel, seed: int) -> tuple[float, float]:
    """Return noise and holes of a frame's simulation over the frame's own; NaN without a plane."""
    i, depth = frames.intrinsics, frames.depths_m[k]
    fB = np.float32(i.fx * model.baseline_m)
    scene, seen = simulated(frames, k, model, seed)
    holes = (scene.judged & (seen == 0)).sum() / max(int((scene.judged & scene.hole).sum()), 1)
    try:
        plane = find_plane(depth, i, model.baseline_m, name=frames.names[k])
    except InputError:
        return float("nan"), float(holes)
    flat = np.nan_to_num(np.where(plane.area, fB / plane.disparity, 0))
    bare = replace(model, occlusion=False).measure(flat, i, np.random.default_rng([seed, k]))
    on = plane.mask & (bare > 0)

    def noise(picture: Array32, window_px: int) -> float:
        return local_noise(picture * on, i, model.baseline_m, on, window_px).median_px

    logs = [np.log(noise(bare, w) / noise(depth, w)) for w in WINDOWS_PX]
    return float(np.exp(np.mean(logs))), float(holes)


def simulated(
    frames: DepthFrames, k: int, model: DepthSensorModel, seed: int
) -> tuple[FilledView, Array32]:
    """Return a frame with its holes filled, and what the sensor makes of it (H, W) [m]."""
    scene = filled(frames.depths_m[k], frames.intrinsics, model)
    known = scene.disparity > 0
    fB = np.float32(frames.intrinsics.fx * model.baseline_m)
    exact = np.where(known, fB / np.where(known, scene.disparity, 1), 0)
    return scene, model.measure(exact, frames.intrinsics, np.random.default_rng([seed, k, 1]))


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=Path, help="folder of a D405's 16-bit depth, 640x480")


if __name__ == "__main__":
    run(
        "depth_d405", __doc__, ("numpy", "realsim"), FIGURES, {"d405": depth_d405}, options=_options
    )
