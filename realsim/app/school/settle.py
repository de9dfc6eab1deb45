"""`realsim school settle`: do the objects of a scene stand when physics starts?"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.app.console import Console
from realsim.app.school.inputs import CACHE, SchoolInputs, SchoolRequest, is_session, read_inputs
from realsim.errors import InputError
from realsim.json_values import json_value
from realsim.store import atomic

if TYPE_CHECKING:
    from realsim_sim_bridge.scenes.school_scene import SchoolScene
    from realsim_sim_bridge.scenes.stable_state import StandReport

PICTURE = "settle.png"


def settle(
    source: Path, request: SchoolRequest, out: Path | None, json_file: Path | None, console: Console
) -> bool:
    """Show what becomes of a scene, and return whether every object stands.

    Args:
        source: a session, or a scene of another program.
        request: masses, density, and where models are.
        out: folder for the picture; None = the session's reports, or none.
        json_file: file for the table.
        console: progress and table go there.

    Raises:
        InputError: the scene cannot be read, or an object has no volume.
    """
    from realsim_sim_bridge.scenes.stable_state import HEADERS, stand_rows

    with tempfile.TemporaryDirectory() as scratch:
        folder = out or Path(scratch)  # convex parts take minutes: in a folder that stays, once
        inputs = read_inputs(source, None if is_session(source) else folder, request, console)
        report, picture = _settled(inputs, console, request.supports)
    console.table(f"Objects of {inputs.scene.name}", list(HEADERS), stand_rows(report))
    console.warn(*report.notes)
    for a, b, depth_m in report.inside:
        console.say(f"{a} and {b} are {1e3 * depth_m:.1f} mm inside one another.")
    if inputs.store is not None and out is None:
        inputs.write(f"reports/{PICTURE}", picture)
        console.say(f"picture   {inputs.folder / 'reports' / PICTURE}")
    elif out is not None:
        atomic.write_bytes(out / PICTURE, picture)
        console.say(f"picture   {out / PICTURE}")
    console.result(as_json(report), json_file)
    return report.stable


def warn_of_falls(inputs: SchoolInputs, console: Console) -> None:
    """Say which objects of a scene do not stand, and keep the picture of it with the results.

    Grasps of an object that jumps or falls are tried all the same: the slip test holds it alone.
    """
    try:
        report, picture = _settled(inputs, console)
    except InputError as error:  # an object without volume: the School says so of that object alone
        console.warn(f"whether the objects stand could not be looked at: {error}")
        return
    for o in report.objects:
        if o.verdict != "stands":
            console.warn(f"'{o.name}' does not stand ({o.verdict}): {o.sentence}")
    for a, b, depth_m in report.inside:
        console.warn(f"{a} and {b} are {1e3 * depth_m:.1f} mm inside one another.")
    inputs.write(f"reports/{PICTURE}", picture)


def _settled(
    inputs: SchoolInputs, console: Console, supports: Sequence[Path] = ()
) -> tuple["StandReport", bytes]:
    """Return what becomes of a scene, with a picture of it.

    Raises:
        InputError: no table, no object, one without volume, or no file of a support.
    """
    from realsim_sim_bridge.scenes.stable_state import stable_state, stand_picture
    from realsim_sim_bridge.scenes.table_world import TableWorld

    scene = with_supports(school_scene(inputs, console), supports)
    with (
        console.stage("settle", f"{len(scene.scene.objects)} objects"),
        TableWorld(scene, cache=inputs.folder / CACHE) as world,
    ):
        report = stable_state(world)
    return report, stand_picture(scene, report)


def school_scene(inputs: SchoolInputs, console: Console) -> "SchoolScene":
    """Return the scene with convex parts and matter of every object that was not rejected.

    Raises:
        InputError: no table, no object, or one without volume.
    """
    from realsim_sim_bridge.scenes.school_scene import Matter, SchoolScene, known_solids

    kept = tuple(o for o in inputs.scene.objects if o.verdict != "rejected")
    left_out = len(inputs.scene.objects) - len(kept)
    if left_out:
        console.warn(
            f"{left_out} rejected objects are left out: their poses are known to be wrong."
        )
    models = {o.obj_id: inputs.models[o.obj_id] for o in kept if o.obj_id in inputs.models}
    matter = Matter(cache=inputs.folder / CACHE)
    return SchoolScene(
        scene=replace(inputs.scene, objects=kept),
        models=models,
        solids=known_solids(models, matter, inputs.solids),
    )


def with_supports(scene: "SchoolScene", urdfs: Sequence[Path]) -> "SchoolScene":
    """Return the scene with bodies that stand still, each in the table's frame.

    Raises:
        InputError: a file does not exist.
    """
    from realsim_sim_bridge.scenes.school_scene import Support

    plane = scene.scene.plane
    assert plane is not None, "a SchoolScene has a table"
    added = tuple(
        Support(name=path.stem, T_world_support=plane.T_world_table, urdf=path) for path in urdfs
    )
    return replace(scene, supports=scene.supports + added)


def as_json(report: "StandReport") -> dict[str, Any]:
    """Return what a program wants to know, as plain JSON values."""
    return json_value(
        {
            "stable": report.stable,
            "simulated_s": report.simulated_s,
            "objects": [
                {
                    "instance": o.instance,
                    "name": o.name,
                    "verdict": o.verdict,
                    "what": o.sentence,
                    "moved_mm": 1e3 * o.moved_m,
                    "turned_deg": o.turned_deg,
                    "jump_m_s": o.jump_m_s,
                    "into_mm": {name: 1e3 * depth for name, depth in o.into.items()},
                    "T_world_after": o.T_world_after.tolist(),
                }
                for o in report.objects
            ],
            "notes": list(report.notes),
        }
    )
