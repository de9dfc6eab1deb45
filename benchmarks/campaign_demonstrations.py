"""What demonstrations cost, and whether their words are true.

demonstrations  demo_attempt_cpu_s        CPU time of an attempt at the default settings (320 x 240,
                                          20 steps a second, two cameras), pictures and videos
                                          included, mean over some; the first is not counted: it
                                          prepares the scene
                languages_checked_share   share of pick-and-place episodes whose text agrees with
                                          the final geometry, both read back from the data set:
                                          successes are where the words say, failures are not

    uv run --extra lerobot python benchmarks/campaign_demonstrations.py [--quick]
"""

import argparse
import json
import re
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from figures import Figure, Found, Goal, run

from realsim import interop
from realsim.app.console import Console, Tick
from realsim.app.demonstrations.run import DemonstrationRequest, export_demonstrations
from realsim.app.school.files import stored_grasps
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import run as school
from realsim.arrays import Array
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, CaptureSession, ObjectPose, Scene, SupportPlane
from realsim.store import SessionStore, save_scene

FIGURES = {
    "demo_attempt_cpu_s": Figure(unit="s", goal=Goal(high=5.0)),
    "languages_checked_share": Figure(unit="", goal=Goal(low=1.0, high=1.0)),
}
PLACES = {"cube": (-0.11, -0.02, 0.2), "wedge": (0.11, 0.0, 1.1), "mug": (0.0, 0.13, -0.5)}
"""x, y [m] and turn [rad] of each thing."""
SIDES = {"left": (0, 1), "right": (0, -1), "front": (-1, 0), "behind": (1, 0)}
"""Where words lead, for a robot that looks along x."""
WORDS = (
    (r"left of the (.+?)(,| as|$)", "left"), (r"right of the (.+?)(,| as|$)", "right"),
    (r"in front of the (.+?),", "front"), (r"between the robot and the (.+)$", "front"),
    (r"robot's side of the (.+)$", "front"), (r"behind the (.+?),", "behind"),
    (r"beyond the (.+?) as", "behind"), (r"far side of the (.+)$", "behind"),
)  # fmt: skip


