"""The packages that realsim stands on: what each is for, and the command that gets it."""

from dataclasses import dataclass

from realsim.interop import offer

REINSTALL = "`uv sync --inexact`, or `pip install realsim` once more"
"""How a required package is got."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Package:
    """A package of the index."""

    name: str
    """On the index, as pyproject.toml has it."""
    module: str
    """As it is imported; empty where it holds files only."""
    use: str
    """What realsim does with it."""
    extra: str = ""
    """The extra it belongs to; empty where it is required."""

    @property
    def how(self) -> str:
        """The command that gets it."""
        return offer(self.extra) if self.extra else REINSTALL


_REQUIRED = (
    ("numpy", "numpy", "arrays"),
    ("scipy", "scipy", "optimisation, search trees"),
    ("numba", "numba", "inner loops"),
    ("open3d-cpu", "open3d", "point clouds, ray casting, ICP"),
    ("kiss-icp", "kiss_icp", "camera motion from depth alone"),
    ("pycolmap", "pycolmap", "structure from motion"),
    ("gtsam", "gtsam", "factor graphs"),
    ("opencv-python-headless", "cv2", "images, targets"),
    ("pyrealsense2", "pyrealsense2", "RealSense cameras"),
    ("pybullet", "pybullet", "the Robot School's physics"),
    ("trimesh", "trimesh", "mesh files"),
    ("rosbags", "rosbags", "ROS recordings"),
    ("viser", "viser", "the review in the browser"),
    ("click", "click", "this command line"),
    ("rich", "rich", "tables and progress"),
    ("matplotlib", "matplotlib", "plots of the reports"),
    ("pillow", "PIL", "textures"),
    ("msgspec", "msgspec", "the project's own files"),
    ("jinja2", "jinja2", "pages"),
    ("threadpoolctl", "threadpoolctl", "one thread where more cost time"),
    ("eaik", "eaik.IK_Robot", "inverse kinematics"),
    ("coacd", "coacd", "convex parts of meshes"),
    ("libusb-package", "libusb_package", "libusb without the system's"),
    ("reportlab", "reportlab", "calibration targets as PDF"),
    ("ruamel.yaml", "ruamel.yaml", "YAML files"),
    ("coal", "coal", "collision distances"),
    ("pin", "pinocchio", "the arm's kinematics"),
    ("ompl", "ompl", "motion planning"),
    ("ur-rtde", "rtde_control", "the UR robot"),
    ("toppra", "toppra", "time along the arm's path"),
    ("h5py", "h5py", "HDF5 files"),
    ("isal", "isal", "fast compression of images"),
)
_EXTRAS = (
    ("looks", "example-robot-data", "", "the UR5's own meshes in the replay"),
    ("usd", "usd-core", "pxr.Usd", "USD files, scenes for Isaac Sim"),
    ("franka", "franky-control", "franky", "captures with a Franka arm"),
    ("lerobot", "av", "av", "demonstrations with videos"),
    ("lerobot", "pyarrow", "pyarrow", "tables of demonstrations"),
    ("parquet", "pyarrow", "pyarrow", "grasps as Parquet tables"),
    ("mujoco", "mujoco", "mujoco", "the Robot School's second engine"),
    ("cluster", "ray", "ray", "the Robot School on several machines"),
    ("photo", "mitsuba", "mitsuba", "photoreal pictures"),
    ("photo", "pyoidn", "pyoidn", "the denoiser of photoreal pictures"),
    ("photo", "karellen-llvm-core", "", "what Mitsuba compiles with"),
)
REQUIRED = tuple(Package(name=n, module=m, use=u) for n, m, u in _REQUIRED)
EXTRAS = tuple(Package(name=n, module=m, use=u, extra=e) for e, n, m, u in _EXTRAS)
