"""Small scenes for Robot School, and what makes two of its results the same."""

import dataclasses

import numpy as np

from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim_sim_bridge.grasping.antipodal import CandidateConfig
from realsim_sim_bridge.school import SchoolConfig
from trimesh_solids import box

CONFIG = SchoolConfig(max_candidates=6, candidates=CandidateConfig(surface_points=200))


def small_worlds(config=CONFIG, pairs=2):
    """Return a config whose worlds hold few pairs, so that few grasps make several shards."""
    engine = dataclasses.replace(config.slip.engine, pairs_per_world=pairs)
    return dataclasses.replace(config, slip=dataclasses.replace(config.slip, engine=engine))


def model(obj_id=1, size=0.05, **kwargs):
    return ObjectModel(obj_id=obj_id, name=f"box{obj_id}", mesh=box((size, size, size)), **kwargs)


def at(x, y, instance=0, obj_id=1, size=0.05, **kwargs):
    T = se3.from_translation([x, y, size / 2])
    return ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T, **kwargs)


def scene(*objects, plane=True):
    table = SupportPlane(T_world_table=np.eye(4)) if plane else None
    return Scene(name="test", objects=objects, plane=table)


def same(a, b):
    """Return whether two grasp sets are the same, bit for bit."""
    arrays = ("Ts_obj_grasp", "widths_m", "scores", "base_scores", "slip_m", "slip_rad")
    pairs = [(getattr(a, name), getattr(b, name)) for name in (*arrays, "reachable")]
    pairs += [(a.measures[name], b.measures[name]) for name in a.measures]
    return (
        list(a.measures) == list(b.measures)
        and all(x.tobytes() == y.tobytes() for x, y in pairs)
        and (a.failures, a.parameters) == (b.failures, b.parameters)
    )


def same_result(a, b):
    """Return whether the school made the same of an object, attempts included."""
    return same(a.grasp_set, b.grasp_set) and same_motion(a.trajectories, b.trajectories)


def same_motion(a, b):
    """Return whether two trajectories are the same, bit for bit."""
    if a is None or b is None:
        return a is b
    names = [f.name for f in dataclasses.fields(a)]
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in names)
