"""Where the libraries differ: quaternion order, pixel origin, camera axes, and how they load.

Inside realsim there is one convention (`T_a_b`, OpenCV camera axes, integer pixel centres, twists
rotation first). Every other one is converted here, each by a function with a known-answer test:

| library     | quaternion | pixel centre | camera axes              | pose                      |
|-------------|------------|--------------|--------------------------|---------------------------|
| gtsam       | w x y z    | as given     | OpenCV                   | Pose3, twist rotation first |
| pybullet    | x y z w    | -            | OpenGL, column-major list | (position, quaternion)    |
| pycolmap    | x y z w    | +0.5         | OpenCV                   | cam_from_world            |
| viser       | w x y z    | -            | OpenCV                   | (wxyz, position)          |
| UR          | rotation vector | -       | -                        | [x y z rx ry rz]          |
"""

import ctypes
import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim import stand_ins
from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import se3

APT_PACKAGES = {
    "libusb": "libusb-1.0-0", "libudev": "libudev1", "libstdc++": "libstdc++6", "libz": "zlib1g",
}  # fmt: skip
"""Debian/Ubuntu package of each shared library that the wheels expect from the system and call."""
T_CAM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL camera axes (x right, y up, z backward) in OpenCV's; its own inverse."""
COLMAP_PIXEL_SHIFT = 0.5
"""COLMAP puts the centre of the first pixel at (0.5, 0.5), OpenCV and BOP at (0, 0)."""


# --- libraries that need something of the system -----------------------------------------------


def _preload_libusb() -> None:
    """Load the libusb of the `libusb-package` wheel, so that none of the system is needed."""
    try:
        import libusb_package
    except ImportError:
        return  # the system's own libusb may do; if not, the import that follows says so
    path: Any = libusb_package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _folder_of(package: str) -> Path:
    """Return the folder of an installed package.

    Raises:
        ImportError: it is not installed.
    """
    found = find_spec(package)
    if found is None or found.origin is None:
        raise ImportError(f"No module named '{package}'", name=package)
    return Path(found.origin).parent


@contextmanager
def quiet_output() -> Generator[None]:
    """Send what C code prints nowhere: PyBullet greets at import and at each connect.

    Works on the file descriptors, which Python's own redirection does not reach. Exceptions pass.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    kept = {number: os.dup(number) for number in (1, 2)}
    try:
        with open(os.devnull, "wb") as nowhere:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        # Into a file or a pipe C prints with a buffer, which would come out after the switch back.
        ctypes.CDLL(None).fflush(None)
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)


def missing_library(module: str, error: Exception) -> MissingLibraryError:
    """Return the error that names what to install, from what the loader said."""
    text = str(error)
    packages = [package for library, package in APT_PACKAGES.items() if library in text]
    if not packages:
        return MissingLibraryError(
            f"{module} cannot be imported: {text}. Install it with the project's dependencies "
            "(`uv sync --inexact`, or `pip install realsim`); `realsim doctor` says what else is "
            "missing."
        )
    return MissingLibraryError(
        f"{module} is installed, but a library of the system is missing: {text}. It comes with "
        f"{packages[0]}; install with `sudo apt-get install --no-install-recommends "
        f"{packages[0]}`. `realsim doctor` says what else is missing."
    )


def _plotly_when_called() -> None:
    """Put a module before Open3D's figures in Plotly, whose import costs 2.5 CPU s, until a call.

    A figure that is asked for imports the real module, Plotly and Dash.
    """
    name = "open3d.visualization.draw_plotly"

    def later(function: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if sys.modules.get(name) is module:
                del sys.modules[name]
            return getattr(importlib.import_module(name), function)(*arguments, **options)

        return call

    module = ModuleType(name)
    for function in ("get_plotly_fig", "draw_plotly", "draw_plotly_server"):
        setattr(module, function, later(function))
    sys.modules.setdefault(name, module)


def offer(extra: str) -> str:
    """Return the commands that install an extra."""
    pip = f"`pip install 'realsim[{extra}]'`"
    return f"Install it with: `uv sync --inexact --extra {extra}`, or {pip}"


def import_extra(module: str, extra: str, use: str, instead: str = "") -> Any:
    """Return a module that an extra brings.

    Args:
        module: as it is imported.
        extra: name of the extra.
        use: what needs it; the subject of the message.
        instead: what works without it, as a sentence.

    Raises:
        MissingLibraryError: it cannot be imported; the message says what to type.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"{use} needs {module.split('.', maxsplit=1)[0]}, which cannot be imported ({error}). "
            f"{offer(extra)}. {instead}".rstrip()
        ) from error


