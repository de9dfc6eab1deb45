"""CPU of a view of 1280x720 in the simulated lab, colour and depth stored, rendering taken off.

The frames are those of the lab; planning is not part of it: the views are the shipped plan's.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from figures import Found

from realsim.records import CaptureSession
from realsim.store import SessionStore
from realsim_capture_plans.capturing.capture import CaptureConfig, CaptureJob, capture
from realsim_capture_plans.capturing.contact_sheet import Thumbnails
from realsim_capture_plans.devices.interfaces import Frame
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.plan_files.plan_json import resolve_plan
from realsim_capture_plans.planning.record import CapturePlan

VIEWS = 256
RENDERED = 32
"""Frames that are rendered, each a CPU-second; then they come again in turn."""


class TimedCamera:
    """The lab's camera; keeps what its frames cost, and gives them again after `rendered`."""

    def __init__(self, lab: SimulatedLab, rendered: int) -> None:
        """Take over the camera of a lab."""
        self._camera, self._rendered = lab.camera, rendered
        self._frames: list[Frame] = []
        self._count = 0
        self.cpu_s = 0.0

    def __getattr__(self, name: str) -> Any:
        """Return what the lab's camera says of itself."""
        return getattr(self._camera, name)

    def grab(self) -> Frame:
        """Return a frame with a new time stamp, its cost noted."""
        began = time.process_time()
        if len(self._frames) < self._rendered:
            self._frames.append(self._camera.grab())
        frame = replace(self._frames[self._count % self._rendered], time_s=float(self._count))
        self._count += 1
        self.cpu_s += time.process_time() - began
        return frame


class TimedStore(SessionStore):
    """A session that keeps what storing its views costs."""

    cpu_s = 0.0

    def add_view(self, *args: Any, **kwargs: Any) -> None:
        """Store a view, its cost noted."""
        began = time.process_time()
        super().add_view(*args, **kwargs)
        TimedStore.cpu_s += time.process_time() - began


def first_views(views: int) -> CapturePlan:
    """Return the beginning of the shipped plan."""
    plan = resolve_plan("shipped:ur5_d405_hemisphere_256")
    vias = tuple((k, via) for k, via in plan.vias if k < views)
    return replace(plan, joints=plan.joints[:views], vias=vias, reference_view=0)


def captured(views: int, rendered: int, folder: Path) -> dict[str, float]:
    """Capture once and return the figures."""
    lab = SimulatedLab(LabConfig(seed=0))
    lab.place_objects()
    plan = first_views(views)
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


def speed(arguments: argparse.Namespace) -> Found:
    """Return the figures of one capture."""
    views, rendered = (24, 6) if arguments.quick else (VIEWS, RENDERED)
    with tempfile.TemporaryDirectory() as folder:
        return Found(figures=captured(views, rendered, Path(folder) / "session"))
