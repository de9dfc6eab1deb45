"""The cameras of a recording, and whether depth is on the colour image's pixels already.

What librealsense's own recordings (.bag up to 2.5x, .db3 since 2.59) keep beside the images.

/device_0/sensor_0/Depth_0/image/data               .bag    frame, header = the frame's clock
/device_0/sensor_0/Depth_0/image/data/compressedDepth .db3  header = time of recording only!
.../image/metadata   KeyValue messages | one String `Frame number=1;timestamp=1033.0;...`
.../tf/0 | tf/ref_1  p_stream = R p_reference + t: Transform | String `rotation=` by columns
.../option/Depth Units/value | Depth_Units/value    Float32 | String [m per count]
.../camera_info      String with the model's true name (.db3); its CameraInfo always says
plumb_bob
"""

from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bags import topics as ci
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.tf_tree import T_of_numbers, TfTree
from realsim.formats.bags.topics import (
    CAMERA_INFO,
    BagChoice,
    ImageTopic,
    Topics,
    without_transport,
)
from realsim.formats.bags.wire import Cursor
from realsim.geometry import se3
from realsim.records import CameraIntrinsics

STRING = "std_msgs/msg/String"
IMAGE_ENDING = "/image/data"
NS_PER_MS = 1_000_000


def stream_of(image_topic: str) -> str | None:
    """Return `/device_0/sensor_0/Depth_0` of an image topic of librealsense, or None."""
    topic = without_transport(image_topic)
    is_own = topic.startswith("/device_") and topic.endswith(IMAGE_ENDING)
    return topic[: -len(IMAGE_ENDING)] if is_own else None


def metadata_topic(image_topic: str, recording: Recording) -> str | None:
    """Return the topic whose text tells the true time of every frame (.db3 only)."""
    stream = stream_of(image_topic)
    topic = recording.topics.get(f"{stream}/image/metadata") if stream else None
    return topic.name if topic is not None and topic.msgtype == STRING else None


def fields_of(text: str) -> dict[str, str]:
    """Return the pairs of `a=1;b=2;`."""
    return {k.strip(): v for k, _, v in (part.partition("=") for part in text.split(";")) if k}


def text_of(data: bytes) -> str:
    """Return the content of a std_msgs/String of ROS2."""
    return Cursor(data, is_ros2=True).string()


@dataclass(slots=True)
class FrameTimes:
    """The frames' own clock, from their metadata, by the time at which they were recorded."""

    stamps_ns: dict[int, int] = field(default_factory=dict[int, int])
    """Receive time [ns] -> time stamp of the frame [ns]."""
    domains: set[str] = field(default_factory=set[str])
    """Which clocks stamped the frames."""
    units: set[float] = field(default_factory=set[float])
    """Depth units that the frames name [m per count]."""

    def add(self, receive_ns: int, text: str) -> None:
        """Take over the metadata of one frame."""
        fields = fields_of(text)
        if "timestamp" in fields:
            self.stamps_ns[receive_ns] = round(
                _numbers(fields["timestamp"], 1, "timestamp")[0] * NS_PER_MS
            )
        self.domains.add(fields.get("timestamp_domain", "unknown"))
        if "depth_units" in fields:
            self.units.add(_decimal(_numbers(fields["depth_units"], 1, "depth_units")[0]))


def _numbers(text: str | None, count: int | None, name: str) -> Array:
    """Return the numbers of a text such as "1.0,2.5".

    Raises:
        InputError: they are not `count` finite ones (None = any count).
    """
    try:
        found = np.array([float(word) for word in (text or "").split(",")])
    except ValueError:
        found = np.array([np.nan])
    if not np.all(np.isfinite(found)) or (count is not None and len(found) != count):
        wanted = "numbers are" if count is None else f"{count} number{'s' * (count > 1)} are"
        raise InputError(f"{name} is '{str(text)[:60]}'; {wanted} expected. It is damaged.")
    return found


def _decimal(value: float) -> float:
    """Return the shortest decimal that is this float32: 0.0010000000474974513 is 0.001."""
    return float(str(np.float32(value)))


