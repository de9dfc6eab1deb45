"""What breaks realsim: damaged files for every reader, and outputs that go round their guard.

    uv run python benchmarks/reliability.py [--quick] [--part fuzz|outputs]

One damaged file alone, for a debugger: `benchmarks/formats_mutations.py NAME:SEED`.
"""

import argparse
import resource
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from figures import Figure, Found, Goal, run

PACKAGES = ("numpy", "realsim", "h5py", "pyarrow", "scipy", "trimesh")
FIGURES = {
    "fuzz_inputs": Figure(unit="", goal=Goal(low=50_000)),
    "fuzz_tracebacks": Figure(unit="", goal=Goal(high=0)),
    "fuzz_nan": Figure(unit="", goal=Goal(high=0)),
    "fuzz_hangs": Figure(unit="", goal=Goal(high=0)),
    "fuzz_peak_mb": Figure(unit="MB", goal=Goal(high=2000)),
    "outputs_guarded_share": Figure(unit="", goal=Goal(low=1, high=1)),
}
INPUTS, QUICK_INPUTS = 50_000, 2_000
WORKERS = 2
CLASSES = {
    "fuzz_tracebacks": ("traceback", "memory", "crash"), "fuzz_nan": ("nan",),
    "fuzz_hangs": ("hang",),
}  # fmt: skip


def fuzz(given: argparse.Namespace) -> Found:
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
    found.add("fuzz_peak_mb", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
    found.cases["inputs"] = result.counts
    found.cases["offenders"] = [o._asdict() for o in result.offenders]
    found.notes += [f"{o.kind}: formats_mutations.py '{o.name}:{o.seed}'" for o in result.offenders]
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


def inputs_option(parser: argparse.ArgumentParser) -> None:
    """Add how many damaged files are read."""
    parser.add_argument("--inputs", type=int, default=0, help=f"damaged files ({INPUTS})")


if __name__ == "__main__":
    parts = {"fuzz": fuzz, "outputs": outputs}
    run("reliability", __doc__ or "", PACKAGES, FIGURES, parts, options=inputs_option)
