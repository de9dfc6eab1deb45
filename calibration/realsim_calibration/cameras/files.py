"""`cameras.json`: all cameras of a rig in one file, for programs; and back.

Every camera has besides the files of a camera alone (`exports`), which say more of it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from realsim import __version__
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, Check
from realsim.records.calibration import AnyRobotMap
from realsim.records.checked_arrays import rigid
from realsim.store.atomic import write_json
from realsim.untrusted.own_json import OwnFile, Real, from_json, read_object, to_json
from realsim_calibration.cameras.results import CamerasReport
from realsim_calibration.cameras.rig import Mount, Place

SCHEMA, VERSION = "realsim.cameras", 1


class CameraEntry(OwnFile, frozen=True, kw_only=True):
    """One camera."""

    name: str
    mount: Mount
    T: Array
    """(4, 4) in the tool (mount hand) or in the base (fixed), together with `robot_map` [m]."""
    T_alone: Array
    """(4, 4) the same for programs that know no map of the robot's error [m]."""
    sigma_mm: Real
    sigma_deg: Real
    held_out_px: Real
    held_out_mm: Real
    intrinsics: CameraIntrinsics
    views_used: int
    views_given: int


class BoardEntry(OwnFile, frozen=True, kw_only=True):
    """One board."""

    name: str
    place: Place
    T: Array | None
    """(4, 4) in the base or in the tool [m]; None = moved by hand."""


class PairEntry(OwnFile, frozen=True, kw_only=True):
    """Two cameras."""

    names: tuple[str, str]
    T_a_b: Array
    covariance: Array
    sigma_mm: Real
    sigma_deg: Real
    together: int
    apart_mm: Real
    worst: str


class RejectedEntry(OwnFile, frozen=True, kw_only=True):
    """A view that was not used."""

    camera: str
    name: str
    reason: str


class CamerasFile(OwnFile, frozen=True, kw_only=True):
    """The file."""

    schema: str
    version: int
    written_by: str
    reference: str
    """What the fixed cameras' places are in."""
    cameras: tuple[CameraEntry, ...]
    covariance: Array
    """(6 n, 6 n) of the right perturbations of all T, rotation first [rad, m]."""
    boards: tuple[BoardEntry, ...]
    pairs: tuple[PairEntry, ...]
    robot_map: AnyRobotMap | None
    bad_arm: tuple[str, ...]
    rejected: tuple[RejectedEntry, ...]
    checks: tuple[Check, ...]

    def camera(self, name: str) -> CameraEntry:
        """Return one camera.

        Raises:
            InputError: there is none of this name.
        """
        for entry in self.cameras:
            if entry.name == name:
                return entry
        known = ", ".join(c.name for c in self.cameras)
        raise InputError(f"there is no camera '{name}'; there are {known}.")


def cameras_file(report: CamerasReport) -> CamerasFile:
    """Return the file of a calibration."""
    return CamerasFile(
        schema=SCHEMA,
        version=VERSION,
        written_by=f"realsim {__version__}",
        reference=report.reference,
        cameras=tuple(
            CameraEntry(
                name=camera.name, mount=camera.mount, T=r.X, T_alone=r.X_alone,
                sigma_mm=r.sigma_mm, sigma_deg=r.sigma_deg, held_out_px=r.held_out_px,
                held_out_mm=r.held_out_mm, intrinsics=r.intrinsics,
                views_used=sum(v.used for v in report.views if v.camera == camera.name),
                views_given=sum(v.camera == camera.name for v in report.views),
            )
            for camera, r in zip(report.rig.cameras, report.cameras, strict=True)
        ),
        covariance=report.covariance,
        boards=tuple(
            BoardEntry(name=b.name, place=b.place, T=T)
            for b, T in zip(report.rig.boards, report.boards, strict=True)
        ),
        pairs=tuple(
            PairEntry(
                names=p.names, T_a_b=p.T_a_b, covariance=p.covariance, sigma_mm=p.sigma_mm,
                sigma_deg=p.sigma_deg, together=p.together, apart_mm=p.apart_mm, worst=p.worst,
            )
            for p in report.pairs
        ),
        robot_map=report.robot_map,
        bad_arm=report.bad_arm,
        rejected=tuple(
            RejectedEntry(camera=v.camera, name=v.name, reason=v.reason) for v in report.rejected
        ),
        checks=report.all_checks,
    )  # fmt: skip


def document(report: CamerasReport) -> Any:
    """Return a calibration as plain JSON values, as in the file."""
    return to_json(cameras_file(report))


def write_cameras(report: CamerasReport, path: Path | str) -> Path:
    """Write `cameras.json`, whole or not at all."""
    write_json(Path(path), document(report))
    return Path(path)


def read_cameras(path: Path | str) -> CamerasFile:
    """Return what a `cameras.json` holds.

    Raises:
        InputError: no such file, another schema or version, a missing or damaged entry.
    """
    values = read_object(Path(path))
    if values.get("schema") != SCHEMA or values.get("version") != VERSION:
        raise InputError(
            f"{path} has schema {values.get('schema')!r}, version {values.get('version')!r}; "
            f"{SCHEMA!r}, version {VERSION} is expected. Is it another file?"
        )
    found = from_json(values, CamerasFile, str(path))
    for entry in found.cameras:
        rigid(entry.T, f"{path}: camera {entry.name}")
    if found.covariance.shape != (6 * len(found.cameras),) * 2 or not np.all(
        np.isfinite(found.covariance)
    ):
        raise InputError(f"{path}: the covariance does not belong to {len(found.cameras)} cameras.")
    return found
