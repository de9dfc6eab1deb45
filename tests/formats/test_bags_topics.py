"""Which topics of a recording are read, and what is asked for where they do not say enough."""

from pathlib import Path

import cv2
import numpy as np

from realsim.formats.bags import BagChoice, open_bag
from realsim.records import CameraIntrinsics
from written_bags import COLOUR, DEPTH, HEIGHT, WIDTH, Bag, pictures, recorded, refused, stamp

# --- topics ---------------------------------------------------------------------------------------


def test_two_cameras_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for c, cam in enumerate(("/left", "/right")):
        for stream in ("color", "aligned_depth_to_color"):
            bag.info(f"{cam}/{stream}/camera_info", f=30.0 + c)
        for k in range(3):
            rgb, depth = pictures(10 * c + k)
            bag.image(f"{cam}/color/image_raw", rgb, "rgb8", stamp(k))
            bag.image(f"{cam}/aligned_depth_to_color/image_raw", depth, "16UC1", stamp(k))
    path = bag.write()
    message = refused(path)
    assert "2 cameras" in message and "colour=/left/color/image_raw" in message
    source = open_bag(path, BagChoice(colour="/right/color/image_raw"))
    assert source.intrinsics.fx == 31.0
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, pictures(10 + k)[0])
        assert np.array_equal(frame.depth_counts, pictures(10 + k)[1])
    assert "is not a topic of colour images" in refused(path, BagChoice(colour="/up"))
    assert "is not a topic of depth images" in refused(
        path, BagChoice(colour="/left/color/image_raw", depth="/left/color/image_raw")
    )


def test_raw_is_preferred_to_compressed_and_compressed_is_read(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.info("/camera/aligned_depth_to_color/camera_info")
    for k in range(3):
        rgb, depth = pictures(k)
        png = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
        png16 = cv2.imencode(".png", depth)[1].tobytes()
        bag.packed(COLOUR + "/compressed", png, "rgb8; png compressed bgr8", stamp(k))
        head = bytes(12)
        form = "16UC1; compressedDepth png"
        bag.packed(DEPTH + "/compressedDepth", head + png16, form, stamp(k))
    source = open_bag(bag.write())
    assert source.depth_unit_m == 1e-3
    for k, frame in enumerate(source.frames()):
        assert np.array_equal(frame.rgb, pictures(k)[0])
        assert np.array_equal(frame.depth_counts, pictures(k)[1])
    both = tmp_path / "both"
    both.mkdir()
    png = cv2.imencode(".png", pictures(0)[0])[1].tobytes()
    path = recorded(
        both, change=lambda b: b.packed(COLOUR + "/compressed", png, "png", stamp(0))
    ).path
    assert open_bag(path).extra["topics"]["colour"] == COLOUR


def test_colour_alone_is_imported_and_depth_alone_is_not(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.image(COLOUR, pictures(0)[0], "bgr8", stamp(0))
    source = open_bag(bag.write())
    assert source.depth_unit_m is None
    assert np.array_equal(next(iter(source.frames())).rgb, pictures(0)[0][..., ::-1])
    assert any("no depth images" in n for n in source.notes)
    other = tmp_path / "other"
    other.mkdir()
    bag = Bag(other)
    bag.image(DEPTH, pictures(0)[1], "16UC1", stamp(0))
    assert "only depth images" in refused(bag.write())


def test_without_camera_info_the_camera_can_be_given(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    path = bag.write()
    message = refused(path)
    assert "no CameraInfo" in message and "intrinsics=" in message
    camera = CameraIntrinsics(width=WIDTH, height=HEIGHT, fx=30, fy=30, cx=16, cy=12)
    assert open_bag(path, BagChoice(intrinsics=camera)).intrinsics is camera
    wrong = CameraIntrinsics(width=64, height=48, fx=30, fy=30, cx=16, cy=12)
    assert "64x48" in refused(path, BagChoice(intrinsics=wrong))


def test_bad_cameras_are_refused(tmp_path: Path) -> None:
    def other_mode(bag: Bag) -> None:
        bag.info("/camera/color/camera_info", stamp(3), f=55.0)

    assert "changes during the recording" in refused(recorded(tmp_path, change=other_mode).path)
    bag = Bag(tmp_path / "fisheye.bag")
    bag.path = tmp_path / "fisheye.bag"
    bag.info("/camera/color/camera_info", model="equidistant", d=(0.1, 0.1, 0.0, 0.0))
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    assert "fisheye" in refused(bag.write())
