"""Captures killed at random moments, and on a full disk: is anything that was sealed ever lost?

A child process captures a small session in the simulated lab (the real pipeline, 320x180) and is
killed with SIGKILL at a moment drawn evenly over its running time, start included; then the same
command runs again. What the parent saw sealed (a whole line in robot.jsonl) must be there for ever
after, bit for bit. Another child writes to a small file system of its own that fills up at random
places (root, Linux); room is made, and it goes on.
"""

import argparse
import hashlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from figures import Found

VIEWS, WIDTH, HEIGHT = 24, 320, 180
SEED = 4
FULL_EXIT = 3
"""What the child ends with when it was told that the disk is full."""
DISK_MB = 8
TIMEOUT_S = 300.0


def child(folder: Path) -> None:
    """Capture the plan beside the session, or go on with it."""
    from realsim.records import CaptureSession
    from realsim.store import SessionStore, StorageError
    from realsim_capture_plans.capturing.capture import capture
    from realsim_capture_plans.lab import LabConfig, SimulatedLab
    from realsim_capture_plans.plan_files.plan_json import load_plan

    plan = load_plan(folder.parent / "plan.json")
    lab = SimulatedLab(LabConfig(seed=SEED, width=WIDTH, height=HEIGHT))
    lab.place_objects()
    try:
        if (folder / "session.json").is_file():
            store = SessionStore.open(folder)
        else:
            session = CaptureSession(
                name="kills", intrinsics=lab.camera.intrinsics, views=(),
                depth_unit_m=lab.camera.depth_unit_m,
            )  # fmt: skip
            store = SessionStore.create(folder, session, {"plan_hash": plan.content_hash})
        capture(plan, lab.arm, lab.camera, store)
        store.close()
    except StorageError as error:
        print(error, file=sys.stderr)
        sys.exit(FULL_EXIT)


def make_plan(folder: Path) -> None:
    """Write the beginning of the shipped plan; every run drives the same."""
    from capture_speed import first_views

    from realsim_capture_plans.plan_files.plan_json import save_plan

    save_plan(first_views(VIEWS), folder / "plan.json")


@dataclass(kw_only=True)
class Sealed:
    """What the parent has seen sealed in the session that is being captured."""

    folder: Path
    lines: dict[int, str] = field(default_factory=dict)
    images: dict[str, str] = field(default_factory=dict)

    def look(self) -> tuple[bool, int]:
        """Compare with what was seen before, remember what is new.

        Returns:
            Whether something sealed is gone or changed, and how many views were in flight.
        """
        from realsim.store.atomic import complete_lines
        from realsim.store.session_check import check_session, is_session

        if not is_session(self.folder):
            return bool(self.lines), 0
        now = {int(json.loads(t)["index"]): t for t in complete_lines(self.folder / "robot.jsonl")}
        lost = any(now.get(k) != line for k, line in self.lines.items())
        for path, digest in self.images.items():
            file = self.folder / path
            lost |= not file.is_file() or _digest(file) != digest
        for k in set(now) - set(self.lines):
            for path in (f"rgb/{k:06d}.png", f"depth/{k:06d}.png"):
                lost |= not (self.folder / path).is_file()
                if (self.folder / path).is_file():
                    self.images[path] = _digest(self.folder / path)
        self.lines = now
        if (self.folder / "session.json").is_file():
            report = check_session(self.folder, decode=True)
            lost |= not report.sound or set(report.views) != set(now)
        in_flight = {p.stem for p in self.folder.glob("[rd]*/*.png")} - {f"{k:06d}" for k in now}
        return lost, len(in_flight)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def start(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, __file__, str(folder)], stderr=subprocess.PIPE)


def finish(folder: Path) -> float:
    """Run the child to its end and return the seconds it took."""
    began = time.monotonic()
    process = start(folder)
    _, said = process.communicate(timeout=TIMEOUT_S)
    if process.returncode != 0:
        raise SystemExit(f"the capture itself failed:\n{said.decode()}")
    return time.monotonic() - began


def run_kills(root: Path, kills: int, rng: np.random.Generator) -> dict[str, float]:
    """Kill captures until enough were killed; a session that is whole gives way to a new one."""
    from realsim.store import SessionStore

    finish(root / "cold")  # compiles and fills caches
    seconds = finish(root / "warm")
    sealed = Sealed(folder=root / "s0")
    done = with_loss = in_flight_max = completed = 0
    while done < kills:
        process = start(sealed.folder)
        try:
            process.wait(timeout=rng.uniform(0.0, seconds))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
        _, said = process.communicate(timeout=TIMEOUT_S)
        if process.returncode not in (0, -signal.SIGKILL):
            raise SystemExit(f"the capture itself failed:\n{said.decode()}")
        killed = process.returncode == -signal.SIGKILL
        lost, in_flight = sealed.look()
        done += killed
        with_loss += killed and lost
        in_flight_max = max(in_flight_max, in_flight)
        print(
            f"{done} of {kills} kills, {with_loss} with loss, {len(sealed.lines)} views sealed",
            file=sys.stderr,
        )
        if len(sealed.lines) == VIEWS:
            faults = SessionStore.open(sealed.folder).verify()  # opening cleans up, loses nothing
            with_loss += bool(faults) or sealed.look()[0]
            completed += 1
            shutil.rmtree(sealed.folder)
            sealed = Sealed(folder=root / f"s{completed}")
    return {
        "kills": done, "kills_with_loss": with_loss, "views_in_flight_lost_max": in_flight_max,
        "sessions_completed": completed, "capture_s": seconds,
    }  # fmt: skip


def run_enospc(root: Path, runs: int, rng: np.random.Generator) -> dict[str, float]:
    """Fill the disk at random places; make room; go on."""
    disk = root / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(disk)]
    if subprocess.run(mount, check=False, capture_output=True).returncode != 0:
        print("a small file system cannot be mounted here: that needs root", file=sys.stderr)
        return {}
    try:
        shutil.copy(root / "plan.json", disk / "plan.json")
        sealed, ballast = Sealed(folder=disk / "s0"), disk / "ballast"
        done = with_loss = sessions = 0
        while done < runs:
            room = int(rng.uniform(2e4, 1.5e6))
            ballast.write_bytes(b"\0" * max(0, shutil.disk_usage(disk).free - room))
            process = start(sealed.folder)
            _, said = process.communicate(timeout=TIMEOUT_S)
            if process.returncode not in (0, FULL_EXIT):
                raise SystemExit(f"a full disk was not told as one:\n{said.decode()}")
            ballast.unlink()
            done += process.returncode == FULL_EXIT
            lost, _ = sealed.look()
            with_loss += lost
            if process.returncode == 0:
                sessions += 1
                shutil.rmtree(sealed.folder)
                sealed = Sealed(folder=disk / f"s{sessions}")
        return {"enospc_runs": done, "enospc_with_loss": with_loss}
    finally:
        subprocess.run(["umount", str(disk)], check=False)


def kills(arguments: argparse.Namespace) -> Found:
    """Kill, fill, compare."""
    count, full = (2, 1) if arguments.quick else (60, 10)
    rng = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        make_plan(root)
        return Found(figures=run_kills(root, count, rng) | run_enospc(root, full, rng))


if __name__ == "__main__":
    child(Path(sys.argv[1]))
