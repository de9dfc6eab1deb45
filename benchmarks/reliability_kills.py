"""Every long command ended at random moments, run again, and held against a run left alone.

A command is forked from a process that has imported all it needs, so that moments fall on its work.
It is killed (SIGKILL), asked to end (SIGTERM) at a moment drawn evenly over its running time, or
gets no room for files beyond a random size (as of a full disk); then the same command runs to its
end in the same folder. Compared is every file and value, as `realsim reproduce` does; fields
in which two runs left alone differ (times) do not count. A capture's log has the events of both
runs: what it says of each view is compared. A view that is taken after a kill has a time of its
own, as the arm comes from elsewhere, and so its line has another checksum.
"""

import argparse
import contextlib
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from importlib import import_module
from pathlib import Path

import numpy as np
from figures import Found
from reliability_log import Log

KILLS, QUICK_KILLS, EACH = 200, 2, 5
FULL = signal.SIGXFSZ
"""Stands for a full disk among the ways to end: the signal of a file that may not grow."""
ROOM_BYTES = (2_000, 100_000)
BOARD, SMALL = "aprilgrid:7x5,tag=30mm,gap=10mm", "--fps 4 --width 64 --height 48 --limit 2"
LONG = {
    "annotate": "annotate session --workers 1",
    "export": "export session --to bop --out bop",
    "report": "report session",
    "stats": "stats session --out stats",
    "import": "import bop imported",
    "generate": "generate made --scenes 1 --views 2 --size 96x64 --objects 2 --workers 1",
    "render": "render session --views 2 --size 96x64 --workers 1",
    "school": "school two --engine mujoco --grasps 2 --workers 1",
    "demonstrations": f"demonstrations two --out demonstrations {SMALL}",
    "register": "register raw --object mug",
    "capture": "capture shots --plan plan.json --simulated --objects 1",
    "plan": "plan --board-views --views 8 --center 0.45,0,0 --out views.json --overwrite",
    "board views": f"capture lab --plan views.json --board {BOARD} --simulated",
    "calibrate": "calibrate lab",
    "upgrade": "upgrade bop --out upgraded --grasps 2 --workers 1",
    "scan": "scan import session/models/obj_000008.ply --unit mm --library models --overwrite",
}
"""In this order: each finds what the ones before it made."""
QUICK = ("export", "stats")
Fields = set[tuple[str, str]]
"""Files and the fields in which they differ."""
TIMES = {(f"{at}/robot.jsonl", f"{k}.{field}") for at in ("shots", "lab/calibration/capture")
         for k in range(8) for field in ("time_s", "sha256")}  # fmt: skip
"""Times of captured views, and the checksums that follow from them."""
TIMED = re.compile(r"(^|\.)(costs\..*|seconds|settle_s|created)$")
"""Fields of times that two runs left alone may share by chance: they are rounded."""


def make_inputs(folder: Path) -> None:
    """Write sessions to begin with, and a plan."""
    sys.path.append(str(Path(__file__).parents[1] / "tests/support"))
    from capture_speed import first_views

    from realsim.records import Scene
    from realsim.store import results
    from realsim_capture_plans.plan_files.plan_json import save_plan
    from registered_sessions import table_session, true_poses
    from school_sessions import registered

    table_session(folder / "raw", 2).close()
    with table_session(folder / "session", 2, (0.0, 0.0)) as store:
        results.save_scene(store, Scene(name="table", objects=tuple(true_poses())))
    registered(folder / "two")
    save_plan(first_views(2), folder / "plan.json")


def run(work: Path, words: str, how: int = 0, much: float = 0.0) -> int:
    """Run a command in a fork of this process; return its exit code (-N: signal N).

    Args:
        work: folder in which it runs.
        words: behind `realsim`.
        how: signal that ends it after `much` seconds; `FULL`: no file is longer than `much` bytes.
        much: time [s] or size [bytes], as `how` says; 0 = it is left alone.
    """
    heard, spoken = os.pipe()  # what is printed needs no room
    pid = os.fork()
    if pid == 0:
        _be_the_command(work, words, int(much) if how == FULL else 0, spoken)
    os.close(spoken)
    if how and how != FULL:
        time.sleep(much)
        os.kill(pid, how)
    with os.fdopen(heard, "rb") as said, (work.parent / "log").open("wb") as log:
        shutil.copyfileobj(said, log)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _be_the_command(work: Path, words: str, room: int, spoken: int) -> None:
    code, before = 70, set(sys.modules)
    try:
        os.chdir(work)
        sys.stdout = sys.stderr = os.fdopen(spoken, "w", buffering=1)
        for stream in (1, 2):
            os.dup2(spoken, stream)
        if room:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
        from realsim.app.cli import main

        sys.argv = ["realsim", *words.split(), "--quiet"]
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()  # as Python would
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        (work.parent / "modules").write_text("\n".join(n for n in sys.modules if n not in before))
        os._exit(code)


def fields(first: Path, second: Path) -> Fields:
    """Return in what two folders differ."""
    from realsim.app.reproduce import compare

    compare.MOST_FIELDS = 10**6
    for log in (*first.rglob("capture_log.jsonl"), *second.rglob("capture_log.jsonl")):
        log.write_text(told_of_views(log.read_text()))
    found = compare.compare_folders(first, second)[1]
    told = {(d.path, w.split(": ")[0] if ": " in w else w[-12:]) for d in found for w in d.words}
    return {(path, field) for path, field in told if not TIMED.search(field)}


