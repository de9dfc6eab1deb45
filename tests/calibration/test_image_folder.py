import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pose_layouts import LAYOUTS, PAIRS, folder_a_pose, layouts_read, save_images, tiny
from pose_rows import folder, rows_of, write_lines
from realsim.errors import InputError
from realsim.geometry import se3
from realsim_calibration.inputs.folder import read_board_poses, read_image_folder
from realsim_calibration.inputs.image_files import list_images, load_image
from realsim_calibration.inputs.pairing import pair
from realsim_calibration.inputs.readings import reading_from_text
from refusals import refused

READING = reading_from_text("quat_xyzw,m")


def save(path, array):
    Image.fromarray(array).save(path)
    return path


def make_images(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        save(folder / name, tiny(k))
    return folder


def rows(n, seed=0):
    return rows_of(READING, se3.random_transform(np.random.default_rng(seed), n, spread=0.5))


# --- pairing ----------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(
    n=st.integers(2, 30),
    order=st.randoms(use_true_random=False),
    how=st.sampled_from(["names", "stems", "upper case", "numbers", "folders"]),
    missing=st.integers(0, 3),
)
def test_names_pair_whatever_the_order(n, order, how, missing):
    numbers = order.sample(range(200), n)
    images = sorted((f"img_{k:04d}.png" for k in numbers), key=str)
    mine = order.sample(numbers, max(n - missing, 1))
    labels, stems = [None] * len(mine), [""] * len(mine)
    if how in ("stems", "numbers"):
        stems = [f"img_{k:04d}" if how == "stems" else f"pose{k}" for k in mine]
    else:
        labels = [f"img_{k:04d}.png" for k in mine]
        labels = [x.upper() for x in labels] if how == "upper case" else labels
        labels = [f"shots/{x}" for x in labels] if how == "folders" else labels
    try:
        found = pair(images, labels, stems, [f"line {k}" for k in mine])
    except InputError as error:
        # as many numbers as images, all shifted by the same: only random "numbers" could do that
        assert how == "numbers" and "count from different starts" in str(error)
        return
    if how == "numbers" and len(mine) == 1 and found.sentence.startswith("Paired by order"):
        return
    assert len(found.pairs) == len(mine)
    for image, row in found.pairs:
        assert int(images[image][4:8]) == mine[row]
    left = {images[i] for i, _ in found.unpaired_images}
    assert left == {f"img_{k:04d}.png" for k in set(numbers) - set(mine)}


def test_counts_that_differ_without_names_are_refused_with_both_sides():
    names = [f"{k}.png" for k in range(1, 41) if k not in (17, 23)]
    said = refused(".", pair, names, [None] * 40, [""] * 40, [f"line {k}" for k in range(1, 41)])
    for part in ("38 images and 40 poses", "number 17, 23 missing", "1.png", "line 40", "beside"):
        assert part in said


def test_shifted_numbers_are_refused():
    images = [f"{k}.png" for k in range(1, 25)]
    stems = [str(k) for k in range(24)]
    refused(r"poses \+1: 1.png.*different starts", pair, images, [None] * 24, stems, stems)


@pytest.mark.parametrize(
    ("labels", "says"),
    [
        (["a.png", "a.png", "b.png"], r"'a.png' 2 times \(line 1, line 2\)"),
        (["a.png", "a.jpg", "b.png"], "several names of the poses mean the image 'a.png'"),
        (["x.png", "y.png", None], "none of the 3 names.*x.png, y.png; the images are a.png"),
    ],
)
def test_names_that_cannot_pair_are_refused(labels, says):
    refused(says, pair, ["a.png", "b.png"], labels, [""] * 3, ["line 1", "line 2", "line 3"])


# --- folders ----------------------------------------------------------------------------------


