"""A campaign of generated scenes from one file to an exported data set, and what a large one costs.

scenes      scenes_done       scenes that went through all stages, of 20 (--quick: 2 small ones)
            manual_steps      commands that somebody had to type beside `realsim pipeline`
            memory_growth     of the pipeline's own processes, last quarter of the scenes over the
                              second [share]
            objects_right_share  of all objects, placed within 3 mm (MSSD) of where the simulator
                              left them, whatever the verdict
            wrong_accepted    accepted and farther off, or accepted and not there
            paper_scene_cpu_s CPU time of one scene at the paper's size, from these rates [s]

  uv run python benchmarks/campaign.py --part scenes [--quick] [--keep FOLDER]

Each scene has 64 views of 848 x 480 pixels and 6 to 10 objects, which are found (`--find-all`), not
given. The notes hold the cost of the paper's data set (1,135 scenes, 256 views, 2.3 million grasps)
on 1, 10 and 100 machines of eight cores.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from figures import Figure, Found, Goal

FIGURES = {
    "scenes_done": Figure(unit="", goal=Goal(low=20, high=20)),
    "manual_steps": Figure(unit="", goal=Goal(low=0, high=0)),
    "memory_growth": Figure(unit="", goal=Goal(high=0.05)),
    "objects_right_share": Figure(unit=""),
    "wrong_accepted": Figure(unit=""),
    "paper_scene_cpu_s": Figure(unit="s"),
}
RIGHT_MM = 3.0
FILE = """[campaign]
out = "out"
stages = ["register", "school", "annotate", "export", "stats"]
[generate]
scenes = {scenes}
views = {views}
objects = "{objects}"
size = "{size}"
range = "d405"
seed = {seed}
no-maps = true
[register]
find-all = true
[school.run]
grasps = {grasps}
[export]
to = "bop"
"""
FULL: dict[str, Any] = {
    "scenes": 20, "views": 64, "objects": "6-10", "size": "848x480", "grasps": 25,
}  # fmt: skip
QUICK: dict[str, Any] = {
    "scenes": 2, "views": 4, "objects": "2-3", "size": "424x240", "grasps": 4,
}  # fmt: skip
PAPER_SCENES, PAPER_VIEWS, PAPER_GRASPS = 1135, 256, 2.3e6
CORES, NETWORK_BYTES_S, DISK_BYTES_S = 8, 110e6, 400e6
"""Cores of a machine, a gigabit network, one writer's disk."""
PER_VIEW, PER_GRASP = ("generate", "register", "annotate", "export"), ("school",)


def scenes(args: argparse.Namespace) -> Found:
    """Run a campaign and return what became of it."""
    found = Found()
    size = QUICK if args.quick else FULL
    count, views = size["scenes"], size["views"]
    with tempfile.TemporaryDirectory(prefix="campaign_scenes_") as place:
        folder = Path(args.keep or place)
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "campaign.toml"
        file.write_text(FILE.format(seed=args.seed, **size))
        code, memory = run_watched(file, folder / "out" / "records")
        told = json.loads((folder / "out/campaign.json").read_text())
        written = sum(p.stat().st_size for p in (folder / "out/scenes").rglob("*") if p.is_file())
        tried = tried_grasps(folder / "out/scenes")
        placed = [objects_right(scene) for scene in sorted((folder / "out/scenes").glob("scene_*"))]
    found.add("scenes_done", told["done"], f"{count} scenes, exit code {code}")
    found.add("manual_steps", 0 if told["done"] == count and not told["failed"] else 1)
    if len(memory) > 3 * count:
        found.add("memory_growth", growth(memory, count), f"{len(memory)} looks")
    right, there, wrong = np.sum(placed, axis=0)
    found.add("objects_right_share", right / there, f"{right} of {there}")
    found.add("wrong_accepted", wrong)
    rates = Rates.of(told, count, views, tried, written)
    found.add("paper_scene_cpu_s", rates.scene_cpu_s(PAPER_VIEWS, PAPER_GRASPS / PAPER_SCENES))
    found.notes += [f"{name}: {why}" for name, why in told["failed"].items()]
    found.notes += [str(rates), *(rates.cost(machines) for machines in (1, 10, 100))]
    return found


