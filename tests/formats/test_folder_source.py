"""A folder of images: what belongs together is joined by name, whatever the order and the gaps."""

import random
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from realsim.errors import UnitError
from realsim.formats.folders import (
    FolderChoice,
    FrameState,
    list_folder,
    open_folder,
    read_cam_info,
)
from realsim.formats.folders.depth_evidence import coding_of, decoded, depth_evidence
from realsim.formats.folders.listing import join_names, join_states
from realsim.geometry import se3
from realsim.images import read_counts
from realsim.records import CameraIntrinsics
from refusals import refused

CAMERA = CameraIntrinsics(width=40, height=30, fx=35, fy=35, cx=20, cy=15)
MM = FolderChoice(depth_unit_m=0.001)


def rgb_of(number: int, size=(30, 40)) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (*size, 3), dtype=np.uint8)


def depth_of(number: int, size=(30, 40)) -> np.ndarray:
    return np.random.default_rng(number).integers(400, 900, size).astype(np.uint16)


def write(folder: Path, name: str, image: np.ndarray) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)
    return path


def make(folder: Path, numbers, colour="rgb_{:04d}.png", depth="depth_{:04d}.png") -> Path:
    for k in numbers:
        write(folder, colour.format(k), rgb_of(k))
        write(folder, depth.format(k), depth_of(k))
    return folder


def opened(folder: Path, *poses: list[FrameState]):
    return open_folder(folder, CAMERA, poses, choice=MM)


def number_of(frame) -> int:
    """Return which frame's pixels these are, and check that all its parts are of that frame."""
    k = next(k for k in range(40) if np.array_equal(frame.rgb, rgb_of(k)))
    if frame.depth_counts is not None:
        assert np.array_equal(frame.depth_counts, depth_of(k))
    if frame.T_base_ee is not None:
        assert frame.T_base_ee[0, 3] == k / 100
    return k


def states(numbers, name="{:04d}") -> list[FrameState]:
    Ts = {k: se3.from_translation([k / 100, 0, 0]) for k in numbers}
    return [FrameState(name=name.format(k), where=f"row {k}", T_base_ee=T) for k, T in Ts.items()]


@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        ("rgb_{:04d}.png", "depth_{:04d}.png"),
        ("frame-{:06d}.color.png", "frame-{:06d}.depth.png"),
        ("{}.bmp", "{}.png"),
        ("rgb/{:03d}.png", "depth/{:05d}.png"),
        ("color/img7_{}.png", "depth/kinect_{:03d}.png"),
    ],
)
def test_every_frame_gets_its_own_parts(tmp_path, colour, depth):
    numbers = [0, 1, 2, 9, 10, 11]
    make(tmp_path, numbers, colour, depth)
    source = opened(tmp_path, states(numbers))
    assert [number_of(f) for f in source.frames()] == numbers
    assert [f.time_s for f in source.frames(3)] == [3, 4, 5]


def test_gaps_and_order_do_not_change_what_belongs_together(tmp_path):
    """Law: whatever files are taken away, each frame that is left is joined as before."""
    rng = random.Random(0)
    numbers = range(12)
    gone = [set(rng.sample(numbers, 2)) for _ in range(3)]
    for k in numbers:
        if k not in gone[0]:
            write(tmp_path, f"rgb_{k}.png", rgb_of(k))
        if k not in gone[1]:
            write(tmp_path, f"depth_{k}.png", depth_of(k))
    rows = [s for s in states(numbers) if int(s.name) not in gone[2]]
    rng.shuffle(rows)
    source = opened(tmp_path, rows)
    left = sorted(set(numbers) - set.union(*gone))
    assert [number_of(f) for f in source.frames()] == left
    said = " ".join(source.notes)
    assert all(f"rgb_{k}.png (no " in said for k in (gone[1] | gone[2]) - gone[0])
    assert len(source) == len(left)