def demonstrations(args: argparse.Namespace) -> Found:
    """Return the cost of an attempt, and the share of true words."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_demonstrations_") as place:
        session = _session(Path(place) / "session", 6 if args.quick else 20)
        quiet = Console(quiet=True)
        limit = 2 if args.quick else 4
        costs = _Costs(quiet=True)
        request = DemonstrationRequest(limit=limit)
        export_demonstrations(session, Path(place) / "grasped", request, costs)
        each = np.diff(costs.ticks)
        found.add("demo_attempt_cpu_s", float(each.mean()), f"{len(each)} attempts after the first")
        out = Path(place) / "placed"
        request = DemonstrationRequest(task="place", fps=10, width=64, height=48)
        export_demonstrations(session, out, request, quiet)
        true = _true_words(out, session)
        note = f"{len(true)} episodes, {sum(s for s, _ in true)} of them successes"
        found.add("languages_checked_share", float(np.mean([s == g for s, g in true])), note)
    return found


class _Costs(Console):
    """Notes the CPU time whenever an episode is done."""

    @contextmanager
    def stage(self, name: str, note: str = "") -> Generator[Tick]:
        """Watch the stage of the episodes."""
        if name == "demonstrations":
            self.ticks: list[float] = []
            yield lambda done, total: self.ticks.append(time.process_time())
        else:
            yield lambda done, total: None


def _session(folder: Path, grasps: int) -> Path:
    """Write a registered session of three things, tried by the School."""
    intrinsics = CameraIntrinsics(width=64, height=48, fx=60, fy=60, cx=31.5, cy=23.5)
    session = CaptureSession(name="three", intrinsics=intrinsics, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(folder, session)
    save_models(folder / "models", {part(n).obj_id: part(n) for n in PLACES})
    objects: list[ObjectPose] = []
    for k, (name, (x, y, turn)) in enumerate(PLACES.items()):
        T = se3.from_rt(se3.exp_so3([0.0, 0.0, turn]), [x, y, -part(name).mesh.bounds[0][2]])
        objects.append(ObjectPose(obj_id=part(name).obj_id, instance=k, T_world_obj=T))
    plane = SupportPlane(T_world_table=np.eye(4))
    save_scene(store, Scene(name="three", objects=tuple(objects), plane=plane))
    request = SchoolRequest(grasps=grasps, engine="mujoco")
    school(folder, None, request, Console(quiet=True))
    return folder


def _true_words(out: Path, session: Path) -> list[tuple[bool, bool]]:
    """Return of each episode whether it says that it succeeded, and whether its words are true."""
    models = stored_grasps(session)[1]
    notes = [json.loads(line) for line in (out / "realsim/episodes.jsonl").read_text().splitlines()]
    rows = [r for f in sorted((out / "meta/episodes").rglob("*.parquet"))
            for r in pq.read_table(f).to_pylist()]  # fmt: skip
    steps = [r for f in sorted((out / "data").rglob("*.parquet"))
             for r in pq.read_table(f, columns=["object_pose"]).to_pylist()]  # fmt: skip
    by_name = {m.name: m for m in models.values()}
    names = list(PLACES)
    result: list[tuple[bool, bool]] = []
    for row, note in zip(rows, notes, strict=True):
        pose = np.array(steps[row["dataset_to_index"] - 1]["object_pose"])
        T = se3.from_rt(interop.R_from_quaternion_xyzw(pose[3:]), pose[:3])
        before = {int(i): np.array(M) for i, M in note["Ts_base_obj"].items()}
        T_base_table = before[0] @ se3.invert(_stood(names[0]))
        corners = {i: se3.transform(se3.invert(T_base_table) @ M, by_name[names[i]].mesh.vertices)
                   for i, M in before.items()}  # fmt: skip
        own = note["instance"]
        T_table = se3.invert(T_base_table) @ T
        corners[own] = se3.transform(T_table, by_name[names[own]].mesh.vertices)
        stands = abs(float(corners[own][:, 2].min())) < 0.004
        upright = (T_table @ se3.invert(_stood(names[own])))[2, 2] > np.cos(np.radians(20.5))
        true = stands and upright and _is_where(row["tasks"][0], own, corners, names)
        result.append((bool(row["success"]), bool(true)))
    return result


def _stood(name: str) -> Array:
    x, y, turn = PLACES[name]
    return se3.from_rt(se3.exp_so3([0, 0, turn]), [x, y, -part(name).mesh.bounds[0][2]])


def _is_where(text: str, own: int, corners: dict[int, Array], names: list[str]) -> bool:
    """Return whether an object is where a text says, seen from a robot that looks along x."""
    middles = {i: (c.min(axis=0) + c.max(axis=0))[:2] / 2 for i, c in corners.items()}
    if names[own].replace("_", " ") not in text:
        return False
    for pattern, side in WORDS:
        match = re.search(pattern, text)
        if match:
            apart = middles[own] - middles[names.index(match[1].replace(" ", "_"))]
            x, y = SIDES[side]
            along, aside = apart @ (x, y), abs(apart[0] * y - apart[1] * x)
            return bool(along > 0 and aside <= along + 1e-6)
    others = np.concatenate([c for i, c in corners.items() if i != own])[:, :2]
    mine = corners[own][:, :2]
    # Of convex things seen from above the vertices bound the distance from above.
    return bool(np.linalg.norm(mine[:, None] - others[None], axis=-1).min() >= 0.04)


if __name__ == "__main__":
    run("campaign_demonstrations", __doc__ or "", ("realsim", "numpy", "mujoco", "pybullet", "av"),
        FIGURES, {"demonstrations": "campaign_demonstrations:demonstrations"})  # fmt: skip
