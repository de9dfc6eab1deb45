"""What damaged files of every format end in; the part `damage` of `formats.py`."""

from collections import Counter

from figures import Found
from formats_mutations import run_mutations

COUNT, QUICK_COUNT = 10_000, 300
WORKERS = 2
CLASSES = {
    "mutated_tracebacks": "traceback", "mutated_nan": "nan", "mutated_hangs": "hang",
    "mutated_memory": "memory", "mutated_crashes": "crash",
}  # fmt: skip


def damage(seed: int, quick: bool) -> Found:
    """Return how many mutated files there were, and how many ended otherwise than they may."""
    result = run_mutations(QUICK_COUNT if quick else COUNT, seed, WORKERS)
    found = Found()
    sums = Counter[str]()
    for row in result.counts.values():
        sums.update(row)
    found.add(
        "mutated_files", result.total(),
        f"{len(result.counts)} formats; {sums['read']} read, {sums['refused']} refused",
    )  # fmt: skip
    for key, name in CLASSES.items():
        found.add(key, sums[name])
    found.cases["mutations"] = result.counts
    found.cases["offenders"] = [o._asdict() for o in result.offenders]
    found.notes += [f"{o.kind}: --replay '{o.name}:{o.seed}'" for o in result.offenders]
    return found
