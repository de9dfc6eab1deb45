"""Grasps of sessions in the formats of other programs, one folder a scene."""

import tempfile
from pathlib import Path

import numpy as np

from realsim.app.export.target import METRES, SceneJob, Target
from realsim.errors import InputError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.grasps.scene_grasps import executed, labelled
from realsim.formats.labelled_scene import LabelledScene, WrittenScene
from realsim.formats.session_scene import SessionScene

LABELLED_ONLY = ("acronym", "graspgen", "isaac")
"""Formats of grasps that have a label by physics."""


def session_of(scene: LabelledScene) -> SessionScene:
    """Return the session that a scene is.

    Raises:
        InputError: it is a data set of others, which has no grasps tried by physics.
    """
    if not isinstance(scene, SessionScene):
        raise InputError(
            f"{scene.name} is no session, and grasps are tried in sessions: import it "
            "(`realsim import`), register it, and run `realsim school`."
        )
    return scene


def _files(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.app.school.export import export

    session, inner = session_of(scene), folder.below(job.place.name)
    request = job.request
    written = not inner.has("grasps")
    if written:
        with tempfile.TemporaryDirectory() as place:
            target = Path(place) / "grasps"
            export(session.store.folder, request.target, target, request.least_score)
            found = {p.relative_to(target).as_posix(): p for p in sorted(target.rglob("*"))}
            inner.write_piece("grasps", {name: p for name, p in found.items() if p.is_file()})
    job.tick()
    sets = () if (grasps := session.grasps()) is None else grasps.sets
    all_of_them, count, notes = sum(len(s) for s in sets), 0, list[str]()
    for s in sets:
        rows = np.ones(len(s), dtype=np.bool_)
        if request.target == "isaac":
            rows = labelled(s) & (s.labels >= request.least_score)
        elif request.target in LABELLED_ONLY:
            rows = executed(s)
        count += int(rows.sum())
    if request.target in LABELLED_ONLY and count < all_of_them:
        score = f", or whose label is below {request.least_score:g}," * (request.least_score > 0)
        notes.append(
            f"{all_of_them - count} of {all_of_them} grasps are left out: those that physics did "
            f"not try{score} are no grasps to this format."
        )
    return WrittenScene(
        name=session.name, folder=inner.place, frames=0, frames_written=0, objects=len(sets),
        notes=tuple(notes), counts={"grasps": count},
    )  # fmt: skip


def _grasp_groups(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    """Write the grasps of every frame in its camera, as graspnetAPI's GraspGroup."""
    from realsim.formats.graspnet.grasp_group import grasp_group, grasp_group_files

    session, inner = session_of(scene), folder.below(job.place.name)
    grasps = session.grasps()
    if grasps is None:
        raise InputError(
            f"session '{session.store.folder}' has no grasps yet: run `realsim school "
            f"{session.store.folder}`."
        )
    written, count = 0, 0
    for index in session.indices:
        frame = session.frame(index)
        poses = {o.instance: o.T_cam_obj for o in frame.objects if o.instance is not None}
        sets = [s for s in grasps.sets if s.instance in poses]
        group = grasp_group(sets, poses)
        count += len(group)
        piece = f"{index:06d}"
        if not inner.has(piece):
            inner.write_piece(piece, grasp_group_files(f"{piece}.npy", group))
            written += 1
        job.tick()
    return WrittenScene(
        name=session.name, folder=inner.place, frames=len(session.indices),
        frames_written=written, objects=len(grasps.sets), counts={"grasps": count},
        notes=("single precision: poses agree to about 1e-6.",),
    )  # fmt: skip


def _target(name: str, what: str, conventions: tuple[tuple[str, str], ...], loading: str,
            options: tuple[str, ...] = ()) -> Target:  # fmt: skip
    return Target(
        name=name, kind="grasps", help=what, conventions=(METRES, *conventions), loading=loading,
        write_scene=_files, holds_grasps=True, options=options,
    )  # fmt: skip


GRASPS: dict[str, Target] = {
    "grasp-group": Target(
        name="GraspGroup (graspnetAPI)",
        kind="grasps",
        help="tried grasps of every frame in its camera, (N, 17) npy",
        conventions=(
            METRES,
            ("row", "score, width, height, depth, rotation (9, row-major), translation, object"),
            ("frame", "x = approach, y = closing, origin `depth` before the contacts"),
            ("poses", "in the frame's camera (OpenCV axes)"),
            ("score", "p_hold, of sets without it the slip test's score; 0 to 1, higher is better;"
             " not GraspNet's friction"),
            ("beside", "000000.labels.npz: score, stages, p_hold, error, safety; a row a grasp"),
            ("object", "GraspNet's number: realsim's id - 1"),
        ),
        loading='import numpy as np\ngrasps = np.load("{scene}/{file:*.npy}")',
        write_scene=_grasp_groups,
        holds_grasps=True,
        options=("labels",),
    ),
    "acronym": _target(
        "ACRONYM", "HDF5, one file an object",
        (("frame", "mounting face, 0.1034 m behind the contacts; z = approach, x = closing"),
         ("label", "1 = still held after all four stages; scores, p_hold, its error and safety "
          "under qualities/realsim")),
        'import h5py\nfile = h5py.File("{scene}/{file:*.h5}")',
    ),
    "graspgen": _target(
        "GraspGen", "JSON, one file an object",
        (("frame", "as ACRONYM's"),
         ("label", "1 = still held after all four stages; the rest under the key realsim")),
        'import json\ngrasps = json.load(open("{scene}/{file:*.json}"))["grasps"]',
    ),
    "isaac": _target(
        "isaac_grasp", "YAML, one file an object",
        (("frame", "panda_hand: mounting face; z = approach, y = closing"),
         ("confidence", "p_hold, of sets without it the score; a comment says which")),
        'import yaml\ngrasps = yaml.safe_load(open("{scene}/{file:*.yaml}"))["grasps"]',
        ("least_score",),
    ),
    "hdf5": _target(
        "realsim HDF5", "all of a scene in one file, exact",
        (("frame", "between the fingertips; z = approach, y = closing"),),
        'import h5py\nfile = h5py.File("{scene}/grasps.h5")',
    ),
    "parquet": _target(
        "realsim Parquet", "one row a grasp",
        (("frame", "between the fingertips; z = approach, y = closing"),),
        'import pyarrow.parquet as pq\ntable = pq.read_table("{scene}/grasps.parquet")',
    ),
}  # fmt: skip
"""By the name that the command line gives them."""
