"""Reading what people bring: robot poses in any format and folders of images.

What the numbers mean is said by the user, stated by the file, or proven by the images; it is never
guessed. `RawPoses.possible` lists every reading that a file leaves open.
"""

from realsim_calibration.inputs.folder import (
    BoardPosesInput,
    FolderInput,
    read_board_poses,
    read_image_folder,
)
from realsim_calibration.inputs.image_files import ImageListing, list_images, load_image
from realsim_calibration.inputs.pairing import Pairing, pair
from realsim_calibration.inputs.pose_file import read_pose_file
from realsim_calibration.inputs.raw_poses import RawPoses, Said, listed_readings
from realsim_calibration.inputs.readings import (
    EULER_ORDERS,
    ROTATIONS,
    PoseReading,
    reading_from_text,
)

__all__ = [
    "EULER_ORDERS",
    "ROTATIONS",
    "BoardPosesInput",
    "FolderInput",
    "ImageListing",
    "Pairing",
    "PoseReading",
    "RawPoses",
    "Said",
    "list_images",
    "listed_readings",
    "load_image",
    "pair",
    "read_board_poses",
    "read_image_folder",
    "read_pose_file",
    "reading_from_text",
]
