"""The labels of synthetic views: the annotation that real views get, with nothing uncertain."""

from collections.abc import Callable, Sequence

from realsim.records import GraspSet
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.annotate import AnnotationConfig, AnnotationSummary, annotate
from realsim_sim_bridge.annotation.config import OccluderConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene


def exact_annotation(maps: tuple[str, ...]) -> AnnotationConfig:
    """Return the settings for a scene without error: no clearance, and nothing that is unknown."""
    return AnnotationConfig(plane_clearance_m=0.0, maps=maps, occluder=OccluderConfig(is_on=False))


def label_session(
    store: SessionStore,
    synthetic: SyntheticScene,
    grasp_sets: Sequence[GraspSet],
    *,
    maps: tuple[str, ...],
    workers: int,
    progress: Callable[[int, int], None],
) -> AnnotationSummary:
    """Write every label of a synthetic session's views.

    Args:
        store: the session with all its views.
        synthetic: the scene, with its models as they are stored.
        grasp_sets: scored grasps; those of rejected instances are left out.
        maps: label maps that are written of every view.
        workers: processes that compute labels.
        progress: called with (views done, views in all).
    """
    scene = synthetic.exact()
    shown = {o.instance for o in scene.objects}
    return annotate(
        store, scene, synthetic.models, [g for g in grasp_sets if g.instance in shown],
        exact_annotation(maps), progress=progress, workers=workers,
        surroundings=synthetic.surroundings,
    )  # fmt: skip
