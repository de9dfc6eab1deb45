"""What is asked of a registration, and its constants: what a session's calibration knows."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.stages import arm_sigma_mm
from realsim.errors import InputError
from realsim.records.calibration import DepthBias
from realsim.store import SessionStore
from realsim.untrusted.own_json import number_from_json, read_values

if TYPE_CHECKING:
    from realsim.registration.config import Method, RegistrationConfig

BIAS_FILE = "calibration/depth_bias.json"
CACHE = "registration/cache"
"""Where in a session what is derived from meshes is kept; it can be deleted at any time."""
OFF = "off"
"""Instead of a file: the depth is taken as measured."""
HAND_HELD_MM, HAND_HELD_DEG = 2.0, 0.5
"""1-sigma of cameras that odometry placed, as measured in simulation."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RegisterRequest:
    """What the command line asks for."""

    method: "Method" = "joint"
    objects: tuple[str, ...] = ()
    """What is there, and where; empty = as the session's starts say."""
    find_all: bool = False
    """Whether to find out which of the models are there."""
    from_review: bool = False
    """Whether to start from the scene as its reviewers left it."""
    library: Path | None = None
    """Models that the session has not; None = there are no others."""
    views: int | None = None
    """At most so many, spread evenly; None = all."""
    refine_cameras: bool = True
    hand_held: bool = False
    """Whether the cameras' poses are found from the depth images alone."""
    odometry: bool = False
    """Whether the robot's poses are checked by odometry from the depth images (KISS-ICP)."""
    depth_bias: str = ""
    """A file, `off`, or empty = that of the session's calibration, if it has one."""


def config_of(store: SessionStore, request: RegisterRequest) -> "RegistrationConfig":
    """Return the defaults, with what was asked and what the session's calibration knows.

    Raises:
        InputError: the depth bias cannot be read.
    """
    from realsim.registration.config import RegistrationConfig
    from realsim.store import load_hand_eye

    config = RegistrationConfig(
        # The paper's way carries poses by the cameras as they are claimed.
        method=request.method,
        refine_cameras=request.refine_cameras and request.method != "top-down",
        field_folder=store.path(CACHE), bias=_bias_of(store, request), odometry=request.odometry,
    )  # fmt: skip
    if request.depth_bias == OFF:
        config = replace(config, refine=replace(config.refine, fit_bias=False))
    if request.hand_held:
        return replace(config, arm_sigma_mm=HAND_HELD_MM, arm_sigma_deg=HAND_HELD_DEG)
    if not store.has("calibration/hand_eye.json"):
        return config
    hand_eye, c = load_hand_eye(store), config.covariance
    # Where cameras are not refined, an error of the hand-eye moves every object alike.
    covariance = replace(
        c,
        systematic_translation_m=float(
            np.hypot(c.systematic_translation_m, hand_eye.sigma_mm / 1e3)
        ),
        systematic_rotation_deg=float(np.hypot(c.systematic_rotation_deg, hand_eye.sigma_deg)),
    )
    return replace(
        config, covariance=covariance, arm_sigma_mm=arm_sigma_mm(hand_eye),
        hand_eye_sigma_mm=hand_eye.sigma_mm, hand_eye_sigma_deg=hand_eye.sigma_deg,
    )  # fmt: skip


def _bias_of(store: SessionStore, request: RegisterRequest) -> DepthBias:
    """Return the depth camera's bias: as asked for, else as the session's calibration says."""
    if request.depth_bias == OFF:
        return DepthBias.none()
    if request.depth_bias:
        return load_depth_bias(Path(request.depth_bias))
    return load_depth_bias(store.path(BIAS_FILE)) if store.has(BIAS_FILE) else DepthBias.none()


def load_depth_bias(path: Path) -> DepthBias:
    """Return the bias that a calibration measured; none where it could not.

    Raises:
        InputError: it is no such file.
    """
    value: Any = read_values(path)
    try:
        if not value["known"]:
            return DepthBias.none()
        low, high = (number_from_json(v) for v in value["range_m"])
        return DepthBias(
            scale=float(value["scale"]), offset_per_m=float(value["offset_per_m"]),
            covariance=np.array(value["covariance"], dtype=np.float64),
            noise_per_m=number_from_json(value["noise_per_m"]), range_m=(low, high),
            separable=bool(value["separable"]),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"'{path}' is no depth bias: its entries are others. `realsim calibrate` writes one to "
            f"{BIAS_FILE}; give such a file, or --depth-bias {OFF}."
        ) from error