def test_unpaired_unmeasured_and_duplicates_are_named(tmp_path):
    names = [f"{k}.png" for k in range(12)]
    images = make_images(tmp_path / "i", names)
    (images / "7.png").write_bytes((images / "3.png").read_bytes())
    raw = rows(12)
    raw[5] = np.nan
    raw[9] = raw[8]
    listed = [*names[:11], "gone.png"]
    poses = write_lines(tmp_path / "p.txt", raw, names=listed)
    found = read_image_folder(images, poses, reading=READING)
    assert found.labels == tuple(n for k, n in enumerate(names) if k not in (5, 11))
    assert dict(found.unpaired_images).keys() == {"5.png", "11.png"}
    assert dict(found.unpaired_poses).keys() == {"line 6", "line 12"}
    assert "(3.png, 7.png)" in found.warnings[0] and "(line 9, line 10)" in found.warnings[1]
    assert len(found.warnings) == 4 and "Paired by the image names" in found.pairing
    T = READING.apply(raw[[k for k in range(11) if k != 5]])
    assert np.abs(found.Ts_base_ee() - T).max() < 1e-14


def test_a_reading_must_be_said_and_must_fit(tmp_path):
    images = make_images(tmp_path / "i", [f"{k}.png" for k in range(4)])
    file = write_lines(tmp_path / "p.txt", rows(4))
    found = read_image_folder(images, file)
    assert found.reading is None
    refused(r"not said.*quat_xyzw,m; quat_wxyz,m", found.Ts_base_ee)
    with pytest.raises(InputError, match="takes 6 numbers"):
        read_image_folder(images, file, reading=reading_from_text("rotvec,m"))
    write_lines(file, rows(4), ",", head="x_m,y_m,z_m,qx,qy,qz,qw")
    turned = read_image_folder(images, file, reading=reading_from_text("quat_wxyz,m"))
    assert "contradicts the file" in turned.warnings[0] and len(turned.Ts_base_ee()) == 4


def test_poses_and_depth_beside_the_images(tmp_path):
    raw = rows(11)
    for k, row in enumerate(raw):
        save(tmp_path / f"color_{k}.jpg", tiny(k))
        Image.fromarray(np.full((4, 4), 500 + k, np.uint16)).save(tmp_path / f"depth_{k}.png")
        (tmp_path / f"pose_{k}.json").write_text(json.dumps({"pose": row.tolist()}))
    (tmp_path / "camera.json").write_text('{"fx": 600}')
    found = read_image_folder(tmp_path, tmp_path, reading=READING)
    assert found.labels == tuple(f"color_{k}.jpg" for k in range(11))
    assert [d.name for d in found.depths] == [f"depth_{k}.png" for k in range(11)]
    assert found.pairing.startswith("Paired by the numbers in the names")
    assert any("camera.json" in n for n in found.poses.notes)
    assert np.abs(found.Ts_base_ee() - READING.apply(raw)).max() < 1e-14


def test_a_camera_beside_one_pose_file_is_no_pose_file(tmp_path):
    make_images(tmp_path, [f"{k}.png" for k in range(4)])
    write_lines(tmp_path / "p.txt", rows(4))
    (tmp_path / "lens.json").write_text(json.dumps({"fx": 600, "fy": 600, "cx": 320, "cy": 240}))
    found = read_image_folder(tmp_path, tmp_path, reading=READING)
    assert len(found) == 4 and any("lens.json" in n for n in found.poses.notes)


def test_a_list_of_pairs_decides_and_is_checked(tmp_path):
    images = make_images(tmp_path / "i", [f"{k}.png" for k in range(6)])
    (tmp_path / "p").mkdir()
    raw = rows(6)
    for k in range(6):
        write_lines(tmp_path / "p" / f"{k}.txt", raw[k : k + 1])
    turned = [{"pose": f"p/{k}.txt", "image": f"i/{5 - k}.png"} for k in range(6)]
    (tmp_path / "cal.json").write_text(json.dumps({"data": turned}))
    (tmp_path / "others.json").write_text('{"pose": 1, "image": 2,')
    for poses in (tmp_path / "p", tmp_path / "cal.json"):
        found = read_image_folder(images, poses, reading=READING)
        assert np.abs(found.Ts_base_ee() - READING.apply(raw[::-1])).max() < 1e-14
    for bad, says in (("p/9.txt", "entry 0: the pose file 'p/9.txt' of"), ("../x.txt", "outside")):
        turned[0]["pose"] = bad
        (tmp_path / "cal.json").write_text(json.dumps({"data": turned}))
        refused(says, read_image_folder, images, tmp_path / "cal.json")


