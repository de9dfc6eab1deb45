"""Real data: poses agree with the depth better than the published ones."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("REALSIM_DATA", ROOT.parent / "shared" / "data"))
sys.path.insert(0, str(ROOT / "benchmarks"))

import registration_real as real  # noqa: E402

needs_ycbv = pytest.mark.skipif(
    not (DATA / "scenes/ycbv_mini").is_dir(), reason=f"no ycbv_mini under {DATA} (set REALSIM_DATA)"
)
pytestmark = [pytest.mark.real, pytest.mark.slow]


@needs_ycbv
@pytest.mark.parametrize("scene_id", real.MATCHING[:1])
def test_two_starts_end_alike_and_nearer_to_the_depth_than_the_published_pose(scene_id):
    intrinsics, frame, models, truth, network = real.ycbv_frame(scene_id)
    first, second = real.registered(scene_id, "truth"), real.registered(scene_id, "network")
    by = {p.instance: p for p in second.scene.objects}
    said = {p.instance: p for p in network}
    ours, published, compared = [], [], 0
    for p, t in zip(first.scene.objects, truth, strict=True):
        model = models[p.obj_id]
        ours.append(real.median_dz_mm(intrinsics, frame, model, p.T_world_obj))
        published.append(real.median_dz_mm(intrinsics, frame, model, t.T_world_obj))
        start = said.get(p.instance)
        if p.obj_id in real.SYMMETRIC or start is None:
            continue
        if real.apart_by(model, t.T_world_obj, start.T_world_obj)[1] > real.TURNED_DEG:
            continue
        mm, deg = real.apart_by(model, p.T_world_obj, by[p.instance].T_world_obj)
        assert mm < 1.0, model.name
        assert deg < 0.5, model.name
        compared += 1
    assert compared >= 2
    assert np.median(ours) < np.median(published)


@needs_ycbv
@pytest.mark.parametrize("scene_id", real.SHIFTED[:1])
def test_poses_of_a_neighbouring_image_are_named(scene_id):
    found = real.registered(scene_id, "truth")
    assert any(f.kind == "common shift" for f in found.findings)
