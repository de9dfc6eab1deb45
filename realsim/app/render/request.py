"""What `realsim render` was asked for: which views, which camera, which look."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from realsim.app.generate.request import depth_model_of
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.many import Workers
from realsim.records import CameraIntrinsics, Scene
from realsim.rendering.depth_sensors.profiles import PROFILES
from realsim.store import SessionStore
from realsim_sim_bridge.synthetic.config import SyntheticConfig, hemisphere_cameras

LARGEST_VIEWS = 100_000
"""More views than this are a typing error."""
LARGEST_PX = 8192
"""Wider or higher pictures are a typing error."""
DEFAULT_CAMERA = "d405"
DEFAULT_RADIUS_M = (0.4, 0.7)
"""Distance of new views where no real ones tell it [m]: the D405's best range."""
CAMERA_STREAM = 7
"""Stream of chance of the camera poses, apart from those of the frames."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RenderRequest:
    """What the user asked for; empty = decided from the session."""

    views: int | str = "real"
    """'real' or a number of new ones."""
    out: Path | None = None
    renderer: str = "embedded"
    depth: str = "disparity"
    sensor: str | None = None
    """Name of a depth profile."""
    depth_model: Path | None = None
    """File of `realsim depth-fit`."""
    radius: str = ""
    """A-B [m], of new views."""
    size: str = ""
    """WxH [px], of new views."""
    hdri: Path | None = None
    """Panorama of the surroundings."""
    materials: tuple[str, ...] = ()
    """table=KIND."""
    seed: int = 0
    where: Workers = 1

    def __post_init__(self) -> None:
        """Check what can be checked without the session.

        Raises:
            InputError: an option that cannot be; it is named.
        """
        if self.new_views is None:
            for option, value in (("--radius", self.radius), ("--size", self.size)):
                if value:
                    raise InputError(
                        f"{option} is for new views; the twins of real frames stand where the real "
                        f"cameras stood and have their size. Leave it away, or give --views N."
                    )
        radius_of(self.radius)
        size_of(self.size)
        if self.sensor and self.sensor not in PROFILES:
            raise InputError(
                f"--sensor '{self.sensor}' is not known; the depth cameras are: "
                f"{', '.join(sorted(PROFILES))}."
            )
        depth_model_of(self.depth_model, self.depth)
        if self.hdri is not None and not self.hdri.is_file():
            raise InputError(
                f"--hdri '{self.hdri}' is no file; an equirectangular .hdr or .exr is expected."
            )

    @property
    def new_views(self) -> int | None:
        """How many new views; None = the real ones' twins.

        Raises:
            InputError: neither a number nor `real`.
        """
        if self.views == "real":
            return None
        if str(self.views).isdecimal() and 1 <= int(self.views) <= LARGEST_VIEWS:
            return int(self.views)
        raise InputError(
            f"--views '{self.views}' is neither 'real' nor a number of new views from 1 to "
            f"{LARGEST_VIEWS}."
        )

    def folder(self, session: Path) -> Path:
        """Return where the views go: without --out, a folder for each set of options.

        Views of other options would be refused in the same folder.
        """
        if self.out is not None:
            return self.out
        name = "real" if self.new_views is None else f"new{self.new_views}"
        chosen = [
            self.sensor,
            self.depth_model.stem if self.depth_model else "",
            f"{self.radius}m" if self.radius else "",
            self.size,
            self.hdri.stem if self.hdri else "",
            *self.materials,
            f"seed{self.seed}" if self.seed else "",
        ]
        parts = [name, self.renderer, self.depth, *(c for c in chosen if c)]
        return session / "synthetic" / re.sub(r"[^\w.-]+", "_", "-".join(parts))

    def config(self, store: SessionStore) -> SyntheticConfig:
        """Return the settings; twins store depth as their session does, so that both compare."""
        unit_m = store.session.depth_unit_m if self.new_views is None else None
        return SyntheticConfig(
            renderer=self.renderer, depth=self.depth,  # pyright: ignore[reportArgumentType]
            profile=self.sensor or camera_of(store), depth_unit_m=unit_m,
            depth_model=depth_model_of(self.depth_model, self.depth),
        )  # fmt: skip


def camera_of(store: SessionStore) -> str:
    """Return the depth profile whose name is in what the session says of its camera."""
    said = str(store.extra.get("camera", "")).lower()
    return next((name for name in sorted(PROFILES) if name in said), DEFAULT_CAMERA)


def radius_of(text: str) -> tuple[float, float] | None:
    """Return the range of distances A-B, or A alone [m]; None for an empty text.

    Raises:
        InputError: it is no range of distances.
    """
    if not text:
        return None
    number = r"(\d+\.?\d*|\.\d+)"
    found = re.fullmatch(f"{number}(?:-{number})?", text.strip())
    low, high = (float(found[1]), float(found[2] or found[1])) if found else (0.0, 0.0)
    if not 0 < low <= high <= 20:
        raise InputError(
            f"--radius '{text}' is no range of distances; A-B in metres, up to 20, such as "
            "0.4-0.7, is one."
        )
    return low, high


def size_of(text: str) -> tuple[int, int] | None:
    """Return width and height of a text WxH [px]; None for an empty text.

    Raises:
        InputError: it is no size.
    """
    if not text:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip())
    if found is None or not all(16 <= int(n) <= LARGEST_PX for n in found.groups()):
        raise InputError(
            f"--size '{text}' is no size; WIDTHxHEIGHT from 16 to {LARGEST_PX} px, such as "
            "1280x720, is one."
        )
    return int(found[1]), int(found[2])


def resized(intrinsics: CameraIntrinsics, width: int, height: int) -> CameraIntrinsics:
    """Return the same lens with a picture of another size: as wide a view, cut or grown in height.

    Pixel x covers x - 0.5 to x + 0.5, so x' + 0.5 = s (x + 0.5).
    """
    s = width / intrinsics.width
    return replace(
        intrinsics, width=width, height=height, fx=s * intrinsics.fx, fy=s * intrinsics.fy,
        cx=s * (intrinsics.cx + 0.5) - 0.5,
        cy=s * (intrinsics.cy + 0.5) - 0.5 + 0.5 * (height - s * intrinsics.height),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class WantedViews:
    """The cameras of a run."""

    intrinsics: CameraIntrinsics
    Ts_world_cam: Array
    """(N, 4, 4) [m]."""
    real: tuple[int, ...] | None
    """Numbers of the real views that they are twins of; None = new views."""


def wanted_views(store: SessionStore, scene: Scene, request: RenderRequest) -> WantedViews:
    """Return the cameras: those of the real views, or new ones around the objects.

    Raises:
        InputError: no real view has a camera pose.
    """
    known = store.session.Ts_world_cam
    real = np.array(list(known.values())).reshape(-1, 4, 4)
    if request.new_views is None:
        if not known:
            raise InputError(
                f"session '{store.folder}' has no view with a camera pose, so there is nothing to "
                "render a twin of. Calibrate or register it, or give --views N for new views."
            )
        return WantedViews(
            intrinsics=store.session.intrinsics, Ts_world_cam=real, real=tuple(known)
        )
    intrinsics, size = store.session.intrinsics, size_of(request.size)
    if size is not None:
        intrinsics = resized(intrinsics, *size)
    shown = [o for o in scene.objects if o.verdict != "rejected"]
    center = np.mean([o.T_world_obj[:3, 3] for o in shown], axis=0)
    radius = radius_of(request.radius)
    if radius is None and known:
        away = np.linalg.norm(real[:, :3, 3] - center, axis=1)
        radius = float(away.min()), float(away.max())
    rng = np.random.default_rng([request.seed, CAMERA_STREAM])
    # The hemisphere stands on the table, whichever way the world lies.
    T_world_table = np.eye(4) if scene.plane is None else scene.plane.T_world_table
    center_table = se3.transform(se3.invert(T_world_table), center[None])[0]
    Ts = hemisphere_cameras(center_table, radius or DEFAULT_RADIUS_M, request.new_views, rng)
    return WantedViews(intrinsics=intrinsics, Ts_world_cam=T_world_table @ Ts, real=None)
