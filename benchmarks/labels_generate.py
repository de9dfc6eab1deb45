"""How many frames of generated scenes a CPU hour gives, with every label and a photograph.

Imported by `labels.py`. It runs `realsim generate` as a user does, in processes of its own, and
counts their CPU seconds: dropping, looks, photographs, depth, labels, files.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from figures import Found, children_cpu_s
from labels import PAPER_FRAMES_PER_GPU_H

SIZE = "1280x720"


def generate_cost(seed: int, quick: bool) -> Found:
    """Return frames per CPU hour of `realsim generate` at 1280x720."""
    scenes, views = (1, 2) if quick else (10, int(os.environ.get("LABELS_VIEWS", "256")))
    found = Found()
    with tempfile.TemporaryDirectory(prefix="realsim_generate_") as folder:
        command = [
            str(Path(sys.executable).with_name("realsim")), "generate", f"{folder}/out", "--scenes",
            str(scenes), "--views", str(views), "--size", SIZE, "--seed", str(seed), "--workers",
            "1" if quick else "2", "--quiet", *(("--objects", "4-5") if quick else ()),
        ]  # fmt: skip
        before, start = children_cpu_s(), time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        wall, cpu = time.perf_counter() - start, children_cpu_s() - before
        out = Path(folder) / "out"
        frames = len(list(out.glob("scene_*/rgb/*.png")))
        size = sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
        data = json.loads((out / "dataset.json").read_text())
        objects = [len(s["objects"]) for s in data["scenes"]]
    if frames != scenes * views:
        raise RuntimeError(f"{frames} photographs of {scenes} x {views} were written")
    found.figures["generate_frames_per_cpu_h"] = 3600 * frames / cpu
    found.over["generate_frames_per_cpu_h"] = (
        f"{scenes} scenes x {views} views, {min(objects)} to {max(objects)} objects; {cpu:.0f} CPU "
        f"s, {wall:.0f} s by the clock, {1e-6 * size / frames:.2f} MB a frame, all maps"
    )
    days = 1035 * 256 / (3600 * frames / cpu) / 24 / 2
    found.notes.append(
        f"1,035 scenes x 256 views at {SIZE} would take {days:.1f} days on two cores; the paper's "
        f"rate is {PAPER_FRAMES_PER_GPU_H:.0f} frames per GPU hour, grasps included"
    )
    return found
