"""What librealsense's own recordings (.bag up to 2.5x, .db3 since 2.59) keep beside the images.

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
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.tf_tree import T_of_numbers
from realsim.formats.bags.topics import without_transport
from realsim.formats.bags.wire import Cursor
from realsim.geometry import se3

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
