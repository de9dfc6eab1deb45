"""Grasp trials of a real robot in GRASPA's layout (Bottarel et al. 2020), and what came of each.

    layouts/layout_K.xml                                  where objects stand on the printed board
    results/PLANNER/grasps_data/layout_K/NAME_grasp.xml   hand poses, and whether each lifted
    objects/OBJECT/*.stl                                  meshes [m]

Matrices are in mm, in the frame of the board, z up. A hand pose is that of the point between the
fingertips of Franka's hand, 105 mm before its flange; y is the closing axis. That was proven on the
open trials: with y and no offset 94 % of the hands have the object between both pads, with x 81 %,
and fewer with any offset of 10 mm or more. It is our frame `grasp`, 1.6 mm deeper, which is left.

The files round rotations to few digits, write numbers as "0=", and hold a pose of each trial, not
of each grasp: a repeated trial stands there again.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.records import Mesh
from realsim.untrusted import values
from realsim.untrusted.xml_tree import read_xml

Board = dict[str, tuple[Array, str]]
"""Pose (4, 4) [m] and file of each object on a board, by its name there."""
Trials = list[tuple[str, str, Array, bool]]
"""Planner, name, pose (4, 4) of the hand [m] and result of each."""
MM = 1e-3
ROUNDED = 0.02
"""Greatest entry of R^T R - 1 that rounding explains; the worst of the open trials has 0.001."""
FAR_M = 0.3
"""A hand so far from its object's box was tried on nothing; the open trials reach to 0.09 m."""
AT_ORIGIN_M = 2e-3
"""Hands all so near to the board's origin are in metres; the open trials keep 0.12 m."""
PLAIN = re.compile(r"\w[\w.-]*")
"""A name that stays in its folder."""
YCB_MASSES_KG = {
    "banana": 0.066,
    "chips_can": 0.205,
    "cracker_box": 0.411,
    "foam_brick": 0.028,
    "gelatin_box": 0.097,
    "hammer": 0.665,
    "master_chef_can": 0.414,
    "medium_clamp": 0.059,
    "mustard_bottle": 0.603,
    "pear": 0.049,
    "potted_meat_can": 0.370,
    "power_drill": 0.895,
    "scissors": 0.082,
    "strawberry": 0.018,
    "tennis_ball": 0.058,
    "tomato_soup_can": 0.349,
}
"""YCB's data sheet (Calli et al. 2015), of the objects on GRASPA's boards."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TriedObject:
    """An object where it stood, and the grasps that were tried on it."""

    name: str
    """The folder's, such as `mustard_bottle`."""
    layout: str
    """Such as `layout_0`."""
    mesh: Mesh
    """[m]."""
    mass_kg: float | None
    """None = not known."""
    T_board_obj: Array
    """(4, 4) as the board was printed; nobody measured where it really stood [m]."""
    Ts_board_grasp: Array
    """(N, 4, 4) frame `grasp` [m]."""
    held: Mask
    """(N,) whether the robot lifted the object."""
    planners: tuple[str, ...]
    """(N,) the run that a trial is of."""
    trials: tuple[str, ...]
    """(N,) the trial's name in its file."""

    @property
    def Ts_obj_grasp(self) -> Array:
        """(N, 4, 4) [m]."""
        return se3.invert(self.T_board_obj) @ self.Ts_board_grasp