def depth_unit_m(recording: Recording, depth_topic: str) -> float | None:
    """Return metres per count of the depth sensor, from its options; None if not recorded."""
    stream = stream_of(depth_topic)
    if stream is None:
        return None
    sensor = stream.rpartition("/")[0]
    for name in ("Depth Units", "Depth_Units"):
        topic = recording.topics.get(f"{sensor}/option/{name}/value")
        if topic is not None and topic.count:
            texts = [str(m.data) for m in recording.decoded(topic.name)]
            values = [_decimal(_numbers(t, 1, topic.name)[0]) for t in texts]
            if values and values[-1] > 0:
                return values[-1]
    return None


def extrinsics(recording: Recording, depth_topic: str, colour_topic: str) -> Array | None:
    """Return T_colour_depth (4, 4) [m]; None if the recording does not say it."""
    streams = stream_of(depth_topic), stream_of(colour_topic)
    if streams[0] is None or streams[1] is None:
        return None
    found = [_to_references(recording, s) for s in streams if s]
    for reference in found[0].keys() & found[1].keys():
        return found[1][reference] @ se3.invert(found[0][reference])
    return None


def _to_references(recording: Recording, stream: str) -> dict[str, Array]:
    """Return T_stream_reference (4, 4) of a stream, by the reference's name."""
    found: dict[str, Array] = {}
    for topic in recording.topics.values():
        start, _, reference = topic.name.rpartition("/")
        if start != f"{stream}/tf" or not topic.count:
            continue
        message = recording.first_decoded(topic.name)
        if topic.msgtype == STRING:
            fields = fields_of(str(message.data))
            R = _numbers(fields.get("rotation"), 9, f"rotation of {topic.name}").reshape(3, 3).T
            t = _numbers(fields.get("translation"), 3, f"translation of {topic.name}")
            # Six decimals were written: off by 1e-6, which check_rigid puts right.
            T = se3.check_rigid(se3.from_rt(R, t), topic.name)
        else:
            q, p = message.rotation, message.translation
            T = T_of_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        found[reference.removeprefix("ref_")] = T
    return found


def frame_rate(recording: Recording, image_topic: str) -> float | None:
    """Return the frames per second that the stream was set to, if recorded."""
    stream = stream_of(image_topic)
    topic = recording.topics.get(f"{stream}/info") if stream else None
    if topic is None or not topic.count:
        return None
    message = recording.first_decoded(topic.name)
    text = fields_of(str(message.data)).get("fps", "0") if topic.msgtype == STRING else message.fps
    return float(_numbers(str(text), 1, topic.name)[0]) or None


def check_model(recording: Recording, image_topic: str) -> None:
    """Check the lens model of a .db3, whose CameraInfo says plumb_bob whatever it is.

    Raises:
        InputError: it is another than OpenCV's, with coefficients.
    """
    stream = stream_of(image_topic)
    topic = recording.topics.get(f"{stream}/camera_info") if stream else None
    if topic is None or topic.msgtype != STRING or not topic.count:
        return
    fields = fields_of(str(recording.first_decoded(topic.name).data))
    model = fields.get("model", "")
    coefficients = _numbers(fields.get("coeffs", "0"), None, f"coeffs of {topic.name}").tolist()
    if any(coefficients) and model.lower() not in ("brown conrady", "none"):
        raise InputError(
            f"{topic.name}: the lens model is '{model}' with coefficients {coefficients}; only "
            "Brown Conrady (OpenCV's) or zeros can be used. Calibrate the camera and give it in a "
            "file (intrinsics=)."
        )


def device_info(recording: Recording, image_topic: str) -> dict[str, str]:
    """Return name, serial number, firmware of the camera, as recorded."""
    stream = stream_of(image_topic)
    topic = recording.topics.get(f"/{stream.split('/')[1]}/info") if stream else None
    if topic is None:
        return {}
    messages = list(recording.decoded(topic.name))
    if topic.msgtype == STRING:
        return fields_of(";".join(str(m.data) for m in messages))
    return {str(m.key): str(m.value) for m in messages}


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
    check_model(recording, topics.colour.name)
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
    stream = stream_of(depth.name) is not None  # its frame ids say nothing
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
        T, source = extrinsics(recording, depth.name, topics.colour.name), "the recording's"
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
