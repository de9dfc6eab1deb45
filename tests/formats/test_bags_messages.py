"""Messages of recordings: their bytes, pixels and cameras."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.formats.bags import pixels, topics, wire
from realsim.geometry.camera import project
from refusals import refused
from written_bags import Bag

FORMS = ("ros1", "cdr", "cdr big endian")
BAGS = {form: Bag(Path(), "ros1" if form == "ros1" else "mcap") for form in FORMS}
S = wire.NS_PER_S


# --- bytes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@given(
    frame=st.text("abc_/é", max_size=9),
    names=st.lists(st.text("joint_123", max_size=11), max_size=7),
    stamp=st.integers(0, 2**31 * S - 1),
)
@settings(max_examples=10, deadline=None)
def test_joint_states_are_read_as_the_full_deserialiser_reads_them(
    form: str, frame: str, names: list[str], stamp: int
) -> None:
    bag, q = BAGS[form], np.linspace(-3, 3, len(names))
    values = (bag.header(stamp, frame), names, q, 2 * q, np.zeros(0))
    message = bag.t["sensor_msgs/msg/JointState"](*values)
    kind = message.__msgtype__
    if bag.is_ros1:
        data = bag.store.serialize_ros1(message, kind)
    else:
        data = bag.store.serialize_cdr(message, kind, little_endian=form == "cdr")
    found = wire.joints_of(bytes(data), not bag.is_ros1)
    assert (found.stamp_ns, found.names) == (stamp, tuple(names))
    assert np.array_equal(found.position, q)
    assert np.array_equal(found.velocity, 2 * q)


# --- pixels ---------------------------------------------------------------------------------------


def raw_image(image: Any, encoding: str, padding: int = 0, big: bool = False) -> wire.ImageMessage:
    rows = np.ascontiguousarray(image).reshape(image.shape[0], -1).view(np.uint8)
    padded = np.concatenate([rows, np.full((len(rows), padding), 99, np.uint8)], 1)
    return wire.ImageMessage(
        0, "cam", encoding, padded.ravel(), image.shape[1], image.shape[0], padded.shape[1], big
    )


RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(("encoding", "sent"), [
    ("rgb8", RGB),
    ("bgr8", RGB[..., ::-1]),
    ("rgba8", np.dstack([RGB, RGB[..., :1]])),
    ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., :1]])),
])  # fmt: skip
def test_colour_encodings(encoding: str, sent: Any, padding: int) -> None:
    found = pixels.rgb_of(raw_image(sent, encoding, padding), False, "x")
    assert np.array_equal(found, RGB)


def test_grey_yuv_and_bayer() -> None:
    grey = RGB[..., 0]
    found = pixels.rgb_of(raw_image(grey, "mono8"), False, "x")
    assert np.array_equal(found, np.dstack([grey] * 3))
    # A grey YUV image: Y between the neutral chroma of 128; full range of OpenCV is 16..235.
    y = np.full((6, 8), 126, np.uint8)
    neutral = np.full_like(y, 128)
    for encoding, order in (("yuv422_yuy2", (y, neutral)), ("yuv422", (neutral, y))):
        found = pixels.rgb_of(raw_image(np.dstack(order), encoding), False, "x")
        assert found.shape == (6, 8, 3)
        assert np.all(found == found[0, 0, 0])
        assert found[0, 0, 0] == pytest.approx(round((126 - 16) * 255 / 219), abs=1)
    red = np.zeros((8, 8), np.uint8)
    red[::2, ::2] = 200  # only the red cells of RGGB see light
    found = pixels.rgb_of(raw_image(red, "bayer_rggb8"), False, "x")
    assert found[4, 4].tolist() == [200, 0, 0]


def test_depth_encodings() -> None:
    counts = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    for order, big in (("<u2", False), (">u2", True)):
        message = raw_image(counts.astype(order), "16UC1", padding=4, big=big)
        assert np.array_equal(pixels.depth_of(message, False, "x"), counts)
    metres = np.array([[0.5, np.nan, np.inf], [0.0, -1.0, 7.0]], np.float32)
    found = pixels.depth_of(raw_image(metres, "32FC1"), False, "x")
    assert pixels.counts_of(found, 1e-4).tolist() == [[5000, 0, 0], [0, 0, 0]]
    assert pixels.counts_of(found, 1e-3).tolist() == [[500, 0, 0], [0, 0, 7000]]


def compressed(data: bytes, encoding: str) -> wire.ImageMessage:
    return wire.ImageMessage(0, "cam", encoding, np.frombuffer(data, np.uint8))


def test_compressed_images() -> None:
    smooth = cv2.GaussianBlur(np.tile(RGB, (8, 8, 1)), (0, 0), 9)
    png = cv2.imencode(".png", smooth[..., ::-1])[1].tobytes()
    assert np.array_equal(pixels.rgb_of(compressed(png, "rgb8; png"), True, "x"), smooth)
    jpeg = cv2.imencode(".jpg", smooth[..., ::-1])[1].tobytes()
    found = pixels.rgb_of(compressed(jpeg, "bgr8; jpeg compressed bgr8"), True, "x")
    assert np.abs(found.astype(int) - smooth).max() < 25
    assert pixels.kind_of(compressed(jpeg, "jpeg"), True).kind == "colour"
    counts = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    png16 = cv2.imencode(".png", counts)[1].tobytes()
    packed = (bytes(12) + png16, "16UC1; compressedDepth png"), (png16, "16UC1; png compressed ")
    for message in (compressed(*sent) for sent in packed):
        assert pixels.kind_of(message, True) == ("depth", 8, 6, "16UC1")
        assert np.array_equal(pixels.depth_of(message, True, "x"), counts)


@given(st.floats(0.3, 8.0))
@settings(max_examples=10, deadline=None)
def test_inverse_depth_is_undone_within_its_quantisation(z: float) -> None:
    # As compressed_depth_image_transport quantises: A = q (q + 1), B = 1 - A / z_max.
    q, z_max = 100.0, 10.0
    a = q * (q + 1)
    b = 1 - a / z_max
    value = np.full((2, 2), round(a / z + b), np.uint16)
    value[0, 0] = 0
    head = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    data = head + cv2.imencode(".png", value)[1].tobytes()
    found = pixels.depth_of(compressed(data, "32FC1; compressedDepth png"), True, "x")
    assert found[0, 0] == 0
    assert found[1, 1] == pytest.approx(z, abs=0.6 * z * z / a + 1e-5)


def test_damaged_images_are_named() -> None:
    short = raw_image(RGB, "rgb8")._replace(pixels=RGB.ravel()[:50])
    refused(r"frame 7.*50 bytes", pixels.rgb_of, short, False, "frame 7")
    refused("cannot be decoded", pixels.rgb_of, compressed(b"nonsense", "jpeg"), True, "frame 7")
    refused("not a colour one", pixels.rgb_of, raw_image(RGB, "rgb16"), False, "frame 7")


# --- cameras --------------------------------------------------------------------------------------


def info(**changes: Any) -> Any:
    values: dict[str, Any] = dict(
        width=64, height=48, distortion_model="plumb_bob", d=np.zeros(5),
        k=np.array([50.0, 0, 31, 0, 52, 23, 0, 0, 1]), p=np.zeros(12), binning_x=0, binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    )  # fmt: skip
    return SimpleNamespace(**{**values, **changes})


def test_distortion_models() -> None:
    d = np.array([0.1, -0.2, 1e-3, 2e-3, 0.05])
    assert topics.camera_of(info(d=d), "t", 64, 48, False).distortion[:5].tolist() == list(d)
    d8 = np.arange(8) * 0.01
    rational = info(d=d8, distortion_model="rational_polynomial")
    assert topics.camera_of(rational, "t", 64, 48, False).distortion.tolist() == list(d8)
    for model in ("equidistant", "Inverse Brown Conrady", ""):
        other = info(d=d, distortion_model=model)
        refused("plumb_bob", topics.camera_of, other, "t", 64, 48, False)
        topics.camera_of(info(distortion_model=model), "t", 64, 48, False)  # all zero


def test_rectified_images_have_p_and_no_distortion() -> None:
    p = np.array([40.0, 0, 30, 0, 0, 41, 22, 0, 0, 0, 1, 0])
    message = info(d=np.full(5, 0.1), p=p)
    rectified = topics.camera_of(message, "t", 64, 48, True)
    assert (rectified.fx, rectified.fy, rectified.cx, rectified.cy) == (40, 41, 30, 22)
    assert not rectified.is_distorted
    assert topics.camera_of(message, "t", 64, 48, False).fx == 50
    assert topics.is_rectified("/cam/image_rect_color/compressed")
    assert not topics.is_rectified("/rectified_cam/image_raw")


def test_a_binned_region_sees_the_same_directions() -> None:
    roi = SimpleNamespace(x_offset=8, y_offset=4, width=32, height=24)
    part = topics.camera_of(info(roi=roi, binning_x=2, binning_y=2), "t", 16, 12, False)
    whole = topics.camera_of(info(), "t", 64, 48, False)
    point = np.array([0.1, -0.05, 1.0])
    full, binned = project(whole, point), project(part, point)
    # The binned pixel (0, 0) covers full pixels 8..9 and 4..5, so its centre is (8.5, 4.5).
    assert np.allclose(full, [8.5, 4.5] + 2 * binned)


def test_uncalibrated_and_wrong_size_are_refused() -> None:
    refused("no calibration", topics.camera_of, info(k=np.zeros(9)), "t", 64, 48, False)
    refused("64x48, but they are 32x24", topics.camera_of, info(), "t", 32, 24, False)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        ("/cam/color/image_raw", "/cam/color/camera_info"),
        ("/cam/color/image_raw/compressed", "/cam/color/camera_info"),
        ("/device_0/sensor_1/Color_0/image/data", "/device_0/sensor_1/Color_0/info/camera_info"),
        ("/other/image", None),
    ],
)
def test_camera_info_is_found_by_name(image: str, expected: str | None) -> None:
    there = ["/cam/color/camera_info", "/device_0/sensor_1/Color_0/info/camera_info"]
    assert topics.info_topic(image, there) == expected
