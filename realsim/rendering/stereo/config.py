"""What the stereo simulator lets one choose: texture, light, sensor, pattern, matcher, decoder.

Fields that govern the NOISE of depth: `full_well`, `read_noise` (photons), `texture_contrast`,
`dot_power` (what there is to match), `window_px` (how many pixels share a match),
`noise_floor_px`; for stripes `stripe_noise_px`. Fields that govern HOLES: `least_texture_snr`,
`texture_contrast`, `uniqueness_percent`, `left_right_px`, `residual_limit`, `speckle_px`; for
stripes `least_signal` and `least_modulation`.
"""

from dataclasses import dataclass

from realsim.errors import InputError
from realsim.rendering.depth_sensors.profiles import SensorRecord


@dataclass(frozen=True, kw_only=True, slots=True)
class StereoConfig(SensorRecord):
    """Scene texture, sensor, projector and matcher of a simulated stereo camera."""

    FORMAT = "realsim stereo sensor 1"
    KEY = "config"
    NAME = "a stereo configuration"
    COMMAND = "realsim depth-fit FRAMES --simulator stereo --out FILE"

    texture_contrast: float = 0.15
    """Rms of the unevenness of a rough surface's reflectance at the scale of pixels, relative:
    paper, cloth and cast parts have 0.05 to 0.2. Polished surfaces get less of it."""
    ambient: float = 1.0
    """Factor of the room's light on what the eyes see; 0 = infrared in a dark room."""
    psf_px: float = 0.6
    """Standard deviation of the lens blur [px]: an f/2 lens in focus on 3 um pixels."""
    mean_level: float = 0.40
    """Mean brightness to which the exposure is set, 1 = white (automatic exposure)."""
    full_well: float = 10000.0
    """Electrons at white: the shot noise is 1 % there. Small pixels hold about that."""
    read_noise: float = 5.0
    """Electrons of noise in the dark; 0 together with a `full_well` of 1e8 = no sensor noise."""

    dot_power: float = 0.25
    """Light of one dot on white paper at 1 m, facing, where the room's light on it is 1. A D435 at
    half power is about there indoors; it falls with distance squared."""
    dot_spacing_mrad: float = 7.0
    """Mean distance of neighbouring dots [mrad]: 4.5 px at f = 640 px."""
    dot_radius_mrad: float = 1.3
    """Gaussian radius of a dot [mrad]."""
    projector_at: float = 0.55
    """Where the dot projector stands between the eyes, as a share of the baseline."""

    window_px: int = 7
    """Edge of the window whose pixels share one match [px], odd: Intel's chip takes 5 to 7."""
    search_margin_px: int = 6
    """Disparities searched beyond the scene's own range [px]: room for wrong matches."""
    uniqueness_percent: int = 5
    """By how much the best match must beat the second best [%]."""
    left_right_px: int = 1
    """Difference of the matches found from the left and from the right that is accepted [px]."""
    least_texture_snr: float = 1.6
    """Rms gradient in the window, in units of the sensor noise's own gradient, below which a match
    is dropped: 1 is noise alone."""
    residual_limit: float = 3.0
    """Rms difference of the matched windows, in units of the expected one, above which a match is
    dropped: highlights, and windows over an edge."""
    speckle_px: int = 60
    """Islands of fewer pixels are dropped [px^2]."""
    noise_floor_px: float = 0.0
    """Noise of the disparity that no light takes away [px]: imperfect rectification and optics.
    Correlated over the window."""

    stripe_noise_px: float = 0.06
    """Noise of the decoded disparity on white paper at 1 m, facing [px]."""
    stripe_period_px: float = 16.0
    """Finest stripe on the sensor [px]: neighbouring depths within one pixel blend within it."""
    stripe_correlation_px: float = 1.5
    """Gaussian radius over which the decoder averages [px]."""
    least_signal: float = 0.03
    """Stripe light below which a pixel is lost; 1 = white paper at 1 m, facing."""
    least_modulation: float = 0.55
    """Share of the stripe contrast that must survive the blend of depths and the glare."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in (
            "texture_contrast", "ambient", "psf_px", "read_noise", "dot_power", "search_margin_px",
            "uniqueness_percent", "left_right_px", "least_texture_snr", "speckle_px",
            "noise_floor_px", "stripe_noise_px", "stripe_correlation_px", "least_signal",
            "least_modulation",
        ):  # fmt: skip
            value = getattr(self, name)
            if not 0 <= value < 1e9:
                raise InputError(f"stereo: {name} is {value}; 0 (off) or more is accepted.")
        for name in ("full_well", "dot_spacing_mrad", "dot_radius_mrad", "residual_limit",
                     "stripe_period_px"):  # fmt: skip
            if not getattr(self, name) > 0:
                raise InputError(f"stereo: {name} is {getattr(self, name)}; it must be positive.")
        if not 0 < self.mean_level < 1 or not -1 <= self.projector_at <= 2:
            raise InputError(
                f"stereo: mean_level {self.mean_level} must lie between 0 and 1 and projector_at "
                f"{self.projector_at} between -1 and 2 baselines."
            )
        if self.window_px % 2 == 0 or not 3 <= self.window_px <= 15:
            raise InputError(
                f"stereo: the window is {self.window_px} px; odd sizes from 3 to 15 are accepted."
            )

    @property
    def electron_noise(self) -> tuple[float, float]:
        """Variance of a pixel's value at black and its growth per value, 1 = white."""
        return (self.read_noise / self.full_well) ** 2, 1.0 / self.full_well
