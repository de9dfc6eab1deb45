"""Load the scene that lies beside this file into PyBullet.

    python load_pybullet.py           load, let it settle for a second, print how far things moved
    python load_pybullet.py --gui     the same in a window, until it is closed

Needs nothing but `pip install pybullet`. `load_scene` is meant for your own programs too.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

STEP_S = 1.0 / 240.0
NO_TURN = [0.0, 0.0, 0.0, 1.0]
SKIN_M = 0.001
"""PyBullet lays a skin of 1 mm around convex meshes of a URDF, which cannot be taken off. The table
stands so much lower, so that things rest where they are drawn instead of jumping up. Two objects
that touch are pushed apart by it."""


def load_scene(engine: Any, folder: "Path | str" = Path(__file__).parent) -> "dict[str, int]":
    """Load table and objects; return their body numbers by name.

    Args:
        engine: the module pybullet once it is connected, or a bullet_client.
        folder: of scene.json.
    """
    folder = Path(folder).resolve()
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    engine.setGravity(*scene["gravity"])
    engine.setPhysicsEngineParameter(fixedTimeStep=STEP_S, numSolverIterations=100)
    bodies: dict[str, int] = {}
    things = list(scene["objects"])
    if scene["table"]:
        things.insert(0, {"name": "table", "fixed": True, **scene["table"]})
        down = engine.multiplyTransforms(
            scene["table"]["position"], scene["table"]["orientation_xyzw"], [0, 0, -SKIN_M], NO_TURN
        )
        things[0]["position"] = down[0]
    for thing in things:
        body = engine.loadURDF(
            str(folder / thing["urdf"]),
            # Of the link's frame; getBasePositionAndOrientation speaks of the centre of mass.
            basePosition=thing["position"],
            baseOrientation=thing["orientation_xyzw"],
            useFixedBase=thing["fixed"],
            # Without it PyBullet makes up an inertia from the shape's box.
            flags=engine.URDF_USE_INERTIA_FROM_FILE,
        )
        # Two calls: damping and other settings in one call lose each other.
        engine.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        engine.changeDynamics(
            body,
            -1,
            lateralFriction=thing.get("friction", 1.0),
            spinningFriction=0.0,
            rollingFriction=0.0,
        )
        bodies[thing["name"]] = body
    return bodies


def link_pose(
    engine: Any, body: int
) -> "tuple[tuple[float, float, float], tuple[float, float, float, float]]":
    """Return position and quaternion x y z w of a body's frame, the one its mesh is drawn in."""
    info = engine.getDynamicsInfo(body, -1)
    to_frame = engine.invertTransform(info[3], info[4])
    at_com = engine.getBasePositionAndOrientation(body)
    position, orientation = engine.multiplyTransforms(*at_com, *to_frame)
    return position, orientation


def main() -> None:
    """Load the scene, let it settle, and show or tell."""
    import pybullet as engine

    show = "--gui" in sys.argv[1:]
    engine.connect(engine.GUI if show else engine.DIRECT)
    bodies = load_scene(engine)
    before = {name: link_pose(engine, body)[0] for name, body in bodies.items()}
    for _ in range(240):
        engine.stepSimulation()
    for name, body in bodies.items():
        after = link_pose(engine, body)[0]
        moved = sum((a - b) ** 2 for a, b in zip(before[name], after, strict=True)) ** 0.5
        print(f"{name}: moved {1e3 * moved:.2f} mm in a second")
    while show and engine.isConnected():
        engine.stepSimulation()
        time.sleep(STEP_S)


if __name__ == "__main__":
    main()
