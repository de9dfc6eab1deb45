"""Which topics of a recording are read, and what is asked for where they do not say enough."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from realsim.formats.bags import BagChoice, open_bag
from realsim.records import CameraIntrinsics
from written_bags import (
    COLOUR,
    DEPTH,
    HEIGHT,
    WIDTH,
    Bag,
    pictures,
    recorded,
    refused,
    same_pictures,
    stamp,
)

# --- topics ---------------------------------------------------------------------------------------


def test_two_cameras_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for c, cam in enumerate(("/left", "/right")):
        bag.both_infos(cam, f=30.0 + c)
        for k in range(3):
            rgb, depth = pictures(10 * c + k)
            bag.image(f"{cam}/color/image_raw", rgb, "rgb8", stamp(k))
            bag.image(f"{cam}/aligned_depth_to_color/image_raw", depth, "16UC1", stamp(k))
    path = bag.write()
    refused(path, "2 cameras", "colour=/left/color/image_raw")
    source = open_bag(path, BagChoice(colour="/right/color/image_raw"))
    assert source.intrinsics.fx == 31.0
    same_pictures(source, range(10, 13))
    refused(path, "is not a topic of colour images", colour="/up")
    left = "/left/color/image_raw"
    refused(path, "is not a topic of depth images", colour=left, depth=left)


def test_raw_is_preferred_to_compressed_and_compressed_is_read(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.both_infos()
    for k in range(3):
        rgb, depth = pictures(k)
        png = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
        png16 = bytes(12) + cv2.imencode(".png", depth)[1].tobytes()
        bag.packed(COLOUR + "/compressed", png, "rgb8; png compressed bgr8", stamp(k))
        bag.packed(DEPTH + "/compressedDepth", png16, "16UC1; compressedDepth png", stamp(k))
    source = open_bag(bag.write())
    assert source.depth_unit_m == 1e-3
    same_pictures(source, range(3))
    both = recorded(tmp_path, "mcap", write=False).bag
    png = cv2.imencode(".png", pictures(0)[0])[1].tobytes()
    both.packed(COLOUR + "/compressed", png, "png", stamp(0))
    assert open_bag(both.write()).extra["topics"]["colour"] == COLOUR


def test_colour_alone_is_imported_and_depth_alone_is_not(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.info("/camera/color/camera_info")
    bag.image(COLOUR, pictures(0)[0], "bgr8", stamp(0))
    source = open_bag(bag.write())
    assert source.depth_unit_m is None
    assert np.array_equal(next(iter(source.frames())).rgb, pictures(0)[0][..., ::-1])
    assert any("no depth images" in n for n in source.notes)
    bag = Bag(tmp_path, "mcap")
    bag.image(DEPTH, pictures(0)[1], "16UC1", stamp(0))
    refused(bag.write(), "only depth images")


def test_without_camera_info_the_camera_can_be_given(tmp_path: Path) -> None:
    bag = Bag(tmp_path)
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    path = bag.write()
    refused(path, "no CameraInfo", "intrinsics=")
    camera = CameraIntrinsics(width=WIDTH, height=HEIGHT, fx=30, fy=30, cx=16, cy=12)
    assert open_bag(path, BagChoice(intrinsics=camera)).intrinsics is camera
    refused(path, "64x48", intrinsics=replace(camera, width=64, height=48))


def test_bad_cameras_are_refused(tmp_path: Path) -> None:
    bag = recorded(tmp_path, write=False).bag
    bag.info("/camera/color/camera_info", stamp(3), f=55.0)
    refused(bag.write(), "changes during the recording")
    bag = Bag(tmp_path, "mcap")
    bag.info("/camera/color/camera_info", model="equidistant", d=(0.1, 0.1, 0.0, 0.0))
    bag.image(COLOUR, pictures(0)[0], "rgb8", stamp(0))
    refused(bag.write(), "fisheye")
