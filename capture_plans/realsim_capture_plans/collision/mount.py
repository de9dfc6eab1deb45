"""Camera mounts: the usual one, and a small file for any other."""

from numpy.typing import ArrayLike

from realsim.geometry import se3
from realsim_capture_plans.collision.shapes import Mount, Shape


def d405_mount(T_ee_cam: ArrayLike | None = None) -> Mount:
    """Return a D405 on a plain bracket; by default beside the flange, optical axis along tool z.

    Args:
        T_ee_cam: (4, 4) another place of the camera [m].
    """
    T = (
        se3.from_translation([0.0, -0.065, 0.035])
        if T_ee_cam is None
        else se3.check_rigid(T_ee_cam, "T_ee_cam")
    )
    bracket: tuple[Shape, ...] = ()
    return Mount(name="D405 on a plain bracket", camera="D405", T_ee_cam=T, bracket=bracket)
