"""Stereo and structured-light cameras simulated from the light up."""

from realsim.rendering.stereo.camera import StereoCamera, StereoDepth
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.fit import FittedStereo, fit_stereo

__all__ = ["FittedStereo", "StereoCamera", "StereoConfig", "StereoDepth", "fit_stereo"]