def import_pixar(modules: tuple[str, ...], use: str, instead: str) -> Any:
    """Return Pixar's package `pxr` with those of its modules; `use` and `instead` as above.

    Raises:
        MissingLibraryError: one of them cannot be imported.
    """
    for name in modules:
        import_extra(f"pxr.{name}", "usd", use, instead)
    return importlib.import_module("pxr")


@cache  # the search for its libraries is dear, and loops ask for it
def import_open3d() -> Any:
    """Return the module `open3d`; the only way realsim imports it.

    Raises:
        MissingLibraryError: it, or a library that it calls, is missing.
    """
    try:
        _preload_libusb()
        _plotly_when_called()
        stand_ins.for_windows(_folder_of("open3d").glob("libOpen3D.so*"))
        with unbroken():  # half loaded, it ends the process with a code of its own
            return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise missing_library("open3d", error) from error


def pybullet_client() -> Any:
    """Return a physics world of PyBullet's own, which nothing else is in; `disconnect` frees it."""
    with quiet_output():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        return BulletClient(connection_mode=pybullet.DIRECT)


def import_pinocchio() -> Any:
    """Return the module `pinocchio`, with an OpenMP of another wheel where the system has none."""
    try:
        stand_ins.lend("libgomp.so.1", _folder_of("numpy").parent.glob("*.libs/libgomp-*"))
        return importlib.import_module("pinocchio")
    except (ImportError, OSError) as error:
        raise missing_library("pinocchio", error) from error


def import_pycolmap() -> Any:
    """Return the module `pycolmap`, which must not answer SIGTERM with a stack trace as it does."""
    with unbroken():
        import pycolmap
    return pycolmap


def import_pyrealsense2() -> Any:
    """Return the module `pyrealsense2`; the only way realsim imports it.

    Raises:
        MissingLibraryError: it or its libusb is missing; the message says what to install.
    """
    try:
        _preload_libusb()
        return importlib.import_module("pyrealsense2")
    except (ImportError, OSError) as error:
        raise missing_library("pyrealsense2", error) from error


# --- rotations --------------------------------------------------------------------------------


def quaternion_xyzw_from_R(R: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4), order x y z w (pybullet, pycolmap, ROS, scipy)."""
    return np.roll(se3.quaternion_wxyz(np.asarray(R, dtype=np.float64)[..., :3, :3]), -1, axis=-1)


def R_from_quaternion_xyzw(q: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of a quaternion (..., 4), order x y z w.

    Raises:
        InputError: a quaternion has no length, so it has no direction.
    """
    q = np.asarray(q, dtype=np.float64)
    if not np.all(np.linalg.norm(q, axis=-1) > 1e-9):
        raise InputError(
            f"the quaternion {q.tolist()} has no length; four numbers x y z w of unit length are "
            "expected."
        )
    return se3.from_quaternion_wxyz(np.roll(q, 1, axis=-1))


# --- gtsam ------------------------------------------------------------------------------------


def pose3_from_T(T: ArrayLike) -> Any:
    """Return the gtsam.Pose3 of a (4, 4) transform."""
    import gtsam

    # Pose3's constructor takes whatever matrix it is given, so it is made rigid first.
    return gtsam.Pose3(se3.check_rigid(T, "the transform given to gtsam"))


def T_from_pose3(pose: Any) -> Array:
    """Return the (4, 4) transform of a gtsam.Pose3."""
    return np.array(pose.matrix(), dtype=np.float64)


# --- pybullet ---------------------------------------------------------------------------------


def T_from_pybullet(position: ArrayLike, xyzw: ArrayLike) -> Array:
    """Return the (4, 4) transform of pybullet's position (3,) [m] and quaternion x y z w."""
    return se3.from_rt(R_from_quaternion_xyzw(xyzw), position)


