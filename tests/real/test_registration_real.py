"""Real data: poses agree with the depth better than the published ones; a bad arm is put right."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("REALSIM_DATA", ROOT.parent / "shared" / "data"))
sys.path.insert(0, str(ROOT / "benchmarks"))

import registration_real as real  # noqa: E402

from realsim.registration.evidence import EvidenceConfig, measure_noise  # noqa: E402
from realsim.registration.refinement.views_only import refine_views  # noqa: E402
from realsim.registration.views import SampleConfig, sample_views  # noqa: E402

needs_ycbv = pytest.mark.skipif(
    not (DATA / "scenes/ycbv_mini").is_dir(), reason=f"no ycbv_mini under {DATA} (set REALSIM_DATA)"
)
needs_apc = pytest.mark.skipif(
    not (DATA / "scenes/apc_shelf_multiview").is_dir(),
    reason=f"no apc_shelf_multiview under {DATA} (set REALSIM_DATA)",
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


@needs_apc
def test_a_real_arms_cameras_agree_after_refinement():
    intrinsics, frames = real.apc_frames(DATA)
    assert len(frames) == 15
    assert 0.4 < np.median(frames[0].depth_m[frames[0].depth_m > 0]) < 0.8
    noise = measure_noise(frames, EvidenceConfig())
    views = sample_views(intrinsics, frames, noise, SampleConfig(stride=real.APC_STRIDE))
    refined = refine_views(intrinsics, views, noise)
    before = real.neighbour_steps(intrinsics, frames, [f.T_world_cam for f in frames])
    after = real.neighbour_steps(intrinsics, frames, refined.cameras)
    assert before[0] > 2.5
    assert before[1] > 0.6
    assert after[0] < 0.75 * before[0]
    assert after[1] < 0.5 * before[1]
    # The arm is far worse than a new one's 0.2 mm and 0.03 deg, and the views say so.
    assert refined.view_sigma[1] > 0.8
    assert refined.view_sigma[0] > 0.15
