"""How many candidates a second: `pytest -s -m slow tests/sim_bridge/test_hand_speed.py` prints it.

Ten parts of 50,000 to 200,000 triangles stand close together; sampling and all collision checks
count, and so does preparing the surroundings.
"""

import time

import numpy as np
import pytest
import trimesh

from realsim.geometry import se3
from realsim.geometry.hand import HandGeometry
from realsim.geometry.parts import part
from realsim.records import Mesh
from realsim_sim_bridge.grasping.candidates import (
    CandidateConfig,
    sample_candidates,
    standing_object,
    together,
)
from realsim_sim_bridge.grasping.force_closure import force_closure

NAMES = "flange wedge bowl gear mug box tube elbow cone knob".split()
HAND = HandGeometry()


def fine_part(name):
    mesh = part(name).mesh
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces)
    while len(shape.faces) < 50000:
        shape = shape.subdivide()
    return Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))


@pytest.mark.slow
def test_candidates_and_closures_per_second_of_one_core():
    meshes = [fine_part(name) for name in NAMES]
    Ts = [
        se3.from_translation([0.11 * (i % 4), 0.11 * (i // 4), -mesh.vertices[:, 2].min()])
        for i, mesh in enumerate(meshes)
    ]
    few = CandidateConfig(surface_points=20)
    rng = np.random.default_rng(0)
    near = standing_object(meshes[1], Ts[1], 1, 100)
    warm = sample_candidates(meshes[0], Ts[0], near, few, HAND, rng, 1)  # compiles
    force_closure(meshes[0], warm.Ts_obj_grasp, warm.openings_m)

    start = time.process_time()
    standing = [
        standing_object(m, T, i, 4000) for i, (m, T) in enumerate(zip(meshes, Ts, strict=True))
    ]
    found = []
    for i, (mesh, T) in enumerate(zip(meshes, Ts, strict=True)):
        others = together([s for k, s in enumerate(standing) if k != i])
        rng = np.random.default_rng(i)
        found.append(sample_candidates(mesh, T, others, CandidateConfig(), HAND, rng, 200))
    took = time.process_time() - start
    total, table, free = (
        sum(f.counts[k] for f in found) for k in ("turned", "hand_in_table", "free")
    )

    start = time.process_time()
    for mesh, f in zip(meshes, found, strict=True):
        force_closure(mesh, f.Ts_obj_grasp, f.openings_m)
    closing = time.process_time() - start
    kept = sum(len(f.widths_m) for f in found)
    print(
        f"\n{total} candidates in {took:.1f} CPU s: {total / took:.0f}/s; "
        f"{(total - table) / took:.0f}/s of those above the table, {free / took:.0f}/s free\n"
        f"{kept} force closures in {closing:.2f} CPU s: {kept / closing:.0f}/s"
    )
    assert total / took > 5000
    assert kept / closing > 500