def read_graspa(
    folder: Path | str, masses_kg: Mapping[str, float] | None = None
) -> list[TriedObject]:
    """Return all trials of a folder, one entry for each object on each board.

    Args:
        folder: holds `layouts`, `results` and `objects`.
        masses_kg: weighed masses by object, before those of YCB's data sheet [kg].

    Raises:
        InputError: a folder or file is missing or of another layout, a trial has no pose or no
            result, an object is not on its board or not where its hands are, a mass is none or of
            no object; the file and what was expected are named.
    """
    folder, given = Path(folder), dict(masses_kg or {})
    known = YCB_MASSES_KG | given
    boards, grasps = _read_trials(_trial_files(folder))
    meshes: dict[str, tuple[str, Mesh]] = {}
    found: list[TriedObject] = []
    for (layout, label), rows in sorted(grasps.items()):
        T, told = boards[layout][label]
        if told not in meshes:
            meshes[told] = _mesh(folder, told)
        name, mesh = meshes[told]
        Ts = np.array([row[2] for row in rows])
        _require_near(mesh, T, Ts, f"{folder}: the hands of '{label}' on {layout}")
        found.append(
            TriedObject(
                name=name,
                layout=layout,
                mesh=mesh,
                mass_kg=known.get(name),
                T_board_obj=T,
                Ts_board_grasp=Ts,
                held=np.array([row[3] for row in rows], dtype=np.bool_),
                planners=tuple(row[0] for row in rows),
                trials=tuple(row[1] for row in rows),
            )
        )
    _check_masses(given, {obj.name for obj in found})
    return found


def _trial_files(folder: Path) -> list[Path]:
    """Return the files of trials of a folder that has GRASPA's layout."""
    for need in ("layouts", "results", "objects"):
        if not (folder / need).is_dir():
            raise InputError(
                f"{folder} has no folder '{need}'; GRASPA's layout is expected: layouts/layout_K"
                ".xml, results/PLANNER/grasps_data/layout_K/NAME_grasp.xml, objects/NAME/*.stl."
            )
    files = sorted(folder.glob("results/*/grasps_data/*/*_grasp.xml"))
    if not files:
        raise InputError(
            f"{folder / 'results'} holds no trials; files such as PLANNER/grasps_data/layout_0/"
            "YcbHammer_grasp.xml are expected."
        )
    return files


def _read_trials(files: Iterable[Path]) -> tuple[dict[str, Board], dict[tuple[str, str], Trials]]:
    """Return the boards by layout, and the trials by layout and the object's name on the board."""
    boards: dict[str, Board] = {}
    grasps: dict[tuple[str, str], Trials] = {}
    for file in files:
        layout, label = file.parent.name, file.name.removesuffix("_grasp.xml")
        if layout not in boards:
            boards[layout] = _board(file.parents[4] / "layouts" / f"{layout}.xml")
        if label not in boards[layout]:
            raise InputError(
                f"{file}: '{label}' is not on its board; {layout}.xml has "
                f"{', '.join(boards[layout])}."
            )
        trials = [(file.parents[2].name, *trial) for trial in _trials(file)]
        if trials:
            grasps.setdefault((layout, label), []).extend(trials)
    return boards, grasps


def _check_masses(given: Mapping[str, float], names: set[str]) -> None:
    """Raise if a mass is none, or of an object that was not tried."""
    for name, mass in given.items():
        if name not in names:
            raise InputError(
                f"a mass is given for '{name}', which no trial is of; there are "
                f"{', '.join(sorted(names))}."
            )
        values.number(mass, f"the mass of {name} [kg]", low=1e-6)


def _board(path: Path) -> Board:
    """Return pose and file of every object of a board."""
    objects: Board = {}
    for element in read_xml(path).iter("ManipulationObject"):
        name, file = element.get("name"), element.findtext("File")
        if name is None or file is None:
            raise InputError(f"{path}: an object of the board has no name or no File.")
        objects[name] = _pose(element.find("GlobalPose"), f"{path}: '{name}'"), file.strip()
    if not objects:
        raise InputError(f"{path} has no ManipulationObject; a board with objects is expected.")
    return objects


