import numpy as np
import pytest

from realsim.geometry import se3
from realsim_calibration.lens.coverage import measure_coverage
from refusals import refused


def test_coverage_names_what_is_missing():
    poses = np.stack([se3.from_rt(se3.exp_so3([0.5 * s, 0.4, 0]), [0, 0, 0.5]) for s in (-1, 1)])
    u, v = np.meshgrid(np.linspace(0, 639, 30), np.linspace(0, 479, 30))
    everywhere = np.stack([u.ravel(), v.ravel()], -1)
    full = measure_coverage(everywhere, (640, 480), poses)
    assert full.share == 1 and full.reach > 0.9 and full.advice == ""
    assert full.counts.sum() == len(everywhere)
    missing = everywhere[(everywhere[:, 0] < 320) | (everywhere[:, 1] < 240)]
    part = measure_coverage(missing, (640, 480), poses)
    assert "no corners in the lower right quarter" in part.advice
    straight = np.stack([se3.from_translation([0, 0, z]) for z in (0.4, 0.8)])
    flat = measure_coverage(everywhere, (640, 480), straight)
    assert "tilt it by 30 deg" in flat.advice
    assert flat.distance_m.max() / flat.distance_m.min() == pytest.approx(2)


def test_nothing_seen_is_refused():
    refused("no corners", measure_coverage, np.zeros((0, 2)), (640, 480), np.eye(4)[None])
