"""The simulated depth camera of synthetic views: exact, a noise model on disparity, or stereo.

The noise model is told what only the scene knows: which surfaces the second eye cannot see, by rays
to it, and which materials return too little light or mirror it away.
"""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.loss import material_loss
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.developing import srgb_decoded
from realsim.rendering.photo import Photo
from realsim.rendering.rays import PlacedMesh, RayScene
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene

Array32 = NDArray[np.float32]
Chance = np.random.Generator
LEAST_LOSS = 0.005
"""A material that loses a smaller share than this loses nothing: looking it up is spared."""
TEXELS = 10_000
"""So many texels, evenly spread, are a texture's mean."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear red, green and blue (ITU-R BT.709)."""


class DepthSource(Protocol):
    """A depth camera that looks at the scene."""

    def measure(
        self, photo: Photo, camera: CameraIntrinsics, T_world_cam: ArrayLike, rng: Chance
    ) -> Array32:
        """Return what it reports (H, W) [m] of the view of a photograph; 0 = none."""
        ...


def depth_source(synthetic: SyntheticScene, config: SyntheticConfig) -> DepthSource:
    """Return the depth camera that the config names."""
    if config.depth == "clean":
        return ExactCamera()
    if config.depth == "stereo":
        return MatchingCamera(synthetic, config)
    return DisparityCamera(synthetic, config)


class ExactCamera:
    """Reports exact depth."""

    def measure(
        self, photo: Photo, camera: CameraIntrinsics, T_world_cam: ArrayLike, rng: Chance
    ) -> Array32:
        """See `DepthSource`."""
        return photo.depth_m


class DisparityCamera:
    """The noise model on exact disparity, with the shadows and materials of the scene."""

    def __init__(self, synthetic: SyntheticScene, config: SyntheticConfig) -> None:
        """Prepare the scene and what each of its materials loses."""
        self.model = config.depth_model or DepthSensorModel.from_profile(config.profile)
        placed = synthetic.placed()
        self._scene = RayScene(placed)
        looks = [look_of(p) for p in placed]
        # The last entry answers geometry -1: where no ray meets anything nothing is lost.
        shares = [self._share(look) for look in looks] if config.material_loss else []
        self._shares = np.array([*shares, 0.0], np.float32)
        albedo = [float(LUMINANCE @ np.array(look.base_color)) for look in looks]
        self._reflectance = np.array([*albedo, 1.0], np.float32)

    def _share(self, look: Material) -> float:
        """Return the share of a material's pixels that is lost."""
        if self.model.signal_range_m > 0:
            # The model has a limit of its own for dark surfaces, which grows with distance.
            look = Material(roughness=look.roughness, metallic=look.metallic)
        share = material_loss(look)
        return share if share >= LEAST_LOSS else 0.0

    def measure(
        self, photo: Photo, camera: CameraIntrinsics, T_world_cam: ArrayLike, rng: Chance
    ) -> Array32:
        """See `DepthSource`."""
        loss = reflectance = None
        if np.any(self._shares > 0) or self.model.signal_range_m > 0:
            loss = self._shares[photo.geometry] if np.any(self._shares > 0) else None
            if self.model.signal_range_m > 0:
                reflectance = exposed(self._reflectance[photo.geometry], photo.geometry >= 0)
        return self.model.measure(
            photo.depth_m, camera, rng, scene=self._scene, T_world_cam=T_world_cam,
            loss=loss, reflectance=reflectance,
        )  # fmt: skip


class MatchingCamera:
    """Both eyes' pictures, matched."""

    def __init__(self, synthetic: SyntheticScene, config: SyntheticConfig) -> None:
        """Prepare both eyes."""
        from realsim.rendering.stereo import StereoCamera

        self._camera = StereoCamera(
            synthetic.placed(), profile(config.profile), environment=synthetic.environment
        )

    def measure(
        self, photo: Photo, camera: CameraIntrinsics, T_world_cam: ArrayLike, rng: Chance
    ) -> Array32:
        """See `DepthSource`."""
        return self._camera.measure(camera, T_world_cam, rng).depth_m


def exposed(reflectance: Array32, seen: NDArray[np.bool_]) -> Array32:
    """Return reflectance (H, W) as a camera that sets its own exposure finds it, white = 1.

    The range of a fitted model was found before one wall or table, which the camera exposed for; so
    is a scene, by its mean, and only what is darker than that is short of light.

    Args:
        reflectance: (H, W) of the surfaces [0, 1].
        seen: (H, W) where there is a surface.
    """
    mean = float(reflectance[seen].mean()) if np.any(seen) else 1.0
    return np.minimum(reflectance / np.float32(max(mean, 1e-3)), np.float32(1))


def look_of(placed: PlacedMesh) -> Material:
    """Return a mesh's material with its mean colour as the base colour, without images.

    A mesh without a material has the mean of its texture or colours, else a light grey.
    """
    own = placed.material
    if own is None:
        mean = _mean_of_mesh(placed.mesh)
        return Material() if mean is None else Material(base_color=_color(mean))
    mean = np.array(own.base_color)
    if own.base_color_image is not None:
        mean = mean * _mean_srgb(own.base_color_image)
    return Material(base_color=_color(mean), roughness=own.roughness, metallic=own.metallic)


def _mean_of_mesh(mesh: Mesh) -> NDArray[np.float64] | None:
    """Return the mean linear colour (3,) of a mesh's own texture or colours."""
    if mesh.texture is not None:
        return _mean_srgb(mesh.texture)
    return None if mesh.colors is None else _mean_srgb(mesh.colors)


def _mean_srgb(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the mean linear light (3,) of 8-bit sRGB values (..., 3)."""
    flat = values.reshape(-1, 3)
    flat = flat[:: max(1, len(flat) // TEXELS)]
    return np.asarray(srgb_decoded(flat / 255.0), np.float64).mean(0)


def _color(mean: NDArray[np.float64]) -> tuple[float, float, float]:
    r, g, b = np.clip(mean, 0.0, 1.0).tolist()
    return r, g, b
