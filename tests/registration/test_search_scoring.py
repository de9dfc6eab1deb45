"""Scores of rendered poses: laws of the z-buffers, and that the truth gains most."""

from functools import lru_cache

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import ObjectPose, SupportPlane
from realsim.registration.body import Body, footprint, make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.search.scoring import (
    Canvas,
    ScoreConfig,
    compose,
    likelihoods,
    make_canvas,
    render,
    score,
)
from table_scenes import small_scene

SEED = 3
NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
PLANE = SupportPlane(T_world_table=np.eye(4), rms_m=1e-3, inliers=1000)
CONFIG = ScoreConfig(columns=80, frames=6)


@lru_cache(maxsize=1)
def canvas() -> Canvas:
    scene = small_scene(SEED)
    return make_canvas(scene.intrinsics, scene.frames[:6], NOISE, PLANE, CONFIG)


@lru_cache(maxsize=1)
def bodies() -> list[tuple[Body, np.ndarray]]:
    scene = small_scene(SEED)
    return [
        (make_body(ObjectPose(obj_id=p.obj_id, instance=0, T_world_obj=np.eye(4)),
                   scene.models[p.obj_id], 24, 50), p.T_world_obj)
        for p in scene.truth
    ]  # fmt: skip


def test_a_render_is_the_footprint_of_every_frame():
    scene, (body, T) = small_scene(SEED), bodies()[0]
    got = render(canvas(), body, T)
    seen: dict[int, float] = {}
    width = canvas().rays.shape[1]
    for n, frame in enumerate(scene.frames[:6]):
        f = footprint(body, scene.intrinsics, se3.invert(frame.T_world_cam) @ T, canvas().stride)
        at = (f.rows // canvas().stride) * width + f.columns // canvas().stride
        seen |= dict(zip((n * canvas().cells_per_frame + at).tolist(), f.z, strict=True))
    compared = {c: z for c, z in seen.items()
                if canvas().measured[c] > 0 and z < canvas().table[c]}  # fmt: skip
    assert len(compared) > 200
    assert dict(zip(got.cells.tolist(), got.z, strict=True)).keys() == compared.keys()
    np.testing.assert_allclose(got.z, [compared[c] for c in got.cells.tolist()], atol=1e-6)


def test_gains_of_a_whole_scene_do_not_depend_on_the_order():
    rendered = [render(canvas(), b, T) for b, T in bodies()]
    cells = np.arange(len(canvas().table), dtype=np.int32)
    empty = likelihoods(canvas(), canvas().table, cells).sum()
    full = likelihoods(canvas(), compose(canvas().table, rendered), cells).sum()
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1]):
        total = 0.0
        for k in range(5):
            before = compose(canvas().table, [rendered[i] for i in order[:k]])
            total += score(canvas(), rendered[order[k]], before).gain
        assert total == pytest.approx(full - empty, abs=1e-6 * abs(full))


@pytest.mark.parametrize("n", (0, 3))
def test_the_truth_gains_more_than_anything_beside_it(n: int):
    body, T = bodies()[n]
    others = compose(
        canvas().table, [render(canvas(), b, P) for k, (b, P) in enumerate(bodies()) if k != n]
    )
    right = score(canvas(), render(canvas(), body, T), others)
    assert right.agree > 0.9
    assert right.per_cell > 0.3
    for shift in ([0.008, 0, 0], [0, -0.008, 0], [0, 0, 0.006]):
        moved = render(canvas(), body, se3.from_translation(shift) @ T)
        assert score(canvas(), moved, others).gain < right.gain
