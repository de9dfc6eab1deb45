"""Wheels load where libEGL, libGL, libX11 and libgomp are missing."""

import ctypes
import subprocess
import sys

import pytest

from realsim.stand_ins import library, load

BARE = """
from pathlib import Path
from realsim import interop, stand_ins
stand_ins.is_there = lambda name: False  # as on a machine that has none of them
o3d = interop.import_open3d()
scene = o3d.t.geometry.RaycastingScene()
box = o3d.geometry.TriangleMesh.create_box()
scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(box))
ray = o3d.core.Tensor([[0.3, 0.4, -1, 0, 0, 1]], o3d.core.float32)
print(scene.count_intersections(ray).numpy())
pin = interop.import_pinocchio()
print(pin.randomConfiguration(pin.buildSampleModelManipulator()).shape)
loaded = {Path(line.split()[-1]).name for line in open("/proc/self/maps") if "/" in line}
print([n for n in loaded if n.startswith(("libEGL", "libGL", "libX11", "libgomp.so", "libudev"))])
"""


def test_an_empty_library_is_found_by_its_name_and_answers_0():
    load(library(b"librealsim-test.so.7", (), [b"first", b"second", b"third"]))
    found = ctypes.CDLL("librealsim-test.so.7")
    assert [found.first(), found.second(3), found.third()] == [0, 0, 0]
    with pytest.raises(AttributeError):
        found.fourth  # noqa: B018


def test_a_library_is_found_by_another_name():
    load(library(b"librealsim-other.so.7", [b"libm.so.6"], ()))
    cosine = ctypes.CDLL("librealsim-other.so.7").cos
    cosine.restype, cosine.argtypes = ctypes.c_double, [ctypes.c_double]
    assert cosine(0.0) == 1.0


def test_open3d_and_pinocchio_work_without_libraries_of_the_system():
    done = subprocess.run([sys.executable, "-c", BARE], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["[2]", "(6,)", "[]"], done.stderr
