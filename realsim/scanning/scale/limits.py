"""How well the scale is known, and what limits it."""

import numpy as np

from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.joint import Outlook
from realsim.scanning.scale.result import Limit
from realsim.scanning.scale.state import State

OFFSET_M = 0.0002
"""An offset of the surface that nothing in a session shows [m]: gloss, translucency, powder."""


def sigma_log(look: Outlook, config: ScaleConfig) -> float:
    """Return the 1-sigma of the log scale.

    The part that the shape's error contributes is multiplied by `shape.trust`.
    """
    total = float(look.covariance[6, 6])
    shape = max(total - look.without["shape"], 0.0)
    return float(np.sqrt(total - shape + config.shape.trust**2 * shape))


def limits_of(
    look: Outlook,
    evidence: ScanEvidence,
    state: State,
    config: ScaleConfig,
) -> tuple[Limit, ...]:
    """Return what limits the scale, worst first."""
    total = float(look.covariance[6, 6])

    def share(name: str) -> float:
        return 100.0 * float(np.sqrt(max(total - look.without[name], 0.0)))

    shape_mm = 1e3 * look.shape.sigma_m
    size_mm = 1e3 * evidence.size_m
    shift, turn = (
        1e3 * float(np.linalg.norm(state.hand_eye[3:])),
        float(np.degrees(np.linalg.norm(state.hand_eye[:3]))),
    )
    rows = [
        Limit(
            name="shape", percent=config.shape.trust * share("shape"),
            text=f"the mesh's shape is off by about {shape_mm:.2f} mm, "
            f"{100 * shape_mm / size_mm:.1f} % of its size; a better mesh would help, more views "
            "would not.",
        ),
        Limit(
            name="hand-eye", percent=share("hand-eye"),
            text=f"the hand-eye was moved by {shift:.2f} mm and {turn:.3f} deg to fit table and "
            "object; what is left of its error changes the scale.",
        ),
        Limit(
            name="arm", percent=share("arm"),
            text="each robot pose has an error of its own; more views average it.",
        ),
        Limit(
            name="depth bias", percent=share("bias"),
            text="a constant error of the disparity moves all surfaces; measure it with a board "
            "(`realsim calibrate` does).",
        ),
        Limit(
            name="outline", percent=share("outline"),
            text=f"outlines in depth images lie {state.rim:+.2f} px off; by how much is estimated.",
        ),
        Limit(
            name="depth noise", percent=100.0 * float(np.sqrt(look.without["all"])),
            text="noise of the depth; more views or a shorter distance average it.",
        ),
        Limit(
            name="surface offset", percent=100.0 * 2.0 * OFFSET_M / evidence.size_m,
            text=f"not in the sigma: a surface measured {1e3 * OFFSET_M:.1f} mm off (gloss, "
            f"translucency) changes the scale by 2 x {1e3 * OFFSET_M:.1f} mm / {size_mm:.0f} mm.",
        ),
    ]  # fmt: skip
    # What is not in the sigma comes last, however large.
    return (*sorted(rows[:-1], key=lambda r: -r.percent), rows[-1])
