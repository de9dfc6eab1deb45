import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from realsim.errors import InputError
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics
from realsim_calibration.lens.camera_files import read_camera, write_camera
from refusals import refused

CAMERA = CameraIntrinsics(
    width=1280, height=720, fx=912.25, fy=911.5, cx=641.125, cy=355.75,
    distortion=np.array([0.11, -0.21, 0.0007, -0.0004, 0.09, 0, 0, 0]),
)  # fmt: skip


def same(a, b):
    one, other = ((c.width, c.height, c.K.tolist(), c.distortion.tolist()) for c in (a, b))
    return one == other


def given_file(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    f=st.floats(200, 4000),
    ratio=st.floats(0.9, 1.1),
    cx=st.floats(1, 1279),
    cy=st.floats(1, 719),
    d=st.lists(st.floats(-0.9, 0.9, allow_subnormal=False), max_size=8),
    form=st.sampled_from(["realsim", "ros", "opencv"]),
)
def test_what_was_written_is_read_bit_for_bit(tmp_path, f, ratio, cx, cy, d, form):
    assume((f, f * ratio) != (cx, cy))  # a camera copied from its principal point is refused
    camera = replace(CAMERA, fx=f, fy=f * ratio, cx=cx, cy=cy, distortion=np.array(d))
    path = tmp_path / f"camera_{form}"
    write_camera(path, camera, format=form)
    assert same(read_camera(path), camera)


def test_opencv_reads_what_was_written_and_the_other_way_round(tmp_path):
    import cv2

    ours = tmp_path / "ours.yaml"
    write_camera(ours, CAMERA, format="opencv")
    stored = cv2.FileStorage(str(ours), cv2.FileStorage_READ)
    assert np.array_equal(stored.getNode("camera_matrix").mat(), CAMERA.K)
    distortion = stored.getNode("distortion_coefficients").mat()
    assert np.array_equal(distortion.ravel(), CAMERA.distortion[:5])
    for suffix in ("yaml", "xml", "json"):
        path = tmp_path / f"theirs.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
        storage.write("calibration_time", "Fri 20 Nov 2026")
        storage.write("image_width", CAMERA.width)
        storage.write("image_height", CAMERA.height)
        storage.write("cameraMatrix", CAMERA.K)
        storage.write("distCoeffs", CAMERA.distortion[:5].reshape(1, 5))
        storage.release()
        read = read_camera(path)
        assert np.allclose(read.K, CAMERA.K, rtol=1e-12)
        assert np.allclose(read.distortion, CAMERA.distortion, rtol=1e-12)
        assert (read.width, read.height) == (1280, 720)


def test_the_other_kinds_of_json(tmp_path):
    K = [[912.25, 0, 641.125], [0, 911.5, 355.75], [0, 0, 1]]
    size = {"width": 1280, "height": 720}
    four = {"fx": 912.25, "fy": 911.5}
    d = CAMERA.distortion[:5].tolist()
    cases = {
        "matrix": {"intrinsic": K, "distortion": [d], "resolution": [1280, 720]},
        "realsense": {**four, **size, "ppx": 641.125, "ppy": 355.75, "coeffs": d},
        "nested": {"color": {"K": K, "D": d, **size}},
    }
    for name, content in cases.items():
        assert same(read_camera(given_file(tmp_path, name + ".json", content)), CAMERA), name
    bop = {**four, **size, "cx": 641.125, "cy": 355.75, "depth_scale": 0.1}
    assert not read_camera(given_file(tmp_path, "camera.json", bop)).is_distorted


@pytest.mark.parametrize(
    ("line", "fx", "fy", "d"),
    [
        ("1 SIMPLE_PINHOLE 640 480 500 320 240", 500, 500, []),
        ("1 OPENCV 640 480 500 510 320 240 .1 .2 .003 .004", 500, 510, [0.1, 0.2, 0.003, 0.004]),
        (
            "1 FULL_OPENCV 640 480 500 510 320 240 .1 .2 .003 .004 .5 .6 .7 .8",
            500, 510, [0.1, 0.2, 0.003, 0.004, 0.5, 0.6, 0.7, 0.8],
        ),
    ],
)  # fmt: skip
def test_colmap_pixels_move_by_half_a_pixel(tmp_path, line, fx, fy, d):
    import pycolmap

    path = given_file(tmp_path, "cameras.txt", "# Camera list\n# ...\n" + line + "\n")
    camera = read_camera(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (fx, fy, 319.5, 239.5)
    assert camera.distortion[: len(d)].tolist() == d
    words = line.split()
    params = [float(w) for w in words[4:]]
    theirs = pycolmap.Camera(model=words[1], width=640, height=480, params=params)
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.15, 1.2], [0.0, 0.0, 1.0]])
    uv = np.array([theirs.img_from_cam(p) for p in points]).reshape(-1, 2)
    assert np.allclose(project(camera, points), uv - 0.5, atol=1e-9)