def test_files_that_differ_or_hold_several_poses_are_named(tmp_path):
    for k in range(3):
        write_lines(tmp_path / f"{k}.txt", rows(1, k))
    (tmp_path / "1.txt").write_text("1 2 3 0.1 0.2 0.3\n")
    make_images(tmp_path / "i", ["0.png", "1.png", "2.png"])
    refused(r"1.txt holds 6 numbers, 0.txt 7 numbers", read_image_folder, tmp_path / "i", tmp_path)
    write_lines(tmp_path / "1.txt", rows(2))
    refused(r"1.txt holds 2 poses; beside 2 other", read_image_folder, tmp_path / "i", tmp_path)


def test_folders_without_usable_images_say_what_is_there(tmp_path):
    refused("is no folder", list_images, tmp_path / "none")
    make_images(tmp_path / "colour", ["0.png"])
    refused("images in colour: give that folder", list_images, tmp_path)
    deep = tmp_path / "deep"
    deep.mkdir()
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(deep / "0.png")
    refused("1 images of 16 bit and none of 8", list_images, deep)
    save(tmp_path / "colour" / "0.jpg", tiny(0))
    refused("two images of one name", list_images, tmp_path / "colour")


def test_images_are_looked_for_two_folders_deep(tmp_path):
    refused(r"holds no images .*Give the folder of the board's", list_images, tmp_path)
    for place in ("left/rgb", "right/rgb"):
        make_images(tmp_path / place, ["0.png"])
    refused("images in left/rgb, right/rgb: give one of them", list_images, tmp_path)


def test_all_broken_images_are_named_at_once_with_what_to_do(tmp_path):
    names = [f"{k}.png" for k in range(14)]
    make_images(tmp_path, names)
    np.save(tmp_path / "poses.npy", np.array([np.eye(4)] * 14))
    broken = names[2:12]
    for name in broken:
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:60])
    (tmp_path / "2.png").write_text("no image")
    said = refused("10 of 14 images cannot be used", read_image_folder, tmp_path, tmp_path)
    assert all(f"{tmp_path / name} is " in said for name in broken[:8])
    assert "... and 2 more" in said and said.count("Copy it again") == 1
    # the advice works: the images and their rows are taken out
    for name in broken:
        (tmp_path / name).unlink()
    np.save(tmp_path / "poses.npy", np.delete(np.load(tmp_path / "poses.npy"), range(2, 12), 0))
    assert len(read_image_folder(tmp_path, tmp_path)) == 4


def test_results_are_no_pose_of_a_set_with_one_folder_a_pose(tmp_path):
    for k in range(3):
        make_images(tmp_path / f"pose_{k}", ["image.png"])
        write_lines(tmp_path / f"pose_{k}/pose.txt", rows(1))
    make_images(tmp_path / "calibration", ["views.png", "lens.png"])
    (tmp_path / "calibration/calibrated_of.json").write_text("{}")
    found = read_image_folder(tmp_path, tmp_path)
    assert len(found) == 3 and not found.unpaired_images
    for k in (0, 2):
        (tmp_path / f"pose_{k}/image.png").write_text("no image")
    refused("2 of 3 images cannot be used", read_image_folder, tmp_path, tmp_path)


def test_board_poses_of_other_count_are_refused(tmp_path):
    a, b = write_lines(tmp_path / "a.txt", rows(5)), write_lines(tmp_path / "b.txt", rows(4))
    refused("5 robot poses and 4 board poses", read_board_poses, a, b)
    names = [f"{k}.png" for k in range(5)]
    a = write_lines(tmp_path / "a.txt", rows(5), names=names)
    b = write_lines(tmp_path / "b.txt", rows(5)[[4, 2, 0]], names=names[::-2])
    both = read_board_poses(a, b)
    assert np.array_equal(both.robot.values, both.board.values) and len(both.robot) == 3
    assert [w for w, _ in both.unpaired_robot] == ["line 2", "line 4"]