def pybullet_from_T(T: ArrayLike) -> tuple[list[float], list[float]]:
    """Return position [m] and quaternion x y z w of a (4, 4) transform, as pybullet wants them.

    A body's position in pybullet is that of its centre of mass, not of its mesh's origin: what
    stands here is the frame given, nothing more.
    """
    T = np.asarray(T, dtype=np.float64)
    position: list[float] = T[:3, 3].tolist()
    xyzw: list[float] = quaternion_xyzw_from_R(T[:3, :3]).tolist()
    return position, xyzw


# --- viser ------------------------------------------------------------------------------------


def viser_wxyz_position(T: ArrayLike) -> tuple[Array, Array]:
    """Return quaternions w x y z (..., 4) and positions (..., 3) of transforms, as viser wants."""
    T = np.asarray(T, dtype=np.float64)
    return se3.quaternion_wxyz(T[..., :3, :3]), T[..., :3, 3].copy()


# --- pycolmap ---------------------------------------------------------------------------------


def colmap_from_opencv_px(uv: ArrayLike) -> Array:
    """Return COLMAP's pixel coordinates (..., 2) of OpenCV's (integers are centres)."""
    return np.asarray(uv, dtype=np.float64) + COLMAP_PIXEL_SHIFT


def opencv_from_colmap_px(uv: ArrayLike) -> Array:
    """Return OpenCV's pixel coordinates (..., 2) of COLMAP's (centres at +0.5)."""
    return np.asarray(uv, dtype=np.float64) - COLMAP_PIXEL_SHIFT


def rigid3d_from_T(T_cam_world: ArrayLike) -> Any:
    """Return the pycolmap.Rigid3d `cam_from_world` of T_cam_world (4, 4)."""
    import pycolmap

    T = se3.check_rigid(T_cam_world, "T_cam_world")
    rotation = pycolmap.Rotation3d(quaternion_xyzw_from_R(T[:3, :3]))
    return pycolmap.Rigid3d(rotation, T[:3, 3].copy())


def T_from_rigid3d(cam_from_world: Any) -> Array:
    """Return T_cam_world (4, 4) of a pycolmap.Rigid3d `cam_from_world`."""
    R = R_from_quaternion_xyzw(cam_from_world.rotation.quat)
    return se3.from_rt(R, cam_from_world.translation)


# --- Universal Robots -------------------------------------------------------------------------


def T_from_rotation_vector_pose(pose: ArrayLike) -> Array:
    """Return the (4, 4) transform of a UR controller's pose [x y z rx ry rz] [m, rad].

    The last three are a rotation VECTOR (axis times angle), not roll, pitch and yaw.
    """
    x = np.asarray(pose, dtype=np.float64)
    if x.shape[-1] != 6:
        raise InputError(
            f"a UR pose has six numbers [x y z rx ry rz], got an array of shape {x.shape}."
        )
    return se3.from_rt(se3.exp_so3(x[..., 3:]), x[..., :3])


def rotation_vector_pose_from_T(T: ArrayLike) -> Array:
    """Return the UR controller's pose [x y z rx ry rz] (..., 6) [m, rad] of a transform."""
    T = np.asarray(T, dtype=np.float64)
    return np.concatenate([T[..., :3, 3], se3.log_so3(T[..., :3, :3])], axis=-1)


# --- OpenGL cameras ---------------------------------------------------------------------------


def T_world_gl_from_cam(T_world_cam: ArrayLike) -> Array:
    """Return the pose (..., 4, 4) of the same camera in OpenGL axes (y up, z backward)."""
    return np.asarray(T_world_cam, dtype=np.float64) @ T_CAM_GL


def T_world_cam_from_gl(T_world_gl: ArrayLike) -> Array:
    """Return T_world_cam (..., 4, 4), OpenCV axes, of a camera given in OpenGL axes."""
    return np.asarray(T_world_gl, dtype=np.float64) @ T_CAM_GL


@contextmanager
def unbroken() -> Generator[None]:
    """Let Ctrl-C and SIGTERM wait for the end of a block.

    Trimesh catches them as failures of its own, and goes on without a mesh's colours.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # they never come here
        return
    came: list[int] = []
    both = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda n, _: came.append(n)) for number in both]
    try:
        yield
    finally:
        for number, handler in zip(both, before, strict=True):
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in came[:1]:
            signal.raise_signal(number)


def give_back_memory() -> None:
    """Give the system what was freed: glibc keeps tens of megabytes of large arrays otherwise."""
    with suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
