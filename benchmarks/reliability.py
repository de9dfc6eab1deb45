"""What breaks realsim: damaged inputs, kills, full disks, faults of every kind, long use.

    uv run python benchmarks/reliability.py [--quick] [--part NAME] [--log FILE [--seed N]]

With a log, `fuzz` and `kills` keep every result as it comes. The same command goes on with a run
that was stopped; another seed adds to what is there, and the figures are those of all of it.
One damaged file alone, for a debugger: `benchmarks/formats_mutations.py NAME:SEED`.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from figures import Figure, Found, Goal, run
from reliability_log import OFFENCES, Log

PACKAGES = ("numpy", "realsim", "h5py", "pyarrow", "scipy", "trimesh", "viser", "websockets")
NONE = Goal(high=0)
FIGURES = {
    "fuzz_inputs": Figure(unit="", goal=Goal(low=50_000)),
    "fuzz_tracebacks": Figure(unit="", goal=NONE), "fuzz_nan": Figure(unit="", goal=NONE),
    "fuzz_hangs": Figure(unit="", goal=NONE),
    "fuzz_peak_mb": Figure(unit="MB", goal=Goal(high=2000)),
    "outputs_guarded_share": Figure(unit="", goal=Goal(low=1, high=1)),
    "kills": Figure(unit="", goal=Goal(low=200)),
    "kills_with_difference": Figure(unit="", goal=NONE), "full_disks": Figure(unit=""),
    "full_disks_with_difference": Figure(unit="", goal=NONE),
    "faults_listed": Figure(unit="", goal=Goal(low=25)),
    "faults_failed": Figure(unit="", goal=NONE),
    "soak_growth": Figure(unit="", goal=Goal(high=0.05)),
}  # fmt: skip
INPUTS, QUICK_INPUTS = 50_000, 1_500
WORKERS = 1
ROOT = Path(__file__).parents[1]
PROOF = re.compile(r"^\| (.+?) \|.*\| `([\w/]+)\.py::(\w+)` \|$", re.M)
"""A fault in the table of docs/reliability.md, and the test that provokes it."""
QUICK_FAULTS = 13
"""In a quick run every so many faults are provoked."""


def fuzz(given: argparse.Namespace) -> Found:
    """Damage files and read them; send what is no message; type what is no command."""
    from reliability_door import frames
    from reliability_own import typed

    log, found = Log(given.log), Found()
    for part in (files, frames, typed):
        part(given, log)
    lines = log.of("files") + log.of("frames") + log.of("typed")
    formats = len({line["key"][0] for line in log.of("files")})
    kinds = {k: sum(line.get(k, 0) for line in lines) for k in ("inputs", "read", *OFFENCES)}
    told = f"{formats} formats, frames, words; {kinds['read']} files read, the others refused"
    found.add("fuzz_inputs", kinds["inputs"], told)
    found.add("fuzz_tracebacks", sum(kinds[k] for k in OFFENCES[:3]))
    found.add("fuzz_nan", kinds["nan"])
    found.add("fuzz_hangs", kinds["hang"])
    found.add("fuzz_peak_mb", max(line.get("peak_mb", 0.0) for line in lines))
    found.notes += [str(line) for line in lines if any(line.get(k) for k in OFFENCES)]
    return found


def files(given: argparse.Namespace, log: Log) -> None:
    """Damage a sample of every format, foreign and our own, and read it; offenders once more."""
    from formats_mutations import mutations

    count = given.inputs or (QUICK_INPUTS if given.quick else INPUTS)
    done = {tuple(n["key"]) for n in log.of("files") if not any(n.get(k) for k in OFFENCES)}
    for o in mutations(count, given.seed + 1_000_000, WORKERS, done=done):
        said = {"change": o.change, "detail": o.detail} if o.kind in OFFENCES else {}
        log.add("files", o.name, o.seed, inputs=1, peak_mb=o.peak_mb, **{o.kind: 1}, **said)


def faults(given: argparse.Namespace) -> Found:
    """Run the test of every fault in the table of docs/reliability.md."""
    rows = PROOF.findall((ROOT / "docs/reliability.md").read_text())
    found, provoked = Found(), rows[:: QUICK_FAULTS if given.quick else 1]
    found.add("faults_listed", len(rows))
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        words = ["-q", "-n", "0", "-m", "", "-p", "no:cacheprovider", f"--junit-xml={report}"]
        names = dict.fromkeys(f"tests/{file}.py::{test}" for _, file, test in provoked)
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
    parser.add_argument("--log", type=Path, help="keeps results, and has those of earlier runs")
    parser.add_argument("--kills", type=int, default=0, help="commands that are killed (200)")


if __name__ == "__main__":
    parts = {
        "outputs": outputs, "fuzz": fuzz, "kills": "reliability_kills:kills", "faults": faults,
        "soak": "reliability_door:soak",
    }  # fmt: skip
    run("reliability", __doc__ or "", PACKAGES, FIGURES, parts, options=options)
