"""Small scenes for Robot School."""

from dataclasses import replace

import numpy as np

from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim_sim_bridge.grasping.antipodal import CandidateConfig
from realsim_sim_bridge.school import SchoolConfig
from trimesh_solids import box

CONFIG = SchoolConfig(max_candidates=6, candidates=CandidateConfig(surface_points=200))


def small_worlds(config=CONFIG, pairs=2):
    """Return a config whose worlds hold few pairs, so that few grasps make several shards."""
    engine = replace(config.slip.engine, pairs_per_world=pairs)
    return replace(config, slip=replace(config.slip, engine=engine))


def model(obj_id=1, size=0.05, **kwargs):
    return ObjectModel(obj_id=obj_id, name=f"box{obj_id}", mesh=box((size, size, size)), **kwargs)


def at(x, y, instance=0, obj_id=1, size=0.05, **kwargs):
    T = se3.from_translation([x, y, size / 2])
    return ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T, **kwargs)


def scene(*objects, plane=True):
    table = SupportPlane(T_world_table=np.eye(4)) if plane else None
    return Scene(name="test", objects=objects, plane=table)