BAD = {
    "no size": ({"K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}, "how large its images are"),
    "fisheye": (
        {"K": [500, 0, 320, 0, 500, 240, 0, 0, 1], "D": [0.1, 0.2, 0.3, 0.4], "width": 640,
         "height": 480, "distortion_model": "kannala_brandt"},
        "kannala_brandt",
    ),
    "several": (
        {"left": {"fx": 1, "fy": 1}, "right": {"fx": 1, "fy": 1}}, "several cameras (left, right)",
    ),
    "nan": (
        {"fx": float("nan"), "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480},
        "not a finite number",
    ),
    "transposed": (
        {"K": [500, 0, 0, 0, 500, 0, 320, 240, 1], "width": 640, "height": 480}, "transposed",
    ),
    "copied": (
        {"fx": 640.8, "fy": 357.5, "ppx": 640.8, "ppy": 357.5, "width": 1280, "height": 720},
        "repeat the principal point",
    ),
    "outside": (
        {"fx": 500, "fy": 500, "cx": 960, "cy": 540, "width": 640, "height": 480},
        "outside the image",
    ),
    "yaml": ("a: [1, 2", "not valid YAML"),
    "deep": ("{" + '"a":{' * 3000, "the camera file"),
    "tag": ("!!python/object/apply:os.getcwd []\n", "has the tag"),
    "entities": ("<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage/>", "entities"),
    "cameras": ("# Camera list\n1 PINHOLE 9 9 1 1 4 4\n2 PINHOLE 9 9 1 1 4 4\n", "2 cameras"),
    "colmap fisheye": ("# Camera list\n1 OPENCV_FISHEYE 64 48 1 1 1 1 0 0 0 0\n", "not supported"),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(BAD))
def test_what_is_not_a_camera_is_refused_with_the_reason(tmp_path, name):
    content, reason = BAD[name]
    said = refused("some_camera", read_camera, given_file(tmp_path, "some_camera", content))
    assert reason in said


def test_large_binary_and_missing_files_are_refused(tmp_path):
    refused("does not exist", read_camera, tmp_path / "none.yaml")
    (tmp_path / "large").write_bytes(b" " * 5_000_000)
    refused(r"5\.0 MB", read_camera, tmp_path / "large")
    for head, kind in ((b"\x89PNG\xff\xfe\x00", "a picture"), (b"abc\x00\xff", "a binary file")):
        (tmp_path / "some.file").write_bytes(head)
        with pytest.raises(InputError, match=f"is {kind}, no camera file.*Accepted are text files"):
            read_camera(tmp_path / "some.file")


def test_the_matrix_by_name(tmp_path):
    key = "camera_matrix"
    text = f"{key}: {{fx: 550.5, fy: 551, cx: 320, cy: 240}}\ndistortion: [0.1, -0.2]\n"
    path = given_file(tmp_path, "c.yaml", text + "image_size: [640, 480]\n")
    camera = read_camera(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (550.5, 551, 320, 240)
    assert (camera.width, camera.height) == (640, 480)
    assert camera.distortion[:2].tolist() == [0.1, -0.2]
    assert np.array_equal(read_camera(path, size=(320, 240)).K, camera.K)  # the file counts more
    path = given_file(tmp_path, "d.yaml", text)
    refused("how large its images are", read_camera, path)
    assert np.array_equal(read_camera(path, size=(640, 480)).K, camera.K)
    refused("another image size", read_camera, path, size=(1280, 960))
    with pytest.raises(InputError, match="fx and fy are not among"):
        read_camera(given_file(tmp_path, "e.yaml", f"{key}: {{f: 550, width: 4}}\n"))


def test_nothing_is_written_in_an_unknown_format_or_name(tmp_path):
    refused("not known", write_camera, tmp_path / "a", CAMERA, format="matlab")
    refused("letters", write_camera, tmp_path / "a", CAMERA, format="ros", name="x\ny: 1")
    assert not list(tmp_path.iterdir())


def visp(model, *, extra="", size="<image_width>1280</image_width>"):
    values = "<px>912.25</px><py>911.5</py><u0>641.125</u0><v0>355.75</v0>"
    return (
        f"<?xml version='1.0'?><root><!--ViSP--><camera><name>c</name>{size}"
        f"<image_height>720</image_height>{extra}<model><type>{model}</type>{values}"
        "<kud>-0.125</kud><kdu>0.13</kdu></model></camera></root>"
    )


def test_visps_camera_is_read_with_its_distortion(tmp_path):
    """The model with distortion counts of the two; kud moves a pixel as ViSP says it does."""
    pinhole = visp("perspectiveProjWithoutDistortion")
    assert not np.any(read_camera(given_file(tmp_path, "p.xml", pinhole)).distortion)
    other = "<model><type>perspectiveProjWithoutDistortion</type><px>1</px></model>"
    text = visp("perspectiveProjWithDistortion", extra=other)
    camera = read_camera(given_file(tmp_path, "camera.xml", text))
    assert (camera.width, camera.height) == (1280, 720)
    x, y = 0.2, -0.1
    seen = project(camera, np.array([[x, y, 1.0]]))[0]
    share = 1 - 0.125 * (x * x + y * y)
    assert np.allclose(seen, [641.125 + 912.25 * x * share, 355.75 + 911.5 * y * share])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (visp("ProjWithKannalaBrandtDistortion"), "ProjWithKannalaBrandtDistortion; perspective"),
        (visp("perspectiveProjWithDistortion", size=""), "no number <image_width>"),
        (visp("perspectiveProjWithDistortion").replace("<px>912.25", "<px>x"), "number <px>"),
        (visp("p").replace("</camera>", "</camera><camera><name>d</name></camera>"), "2 cam"),
        ("<root></root>", "holds 0 cameras"),
        ("<!DOCTYPE root [<!ENTITY a 'b'>]>" + visp("x").split("?>")[1], "camera file"),
    ],
)  # fmt: skip
def test_what_is_no_camera_of_visp_is_named(tmp_path, text, words):
    refused(words, read_camera, given_file(tmp_path, "camera.xml", text))