def told_of_views(log: str) -> str:
    """Return a capture's log with the last event of every kind and view."""
    entries = [json.loads(line) for line in log.splitlines()]
    last = {(e["event"], e.get("view")): e | {"captured": "by one run"} for e in entries}
    return "\n".join(map(json.dumps, last.values()))


def views(folder: Path) -> set[str]:
    """Return the whole lines of all views that are stored in the sessions of a folder."""
    files = folder.rglob("robot.jsonl")
    return {t for p in files for t in p.read_text().splitlines(keepends=True) if t.endswith("\n")}


class Command:
    """A long command, what it begins with, and what it makes when it is left alone."""

    def __init__(self, root: Path, words: str) -> None:
        """Run it twice from `root/work`, which then holds what it made.

        Raises:
            RuntimeError: it does not end as it should.
        """
        self.words, self.work, self.log = words, root / "work", root / "log"
        self.before, self.after = (Path(tempfile.mkdtemp(dir=root)) / "t" for _ in range(2))
        shutil.copytree(self.work, self.before)
        self.code = run(self.work, words)
        if self.code not in (0, 1):
            raise RuntimeError(f"realsim {words} ended with {self.code}: {self.said()}")
        for name in (root / "modules").read_text().splitlines():
            with contextlib.suppress(Exception):  # some exclude each other
                import_module(name)
        shutil.copytree(self.work, self.after)
        time.sleep(1.0)  # dates are whole seconds, and checksums follow from them
        begin = time.monotonic()
        self.again()
        self.seconds = time.monotonic() - begin
        self.apart = fields(self.after, self.work)
        print(f"{words}: {self.seconds:.1f} s", file=sys.stderr, flush=True)

    def said(self) -> str:
        """Return the end of what it printed."""
        return self.log.read_text(errors="replace")[-600:]

    def again(self, how: int = 0, much: float = 0.0) -> int:
        """Run it on what was before it."""
        shutil.rmtree(self.work)
        shutil.copytree(self.before, self.work)
        return run(self.work, self.words, how, much)

    def ended(self, how: int, much: float) -> tuple[bool, list[str]]:
        """End it and run it again; return whether it was caught at work, and what differs."""
        expected = (2,) if how == FULL else (-how, 128 + how)
        code = self.again(how, much)
        wrong = [] if code in (*expected, self.code) else [f"exit code {code}: {self.said()}"]
        told = "no room for" in self.said() or "disk is full" in self.said()
        if how == FULL and code == expected[0] and not told:
            wrong.append(self.said())
        sealed = views(self.work)
        last = run(self.work, self.words)
        wrong += [f"a view that was stored is lost: {line}" for line in sealed - views(self.work)]
        if last != self.code:
            wrong.append(f"exit code {last} when it was run again: {self.said()}")
        found = fields(self.after, self.work) - self.apart - TIMES
        return code in expected, [*wrong, *(": ".join(f) for f in sorted(found))]


def kills(given: argparse.Namespace) -> Found:
    """Kill, run again, compare: every command some times, then those that are fast more often."""
    log, found = Log(given.log), Found()
    wanted = given.kills or (QUICK_KILLS if given.quick else KILLS)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        make_inputs(root / "work")
        made = {n: Command(root, w) for n, w in LONG.items() if not given.quick or n in QUICK}
        names, rates = list(made), np.array([1 / c.seconds for c in made.values()])
        for k in log.todo("kills", given.seed, 9 * wanted):
            killed = [line["name"] for line in log.of("kills")
                      if line["kill"] and line["key"][0] == given.seed]  # fmt: skip
            done, rarest = len(killed), min(names, key=killed.count)
            if done >= wanted:
                break
            rng = np.random.default_rng((given.seed, k))
            name = str(rng.choice(names, p=rates / rates.sum()))
            if killed.count(rarest) < min(EACH, wanted // len(names)):
                name = rarest
            how = (signal.SIGKILL, signal.SIGTERM, FULL)[int(rng.integers(3))]
            much = rng.uniform(0, made[name].seconds)
            if how == FULL:
                much = float(np.exp(rng.uniform(*np.log(ROOM_BYTES))))
            caught, wrong = made[name].ended(how, much)
            ends = {"kill": caught and how != FULL, "full": caught and how == FULL}
            told = {"name": name, "how": how.name, "much": round(much, 3), "wrong": wrong[:20]}
            log.add("kills", given.seed, k, **ends, **told)
            print(f"{done} of {wanted} kills: {told}", file=sys.stderr, flush=True)
    lines = log.of("kills")
    count = Counter(line["name"] for line in lines if line["kill"])
    full = [line["how"] == FULL.name for line in lines if line["wrong"]]
    found.add("kills", count.total(), ", ".join(f"{n} {count[n]}" for n in LONG))
    found.add("kills_with_difference", full.count(False))
    found.add("full_disks", sum(line["full"] for line in lines))
    found.add("full_disks_with_difference", full.count(True))
    found.notes += [str(line) for line in lines if line["wrong"]]
    found.cases["apart"] = {name: sorted(c.apart) for name, c in made.items()}
    return found
