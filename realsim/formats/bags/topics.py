"""Which topics of a recording are camera, depth and arm, and what a person can choose.

From sensor_msgs/CameraInfo to a camera: which matrix, which distortion, which size.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bags.joints import UR_JOINTS, prefixes
from realsim.formats.bags.pixels import ImageKind, kind_of
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.wire import image_of, joints_of
from realsim.geometry import se3
from realsim.records import CameraIntrinsics

OPENCV_MODELS = ("plumb_bob", "rational_polynomial", "brown conrady", "brown_conrady")
"""Models whose coefficients are OpenCV's k1 k2 p1 p2 k3 (k4 k5 k6)."""
INVERSE = "inverse brown conrady"
FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
TRANSPORTS = ("compressed", "compressedDepth", "ffmpeg", "theora")


def without_transport(topic: str) -> str:
    """Return the topic of the images before image_transport compressed them."""
    parent, _, last = topic.rpartition("/")
    return parent if last in TRANSPORTS else topic


def is_rectified(topic: str) -> bool:
    """Return whether a topic's name says that its images have been undistorted."""
    return "rect" in without_transport(topic).rpartition("/")[2]


def info_topic(image_topic: str, available: Collection[str]) -> str | None:
    """Return the CameraInfo topic that belongs to an image topic by name, if it is there.

    ROS puts `camera_info` beside the image; RealSense's own files put it under `info` or `image`.
    """
    image = without_transport(image_topic)
    parent = image.rpartition("/")[0]
    grandparent = parent.rpartition("/")[0]
    names = [f"{parent}/camera_info", f"{image}/camera_info", f"{grandparent}/info/camera_info"]
    return next((n for n in names if n in available), None)


def _field(message: Any, name: str) -> Array:
    """Return K, D or P; ROS1 writes them in capitals, ROS2 does not."""
    value = getattr(message, name, None)
    value = getattr(message, name.upper()) if value is None else value
    return np.asarray(value, dtype=np.float64)


def camera_of(
    message: Any, topic: str, width: int, height: int, rectified: bool
) -> CameraIntrinsics:
    """Return the camera of images of a size, from their CameraInfo.

    Args:
        message: the CameraInfo.
        topic: what errors call it.
        width: of the images [px].
        height: of the images [px].
        rectified: the images are undistorted: P and no distortion count, instead of K and D.

    Raises:
        InputError: not calibrated, a model that OpenCV's does not cover, or another size.
    """
    K, D, P = _field(message, "k"), _field(message, "d"), _field(message, "p")
    K = K.reshape(3, 3)
    if rectified and P.size == 12 and P[0] > 0:
        K, D = P.reshape(3, 4)[:, :3].copy(), np.zeros(0)
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(
            f"{topic}: the focal lengths are {K[0, 0]:g} and {K[1, 1]:g}; the driver had no "
            "calibration. Give the camera in a file (intrinsics=), or record a calibrated one."
        )
    distortion = _distortion(D, str(message.distortion_model), topic)
    K, size = _binned(K, message)
    if size != (width, height):
        raise InputError(
            f"{topic} describes images of {size[0]}x{size[1]}, but they are {width}x{height}. "
            "Choose the CameraInfo of these images (camera_info=), or give the camera in a file "
            "(intrinsics=)."
        )
    return CameraIntrinsics.from_K(K, width, height, distortion)


def _distortion(D: Array, model: str, topic: str) -> Array:
    if not np.any(D != 0):
        return np.zeros(0)
    name = model.strip().lower().replace("modified ", "")
    if name in OPENCV_MODELS:
        return D
    hint = "It is a fisheye model." if name in FISHEYE else ""
    if name.replace("_", " ") == INVERSE:
        hint = "It undistorts where OpenCV's distorts."
    raise InputError(
        f"{topic}: the distortion model is '{model}' with coefficients {D.tolist()}; plumb_bob and "
        f"rational_polynomial are accepted. {hint} Use a rectified topic if one was recorded, or "
        "calibrate the camera and give it in a file (intrinsics=)."
    )


