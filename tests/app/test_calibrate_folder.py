"""`realsim calibrate` on plain folders: what is found is named, with the exact thing to do."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import realsim_calibration
from pictured_folders import X, Z, pictures, save_pictures
from pictured_targets import CAMERA, TARGETS, truth
from realsim.app.calibrate import run
from realsim.app.calibrate.board_views import arm_of_poses
from realsim.app.calibrate.folder import FolderRequest, read_views
from realsim.app.calibrate.show import show_next_views
from realsim.app.console import Console
from realsim.geometry import se3
from realsim.robots.arm import find_arm
from realsim_calibration import calibrate
from realsim_calibration.planning import view_proposals
from refusals import refused
from typed_commands import invoked

BOARD = "chessboard:7x6,square=20mm"


@pytest.fixture(scope="module")
def found_before(tmp_path_factory):
    """Return a folder of results in which the ten pictures have been searched."""
    folder = tmp_path_factory.mktemp("searched")
    images = folder / "i"
    shots, hands = pictures()
    save_pictures(images, shots)
    write_matrices(images / "poses.json", hands)
    read_views(request(images, folder / "out"), Console(quiet=True))
    return folder / "out"


def request(images, out, **more):
    return FolderRequest(images=images, out=out, **{"board": BOARD} | more)


def write_matrices(path, Ts):
    path.write_text(json.dumps({"poses": np.asarray(Ts).tolist()}))


@pytest.fixture
def lab(tmp_path, found_before):
    """Return a folder with ten pictures and their poses; its pictures are searched already."""
    shots, hands = pictures()
    save_pictures(tmp_path / "lab", shots)
    write_matrices(tmp_path / "lab" / "poses.json", hands)
    shutil.copytree(found_before, tmp_path / "out")
    return tmp_path / "lab"


def read(lab, **more):
    return read_views(request(lab, lab.parent / "out", **more), Console(quiet=True))


def test_a_camera_of_another_size_is_named_before_the_poses(lab):
    camera = {"fx": 300, "fy": 300, "cx": 160, "cy": 120, "width": 320, "height": 240}
    (lab / "camera.json").write_text(json.dumps({**camera, "distortion": []}))
    # rotation vectors would have to be proven by the images, with the wrong lens
    (lab / "poses.json").unlink()
    _, hands = pictures()
    rows = np.hstack([hands[:, :3, 3], se3.log_so3(hands[:, :3, :3])])
    np.savetxt(lab / "poses.txt", rows)
    why = "for images of 320x240 px, and these are 640x480"
    said = refused(why, read, lab, intrinsics=lab / "camera.json")
    assert "s = 2," in said and "leave --intrinsics out" in said
    (lab / "poses.txt").unlink()
    write_matrices(lab / "poses.json", hands)
    assert len(read(lab).views) == 10


def test_images_of_several_sizes_are_named(lab):
    shots, _ = pictures()
    save_pictures(lab, [shots[3][:400]], "03.png")
    said = refused("of 640x480 px", read, lab)
    assert "take these out: 03.png" in said.replace("\n", " ")


def test_nothing_is_said_of_a_given_camera_where_none_was_given(lab):
    found = read(lab)
    result = calibrate(found.views, found.target)
    assert np.abs(se3.log(se3.invert(X) @ result.hand_eye.X)[3:]).max() < 2e-3
    names = [c.name for c in result.checks]
    assert "given camera" not in names and "focal length with poses" in names
    assert not any("given camera" in c.sentence for c in result.checks)
    given = calibrate(found.views, found.target, intrinsics0=result.hand_eye.intrinsics)
    assert "given camera" in [c.name for c in given.checks]


def test_a_fixed_camera_is_told_by_its_flag(lab):
    _, hands = pictures()
    write_matrices(lab / "poses.json", se3.invert(hands))
    found = read(lab)
    said = refused(r"inverted", calibrate, found.views, found.target)
    assert "--eye-to-hand" in said and "--reading" in said


def test_a_folder_is_its_own_from_the_first_note_on(lab, found_before):
    """A run that ends after the search goes on there; one of other images does not."""
    (lab.parent / "out/calibrated_of.json").unlink()
    (lab.parent / "camera.json").write_text("{}")
    refused(r"camera\.json", read, lab, intrinsics=lab.parent / "camera.json")
    call = ("calibrate", "--board", BOARD, "--out", lab.parent / "out", "--intrinsics", "none")
    assert "replacing" not in invoked(*call, lab).output
    (lab.parent / "out/calibration_report.html").touch()  # written last: the result is whole
    assert f"replacing the calibration of {lab} in" in invoked(*call, lab).output
    said = str(invoked(*call, found_before.with_name("i")).exception)
    assert f"calibration of '{lab}'; give --out {lab.with_name('calibration-i')}" in said


def test_results_that_are_half_replaced_have_no_page(tmp_path):
    _, hands = pictures()
    lost = np.arange(len(hands)) == 4
    write_matrices(tmp_path / "hand.json", np.where(lost[:, None, None], np.nan, hands))
    write_matrices(tmp_path / "board.json", se3.invert(hands @ X) @ Z)
    out = tmp_path / "out"
    out.mkdir()
    (out / "calibrated_of.json").write_text(json.dumps({"images": str(tmp_path)}))
    (out / "calibration_report.html").write_text("of the earlier run")
    (out / "exports").write_text("no folder: nothing can be written in it")
    poses = ("--poses", "hand.json", "--board-poses", tmp_path / "board.json")
    done = invoked("calibrate", tmp_path, *poses, "--out", out)
    assert isinstance(done.exception, OSError), done.output
    assert "entry 4 was left out: NaN" in " ".join(done.output.split())
    assert not (out / "calibration_report.html").exists()


def replace_pictures(lab, changed):
    for k, picture in changed.items():
        save_pictures(lab, [picture], f"{k:02d}.png")


@pytest.mark.parametrize("views", [1, 2])
def test_too_few_views_are_named_with_how_many_are_needed(lab, views):
    _, hands = pictures()
    for path in sorted(lab.glob("*.png"))[views:]:
        path.unlink()
    write_matrices(lab / "poses.json", hands[:views])
    refused(f"{views} of {views} images.*3 views at least, and 24", read, lab)


def test_fewer_poses_than_images_are_named_with_what_to_do(lab):
    write_matrices(lab / "poses.json", pictures()[1][:7])
    refused(r"10 images and 7 poses.*image's name beside each", read, lab)


def test_degrees_under_names_of_radians_are_asked_for_by_their_unit(lab):
    hands = pictures()[1]
    twists = [[*T[:3, 3], *np.degrees(se3.log_so3(T[:3, :3]))] for T in hands]
    rows = ["x_m,y_m,z_m,rx_rad,ry_rad,rz_rad", *(",".join(map(str, row)) for row in twists)]
    (lab / "poses.json").unlink()
    (lab / "poses.csv").write_text("\n".join(rows) + "\n")
    refused("in the units that their names state.*--reading rotvec,deg,mm", read, lab)


@pytest.mark.parametrize("what", ["corners", "axes"])
def test_drawings_on_the_target_are_named(lab, what, capsys):
    shots, hands = pictures()
    target, drawn = TARGETS["chessboard"], {}
    for k in (2, 5):
        T = se3.invert(se3.invert(Z) @ hands[k] @ X)
        image = cv2.cvtColor(shots[k], cv2.COLOR_GRAY2BGR)
        if what == "corners":
            uv = truth(target, T).astype(np.float32)
            cv2.drawChessboardCorners(image, (7, 6), uv[:, None], True)
        else:
            rotation = cv2.Rodrigues(T[:3, :3])[0]
            cv2.drawFrameAxes(image, CAMERA.K, np.zeros(5), rotation, T[:3, 3], 0.05, 2)
        drawn[k] = image
    read(lab)
    assert "drawn" not in capsys.readouterr().err
    replace_pictures(lab, drawn)
    read(lab)
    said = " ".join(capsys.readouterr().err.split())
    assert "02.png, 05.png: coloured lines or dots are drawn over the target" in said
    assert "leave these images out" in said


def test_two_boards_among_the_images_are_named(lab, capsys):
    other, _ = pictures("circles")
    replace_pictures(lab, {k: other[k] for k in range(2)})
    read(lab)
    said = " ".join(capsys.readouterr().err.split())
    assert "00.png shows a grid of 7x5 dots, not the target" in said
    assert "it is one of 2 images without it (00.png, 01.png)" in said and "folder of their" in said


def test_a_blurred_picture_is_dropped_with_its_reason(lab):
    shots, _ = pictures()
    replace_pictures(lab, {4: cv2.GaussianBlur(shots[4], (0, 0), 15.0)})
    found = read(lab)
    report = calibrate(found.views, found.target).hand_eye
    (dropped,) = (v for v in report.views if not v.used)
    assert dropped.label == "04.png" and "the picture is blurred" in dropped.reason


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda p: cv2.GaussianBlur(p, (0, 0), 12.0), ["picture is blurred", "1 sigma", "rest"]),
        (lambda p: (p * 0.04).astype(np.uint8), ["too dark, under-exposed", "Expose longer"]),
    ],
    ids=["blurred", "dark"],
)
def test_pictures_that_show_nothing_are_named_for_their_fault(lab, spoil, said):
    shots, hands = pictures()
    for path in lab.glob("*.png"):
        path.unlink()
    replace_pictures(lab, {k: spoil(shot) for k, shot in enumerate(shots[:4])})
    write_matrices(lab / "poses.json", hands[:4])
    text = " ".join(refused("found in none of the 4 images", read, lab).split())
    assert all(words in text for words in said)
    assert "Give --board as it was printed" not in text
    if "blurred" in text:
        assert 9.0 < float(text.split("spread over ")[1].split()[0]) < 16.0


# --- What `realsim calibrate` prints of further views: those that gain something, and nothing else.


@pytest.mark.parametrize(("sigma_mm", "gains"), [(15.77, False), (15.7, False), (9.0, True)])
def test_views_that_gain_nothing_are_not_promised(monkeypatch, capsys, sigma_mm, gains):
    report = SimpleNamespace(
        here_mm=15.77, here_deg=0.4, sigma_mm=40.0, sigma_deg=0.9,
        used=(SimpleNamespace(joints=None),)
    )  # fmt: skip
    view = SimpleNamespace(
        distance_m=0.3, tilt_deg=25.0, roll_deg=15.0, sigma_mm=sigma_mm, sigma_deg=0.399
    )
    monkeypatch.setattr(view_proposals, "propose_views", lambda report: [view])
    monkeypatch.setattr(realsim_calibration, "choose_next_views", lambda *a: [view])
    show_next_views(report, Console())
    said = " ".join(capsys.readouterr().out.split())
    assert ("Further views that would help most" in said) == gains
    assert ("gain nothing: sigma stays at 15.77 mm" in said) == (not gains)
    assert gains or "joint angles with the poses" in said
    monkeypatch.setattr(realsim_calibration, "choose_next_views", lambda *a: [])
    show_next_views(report, Console())
    assert capsys.readouterr().out == ""


# --- `realsim calibrate` keeps BLAS to one thread: several wait for each other on small matrices.


def test_blas_has_one_thread_while_it_calibrates(monkeypatch, tmp_path):
    seen = []

    def look(source: Path, console: Console, **options: object) -> bool:
        seen.extend(lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas")
        return True

    monkeypatch.setattr(run, "_run", look)
    with threadpool_limits(2, user_api="blas"):
        assert run.run_calibrate(tmp_path, Console(quiet=True), live=False)
    assert seen and set(seen) == {1}


# --- Joints beside poses prove the arm, with images and without.


def test_joints_prove_the_arm_whose_poses_they_give():
    chain = find_arm("ur5").chain.bare()
    joints = np.random.default_rng(0).uniform(-2, 2, (12, 6))
    Ts = np.stack([chain.forward(q) for q in joints])
    found = arm_of_poses(Ts, joints)
    assert found is not None and found.name == chain.name
    assert arm_of_poses(Ts, joints[::-1]) is None
