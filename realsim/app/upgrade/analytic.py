"""Analytic grasps (GraspNet's friction labels) tried by the School, beside its own candidates.

OUT/grasp_label/NNN_labels.npz            labels that were computed, in GraspNet's layout
OUT/SPLIT/SCENE/grasps_analytic/*.npz     the sets, as in grasps/; closure_friction = the label
OUT/SPLIT/SCENE/grasps_analytic/grasps.h5
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import __version__
from realsim.app.console import Console
from realsim.app.stages import content_key, judged_scene, session_models
from realsim.app.upgrade.dataset import SceneJob
from realsim.records import GraspSet, ObjectModel
from realsim.store import SessionStore, atomic
from realsim.untrusted.own_json import noted

FOLDER = "grasps_analytic"
LABELS = "grasp_label/{:03d}_labels.npz"
"""GraspNet's number of the object, which is realsim's id - 1."""
NOTE = "analytic.json"
CACHE = "cache"
"""Folder of what the School has done, so that it goes on there."""
LABEL_SEED = 0
"""Seed of the surface points: the labels of a model are the same in every scene."""


def try_analytic(store: SessionStore, job: SceneJob, console: Console) -> list[GraspSet]:
    """Try analytic grasps on every object of a session that has been tried; finished ones stay.

    The sets' closure_friction is the label's.

    Args:
        store: the session, registered.
        job: how many, where labels come from and are kept.
        console: progress.

    Raises:
        InputError: the session has no supporting plane, or a label file is broken.
    """
    from realsim.models.library_session import known_solids
    from realsim.store import load_grasps
    from realsim_sim_bridge.grasping.analytic import AnalyticConfig
    from realsim_sim_bridge.school.config import SchoolConfig
    from realsim_sim_bridge.school.school import object_tasks, run_school_results

    scene, models = judged_scene(store), session_models(store, console)
    solids, _ = known_solids(store.folder / "models", [o.obj_id for o in scene.objects])
    config, folder = job.config, store.folder / FOLDER
    school = SchoolConfig(
        seed=config.seed, max_candidates=config.analytic, analytic=AnalyticConfig()
    )
    used = {o.obj_id: models[o.obj_id] for o in scene.objects if o.verdict != "rejected"}
    files = {i: labels_file(model, job) for i, model in used.items()}
    tasks = object_tasks(scene, models, school, None, dict(solids), files)
    key = content_key(__version__, config.analytic, [t.inputs() for t in tasks])
    if noted(folder / NOTE).get("key") == key:
        return load_grasps(folder)
    with console.stage("analytic", f"up to {config.analytic} grasps an object") as tick:
        results = run_school_results(
            scene, models, school, workers=job.workers, cache=folder / CACHE, progress=tick,
            solids=dict(solids), restart="finished", label_files=files,
        )  # fmt: skip
    sets = [r.grasp_set for r in results]
    _write(folder, sets, {i: m.name for i, m in models.items()}, key)
    return sets


def labels_file(model: ObjectModel, job: SceneJob) -> Path:
    """Return the file of an object's labels: the data set's, else one that was computed."""
    from realsim.formats.graspnet.grasp_labels import write_grasp_labels
    from realsim_sim_bridge.grasping.analytic import analytic_labels

    name = LABELS.format(model.obj_id - 1)
    if job.ref.kind == "graspnet" and (job.given.root / name).is_file():
        return job.given.root / name
    path, note = job.out / name, job.out / f"{name}.json"
    mesh = model.mesh
    key = content_key(__version__, mesh.vertices.tolist(), mesh.faces.tolist())
    if not (path.is_file() and noted(note).get("key") == key):
        path.parent.mkdir(parents=True, exist_ok=True)
        labels = analytic_labels(mesh, np.random.default_rng(LABEL_SEED))
        write_grasp_labels(path, labels)
        atomic.write_json(note, {"key": key})
    return path


def _write(folder: Path, sets: Sequence[GraspSet], names: Mapping[int, str], key: str) -> None:
    """Write the sets and their tables; the note, which says that they are whole, comes last."""
    from realsim.formats.grasps.hdf5 import write_grasps_hdf5
    from realsim.formats.grasps.scene_grasps import SceneGrasps
    from realsim.store import save_grasps

    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():
        if path.is_file():
            path.unlink()
    for grasps in sets:
        save_grasps(folder, grasps)
    if sets:
        together = SceneGrasps(sets=tuple(sets), names=dict(names))
        write_grasps_hdf5(folder / "grasps.h5", together)
    atomic.write_json(folder / NOTE, {"key": key})


# --- score against friction -------------------------------------------------------------------


def agreement_of(sets: Sequence[GraspSet]) -> dict[str, Any] | None:
    """Return how the School's scores and the friction labels go together; None without grasps.

    The label is better where it is smaller: where both agree, the rank correlation is negative.
    """
    from realsim.formats.grasps.scene_grasps import executed
    from realsim_sim_bridge.school.measure_statistics import rank_correlations

    if not any(len(s) for s in sets):
        return None
    friction = np.concatenate([s.measures["closure_friction"] for s in sets])
    scores = np.concatenate([s.scores for s in sets])
    was_tried = np.concatenate([executed(s) for s in sets])

    def at(level: float) -> dict[str, Any]:
        here = was_tried & (friction == level)
        n = int(here.sum())
        return {
            "friction": round(float(level), 3), "grasps": int(np.sum(friction == level)),
            "tried": n, "good": int(np.sum(scores[here] >= 0.5)),
            "mean_score": round(float(scores[here].mean()), 4) if n else None,
        }  # fmt: skip

    pairs = rank_correlations(sets, np.random.default_rng(0))
    pair = next((p for p in pairs if (p.first, p.second) == ("score", "closure_friction")), None)
    rho = None
    if pair is not None and np.isfinite(pair.rho):
        rho = {k: round(float(getattr(pair, k)), 4) for k in ("rho", "low", "high")}
    return {
        "grasps": len(scores), "tried": int(was_tried.sum()),
        "good": int(np.sum(scores[was_tried] >= 0.5)),
        "levels": [at(level) for level in np.unique(friction)],
        "score_vs_friction": rho,
    }  # fmt: skip


def all_sets(out: Path, places: Sequence[str]) -> list[GraspSet]:
    """Return the analytic grasps of all scenes."""
    from realsim.store import load_grasps

    return [
        s for place in places if (out / place / FOLDER / NOTE).is_file()
        for s in load_grasps(out / place / FOLDER)
    ]  # fmt: skip


def level_rows(agreement: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of the table of scores by friction."""
    return [
        [
            f"{level['friction']:g}", str(level["grasps"]), str(level["tried"]),
            str(level["good"]),
            "-" if level["mean_score"] is None else f"{level['mean_score']:.2f}",
        ]
        for level in agreement["levels"]
    ]  # fmt: skip


LEVEL_HEADER = ["friction label", "grasps", "tried", "good", "mean score"]


def correlation_line(agreement: Mapping[str, Any]) -> str:
    """Return the rank correlation in words."""
    rho = agreement["score_vs_friction"]
    if rho is None:
        return "too few analytic grasps were tried for a rank correlation with their labels"
    return (
        f"rank correlation of the School's score with the friction label {rho['rho']:+.2f} (95 % "
        f"{rho['low']:+.2f} to {rho['high']:+.2f}; -1 = both rank grasps alike) over "
        f"{agreement['tried']} grasps"
    )