def _binned(K: Array, message: Any) -> tuple[Array, tuple[int, int]]:
    """Return the camera matrix and the size after CameraInfo's region of interest and binning.

    K speaks of the full image. A binned pixel's centre is the centre of its block.
    """
    roi = message.roi
    width, height = int(message.width), int(message.height)
    if int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        K = K - np.array([[0, 0, roi.x_offset], [0, 0, roi.y_offset], [0, 0, 0]], dtype=np.float64)
    bx, by = max(1, int(message.binning_x)), max(1, int(message.binning_y))
    K = K.copy()
    K[0, 0], K[1, 1] = K[0, 0] / bx, K[1, 1] / by
    K[0, 2], K[1, 2] = (K[0, 2] + 0.5) / bx - 0.5, (K[1, 2] + 0.5) / by - 0.5
    return K, (width // bx, height // by)


Clock = Literal["header", "receive"]
"""The stamp that the sender put into the message, or the time at which the recorder got it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BagChoice:
    """Which topics and frames of a recording to use; None takes the only one that fits."""

    colour: str | None = None
    """Topic of the colour images; needed where two cameras were recorded."""
    depth: str | None = None
    """Topic of the depth images; needed where no single one belongs to the colour topic."""
    without_depth: bool = False
    """Import colour alone, because the depth of the recording cannot or shall not be used."""
    camera_info: str | None = None
    """Topic of the colour camera's CameraInfo, where its name does not follow from the images'."""
    depth_camera_info: str | None = None
    """Topic of the depth camera's CameraInfo, where its name does not follow from the images'."""
    intrinsics: CameraIntrinsics | None = None
    """The colour camera, for a recording without CameraInfo (or one that is wrong)."""
    T_colour_depth: Array | None = None
    """(4, 4) depth camera in the colour camera [m], where the recording does not say it."""
    depth_unit_m: float | None = None
    """Metres per count of 16-bit depth, where the recording does not say it."""
    joints: str | None = None
    """Topic of the JointState messages; needed where several hold the arm's joints."""
    joint_names: tuple[str, ...] = UR_JOINTS
    """The arm's joints from the base outwards, as messages call them behind a prefix."""
    joint_prefix: str | None = None
    """What stands before the joints' names, where there are two arms."""
    base_frame: str | None = None
    """Frame of tf that is the robot's base; else `base`, else `base_link`."""
    ee_frame: str | None = None
    """Frame of tf that is the bare flange; else `tool0`."""
    world_frame: str | None = None
    """Frame of tf to give camera poses in, for rigs whose camera is tracked; else none is given."""
    clock: Clock = "header"
    """`receive` joins by the recorder's clock: less exact, but one clock for all topics."""
    max_pair_gap_s: float | None = None
    """Greatest time between colour and its depth [s]; else half a frame period, 0.1 s at most."""
    max_arm_gap_s: float = 0.25
    """Greatest time between two arm readings to interpolate between [s]: a 10 Hz publisher may
    lose a message, but a gap of seconds says nothing about where a moving arm was."""
    still_speed: float = 0.01
    """Leading joint's speed up to which the arm stands [rad/s] (with tf alone: flange, rad/s and
    m/s): what a 30 ms time stamp error makes of it is 0.3 mm at 1 m."""
    only_still: bool = False
    """Leave out the frames at which the arm moved (or its speed is not known)."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.clock not in ("header", "receive"):
            raise InputError(f"clock is {self.clock!r}; 'header' or 'receive' is accepted.")
        for name in ("depth_unit_m", "max_pair_gap_s", "max_arm_gap_s", "still_speed"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; a positive number is needed.")
        if self.without_depth and self.depth is not None:
            raise InputError(
                f"depth={self.depth} and without_depth were both given; leave one of them out."
            )
        if self.T_colour_depth is not None:
            T = se3.check_rigid(self.T_colour_depth, "T_colour_depth")
            object.__setattr__(self, "T_colour_depth", T)


IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ALIGNED = ("aligned_depth", "depth_registered", "depth_to_rgb", "depth_to_color", "registered")
"""Parts of topic names by which drivers say that depth is on the colour image's pixels."""
JOINT_MESSAGES_LOOKED_AT = 60
"""Grippers publish on the arm's topic: more than one message is needed to see all the names."""


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A topic of images, as its first message shows it."""

    name: str
    compressed: bool
    image: ImageKind
    frame_id: str
    count: int

    def __str__(self) -> str:
        """Return name, kind, size and number of images, for a message to a person."""
        i = self.image
        return f"{self.name} ({i.kind}, {i.width}x{i.height} {i.encoding}, {self.count} images)"


@dataclass(slots=True)
class Topics:
    """The topics that are used, and what a person should know of the choice."""

    colour: ImageTopic
    depth: ImageTopic | None = None
    colour_info: str | None = None
    depth_info: str | None = None
    joints: str | None = None
    joint_prefix: str = ""
    tf: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])


def choose(recording: Recording, choice: BagChoice) -> Topics:
    """Return the topics to use.

    Raises:
        InputError: nothing fits, or several do; the message lists them and the option to choose.
    """
    images = [_image_topic(recording, t.name) for t in recording.of_type(IMAGE, COMPRESSED)]
    if not images:
        raise InputError(
            f"{recording.path.name} has no images; its topics are {recording.listing()}. A "
            "recording with sensor_msgs/Image or CompressedImage is needed."
        )
    topics = Topics(_colour(recording, images, choice))
    topics.depth = _depth(recording, images, topics, choice)
    infos = [t.name for t in recording.of_type(CAMERA_INFO)]
    if choice.intrinsics is None:
        topics.colour_info = _info(infos, topics.colour, choice.camera_info, "camera_info")
    if topics.depth is not None:
        wanted = choice.depth_camera_info
        topics.depth_info = _info(infos, topics.depth, wanted, "depth_camera_info")
    _joints(recording, topics, choice)
    topics.tf = [t.name for t in recording.of_type(*TF_TYPES)]
    return topics


def _image_topic(recording: Recording, name: str) -> ImageTopic:
    topic = recording.topics[name]
    compressed = topic.msgtype == COMPRESSED
    message = image_of(recording.first(name), recording.is_ros2, compressed)
    kind = kind_of(message, compressed)
    return ImageTopic(name, compressed, kind, message.frame_id.lstrip("/"), topic.count)


def _listed(images: Sequence[ImageTopic]) -> str:
    return "; ".join(str(i) for i in images)


def _named(
    images: Sequence[ImageTopic], name: str, option: str, kinds: Sequence[str]
) -> ImageTopic:
    """Return the image topic that a person named."""
    fitting = [i for i in images if i.image.kind in kinds]
    for image in fitting:
        if image.name == name:
            return image
    raise InputError(
        f"{option}={name} is not a topic of {kinds[0]} images; there are "
        f"{_listed(fitting) or 'none'}. All image topics: {_listed(images)}."
    )


def _best(images: Sequence[ImageTopic], *scores: Callable[[ImageTopic], float]) -> list[ImageTopic]:
    """Return those with the greatest scores, compared in order."""
    if not images:
        return []
    top = max(tuple(s(i) for s in scores) for i in images)
    return [i for i in images if tuple(s(i) for s in scores) == top]


def _colour(recording: Recording, images: list[ImageTopic], choice: BagChoice) -> ImageTopic:
    if choice.colour is not None:
        return _named(images, choice.colour, "colour", ("colour", "grey"))
    found = [i for i in images if i.image.kind == "colour"]
    found = found or [i for i in images if i.image.kind == "grey"]
    if not found:
        kinds = {i.image.kind for i in images}
        missing = (
            "only depth images: a session needs the colour images, too"
            if kinds == {"depth"}
            else "no colour images that can be read"
        )
        raise InputError(f"{recording.path.name} has {missing}. Its images: {_listed(images)}.")
    cameras = {without_transport(i.name).rpartition("/")[0] for i in found}
    if len(cameras) > 1:
        raise InputError(
            f"{recording.path.name} has {len(cameras)} cameras: {_listed(found)}. Choose one "
            f"(for example colour={found[0].name})."
        )
    # Of one camera: as it was taken rather than rectified, demosaiced, not compressed.
    best = _best(
        found,
        lambda i: not is_rectified(i.name),
        lambda i: "bayer" not in i.image.encoding,
        lambda i: not i.compressed,
    )
    return best[0]


def _depth(
    recording: Recording, images: list[ImageTopic], topics: Topics, choice: BagChoice
) -> ImageTopic | None:
    if choice.without_depth:
        return None
    if choice.depth is not None:
        return _named(images, choice.depth, "depth", ("depth",))
    found = [i for i in images if i.image.kind == "depth"]
    if not found:
        topics.notes.append(
            f"no depth images were recorded: colour alone. Topics: {_listed(images)}."
        )
        return None
    colour = topics.colour.name.split("/")

    def shared(i: ImageTopic) -> float:
        parts = i.name.split("/")
        same = [a == b for a, b in zip(parts, colour, strict=False)]
        return same.index(False) if False in same else len(same)

    best = _best(
        found,
        shared,
        lambda i: any(word in i.name for word in ALIGNED),
        lambda i: i.frame_id == topics.colour.frame_id,
        lambda i: i.image.encoding != "32FC1",
        lambda i: not i.compressed,
    )
    if len(best) > 1:
        raise InputError(
            f"{recording.path.name} has several depth topics for {topics.colour.name}: "
            f"{_listed(best)}. Choose one (for example depth={best[0].name})."
        )
    return best[0]


def _info(infos: list[str], image: ImageTopic, wanted: str | None, option: str) -> str | None:
    if wanted is None:
        return info_topic(image.name, infos)
    if wanted not in infos:
        raise InputError(
            f"{option}={wanted} is not a CameraInfo topic; there are {', '.join(infos) or 'none'}."
        )
    return wanted


def _joints(recording: Recording, topics: Topics, choice: BagChoice) -> None:
    """Find the topic and the prefix of the arm's joints."""
    first, *_, last = choice.joint_names
    found: list[tuple[str, str]] = []
    seen: set[str] = set()
    for topic in recording.of_type(JOINT_STATE):
        if choice.joints in (None, topic.name):
            names: set[str] = set()
            for n, (_, _, data) in enumerate(recording.messages([topic.name])):
                names.update(joints_of(data, recording.is_ros2).names)
                if n >= JOINT_MESSAGES_LOOKED_AT:
                    break
            seen.update(names)
            found += [(topic.name, p) for p in prefixes(names, choice.joint_names)]
    if choice.joints is not None and not any(t == choice.joints for t, _ in found):
        raise InputError(
            f"joints={choice.joints} does not hold the joints {first} ... {last}; "
            f"names there: {', '.join(sorted(seen)) or 'none'}. JointState topics: "
            f"{', '.join(t.name for t in recording.of_type(JOINT_STATE)) or 'none'}."
        )
    if choice.joint_prefix is not None:
        found = [(t, p) for t, p in found if p == choice.joint_prefix]
        if not found:
            raise InputError(
                f"joint_prefix={choice.joint_prefix!r}: no joint {choice.joint_prefix}"
                f"{first} and so on; names there: {', '.join(sorted(seen)) or 'none'}."
            )
    if len(found) > 1:
        options = ", ".join(f"joints={t} joint_prefix={p!r}" for t, p in found)
        raise InputError(
            f"{recording.path.name} has the joints of several arms. Choose one: {options}."
        )
    if found:
        topics.joints, topics.joint_prefix = found[0]
    elif seen:
        shown = ", ".join(sorted(seen)[:12])
        topics.notes.append(
            f"joints were not imported: {first} ... {last} are not all among {shown}. Joints of "
            "another arm are read where it is named (--arm)."
        )
