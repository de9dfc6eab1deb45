"""How much of a scene the review shows, and of what size."""

from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneConfig:
    """How much is shown; a browser without a graphics card should still turn the scene."""

    voxel_m: float = 0.002
    """Edge of the cloud's finest voxels [m]: the depth noise of the camera at 0.4 m."""
    most_points: int = 400_000
    """Points of the cloud that are kept, for those who ask for all. A table of half a square metre
    has no more voxels of 2 mm; with voxels of 0.5 mm 2 million can be asked for (30 MB)."""
    shown_points: int = 100_000
    """Points of the cloud shown unasked: without a graphics card a browser draws 100,000 at 27
    frames/s and 2 million at one [measured, SwiftShader]."""
    coarse_points: int = 20_000
    """Points of the first, coarse level, which is there as soon as the page is: 300 kB."""
    piece_points: int = 100_000
    """Points a message of the finer levels carries: 1.5 MB, a tenth of a click's time."""
    most_fused_views: int = 24
    """Views fused into the cloud: more add noise, not surface."""
    most_cameras: int = 256
    """Cameras drawn, evenly spread over the session."""
    thumbnail_px: int = 160
    """Width of the photographs in the frustums [px]."""
    thumbnail_quality: int = 70
    """JPEG quality of these photographs [%]: 4 kB each."""
    most_grasps: int = 5_000
    """Grasps drawn at once; the filters choose among all."""
    most_triangles: int = 30_000
    """Triangles of a mesh without texture; more cannot be told apart at the size of a screen."""
    most_textured_triangles: int = 100_000
    """Triangles of a mesh with a texture. Fewer than so many cost it the texture, so more are
    borne."""
    most_texels: int = 1024
    """Longest side of a texture [px]: an object is rarely shown larger."""
    frustum_m: float = 0.025
    """Length of a camera's frustum [m]."""
    margin_m: float = 0.2
    """How far about the objects the cloud is shown [m]: enough to see what they stand on."""
    grid_m: float = 1.2
    """Edge of the table's grid [m]."""

    def __post_init__(self) -> None:
        """Check that every size is positive, and that the coarse level is no more than is shown."""
        for name in ("voxel_m", "frustum_m", "margin_m", "grid_m"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)}; it must be greater than 0.")
        for name in ("most_points", "shown_points", "coarse_points", "piece_points",
                     "most_fused_views", "most_cameras", "thumbnail_px", "most_triangles",
                     "most_textured_triangles", "most_texels"):  # fmt: skip
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be 1 or more.")
        if self.most_grasps < 0:
            raise InputError(f"most_grasps is {self.most_grasps}; it must be 0 or more.")
        if not 1 <= self.thumbnail_quality <= 100:
            raise InputError(
                f"thumbnail_quality is {self.thumbnail_quality}; it must be from 1 to 100."
            )
