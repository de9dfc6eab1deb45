"""The cameras of a recording, and whether depth is on the colour image's pixels already."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bags import realsense as rs
from realsim.formats.bags import topics as ci
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.tf_tree import TfTree
from realsim.formats.bags.topics import CAMERA_INFO, BagChoice, ImageTopic, Topics
from realsim.records import CameraIntrinsics

SAME_PIXEL = 0.01
"""Cameras that differ by less than this everywhere are one [px]."""
SAME_PLACE = 1e-6
"""Cameras that are nearer than this are at one place [m, and rad]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reprojection:
    """How depth gets onto the colour image's pixels."""

    depth_camera: CameraIntrinsics
    T_colour_depth: Array
    """(4, 4) depth camera in the colour camera [m]."""


def colour_camera(recording: Recording, topics: Topics, choice: BagChoice) -> CameraIntrinsics:
    """Return the camera of the colour images.

    Raises:
        InputError: no CameraInfo and none given, or one that cannot be used.
    """
    image = topics.colour.image
    if choice.intrinsics is not None:
        given = choice.intrinsics
        if (given.width, given.height) != (image.width, image.height):
            raise InputError(
                f"the camera given is for images of {given.width}x{given.height}, but "
                f"{topics.colour.name} has {image.width}x{image.height}."
            )
        return given
    if topics.colour_info is None:
        infos = recording.of_type(CAMERA_INFO)
        has = f"there are {', '.join(t.name for t in infos)}" if infos else "there is none at all"
        raise InputError(
            f"{recording.path.name} has no CameraInfo for {topics.colour.name}: {has}. Choose one "
            "(camera_info=), or give the camera in a file (intrinsics=)."
        )
    rs.check_model(recording, topics.colour.name)
    return _of_topic(recording, topics.colour_info, topics.colour)


def _of_topic(recording: Recording, info: str, image: ImageTopic) -> CameraIntrinsics:
    message = recording.first_decoded(info)
    rectified = ci.is_rectified(image.name)
    return ci.camera_of(message, info, image.image.width, image.image.height, rectified)


def reprojection(
    recording: Recording,
    topics: Topics,
    depth: ImageTopic,
    colour: CameraIntrinsics,
    tree: TfTree,
    choice: BagChoice,
) -> tuple[Reprojection | None, str]:
    """Return how depth gets onto the colour image (None: it is there already), and a note.

    Raises:
        InputError: it is not there, and what it takes is not in the recording.
    """
    size = (colour.width, colour.height) == (depth.image.width, depth.image.height)
    same_frame = bool(depth.frame_id) and depth.frame_id == topics.colour.frame_id
    stream = rs.stream_of(depth.name) is not None  # its frame ids say nothing
    if topics.depth_info is None:
        if size and same_frame and not stream:
            return None, (
                f"{depth.name} has no CameraInfo; its frame and size are those of the colour "
                "images, so it was taken to be on their pixels."
            )
        raise _cannot(recording, topics, depth, "it has no CameraInfo (depth_camera_info=)")
    camera = _of_topic(recording, topics.depth_info, depth)
    T, source = choice.T_colour_depth, "given"
    if T is None and stream:
        T, source = rs.extrinsics(recording, depth.name, topics.colour.name), "the recording's"
    elif T is None and same_frame:
        T, source = np.eye(4), "one frame"
    elif T is None:
        T = _static(tree, topics.colour.frame_id, depth.frame_id)
        source = f"tf, {topics.colour.frame_id} to {depth.frame_id}"
    if T is None:
        raise _cannot(
            recording, topics, depth,
            f"neither tf nor the recording says how frame '{depth.frame_id}' lies to "
            f"'{topics.colour.frame_id}'",
        )  # fmt: skip
    if float(np.abs(T - np.eye(4)).max()) < SAME_PLACE and _same(camera, colour):
        return None, f"{depth.name} is on the colour image's pixels."
    offset = float(np.linalg.norm(T[:3, 3])) * 1e3
    return Reprojection(depth_camera=camera, T_colour_depth=T), (
        f"{depth.name} ({camera.width}x{camera.height}, {offset:.1f} mm from the colour camera by "
        f"{source}) was projected onto the colour image's pixels."
    )


def _same(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    """Return whether two cameras see the same with every pixel."""
    size = (a.width, a.height) == (b.width, b.height)
    close = float(np.abs(a.K - b.K).max()) < SAME_PIXEL
    return size and close and bool(np.allclose(a.distortion, b.distortion, atol=1e-6))


def _static(tree: TfTree, colour: str, depth: str) -> Array | None:
    """Return T_colour_depth of tf_static; cameras that move against each other are no pair."""
    if not colour or not depth or len(tree.times_ns(colour, depth)):
        return None
    return tree.lookup(colour, depth, 0, 1.0)


def _cannot(recording: Recording, topics: Topics, depth: ImageTopic, why: str) -> InputError:
    aligned = [t for t in recording.topics if "aligned" in t and "info" not in t]
    other = f" Aligned topics here: {', '.join(aligned)}." if aligned else ""
    return InputError(
        f"{depth.name} is not known to be on the pixels of {topics.colour.name}: {why}. Choose an "
        "aligned topic (depth=/camera/aligned_depth_to_color/image_raw is RealSense's), give the "
        f"depth camera's pose (T_colour_depth=), or import colour alone (without_depth).{other}"
    )
