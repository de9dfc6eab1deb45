"""What cannot be fitted is named with what to do, and no wrong scale is accepted."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError, RealsimError
from realsim.records import Mesh
from realsim.registration.evidence import DepthFrame
from realsim.scanning.scale.result import ScaleFit
from scanned_objects import (
    LAB,
    UNIT_M,
    block,
    fit_of,
    joined,
    mirrored,
    real_mesh,
    scaled,
    scanned,
    scanned_mesh,
    shifted,
)


def as_scan(name: str) -> Mesh:
    return scaled(real_mesh(name), 1 / UNIT_M)


def test_several_objects():
    known = scanned_mesh(
        joined(shifted(block(), -0.07, 0, 0), shifted(block(), 0.07, 0, 0)), replace(LAB, views=6)
    )
    with pytest.raises(InputError, match=r"2 objects .* x=.* mm tall.*--at x,y .*alone"):
        fit_of(known, as_scan("block"), start=None)


def blind(frame: DepthFrame) -> DepthFrame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (lambda f: (), "no depth frames"),
        (lambda f: f[:2], r"2 views .* at least 3 from different sides .* 12 or more"),
        (lambda f: [blind(g) for g in f], r"10 depth images .*Is the depth all zero\?"),
        (lambda f: [replace(g, depth_m=g.depth_m * np.float32(1000)) for g in f],
         r"(?i)millimet|unit|metres"),
        (lambda f: [replace(g, depth_m=(1e4 * g.depth_m).astype(np.uint16)) for g in f],
         r"uint16; float32 metres .* depth unit"),
        (lambda f: (*f[:3], replace(f[3], depth_m=f[3].depth_m[::2, ::2])),
         r"\(180, 320\); the camera's is \(360, 640\)"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_used_are_named(frames, said: str):
    known = scanned("block")
    with pytest.raises(RealsimError, match=said):
        fit_of(known, frames=frames(known.frames))


def test_flat_meshes():
    known = scanned("block")
    flat = replace(known.scan, vertices=known.scan.vertices * [1, 0, 0])
    with pytest.raises(RealsimError, match=r"flat|line or a point") as caught:
        fit_of(known, flat)
    assert isinstance(caught.value, InputError | DegenerateError)
    assert "extent" in str(caught.value)


@lru_cache(maxsize=16)
def another(real: str, given: str) -> ScaleFit:
    return fit_of(scanned(real), as_scan(given), start=None)


def test_a_mug_given_for_a_block_is_not_accepted():
    fit = another("block", "mug")
    assert fit.verdict != "accepted"
    assert "% of what was measured of the object" in " ".join(fit.reasons)
    assert all(len(r) > 20 for r in fit.reasons)


@pytest.mark.slow
@pytest.mark.parametrize(("real", "given"), [("l_bracket", "t_profile"), ("bunny", "duck")])
def test_no_mesh_of_another_object_is_accepted(real: str, given: str):
    assert another(real, given).verdict != "accepted"


@pytest.mark.slow
def test_a_mirrored_mesh_is_not_accepted_and_named():
    known = scanned("scalene")
    fit = fit_of(known, mirrored(known.scan), start=None)
    assert fit.verdict != "accepted"
    assert any("mirror" in r for r in (*fit.reasons, *fit.notes))


@pytest.mark.slow
def test_an_open_mesh_is_fitted_too():
    """Scans have no underside: nobody saw it."""
    known = scanned("bunny")
    mesh = known.scan
    middles = mesh.vertices[mesh.faces].mean(1)[:, 2]
    above = middles > mesh.vertices[:, 2].min() + 0.08 * mesh.extent[2]
    assert not above.all()
    fit = fit_of(known, replace(mesh, faces=mesh.faces[above]))
    assert fit.scale == pytest.approx(UNIT_M, rel=0.01)
    assert abs(fit.scale - UNIT_M) < 3.5 * fit.sigma


@pytest.mark.slow
def test_poses_of_other_images_are_not_accepted():
    known = scanned("bunny")
    poses = [f.T_world_cam for f in known.frames]
    frames = tuple(
        replace(f, T_world_cam=T) for f, T in zip(known.frames, poses[3:] + poses[:3], strict=True)
    )
    try:
        fit = fit_of(known, frames=frames)
    except RealsimError as error:
        assert "pose" in str(error) or "stand" in str(error)
    else:
        assert fit.verdict != "accepted"