# --- images -----------------------------------------------------------------------------------


def test_lossless_images_come_back_exactly(tmp_path):
    colour, grey = tiny(1), tiny(2)[..., 0]
    for ending in ("png", "tif"):
        assert np.array_equal(load_image(save(tmp_path / f"c.{ending}", colour)), colour)
    loaded = load_image(save(tmp_path / "g.png", grey))
    assert all(np.array_equal(loaded[..., c], grey) for c in range(3))
    opaque = np.dstack([colour, np.full(grey.shape, 255, np.uint8)])
    assert np.array_equal(load_image(save(tmp_path / "o.png", opaque)), colour)


def test_images_that_are_no_plain_colour_are_refused(tmp_path):
    deep = tmp_path / "deep.png"
    Image.fromarray(np.full((4, 4), 700, np.uint16)).save(deep)
    clear = save(tmp_path / "clear.png", np.full((4, 4, 4), 100, np.uint8))
    turned = tmp_path / "turned.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(tiny(6)).save(turned, exif=exif)
    (tmp_path / "text.png").write_text("no image")
    deep_colour = tmp_path / "deep_colour.png"
    cv2.imwrite(str(deep_colour), np.full((8, 8, 3), 40000, np.uint16))
    for path, says in (
        (deep, "more than 8 bits"),
        (deep_colour, "more than 8 bits"),
        (clear, "partly transparent"),
        (turned, "shown turned"),
        (tmp_path / "text.png", "not an image"),
        (tmp_path / "none.png", "does not exist"),
    ):
        refused(says, load_image, path)


@settings(max_examples=25, deadline=None)
@given(
    share=st.floats(0, 1), byte=st.integers(0, 255), ending=st.sampled_from(["png", "jpg", "tif"])
)
def test_no_damage_whatever_ends_in_a_traceback(share, byte, ending):
    with folder() as place:
        path = save(place / f"a.{ending}", tiny(7))
        data = bytearray(path.read_bytes())
        data[int(share * (len(data) - 1))] = byte
        path.write_bytes(bytes(data))
        try:
            image = load_image(path)
        except InputError as error:
            assert str(path) in str(error)
        else:
            assert image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8


# --- Every layout of images and poses that the documents list is read, and without being told.

GUIDE = Path(__file__).parents[2] / "docs/how-to/calibrate-from-your-own-files.md"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return layouts_read(tmp_path_factory.mktemp("layouts"))


@pytest.mark.parametrize("name", [*LAYOUTS, *PAIRS])
def test_a_layout_is_read(result, name):
    assert result[name] == ""


def test_the_guide_lists_every_layout():
    rows = [line for line in GUIDE.read_text().splitlines() if line.startswith("| `")]
    listed = [row.split("`")[1] for row in rows]
    assert listed == [*LAYOUTS, *PAIRS] and len(listed) >= 16


def test_pairs_that_do_not_say_whose_they_are_are_refused(tmp_path):
    for name, text in (("a.json", '[{"A": [1], "B": [2]}]'), ("a.csv", "x,y,z\n1,2,3\n4,5,6\n")):
        (tmp_path / name).write_text(text)
        refused(r"does not say which.*object_wrt_sensor", read_board_poses, None, tmp_path / name)


def test_a_pose_folder_with_two_images_is_named(tmp_path):
    Ts = se3.random_transform(np.random.default_rng(0), 4, spread=0.5)
    folder_a_pose(tmp_path, Ts, [tiny(k) for k in range(4)])
    save_images(tmp_path / "pose_02", [tiny(9)], "second.png")
    refused(r"pose_02 holds 2 images.*second.png", read_image_folder, tmp_path, tmp_path)
