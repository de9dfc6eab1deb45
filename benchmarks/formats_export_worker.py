"""One export of many frames in a process of its own, so that its peak of memory is its own.

    python benchmarks/formats_export_worker.py bop|graspnet FRAMES FOLDER

Prints JSON: level_mb (resident after the imports and after a first export of two frames), peak_mb
(the greatest since then), cpu_s, resume_s (going on with the export when all is written but
nothing is closed), and frames. Linux only: the peak is VmHWM, reset through clear_refs.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import blas_threads  # noqa: F401
from formats_scene import LongScene, long_scene

from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene

OBJECTS = 10
GRASPNET_SCENE = 256
"""Frames of a scene of GraspNet-1Billion; an export of more has more scenes."""
Write = Callable[[list[LongScene], ExportFolder], None]


def write_bop(scenes: list[LongScene], export: ExportFolder) -> None:
    """Write everything of a BOP data set but the end."""
    for scene in scenes:
        write_bop_scene(scene, export)
    write_bop_models(scenes[0].models(), export)
    write_bop_root(export, name="long")


def write_graspnet(scenes: list[LongScene], export: ExportFolder) -> None:
    """Write a GraspNet tree."""
    for scene in scenes:
        write_graspnet_scene(scene, export, GraspnetWriteConfig())


WRITERS: dict[str, Write] = {"bop": write_bop, "graspnet": write_graspnet}


def scenes_of(form: str, frames: int, folder: Path) -> list[LongScene]:
    """Return one scene of all frames (BOP), or as many as GraspNet would have."""
    if form == "bop":
        return [long_scene(folder, frames, OBJECTS)]
    counts = [min(GRASPNET_SCENE, frames - k) for k in range(0, frames, GRASPNET_SCENE)]
    return [long_scene(folder, n, OBJECTS, number=k) for k, n in enumerate(counts)]


def memory_mb(key: str) -> float:
    """Return a figure of /proc/self/status: VmRSS (now) or VmHWM (the greatest)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise KeyError(key)


def export(form: str, frames: int, home: Path) -> dict[str, float]:
    """Write an export and return what it cost."""
    write = WRITERS[form]
    first = ExportFolder.begin(home / "first", {})
    write(scenes_of(form, 2, home / "images"), first)
    first.finish({})
    level = memory_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    scenes = scenes_of(form, frames, home / "images")
    start = time.process_time()
    write(scenes, ExportFolder.begin(home / "long", {"frames": frames}))
    written = time.process_time()
    again = ExportFolder.begin(home / "long", {"frames": frames})
    write(scenes, again)
    resumed = time.process_time()
    again.finish({"README.md": b"long\n"})
    return {
        "frames": frames,
        "level_mb": level,
        "peak_mb": memory_mb("VmHWM"),
        "cpu_s": written - start + time.process_time() - resumed,
        "resume_s": resumed - written,
    }


if __name__ == "__main__":
    print(json.dumps(export(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))))
