"""Benchmark of the capture in the simulated lab: CPU per view beyond rendering.

    uv run python benchmarks/capture_speed.py [--views 256] [--quick] [--json FILE]

Figures (keys of the JSON's "figures"): capture_ms_per_view, CPU of process and threads per view of
1280x720 with colour and depth stored, the camera's own CPU taken off; of which
capture_checks_ms_per_view is everything but `SessionStore.add_view`; capture_wall_ms_per_view,
which includes the wait for a standing arm and the disk; capture_mb_per_view. The arm and the
frames are those of the lab; planning is not part of it: the views are an arc round the objects.
"""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse
import json
import platform
import tempfile
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.geometry import se3
from realsim.records import CameraIntrinsics, CaptureSession
from realsim.store import SessionStore
from realsim_capture_plans.arms.kinematics import UR5
from realsim_capture_plans.capturing.capture import CaptureConfig, CaptureJob, capture
from realsim_capture_plans.capturing.contact_sheet import Thumbnails
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.devices.interfaces import Frame
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.lab.devices import HOME
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

PACKAGES = ("realsim", "numpy", "opencv-python-headless")
RENDERED = 32
"""Frames that are rendered, each a CPU-second; then they come again in turn."""
RADIUS_M = 0.36
"""Camera to the objects [m], the middle of a D405's sweet spot."""
PART_OF_ARC = np.pi
"""Half a turn round the objects, on the arm's side."""


class TimedCamera:
    """The lab's camera; keeps what its frames cost, and gives them again after `rendered`."""

    def __init__(self, lab: SimulatedLab, rendered: int) -> None:
        """Take over the camera of a lab."""
        self._camera = lab.camera
        self._rendered = rendered
        self._frames: list[Frame] = []
        self._count = 0
        self.cpu_s = 0.0

    @property
    def name(self) -> str:
        """The lab camera's."""
        return self._camera.name

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The lab camera's."""
        return self._camera.intrinsics

    @property
    def depth_unit_m(self) -> float:
        """The lab camera's."""
        return self._camera.depth_unit_m

    @property
    def description(self) -> dict[str, Any]:
        """The lab camera's."""
        return self._camera.description

    def grab(self) -> Frame:
        """Return a frame with a new time stamp, its cost noted."""
        began = time.process_time()
        if len(self._frames) < self._rendered:
            self._frames.append(self._camera.grab())
        frame = replace(self._frames[self._count % self._rendered], time_s=float(self._count))
        self._count += 1
        self.cpu_s += time.process_time() - began
        return frame

    def recover(self) -> None:
        """Do nothing: it never stops."""


class TimedStore(SessionStore):
    """A session that keeps what storing its views costs."""

    cpu_s = 0.0

    def add_view(self, *args: Any, **kwargs: Any) -> None:
        """Store a view, its cost noted."""
        began = time.process_time()
        super().add_view(*args, **kwargs)
        TimedStore.cpu_s += time.process_time() - began


def arc_plan(views: int, center: np.ndarray[Any, Any]) -> CapturePlan:
    """Return a plan of views on an arc round the objects, all of one arm branch."""
    config, joints = PlanConfig(), list[np.ndarray[Any, Any]]()
    home = HOME + np.pi * np.eye(6)[0]
    for turn in np.linspace(0.0, PART_OF_ARC, views):
        eye = center + RADIUS_M * np.array([-0.3 * np.sin(turn), 0.3 * np.cos(turn), 0.95])
        z = (center - eye) / np.linalg.norm(center - eye)
        y = UR5.forward(home)[:3, 1]
        x = np.cross(y, z) / np.linalg.norm(np.cross(y, z))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
        q = UR5.inverse(T @ se3.invert(d405_mount().T_ee_cam))
        joints.append(q[np.argmin(np.abs(q - (joints[-1] if joints else home)).max(-1))])
    return CapturePlan(
        kind="hemisphere", chain=UR5, mount=d405_mount(),
        cell=config.work_cell(center, "hemisphere"), home=home, joints=np.stack(joints),
        center_world=center, vias=(), reference_view=views // 2, config=config,
    )  # fmt: skip


def run(views: int, rendered: int, folder: Path) -> dict[str, float]:
    """Capture once and return the figures."""
    lab = SimulatedLab(LabConfig(seed=0))
    lab.place_objects()
    plan = arc_plan(views, lab.scene_center)
    camera = TimedCamera(lab, rendered)
    session = CaptureSession(
        name="benchmark", intrinsics=camera.intrinsics, views=(), depth_unit_m=camera.depth_unit_m
    )
    store = TimedStore.create(folder, session, {"plan_hash": plan.content_hash})
    warm = Thumbnails((160, 90))
    warm.add(0, camera.grab().rgb)  # loads and compiles what the first frame needs
    camera = TimedCamera(lab, rendered)  # the first frame was seen from elsewhere
    TimedStore.cpu_s = 0.0
    cpu, wall = time.process_time(), time.perf_counter()
    job = CaptureJob(on_view=Thumbnails((160, 90)).add)
    summary = capture(plan, lab.arm, camera, store, config=CaptureConfig(), job=job)
    cpu, wall = time.process_time() - cpu - camera.cpu_s, time.perf_counter() - wall
    assert summary.captured == views and store.completed == set(range(views))
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    return {
        "capture_ms_per_view": 1e3 * cpu / views,
        "capture_checks_ms_per_view": 1e3 * (cpu - TimedStore.cpu_s) / views,
        "capture_render_ms_per_view": 1e3 * camera.cpu_s / views,
        "capture_wall_ms_per_view": 1e3 * wall / views,
        "capture_mb_per_view": size / views / 1e6,
        "capture_frames_retaken": float(len(summary.rejected)),
        "capture_views_noted": float(len(summary.noted)),
    }


def main() -> None:
    """Run, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=256)
    parser.add_argument("--quick", action="store_true", help="24 views, 6 rendered")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    views, rendered = (24, 6) if args.quick else (args.views, RENDERED)
    with tempfile.TemporaryDirectory() as folder:
        figures = run(views, rendered, Path(folder) / "session")
    for key, value in figures.items():
        print(f"{key:32} {value:10.3f}")
    if args.json:
        result = {
            "figures": figures,
            "views": views,
            "machine": platform.platform(),
            "versions": {p: version(p) for p in PACKAGES},
        }
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
