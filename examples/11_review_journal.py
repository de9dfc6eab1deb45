"""Review from Python: accept, reject, move and take back; nothing is ever overwritten."""

from pathlib import Path

import numpy as np

from realsim import InputError, ObjectPose, Scene
from realsim.geometry import se3
from realsim.review import journal
from realsim.review.corrections import check_is_current, corrected_scene, reviewed_scene

# Three objects as a registration left them. The second one is doubtful; it is 4 mm too far left.
names = ("mug", "wedge", "gear")
verdicts = ("accepted", "doubtful", "accepted")
scene = Scene(
    name="three parts",
    objects=tuple(
        ObjectPose(
            obj_id=k + 1, instance=k, T_world_obj=se3.from_translation([0.1 * k, 0.0, 0.0]),
            verdict=verdict, reasons=() if verdict == "accepted" else ("it floats",),
        )
        for k, verdict in enumerate(verdicts)
    ),
)  # fmt: skip
file = Path("session") / journal.JOURNAL_FILE


def state() -> journal.ReviewState:
    return journal.replay(journal.read(file).entries)


def write(action, placed, reviewer, **said) -> journal.Entry:
    """Sign a line and add it, unless somebody else has moved the object meanwhile."""
    entry = journal.new_entry(action, placed, reviewer, **said)
    journal.append(file, entry, check=check_is_current(scene, placed))
    return entry


mug, wedge, gear = scene.objects
write("accept", mug, "Ada")
moved = wedge.T_world_obj @ se3.from_translation([0.004, 0.0, 0.0])
write("move", wedge, "Ada", pose=moved, how="python")
try:
    write("accept", wedge, "Bo")  # Bo still looks at the wedge where it was
except InputError as error:
    print(f"Bo is told: {error}\n")
write("accept", corrected_scene(scene, state()).object(1), "Bo", comment="on its points")
mistaken = write("reject", gear, "Bo")
write("undo", gear, "Bo", undoes=mistaken.id)

print(f"{len(state().entries)} lines, {len(state().standing)} stand")
for name, before, after in zip(
    names, scene.objects, reviewed_scene(scene, state()).objects, strict=True
):
    mm = 1e3 * np.linalg.norm(after.T_world_obj[:3, 3] - before.T_world_obj[:3, 3])
    print(f"{name:6s} {before.verdict:8s} -> {after.verdict:8s} moved {mm:.1f} mm; {after.reasons}")
