"""What a registration costs: CPU time and memory of a full session, in processes of their own.

Imported by the registration benchmark; also a program of its own that measures one folder, because
memory is that of a fresh process.

    uv run python benchmarks/registration_cost.py FOLDER
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import blas_threads  # noqa: F401
import numpy as np
from registration_cases import SceneKey, library, make_scene
from registration_figures import Done

from realsim.arrays import Array32
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose
from realsim.registration.body import make_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import DepthFrame, LazyFrame
from realsim.registration.register import register_scene
from realsim.registration.search.near_symmetry import near_symmetries
from realsim.registration.search.records import Wanted
from realsim.registration.search.templates import model_templates
from realsim.registration.simulated import DEPTH_UNIT_M

OBJECTS, VIEWS = 15, 256
PILE_OBJECTS, PILE_VIEWS = 13, 256
QUICK_VIEWS = 16
WARM_VIEWS = 8
"""Views of the first registration of a fresh process, which loads what numba has compiled."""
MB = 1024.0
"""ru_maxrss is in kB."""
PNG_LEVEL = 1


def _image(path: Path) -> Array32:
    """Return a depth image (H, W) [m]."""
    import cv2

    counts: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return counts.astype(np.float32) * np.float32(DEPTH_UNIT_M)


def write_session(folder: Path, key: SceneKey, keep: Path | None) -> None:
    """Write a scene's images and what the lab reports of them."""
    import cv2

    scene = make_scene(key, keep)
    for frame in scene.frames:
        counts = np.round(frame.depth_m / np.float32(DEPTH_UNIT_M)).astype(np.uint16)
        path = str(folder / f"{frame.index:06d}.png")
        cv2.imwrite(path, counts, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    i = scene.intrinsics
    said = {
        "camera": [i.width, i.height, i.fx, i.fy, i.cx, i.cy],
        "cameras": [f.T_world_cam.tolist() for f in scene.frames],
        "wanted": [[p.obj_id, p.instance] for p in scene.truth],
        "keep": None if keep is None else str(keep),
    }
    (folder / "session.json").write_text(json.dumps(said))


def caches(models: dict[int, ObjectModel], folder: Path) -> list[float]:
    """Return the CPU seconds of each mesh: distance field, templates, near-symmetries."""
    config = RegistrationConfig()
    find = config.find
    seconds: list[float] = []
    for obj_id, model in models.items():
        began = time.process_time()
        start = ObjectPose(obj_id=obj_id, instance=0, T_world_obj=np.eye(4))
        make_body(start, model, config.field_cells, config.samples, folder)
        if find.field_cells != config.field_cells:
            make_body(start, model, find.field_cells, find.samples, folder)
        model_templates(model, find.templates, folder)
        near_symmetries(model, find.near, folder)
        seconds.append(time.process_time() - began)
    return seconds


def measure(folder: Path) -> dict[str, Any]:
    """Return CPU time and peak memory of the registration of a written session."""
    said = json.loads((folder / "session.json").read_text())
    width, height, fx, fy, cx, cy = said["camera"]
    camera = CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    frames = [
        LazyFrame(k, np.array(T), partial(_image, folder / f"{k:06d}.png"))
        for k, T in enumerate(said["cameras"])
    ]
    wanted = [Wanted(obj_id=a, instance=b) for a, b in said["wanted"]]
    models = library(None if said["keep"] is None else Path(said["keep"]))
    used = {w.obj_id: models[w.obj_id] for w in wanted}
    config = RegistrationConfig(field_folder=folder / "fields", with_single_view=False)
    few: Sequence[DepthFrame] = frames[:: max(1, len(frames) // WARM_VIEWS)]
    register_scene("warm", camera, few, used, wanted, config)
    began = time.process_time()
    found = register_scene("cost", camera, frames, used, wanted, config)
    seconds = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MB
    return {"cpu_s": seconds, "peak_mb": peak, "objects": len(found.scene.objects),
            "search": found.report.get("search", {})}  # fmt: skip


def _measured(key: SceneKey, keep: Path | None) -> tuple[dict[str, Any], list[float]]:
    """Return what `measure` says in a process of its own, and the seconds of the caches."""
    with tempfile.TemporaryDirectory(dir=keep) as name:
        folder = Path(name)
        write_session(folder, key, keep)
        (folder / "fields").mkdir()
        ids = {i for i, _ in json.loads((folder / "session.json").read_text())["wanted"]}
        models = {i: m for i, m in library(keep).items() if i in ids}
        seconds = caches(models, folder / "fields")
        out = subprocess.run(
            [sys.executable, __file__, name], check=True, stdout=subprocess.PIPE, text=True
        )
        return json.loads(out.stdout.splitlines()[-1]), seconds


def cost(keep: Path | None, quick: bool) -> Done:
    """Return the figures of cost."""
    from registration_jobs import WARM_UP, warm_up

    warm_up(keep)
    table = SceneKey(seed=WARM_UP.seed, views=VIEWS, objects=OBJECTS, full=True)
    heap = replace(table, views=PILE_VIEWS, objects=PILE_OBJECTS, pile=True)
    if quick:
        table, heap = (replace(k, views=QUICK_VIEWS) for k in (table, heap))
    first, cache_s = _measured(table, keep)
    second, _ = _measured(heap, keep)
    figures = {
        "total_cpu_s": first["cpu_s"],
        "peak_mb": max(first["peak_mb"], second["peak_mb"]),
        "pile_cpu_s": second["cpu_s"],
        "mesh_cache_cpu_s": float(np.mean(cache_s)),
        "mesh_cache_cpu_s_max": max(cache_s),
    }
    notes = (
        f"cost: {first['objects']} objects on the table, search {first['search'].get('cpu_s')}",
        f"cost: {second['objects']} objects of the heap, search {second['search'].get('cpu_s')}",
    )
    return Done(figures=figures, notes=notes)


if __name__ == "__main__":
    print(json.dumps(measure(Path(sys.argv[1]))))
