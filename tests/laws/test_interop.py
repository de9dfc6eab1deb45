"""Each library's convention, by one known answer: a quarter turn about z and t = (1, 2, 3)."""

import os
import subprocess
import sys

import numpy as np
import pytest

from realsim import interop
from realsim.geometry import se3
from refusals import refused

T = se3.from_rt([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3])
S = np.sqrt(0.5)


def test_quaternions_end_with_w():
    np.testing.assert_allclose(interop.quaternion_xyzw_from_R(T), [0, 0, S, S], atol=1e-15)
    np.testing.assert_allclose(interop.R_from_quaternion_xyzw([0, 0, S, S]), T[:3, :3], atol=1e-15)
    R = se3.random_rotation(np.random.default_rng(0), 20)
    back = interop.R_from_quaternion_xyzw(interop.quaternion_xyzw_from_R(R))
    np.testing.assert_allclose(back, R, atol=1e-14)
    refused("no length", interop.R_from_quaternion_xyzw, [0, 0, 0, 0])


def test_gtsam():
    import gtsam

    pose = interop.pose3_from_T(T)
    assert pose.equals(gtsam.Pose3(gtsam.Rot3.Rz(np.pi / 2), np.array([1.0, 2, 3])), 1e-12)
    np.testing.assert_allclose(interop.T_from_pose3(pose), T, atol=1e-15)
    q = pose.rotation().toQuaternion()
    np.testing.assert_allclose([q.w(), q.x(), q.y(), q.z()], se3.quaternion_wxyz(T[:3, :3]))
    # The same order of the tangent, and the same perturbation on the right.
    np.testing.assert_allclose(gtsam.Pose3.Logmap(pose), se3.log(T), atol=1e-12)
    xi = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    np.testing.assert_allclose(interop.T_from_pose3(pose.retract(xi)), T @ se3.exp(xi), atol=1e-12)
    np.testing.assert_allclose(pose.AdjointMap(), se3.adjoint(T), atol=1e-12)


def test_pybullet():
    import pybullet

    position, xyzw = interop.pybullet_from_T(T)
    assert position == [1, 2, 3]
    np.testing.assert_allclose(xyzw, pybullet.getQuaternionFromEuler([0, 0, np.pi / 2]), atol=1e-12)
    matrix = np.reshape(pybullet.getMatrixFromQuaternion(xyzw), (3, 3))
    np.testing.assert_allclose(matrix, T[:3, :3], atol=1e-12)
    np.testing.assert_allclose(interop.T_from_pybullet(position, xyzw), T, atol=1e-15)


def test_viser():
    from viser import transforms

    wxyz, position = interop.viser_wxyz_position(T)
    np.testing.assert_allclose(wxyz, transforms.SE3.from_matrix(T).rotation().wxyz, atol=1e-12)
    np.testing.assert_allclose(position, [1, 2, 3])
    assert interop.viser_wxyz_position(np.stack([T, T]))[0].shape == (2, 4)


def test_pycolmap():
    import pycolmap

    rigid = interop.rigid3d_from_T(T)
    np.testing.assert_allclose(rigid.matrix(), T[:3], atol=1e-12)
    np.testing.assert_allclose(rigid.rotation.quat, [0, 0, S, S], atol=1e-12)
    np.testing.assert_allclose(interop.T_from_rigid3d(rigid), T, atol=1e-15)
    np.testing.assert_allclose(interop.colmap_from_opencv_px([0, 0]), [0.5, 0.5])
    np.testing.assert_allclose(interop.opencv_from_colmap_px([0.5, 0.5]), [0, 0])
    assert hasattr(pycolmap, "Rigid3d")


def test_universal_robots():
    pose = [1, 2, 3, 0, 0, np.pi / 2]
    np.testing.assert_allclose(interop.T_from_rotation_vector_pose(pose), T, atol=1e-15)
    np.testing.assert_allclose(interop.rotation_vector_pose_from_T(T), pose, atol=1e-15)
    refused("six numbers", interop.T_from_rotation_vector_pose, [1, 2, 3])


def test_opengl_cameras_look_along_minus_z():
    T_world_gl = interop.T_world_gl_from_cam(T)
    np.testing.assert_allclose(T_world_gl[:3, 2], -T[:3, 2])
    np.testing.assert_allclose(T_world_gl[:3, 1], -T[:3, 1])
    np.testing.assert_allclose(T_world_gl[:3, 3], T[:3, 3])
    np.testing.assert_allclose(interop.T_world_cam_from_gl(T_world_gl), T)


def run(code):
    command, env = [sys.executable, "-c", code], os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=env)


def test_open3d_and_pyrealsense2_really_import():
    done = run(
        "from realsim.interop import import_open3d, import_pyrealsense2\n"
        "rs = import_pyrealsense2(); o3d = import_open3d()\n"
        "print(rs.stream.depth, o3d.core.Tensor([1.0]).shape)"
    )
    assert done.returncode == 0, done.stderr
    assert "depth" in done.stdout


@pytest.mark.parametrize(
    ("module", "function", "library", "package"),
    [
        ("open3d", "import_open3d", "libz.so.1", "zlib1g"),
        ("pinocchio", "import_pinocchio", "libstdc++.so.6", "libstdc++6"),
        ("pyrealsense2", "import_pyrealsense2", "libusb-1.0.so.0", "libusb-1.0-0"),
    ],
)
def test_a_missing_system_library_names_its_package(module, function, library, package):
    # A finder that fails as the dynamic loader does on a machine without the library.
    done = run(f"""
import sys
class Loader:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            raise ImportError("{library}: cannot open shared object file: No such file")
sys.meta_path.insert(0, Loader())
from realsim import interop
from realsim.errors import MissingLibraryError
try:
    interop.{function}()
except MissingLibraryError as error:
    print(error)
""")
    assert package in done.stdout and "apt-get install" in done.stdout, done.stderr
    assert library in done.stdout


def test_open3d_asks_for_plotly_only_when_a_figure_is_asked_for():
    done = run("""
import sys
class Asked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("plotly", "dash"):
            raise ImportError(f"{name} is asked for")
sys.meta_path.insert(0, Asked())
from realsim.interop import import_open3d
figure = import_open3d().visualization.get_plotly_fig
for _ in range(2):
    try:
        figure([])
    except ImportError as error:
        print(error)
""")
    assert done.stdout.split("\n")[:2] == ["plotly is asked for"] * 2, done.stderr


def test_realsim_itself_loads_numpy_only():
    done = run(
        "import sys, realsim\n"
        "heavy = {'open3d', 'cv2', 'scipy', 'pybullet', 'trimesh', 'gtsam', 'numba'}\n"
        "import realsim.store, realsim.formats.bop.scene, realsim.interop, realsim.geometry.mesh\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_quiet_output_silences_c_code_and_gives_the_streams_back() -> None:
    code = (
        "import os\n"
        "from realsim.interop import quiet_output\n"
        "print('before', flush=True)\n"
        "with quiet_output():\n"
        "    os.write(1, b'NOISE'); os.write(2, b'NOISE')\n"
        "    import ctypes, pybullet\n"
        "    ctypes.CDLL(None).puts(b'BUFFERED')\n"
        "print('after')"
    )
    done = run(code)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["before", "after"]
