"""A plain folder of images as a frame source: colour, depth and robot states joined by name."""

from realsim.formats.folders.cam_info import CamInfo, find_cam_info, read_cam_info
from realsim.formats.folders.listing import FrameState, ImageFile, ImageFolder, list_folder
from realsim.formats.folders.source import FolderChoice, FolderSource, open_folder

__all__ = [
    "CamInfo",
    "FolderChoice",
    "FolderSource",
    "FrameState",
    "ImageFile",
    "ImageFolder",
    "find_cam_info",
    "list_folder",
    "open_folder",
    "read_cam_info",
]