def test_incomplete_frames_are_named(tmp_path):
    make(tmp_path, range(5))
    (tmp_path / "depth_0002.png").unlink()
    (tmp_path / "rgb_0004.png").unlink()
    source = opened(tmp_path, states([0, 1, 2]))
    assert [number_of(f) for f in source.frames()] == [0, 1]
    said = " ".join(source.notes)
    assert "rgb_0002.png (no depth image)" in said and "rgb_0003.png (no pose)" in said
    assert "depth_0004.png" in said


def test_numbers_with_other_prefixes_are_never_shifted():
    left, right = [f"img_{k}" for k in range(5)], [f"kinect_{k}" for k in range(5)]
    assert join_names(left, right, "a", "b").pairs == {k: k for k in range(5)}
    gapped = [right[k] for k in (4, 0, 2)]
    assert join_names(left, gapped, "a", "b").pairs == {0: 1, 2: 2, 4: 0}
    refused(r"differ by -1", join_names, left, [f"kinect_{k + 1}" for k in range(5)], "a", "b")
    refused("no number is on both", join_names, left, ["kinect_17", "kinect_19"], "a", "b")
    times = ["12-30-05", "12-31-07"], ["12-30-06", "12-31-08"]
    refused("no single number", join_names, *times, "a", "b")


# --- what is refused --------------------------------------------------------------------------


def test_rows_without_names_count_only_without_gaps():
    keys = ["0_10", "0_2", "0_1"] + [f"0_{k}" for k in range(3, 10)]
    pairs = join_states(keys, states(range(1, 11), name="")).pairs
    assert [pairs[k] for k in range(3)] == [9, 1, 0]
    refused("not numbered 0 to 8", join_states, keys[:-1], states(range(10), name="")[:-1])
    refused("names no image", join_states, keys, [*states([1]), *states([2], name="")])


@pytest.mark.parametrize(("name", "size", "says"), [
    ("rgb_0001.jpg", (30, 40), r"rgb_0001\.jpg and rgb_0001\.png are two images"),
    ("rgb_0001.png", (60, 80), r"rgb_0001\.png is 80x60"),
    ("depth_0001.png", (30, 40), r"depth_0001\.png has 8 bits"),  # a picture of the depth
])  # fmt: skip
def test_an_image_that_does_not_fit_is_named(tmp_path, name, size, says):
    make(tmp_path, range(3))
    write(tmp_path, name, rgb_of(1, size))
    refused(says, opened, tmp_path)


def test_no_camera_and_another_camera(tmp_path):
    make(tmp_path, range(2))
    other = CameraIntrinsics(width=80, height=60, fx=70, fy=70, cx=40, cy=30)
    for camera, says in (
        (None, r"camera of the images \(40x30 px\) is not known"),
        (other, "80x60 px, the images are 40x30"),
    ):
        refused(says, open_folder, tmp_path, camera, choice=MM)


def test_empty_missing_file_and_below(tmp_path):
    refused("holds no images", list_folder, tmp_path)
    refused("does not exist", list_folder, tmp_path / "nowhere")
    (tmp_path / "a.txt").write_text("x")
    refused("is a file", list_folder, tmp_path / "a.txt")
    write(tmp_path / "scan", "1.png", rgb_of(1))
    refused("There are images in scan", list_folder, tmp_path)


@pytest.mark.parametrize("damage", ["empty", "text", "cut"])
def test_an_image_that_cannot_be_read_is_named(tmp_path, damage):
    make(tmp_path, range(3), colour="rgb_{}.jpg", depth="depth_{}.png")
    path = tmp_path / "rgb_1.jpg"
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "text": b"hello", "cut": data[: len(data) // 2]}[damage])
    refused(r"rgb_1\.jpg is (not an image|truncated)", opened, tmp_path)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_an_image_marked_to_be_shown_turned_is_refused(tmp_path, ending):
    make(tmp_path, range(2))
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "rgb_0001.png").unlink()
    Image.fromarray(rgb_of(1)).save(tmp_path / f"rgb_0001.{ending}", exif=exif)
    refused(rf"rgb_0001\.{ending} is marked to be shown turned", opened, tmp_path)