def objects_right(scene: Path) -> tuple[int, int, int]:
    """Return the objects of a scene that are right, all there are, and the wrong accepted ones."""
    from realsim.app.stages import session_models
    from realsim.geometry.metrics import mssd_symmetric
    from realsim.store import SessionStore

    models = session_models(SessionStore.open(scene))
    ids = {m.name: i for i, m in models.items()}
    laid = json.loads((scene / "synthetic/scene.json").read_text())["provenance"]["layout"]
    left = [(ids[o["name"]], np.array(o["T_table_obj"])) for o in laid["objects"]]
    count, right, wrong = len(left), 0, 0
    for o in json.loads((scene / "registration/scene.json").read_text())["objects"]:
        off = [
            1e3 * mssd_symmetric(T, np.array(o["T_world_obj"]), models[i])
            if i == o["obj_id"] else np.inf
            for i, T in left
        ]  # fmt: skip
        if min(off, default=np.inf) <= RIGHT_MM:
            right += 1
            left.pop(int(np.argmin(off)))
        else:
            wrong += o["verdict"] == "accepted"
    return right, count, wrong


def run_watched(file: Path, records: Path) -> tuple[int, list[tuple[int, float]]]:
    """Run a campaign; return its exit code, and (scenes done, memory [MB]) as it went."""
    line = "from realsim.app.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", line, "pipeline", str(file), "--quiet"])
    seen: list[tuple[int, float]] = []
    while process.poll() is None:
        time.sleep(0.5)
        own = [process.pid, *(pid for pid in children(process.pid) if is_worker(pid))]
        seen.append((len(list(records.glob("*.json"))), sum(memory_mb(pid) for pid in own)))
    return process.returncode, seen


def children(pid: int) -> list[int]:
    """Return the processes that a process started."""
    try:
        return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def is_worker(pid: int) -> bool:
    """Return whether a process is one of a pool, no command."""
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process [MB], 0 where it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def growth(memory: list[tuple[int, float]], count: int) -> float:
    """Return the growth of memory from the second to the last quarter of the scenes [share]."""
    done = np.array([k for k, _ in memory])
    mb = np.array([m for _, m in memory])
    second = mb[(done >= count // 4) & (done < count // 2)]
    last = mb[(done >= 3 * count // 4) & (done < count)]
    return float(np.median(last) / np.median(second) - 1.0)


def tried_grasps(folder: Path) -> int:
    """Return the number of grasps that were tried in all scenes."""
    files = folder.glob("scene_*/grasps/*.npz")
    return sum(len(np.load(f)["Ts_obj_grasp"]) for f in files if "Ts_obj_grasp" in np.load(f).files)


@dataclass(frozen=True, kw_only=True, slots=True)
class Rates:
    """What a scene costs."""

    view_cpu_s: float
    """CPU time of one view in all stages but the School [s]."""
    grasp_cpu_s: float
    """CPU time of the School for one grasp [s]."""
    view_bytes: float

    @classmethod
    def of(cls, told: dict[str, Any], scenes: int, views: int, grasps: int, size: int) -> "Rates":
        """Return the rates of a campaign."""
        ends = [e for scene in told["commands"].values() for e in scene] + told["of_all"]
        cpu = {name: sum(e["cpu_s"] for e in ends if e["stage"] == name)
               for name in (*PER_VIEW, *PER_GRASP)}  # fmt: skip
        return cls(
            view_cpu_s=sum(cpu[name] for name in PER_VIEW) / (scenes * views),
            grasp_cpu_s=sum(cpu[name] for name in PER_GRASP) / max(grasps, 1),
            view_bytes=size / (scenes * views),
        )

    def scene_cpu_s(self, views: float, grasps: float) -> float:
        """Return the CPU time of a scene [s]."""
        return views * self.view_cpu_s + grasps * self.grasp_cpu_s

    def cost(self, machines: int) -> str:
        """Return what the paper's data set takes on so many machines, in words."""
        cpu = PAPER_SCENES * self.scene_cpu_s(PAPER_VIEWS, PAPER_GRASPS / PAPER_SCENES)
        size = PAPER_SCENES * PAPER_VIEWS * self.view_bytes
        work = cpu / (machines * CORES)
        network = 0.0 if machines == 1 else 2 * size / NETWORK_BYTES_S
        disk = 2 * size / DISK_BYTES_S
        names = {"cores": work, "network": network, "disk": disk}
        slowest = max(names, key=lambda name: names[name])
        return (
            f"{machines} machines of {CORES} cores: cores {work / 3600:.2f} h, network "
            f"{network / 3600:.2f} h, the writer's disk {disk / 3600:.2f} h of {size / 1e9:.0f} "
            f"GB; bound by: {slowest}"
        )

    def __str__(self) -> str:
        return (
            f"a view {self.view_cpu_s:.3f} CPU s and {self.view_bytes / 1e3:.0f} kB, a grasp "
            f"{self.grasp_cpu_s:.3f} CPU s"
        )


def keep(parser: argparse.ArgumentParser) -> None:
    """Add the option of this benchmark."""
    parser.add_argument("--keep", default="", help="folder that keeps the campaign")
