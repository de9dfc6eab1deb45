"""What breaks realsim: damaged inputs, kills, full disks, faults of every kind, long use.

    uv run python benchmarks/reliability.py [--quick] [--part NAME]

One damaged file alone, for a debugger: `benchmarks/formats_mutations.py NAME:SEED`.
"""

import argparse
import re
import resource
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from figures import Figure, Found, Goal, run

PACKAGES = ("numpy", "realsim", "h5py", "pyarrow", "scipy", "trimesh", "viser", "websockets")
NONE = Goal(high=0)
FIGURES = {
    "fuzz_inputs": Figure(unit="", goal=Goal(low=50_000)),
    "fuzz_tracebacks": Figure(unit="", goal=NONE),
    "fuzz_nan": Figure(unit="", goal=NONE),
    "fuzz_hangs": Figure(unit="", goal=NONE),
    "fuzz_peak_mb": Figure(unit="MB", goal=Goal(high=2000)),
    "outputs_guarded_share": Figure(unit="", goal=Goal(low=1, high=1)),
    "kills": Figure(unit="", goal=Goal(low=200)),
    "kills_with_difference": Figure(unit="", goal=NONE),
    "full_disks": Figure(unit=""),
    "full_disks_with_difference": Figure(unit="", goal=NONE),
    "faults_listed": Figure(unit="", goal=Goal(low=25)),
    "faults_failed": Figure(unit="", goal=NONE),
    "soak_growth": Figure(unit="", goal=Goal(high=0.05)),
}
INPUTS, QUICK_INPUTS = 50_000, 1_500
WORKERS = 1
CLASSES = {
    "fuzz_tracebacks": ("traceback", "memory", "crash"), "fuzz_nan": ("nan",),
    "fuzz_hangs": ("hang",),
}  # fmt: skip
ROOT = Path(__file__).parents[1]
PROOF = re.compile(r"^\| (.+?) \|.*\| `([\w/]+)\.py::(\w+)` \|$", re.M)
"""A fault in the table of docs/reliability.md, and the test that provokes it."""
QUICK_FAULTS = 13
"""In a quick run every so many faults are provoked."""


def fuzz(given: argparse.Namespace) -> Found:
    """Damage files and read them; send what is no message; type what is no command."""
    from reliability_door import frames
    from reliability_own import typed

    found = files(given)
    for more in (frames(given), typed(given)):
        for key, value in more.figures.items():
            found.figures[key] += value
        found.notes += more.notes
        found.cases |= more.cases
    found.add("fuzz_peak_mb", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
    return found


def files(given: argparse.Namespace) -> Found:
    """Damage a sample of every format, foreign and our own, and read it."""
    from formats_mutations import run_mutations

    count = given.inputs or (QUICK_INPUTS if given.quick else INPUTS)
    result = run_mutations(count, given.seed + 1_000_000, WORKERS)
    sums, found = Counter[str](), Found()
    for row in result.counts.values():
        sums.update(row)
    told = f"{len(result.counts)} formats; {sums['read']} read, {sums['refused']} refused"
    found.add("fuzz_inputs", result.total(), told)
    for key, kinds in CLASSES.items():
        found.add(key, sum(sums[kind] for kind in kinds))
    found.cases["inputs"] = result.counts
    found.cases["offenders"] = [o._asdict() for o in result.offenders]
    found.notes += [f"{o.kind}: formats_mutations.py '{o.name}:{o.seed}'" for o in result.offenders]
    return found


def faults(given: argparse.Namespace) -> Found:
    """Run the test of every fault in the table of docs/reliability.md."""
    rows = PROOF.findall((ROOT / "docs/reliability.md").read_text())
    found, provoked = Found(), rows[:: QUICK_FAULTS if given.quick else 1]
    found.add("faults_listed", len(rows))
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        words = ["-q", "-n", "0", "-m", "", "-p", "no:cacheprovider", f"--junit-xml={report}"]
        names = sorted({f"tests/{file}.py::{test}" for _, file, test in provoked})
        command = [sys.executable, "-m", "pytest", *words, *names]
        subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.DEVNULL)
        cases = list(ET.parse(report).iter("testcase"))
    held: dict[str, bool] = {}
    for case in cases:
        key = f"{str(case.get('classname')).removeprefix('tests.')}.{case.get('name')}".split("[")[
            0
        ]
        wrong = [c.tag for c in case if c.tag in ("failure", "error", "skipped")]
        held[key] = held.get(key, True) and not wrong
    failed = [f for f, file, test in provoked if not held.get(f"{file.replace('/', '.')}.{test}")]
    found.add("faults_failed", len(failed), f"{len(provoked)} provoked by {len(cases)} tests")
    found.notes += [f"does not hold, or its test cannot run here: {f}" for f in failed]
    return found


def outputs(_: argparse.Namespace) -> Found:
    """Walk the command line: which paths that a command may write to have the guard."""
    import click

    from realsim.app.cli import commands
    from realsim.app.command import walk
    from realsim.app.outputs import OutputFile, OutputFolder, unguarded

    every = {**walk(commands), (): commands}
    named = [(" ".join(path), p) for path, c in every.items() for p in c.params]
    guarded = [p for _, p in named if isinstance(p.type, OutputFile | OutputFolder)]
    loose = [f"{path} {p.opts[0]}" for path, p in named if unguarded(str(p.name), p)]
    paths = sum(isinstance(p.type, click.Path) for _, p in named)
    found = Found(notes=[f"not guarded: {name}" for name in loose])
    share = len(guarded) / (len(guarded) + len(loose))
    found.add("outputs_guarded_share", share, f"{len(guarded)} outputs of {paths} paths")
    return found


def options(parser: argparse.ArgumentParser) -> None:
    """Add how many inputs are damaged, and how many commands killed."""
    parser.add_argument("--inputs", type=int, default=0, help=f"damaged files ({INPUTS})")
    parser.add_argument("--kills", type=int, default=0, help="commands that are killed (200)")


if __name__ == "__main__":
    parts = {
        "outputs": outputs, "fuzz": fuzz, "kills": "reliability_kills:kills", "faults": faults,
        "soak": "reliability_door:soak",
    }  # fmt: skip
    run("reliability", __doc__ or "", PACKAGES, FIGURES, parts, options=options)