def _trials(path: Path) -> list[tuple[str, Array, bool]]:
    """Return name, pose and result of every trial of a file; of a planner without a grasp none."""
    root = read_xml(path)
    told = root.find("Grasped")
    results = _by_name(() if told is None else told.iter("Grasp"), path)
    poses = _by_name(root.iterfind(".//GraspSet/Grasp"), path)
    if not poses and results:
        raise InputError(
            f"{path} has {len(results)} results and no poses; a GraspSet with a Grasp and its "
            "Transform for each is expected."
        )
    for name in results:
        if name not in poses:
            raise InputError(f"{path}: '{name}' has a result and no pose; both are expected.")
    found: list[tuple[str, Array, bool]] = []
    for name, grasp in poses.items():
        if name not in results:
            raise InputError(
                f"{path}: the trial '{name}' has no result; Grasped has "
                f"{', '.join(map(str, results)) or 'none'}."
            )
        quality = _number(results[name].get("quality"), f"{path}: the result of '{name}'")
        if quality not in (0.0, 1.0):
            raise InputError(f"{path}: the result of '{name}' is {quality:g}; 0 or 1 is expected.")
        found.append((name, _pose(grasp, f"{path}: the trial '{name}'"), quality == 1.0))
    return found


def _by_name(grasps: Iterable[Any], path: Path) -> dict[str, Any]:
    """Return the elements by their names, of which none may stand there twice."""
    found: dict[str, Any] = {}
    for grasp in grasps:
        name = str(grasp.get("name"))
        if name in found:
            raise InputError(f"{path} has '{name}' twice; a name for each trial is expected.")
        found[name] = grasp
    return found


def _pose(element: Any, where: str) -> Array:
    """Return a 4x4 matrix [mm] as a pose [m]."""
    matrix = None if element is None else element.find("Transform/Matrix4x4")
    if matrix is None:
        raise InputError(f"{where} has no pose; Transform/Matrix4x4 with four rows is expected.")
    T = np.eye(4)
    for i in range(4):
        row = matrix.find(f"row{i + 1}")
        for j in range(4):
            told = None if row is None else row.get(f"c{j + 1}")
            T[i, j] = _number(told, f"{where}: row {i + 1}, column {j + 1}")
    error = float(np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max())
    if error > ROUNDED:
        raise InputError(
            f"{where}: its rotation is off by {error:.3f} from a rotation; up to {ROUNDED:g} is "
            "what rounding explains."
        )
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3], T[:3, 3] = U @ Vt, MM * T[:3, 3]
    return se3.check_rigid(T, where)


def _require_near(mesh: Mesh, T: Array, Ts: Array, where: str) -> None:
    """Raise if hands (N, 4, 4) of a board are not at their object, whose pose is T (4, 4) [m]."""
    if np.linalg.norm(Ts[:, :3, 3], axis=1).max() < AT_ORIGIN_M:
        raise InputError(
            f"{where} are all within {1e3 * AT_ORIGIN_M:g} mm of the board's origin. Positions "
            "in millimetres are expected; are these in metres?"
        )
    at = (se3.invert(T) @ Ts)[:, :3, 3]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    far = np.linalg.norm(at - np.clip(at, low, high), axis=1).max()
    if far > FAR_M:
        raise InputError(
            f"{where} are up to {far:.2f} m away from it; at most {FAR_M:g} m is accepted. "
            "Boards and hands are expected in millimetres, in the frame of the same board."
        )


def _number(told: str | None, where: str) -> float:
    """Return a number that may end in '='."""
    try:
        return values.number(float((told or "").strip(" =")), where)
    except ValueError:
        raise InputError(f"{where} is {told!r}; a number is expected.") from None


def _mesh(folder: Path, told: str) -> tuple[str, Mesh]:
    """Return an object's name and mesh; the boards name a file that names the mesh."""
    place = PurePosixPath(told)
    name = place.parent.name
    if not (PLAIN.fullmatch(name) and PLAIN.fullmatch(place.stem)):
        raise InputError(f"a board names the object's file {told!r}; FOLDER/NAME.xml is expected.")
    path = folder / "objects" / name / f"{place.stem}.stl"
    if not path.is_file():
        raise InputError(
            f"{path} is missing; the trials of {name} need its mesh in metres there. Add it, or "
            f"leave out the files of its trials below {folder / 'results'}."
        )
    return name, load_mesh(path, "m")