def test_depth_on_other_pixels_needs_a_decision(tmp_path):
    for k in range(3):
        write(tmp_path, f"{k}.jpg", rgb_of(k))
        write(tmp_path, f"{k}.png", depth_of(k, (24, 32)))
    refused(r"32x24 px, the colour images 40x30.*--no-depth", opened, tmp_path)
    source = open_folder(tmp_path, CAMERA, choice=FolderChoice(use_depth=False))
    assert source.depth_unit_m is None and len(source) == 3
    assert all(f.depth_counts is None for f in source.frames())


def test_the_depth_unit_is_asked_for_with_evidence(tmp_path):
    make(tmp_path, range(3))
    refused(r"0\.65\d? m with 0\.001.*0\.06\d+ m with 0\.0001", open_folder, tmp_path, CAMERA)
    tiny = FolderChoice(depth_unit_m=1e-5)
    says = r"median depth is 0\.0065"
    refused(says, open_folder, tmp_path, CAMERA, choice=tiny, error=UnitError)


# --- depth whose bits were turned -------------------------------------------------------------


def turned(depth: np.ndarray) -> np.ndarray:
    return ((depth << 3) | (depth >> 13)).astype(np.uint16)


def test_turning_bits_is_undone_for_every_count():
    every = np.arange(2**16, dtype=np.uint16)
    assert np.array_equal(decoded(turned(every), "apc"), every)
    assert np.array_equal(decoded(every, "plain"), every)


def test_turned_bits_are_recognised_and_plain_ones_left(tmp_path):
    y, x = np.mgrid[:30, :40]
    near = (5000 + 100 * y + 30 * x).astype(np.uint16)  # 0.5 to 0.9 m, partly beyond 8192 counts
    plain = [write(tmp_path, "p.png", near)]
    apc = [write(tmp_path, "a.png", turned(near))]
    assert coding_of(depth_evidence(plain), "auto", "x")[0] == "plain"
    coding, why = coding_of(depth_evidence(apc), "auto", "x")
    assert coding == "apc" and "steps" in why
    assert np.array_equal(decoded(read_counts(apc[0]), coding), near)


def test_counts_in_steps_of_eight_are_ambiguous(tmp_path):
    flat = np.full((30, 40), 4800, dtype=np.uint16)
    evidence = depth_evidence([write(tmp_path, "d.png", flat)])
    refused(r"4800 or of 600 counts.*--depth-coding", coding_of, evidence, "auto", "folder")
    assert coding_of(evidence, "plain", "folder")[0] == "plain"
    assert coding_of(evidence, "apc", "folder")[0] == "apc"


# --- cam.info.txt -----------------------------------------------------------------------------


def cam_info(folder: Path, scale: float = 1.0) -> Path:
    T = se3.look_at([0.5, 0.1, 0.4], [0, 0, 0])
    T[:3, 3] *= scale
    rows = "\n".join("\t".join(f"{x:.12e}" for x in row) for row in T)
    path = folder / "cam.info.txt"
    path.write_text(
        "# Environment: shelf\n\n# Color camera intrinsic matrix\n35 0 20\n0 35 15\n0 0 1\n\n"
        f"# Camera-to-world extrinsic matrix (camera pose) for frame-000003\n{rows}\n"
    )
    return path


def test_cam_info_poses_are_read_as_written(tmp_path):
    info = read_cam_info(cam_info(tmp_path))
    T = info.states[0].T_world_cam
    assert info.states[0].name == "frame-000003" and T is not None
    np.testing.assert_allclose(T, se3.look_at([0.5, 0.1, 0.4], [0, 0, 0]), atol=1e-9)
    refused("millimetres", read_cam_info, cam_info(tmp_path, 1000.0), error=UnitError)
