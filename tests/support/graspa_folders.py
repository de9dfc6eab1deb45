"""Small folders of trials in GRASPA's layout: a box on a board, grasped well and badly."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from realsim.arrays import Array
from realsim.geometry import se3

T_BOARD_BOX = se3.from_rt(se3.exp_so3([0.0, 0.0, 0.4]), [-0.3, 0.12, 0.03])
DOWN = np.diag([1.0, -1.0, -1.0])


def transform_xml(T: Array, ending: str = "") -> str:
    """Return a pose [m] as GRASPA writes it [mm]; `ending` follows every number."""
    mm = np.array(T, dtype=np.float64)
    mm[:3, 3] *= 1e3
    rows = "".join(
        f"<row{i + 1} " + " ".join(f'c{j + 1}="{v}{ending}"' for j, v in enumerate(row)) + "/>"
        for i, row in enumerate(mm.tolist())
    )
    return f"<Transform><Matrix4x4>{rows}</Matrix4x4></Transform>"


def trials_xml(Ts: Sequence[Array], results: Sequence[float | str], ending: str = "") -> str:
    """Return a file of trials named "Grasp 0" and so on."""
    poses = "".join(
        f'<Grasp name="Grasp {k}">{transform_xml(T, ending)}</Grasp>' for k, T in enumerate(Ts)
    )
    told = "".join(f'<Grasp name="Grasp {k}" quality="{q}"/>' for k, q in enumerate(results))
    return (
        f"<grasp_data><ManipulationObject><GraspSet>{poses}</GraspSet></ManipulationObject>"
        f"<Grasped>{told}</Grasped></grasp_data>"
    )


def write_graspa(folder: Path, name: str, Ts_obj_grasp: Array, held: Sequence[bool]) -> Path:
    """Add a box of 40 x 40 x 60 mm and its trials on layout_0; return the trials' file."""
    label = "Ycb" + name.title().replace("_", "")
    (folder / "layouts").mkdir(parents=True, exist_ok=True)
    (folder / "objects" / name).mkdir(parents=True)
    trimesh.creation.box((0.04, 0.04, 0.06)).export(folder / "objects" / name / "nontextured.stl")
    board = folder / "layouts" / "layout_0.xml"
    text = board.read_text() if board.exists() else "<Scene></Scene>"
    placed = (
        f'<ManipulationObject name="{label}"><File>data/objects/YCB/{name}/nontextured.xml</File>'
        f"<GlobalPose>{transform_xml(T_BOARD_BOX)}</GlobalPose></ManipulationObject></Scene>"
    )
    board.write_text(text.replace("</Scene>", placed))
    file = folder / "results/panda-test/grasps_data/layout_0" / f"{label}_grasp.xml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(trials_xml(list(T_BOARD_BOX @ Ts_obj_grasp), [int(h) for h in held]))
    return file


def box_grasps() -> tuple[Array, list[bool]]:
    """Return grasps of the box from above: four through its middle, four beside it."""
    good = [se3.from_rt(DOWN, [x, 0.0, 0.015]) for x in (-0.004, -0.001, 0.002, 0.005)]
    bad = [se3.from_rt(DOWN, [x, 0.0, 0.015]) for x in (-0.07, -0.06, 0.06, 0.07)]
    return np.stack(good + bad), [True] * 4 + [False] * 4
