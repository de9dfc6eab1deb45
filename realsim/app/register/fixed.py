"""The cameras of a session that stand still, as registration takes them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.register.config import BIAS_FILE, OFF, RegisterRequest, load_depth_bias
from realsim.app.register.results import CameraChange, claimed_cameras
from realsim.app.stages import require_sound
from realsim.arrays import Array, evenly
from realsim.errors import InputError
from realsim.records.calibration import DepthBias
from realsim.store import SessionStore
from realsim.store.cameras import open_cameras
from realsim.store.manifest import Manifest
from realsim.store.session_store import depth_path

if TYPE_CHECKING:
    from realsim.registration.views import FixedFrames

CALIBRATED = "calibration/cameras/cameras.json"
"""What `realsim calibrate SESSION --cameras` says of all cameras."""
UNSAID_MM, UNSAID_DEG = 2.0, 0.3
"""1-sigma of a place that no calibration of the session states."""
MOST_IMAGES = 32
"""Images of a fixed camera, evenly spread, whose median is taken."""
STANDS_MM = 0.01
"""A camera whose poses differ by more does not stand still."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FixedInput:
    """One camera that stands still."""

    store: SessionStore
    claimed: dict[int, Array]
    """View -> (4, 4) where it is said to stand [m], the same in all."""
    frames: "FixedFrames"
    key: list[Any]
    """What its part in a registration depends on."""

    def change(self, T_world_cam: Array) -> CameraChange:
        """Return its views before and after a registration that found it there."""
        return CameraChange(claimed=self.claimed, refined=dict.fromkeys(self.claimed, T_world_cam))


def read_fixed(
    store: SessionStore, request: RegisterRequest
) -> tuple[dict[str, FixedInput], list[str]]:
    """Return the cameras that take part, by name, and why others do not.

    Raises:
        InputError: one moves, or an image of it is not as it was captured.
    """
    found: dict[str, FixedInput] = {}
    told: list[str] = []
    for name, camera in open_cameras(store).items():
        claimed = claimed_cameras(camera)
        deep = [k for k in sorted(claimed) if camera.has_depth(k)]
        if request.hand_held:
            told.append(
                f"camera '{name}' is left out: --hand-held knows no base that it stands in."
            )
        elif not claimed:
            told.append(
                f"camera '{name}' is left out, it is not calibrated: run `realsim calibrate "
                f"{store.folder} --cameras wrist=hand,{name}=fixed`."
            )
        elif not deep:
            told.append(f"camera '{name}' is left out: it was recorded without depth.")
        else:
            require_sound(camera)
            _require_still(name, claimed)
            views = evenly(deep, MOST_IMAGES)
            found[name] = _input(name, (store, camera), claimed, views, request)
    return found, told


def _require_still(name: str, claimed: Mapping[int, Array]) -> None:
    Ts = np.stack(list(claimed.values()))
    apart = 1e3 * float(np.linalg.norm(np.ptp(Ts[:, :3, 3], axis=0)))
    if apart > STANDS_MM or np.abs(Ts[:, :3, :3] - Ts[0, :3, :3]).max() > 1e-6:
        raise InputError(
            f"camera '{name}' moves: its views are up to {apart:.3g} mm apart. A further camera of "
            "a session stands still; the one in the hand is the session itself."
        )


def _input(
    name: str,
    stores: tuple[SessionStore, SessionStore],
    claimed: dict[int, Array],
    views: list[int],
    request: RegisterRequest,
) -> FixedInput:
    from realsim.registration.views import FixedCamera, FixedFrames

    store, camera = stores
    bias = DepthBias.unmeasured()
    if request.depth_bias != OFF and camera.has(BIAS_FILE):
        measured = load_depth_bias(camera.path(BIAS_FILE))
        bias = measured if np.any(measured.covariance) else bias
    mm, deg = _sigmas(store.path(CALIBRATED), name)
    said = FixedCamera(
        name=name, intrinsics=camera.session.intrinsics, T_world_cam=claimed[views[0]],
        sigma_mm=mm, sigma_deg=deg, bias=bias,
    )  # fmt: skip
    listed = Manifest(camera.folder).entries
    paths = [depth_path(k) for k in views]
    key = [
        name, str(said.intrinsics), said.T_world_cam.tolist(), mm, deg, bias.scale,
        bias.offset_per_m, bias.covariance.tolist(),
        [listed[p].sha256 if p in listed else p for p in paths],
    ]  # fmt: skip
    frames = FixedFrames(camera=said, read=lambda: (camera.depth_m(k) for k in views))
    return FixedInput(store=camera, claimed=claimed, frames=frames, key=key)


def _sigmas(calibrated: Path, name: str) -> tuple[float, float]:
    """Return the 1-sigma [mm], [deg] of a camera's place, as calibrated or a usual one."""
    from realsim_calibration.cameras.files import read_cameras

    entries = read_cameras(calibrated).cameras if calibrated.is_file() else ()
    for entry in entries:
        if entry.name == name:
            return float(entry.sigma_mm), float(entry.sigma_deg)
    return UNSAID_MM, UNSAID_DEG
