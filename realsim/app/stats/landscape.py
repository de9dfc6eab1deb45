"""A row for our data set in the paper's two tables of comparison with other data sets."""

from realsim.app.stats.statistics import Statistics

YES, PARTLY, NO = "yes", "partly", "no"
LANDSCAPE_HEADER = (
    "data set", "year", "scenes", "frames", "depth", "masks", "6-DoF poses + CAD",
    "object properties", "physics-tried grasps", "slip scores", "real and simulated",
    "robot motions",
)  # fmt: skip
LANDSCAPE = (
    ("NYU-Depth V2", "2012", "464", "1,499", YES, YES, NO, NO, NO, NO, NO, NO),
    ("LineMod", "2013", "15", "15k", YES, YES, YES, PARTLY, NO, NO, NO, NO),
    ("YCB-Video", "2018", "92", "134k", YES, YES, YES, PARTLY, NO, NO, NO, NO),
    ("GraspNet-1B", "2020", "190", "97k", YES, YES, YES, PARTLY, PARTLY, NO, NO, NO),
    ("ACRONYM", "2020", "-", "-", NO, NO, YES, PARTLY, YES, PARTLY, NO, NO),
    ("GraspIT", "2026", "1,135", "316k", YES, YES, YES, YES, YES, YES, YES, PARTLY),
)
"""GraspIT, table "Dataset Landscape"; its column of photorealistic assets, which no count can tell,
and the data sets of demonstrations are left out."""
GRASPS_HEADER = (
    "data set", "objects", "grasps", "by physics", "reach", "score levels (possible)",
    "images", "real and simulated",
)  # fmt: skip
GRASPS = (
    ("Cornell", "240", "5.1k", NO, NO, "1", YES, NO),
    ("Jacquard", "11k", "1.1M", NO, NO, "1", YES, NO),
    ("GraspNet-1B", "88", "1.1B", NO, NO, "10", YES, NO),
    ("ACRONYM", "8.8k", "17.7M", PARTLY, NO, "2", NO, NO),
    ("GraspIT", "7.4k", "2.3M", YES, YES, "5", YES, YES),
)
"""GraspIT, table "Grasping Dataset Comparison"."""
AS_PRINTED = "The other data sets' rows are as the paper has them; its two tables differ in places."
LANDSCAPE_TEXT = f"yes: all sessions have it; partly: some have it. {AS_PRINTED}"
GRASPS_TEXT = f"Score levels: how many base scores there can be, not how many occur. {AS_PRINTED}"
BASE_SCORES = 5
"""0, 1/4, 1/2, 3/4 and 1: one for each stage of physics that a grasp stands."""


def landscape_row(stats: Statistics) -> tuple[str, ...]:
    """Return our row of the landscape: what all sessions have, some have, or none has."""
    sessions = stats.sessions
    return (
        "these sessions", "", f"{len(sessions):,}", f"{sum(s.frames for s in sessions):,}",
        _all(stats, "depth"), _all(stats, "mask_visib"),
        _of([bool(s.objects) and "models" in s.has for s in sessions]),
        _all(stats, "objects"), _all(stats, "grasps"), _all(stats, "grasps"), _both(stats),
        _all(stats, "trajectories"),
    )  # fmt: skip


def grasps_row(stats: Statistics) -> tuple[str, ...]:
    """Return our row of the comparison of grasps."""
    school = stats.school
    levels = BASE_SCORES if school.judged else 0
    return (
        "these sessions", f"{school.objects:,}", f"{school.candidates:,}", _all(stats, "grasps"),
        _all(stats, "trajectories"), str(levels), _of([s.frames > 0 for s in stats.sessions]),
        _both(stats),
    )  # fmt: skip


def _all(stats: Statistics, what: str) -> str:
    return _of([what in s.has for s in stats.sessions])


def _of(there: list[bool]) -> str:
    return YES if all(there) else PARTLY if any(there) else NO


def _both(stats: Statistics) -> str:
    """Return whether there are real and simulated scenes, or physics on real ones."""
    kinds = {s.kind for s in stats.sessions}
    tried = any(s.kind == "real" and "grasps" in s.has for s in stats.sessions)
    return YES if len(kinds) > 1 else PARTLY if tried else NO
