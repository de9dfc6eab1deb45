"""Stereo and structured-light cameras simulated from the light up."""

from realsim.rendering.stereo.camera import StereoCamera, StereoDepth
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.fit import FittedStereo, fit_stereo
from realsim.rendering.stereo.planes import disparity_statistics, grey_plane, plane_statistics

__all__ = [
    "FittedStereo",
    "StereoCamera",
    "StereoConfig",
    "StereoDepth",
    "disparity_statistics",
    "fit_stereo",
    "grey_plane",
    "plane_statistics",
]
