"""One simulated depth camera: exact depth of a known scene in, what a sensor reports out.

What goes wrong comes from one of two sources, or none:

    DepthCamera(placed)                                          exact depth
    DepthCamera(placed, DepthSensorModel.from_profile("d405"))   a noise model on the disparity
    DepthCamera(placed, StereoConfig(), profile=profile("d435")) two eyes' pictures, matched

Both kinds of figures come from a file of `realsim depth-fit` (`DepthSensorModel.load`,
`StereoConfig.load`). `measure` casts the scene itself, or takes the exact view that a renderer has
made already. Who simulates what:

- synthetic views: `exact_shadows` and `material_loss` on; the photograph is the exact view;
- the simulated lab: no meshes, the photograph is the exact view, `unit_m` is the driver's;
- simulated scans and tables: the scene of one object or of many, cast by rays; shadows from the
  depth picture alone, in counts of `unit_m` where the images are stored.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array32, Int32, Mask
from realsim.geometry.colors import luminance
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.depth_sensors.loss import look_of, material_loss
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import PROFILES, DepthProfile
from realsim.rendering.rays import PlacedMesh, RayScene
from realsim.rendering.stereo.config import StereoConfig

LEAST_LOSS = 0.005
"""A material that loses a smaller share than this loses nothing: looking it up is spared."""


class ExactView(Protocol):
    """What is really seen: a `Photo`, `Labels`, or what `DepthCamera.exact` returns."""

    @property
    def depth_m(self) -> Array32:
        """(H, W) depth along z [m]; 0 = nothing."""
        ...

    @property
    def geometry(self) -> Int32:
        """(H, W) number of the placed mesh; -1 = nothing."""
        ...


class DepthCamera:
    """A depth camera in one scene, at any pose."""

    def __init__(
        self,
        placed: Sequence[PlacedMesh] = (),
        sensor: DepthSensorModel | StereoConfig | None = None,
        *,
        profile: DepthProfile = PROFILES["d405"],
        environment: Environment | None = None,
        exact_shadows: bool = False,
        material_loss: bool = False,
        unit_m: float = 0.0,
    ) -> None:
        """Prepare the scene.

        Args:
            placed: the meshes; none are needed for a noise model that is given its exact views
                and looks for shadows in the depth picture.
            sensor: where the errors come from; None = exact depth.
            profile: baseline, range and pattern of matched stereo; a noise model has its own.
            environment: the room's light before a stereo camera; None = a grey room with a lamp.
            exact_shadows: noise model: whether rays to both eyes say what one of them cannot see;
                otherwise the depth picture alone does.
            material_loss: noise model: whether dark and mirroring surfaces lose pixels.
            unit_m: metres per count of the images: depth is rounded to it. 0 = not rounded.
        """
        self.placed, self.sensor, self.unit_m = tuple(placed), sensor, unit_m
        self._exact_shadows, self._material_loss = exact_shadows, material_loss
        if isinstance(sensor, StereoConfig):
            from realsim.rendering.stereo import StereoCamera

            self._stereo = StereoCamera(placed, profile, sensor, environment)

    @cached_property
    def scene(self) -> RayScene:
        """The meshes, ready to be hit by rays."""
        return RayScene(self.placed)

    def exact(self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike) -> ExactView:
        """Return what is really there, by one ray through each pixel's centre."""
        return self.scene.view(intrinsics, T_world_cam)

    def measure(
        self,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
        exact: ExactView | None = None,
    ) -> Array32:
        """Return what the camera reports of a view: (H, W) depth [m], 0 = no measurement.

        Args:
            intrinsics: the depth picture's camera, raw.
            T_world_cam: (4, 4) the camera, its first eye, in world [m].
            rng: source of all chance; the same state gives the same bytes.
            exact: what a renderer saw from there; None = it is cast.

        Raises:
            InputError: the exact view has another size than the camera.
        """
        depth = self._measured(intrinsics, T_world_cam, rng, exact)
        if self.unit_m == 0:
            return depth
        unit = np.float32(self.unit_m)
        return np.round(depth / unit) * unit

    def _measured(
        self,
        intrinsics: CameraIntrinsics,
        T_world_cam: ArrayLike,
        rng: np.random.Generator,
        exact: ExactView | None,
    ) -> Array32:
        """Return the depth before it is counted."""
        if isinstance(self.sensor, StereoConfig):
            return self._stereo.measure(intrinsics, T_world_cam, rng).depth_m
        seen = self.exact(intrinsics, T_world_cam) if exact is None else exact
        if self.sensor is None:
            return seen.depth_m
        loss = reflectance = None
        if self._material_loss:
            shares, albedo = self._materials
            if np.any(shares > 0):
                loss = shares[seen.geometry]
            if self.sensor.signal_range_m > 0:
                reflectance = exposed(albedo[seen.geometry], seen.geometry >= 0)
        return self.sensor.measure(
            seen.depth_m, intrinsics, rng,
            scene=self.scene if self._exact_shadows else None, T_world_cam=T_world_cam,
            loss=loss, reflectance=reflectance,
        )  # fmt: skip

    @cached_property
    def _materials(self) -> tuple[Array32, Array32]:
        """Share lost and reflectance (G + 1,) of each mesh; the last entry answers -1, nothing."""
        looks = [look_of(p) for p in self.placed]
        shares = np.array([*map(self._share, looks), 0.0], np.float32)
        albedo = [float(luminance(look.base_color)) for look in looks]
        return shares, np.array([*albedo, 1.0], np.float32)

    def _share(self, look: Material) -> float:
        """Return the share of a material's pixels that is lost."""
        assert isinstance(self.sensor, DepthSensorModel)
        if self.sensor.signal_range_m > 0:
            # The model has a limit of its own for dark surfaces, which grows with distance.
            look = Material(roughness=look.roughness, metallic=look.metallic)
        share = material_loss(look)
        return share if share >= LEAST_LOSS else 0.0


def exposed(reflectance: Array32, seen: Mask) -> Array32:
    """Return reflectance (H, W) as a camera that sets its own exposure finds it, white = 1.

    The range of a fitted model was found before one wall or table, which the camera exposed for; so
    is a scene, by its mean, and only what is darker than that is short of light.

    Args:
        reflectance: (H, W) of the surfaces [0, 1].
        seen: (H, W) where there is a surface.
    """
    mean = float(reflectance[seen].mean()) if np.any(seen) else 1.0
    return np.minimum(reflectance / np.float32(max(mean, 1e-3)), np.float32(1))
