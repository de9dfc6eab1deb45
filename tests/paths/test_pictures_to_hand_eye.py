"""From a folder of calibration pictures to a hand-eye that can be trusted, with one command.

The target is the sheet that `realsim board` prints, photographed by a simulated camera with a bent
lens in a simulated hand; what the command says is held against the truth and against its own sigma.
"""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from documents import as_arguments, documented
from realsim.arrays import Array, Array32, UInt8
from realsim.geometry import camera, se3
from realsim.images.png import encode_png
from realsim.records import CameraIntrinsics

pytestmark = pytest.mark.slow
README = "README.md"
GOAL_MM, GOAL_DEG = 0.5, 0.1
"""What the demo asks of a hand-eye."""
LENS = CameraIntrinsics(
    width=640, height=480, fx=604.0, fy=603.0, cx=322.0, cy=237.0,
    distortion=np.array([-0.06, 0.05, 6e-4, -4e-4, 0, 0, 0, 0]),
)  # fmt: skip
VIEWS = 16
RAYS = 3
"""Rays across a pixel."""
DPI = 400
INCH_M = 0.0254
ARM = (1e-4, 1e-4)
"""Errors of the controller's poses, one sigma per axis [rad, m]: a good arm's."""


def run(line: str, here: Path, *more: str, **replaced: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [*as_arguments(line, **replaced), *more], cwd=here, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip


def printed(sheet: Path) -> Array32:
    """Return the printed page: how light it is, 0.12 ink to 0.85 paper."""
    import pypdfium2

    page = pypdfium2.PdfDocument(sheet)[0].render(scale=DPI / 72, grayscale=True)
    return (0.12 + 0.73 / 255 * page.to_numpy()).astype(np.float32)


class Camera:
    """Photographs a page through the bent lens; integer pixels are pixel centres."""

    def __init__(self, page: Array32) -> None:
        steps = (np.arange(RAYS) - (RAYS - 1) / 2) / RAYS
        v = (np.arange(LENS.height)[:, None] + steps).ravel()
        u = (np.arange(LENS.width)[:, None] + steps).ravel()
        xy, _ = camera.undistort(LENS, np.stack(np.meshgrid(u, v), -1))
        self.rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1)
        self.page = page
        self.page_m = np.array(page.shape[::-1]) * INCH_M / DPI

    def photograph(self, T_cam_page: Array, rng: np.random.Generator) -> UInt8:
        """Return the picture; the page's x goes along its rows, its origin is its middle."""
        import cv2

        H = np.linalg.inv(T_cam_page[:3, [0, 1, 3]])
        at = self.rays @ H.T
        at = (at[..., :2] / at[..., 2:] + self.page_m / 2) * DPI / INCH_M - 0.5
        x, y = (at[..., k].astype(np.float32) for k in range(2))
        fine = cv2.remap(self.page, x, y, cv2.INTER_LINEAR, borderValue=0.45)
        light = cv2.resize(fine, (LENS.width, LENS.height), interpolation=cv2.INTER_AREA)
        light = cv2.GaussianBlur(light, (0, 0), 0.6) + rng.normal(scale=0.008, size=light.shape)
        grey = np.clip(np.rint(255 * light), 0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, -1)


@dataclass(frozen=True, eq=False)
class Lab:
    """A folder with the sheet, the pictures and the arm's poses, and the truth."""

    folder: Path
    command: str
    T_ee_cam: Array


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """Print the board of the README and photograph it from all round."""
    folder = tmp_path_factory.mktemp("lab")
    board = documented(README, "realsim", "board")
    done = run(board, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    command = documented(README, "realsim", "calibrate", "--board")
    sheet = (folder / command.split("--board")[1].strip()).with_suffix(".pdf")
    rng = np.random.default_rng(3)
    lens = Camera(printed(sheet))
    X = se3.from_rt(se3.exp_so3([0.02, -0.03, 1.52]), [0.031, -0.058, 0.047])
    T_base_page = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.42, 0.08, 0.012])
    lines: list[str] = []
    (folder / "pictures").mkdir()
    for k in range(VIEWS):
        tilt, turn = np.radians(rng.uniform(5, 40)), rng.uniform(0, 2 * np.pi)
        away = [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
        aim = [*rng.uniform(-0.03, 0.03, 2), 0.0]
        eye = np.add(aim, rng.uniform(0.32, 0.45) * np.array(away))
        T_page_cam = se3.look_at(eye, aim, rng.uniform(-np.pi, np.pi))
        picture = lens.photograph(se3.invert(T_page_cam), rng)
        (folder / f"pictures/{k:03d}.png").write_bytes(encode_png(picture))
        error = np.concatenate([rng.normal(scale=s, size=3) for s in ARM])
        told = T_base_page @ T_page_cam @ se3.invert(X) @ se3.exp(error)
        numbers = [*told[:3, 3], *se3.log_so3(told[:3, :3])]
        lines.append(" ".join(f"{x:.6f}" for x in numbers))
    (folder / "pictures/poses.txt").write_text("\n".join(lines) + "\n")
    return Lab(folder, command, X)


def test_one_command_gives_a_hand_eye_as_good_as_it_says(lab: Lab) -> None:
    done = run(lab.command, lab.folder, "--out", "right", "--json", FOLDER="pictures")
    assert done.returncode == 0, done.stdout + done.stderr
    said = json.loads(done.stdout)
    assert said["passed"] and len(said["view_indices"]) >= VIEWS - 1
    error = se3.log(se3.invert(np.array(said["T_ee_cam"])) @ lab.T_ee_cam)
    assert 1e3 * np.linalg.norm(error[3:]) < GOAL_MM
    assert np.degrees(np.linalg.norm(error[:3])) < GOAL_DEG
    # 22.5: six standard normals squared and summed exceed it once in a thousand.
    assert error @ np.linalg.solve(np.array(said["covariance"]), error) < 22.5
    # A sigma that covers everything would tell nothing.
    assert said["sigma_mm"] < GOAL_MM and said["sigma_deg"] < GOAL_DEG
    assert abs(said["intrinsics"]["fx"] - LENS.fx) < 2.0
    assert all(Path(lab.folder, file).is_file() for file in said["files"])
    assert any(file.endswith("calibration_report.html") for file in said["files"])


def test_poses_in_a_wrong_order_end_with_a_reason(lab: Lab) -> None:
    pictures = lab.folder / "pictures"
    shuffled = lab.folder / "shuffled"
    shuffled.mkdir()
    for path in pictures.glob("*.png"):
        (shuffled / path.name).symlink_to(path)
    lines = (pictures / "poses.txt").read_text().splitlines()
    order = np.random.default_rng(1).permutation(VIEWS)
    (shuffled / "poses.txt").write_text("\n".join(lines[k] for k in order) + "\n")
    more = ("--out", "wrong", "--reading", "rotvec,m")
    done = run(lab.command, lab.folder, *more, FOLDER="shuffled")
    said = " ".join((done.stdout + done.stderr).split())
    assert done.returncode == 2 and "Traceback" not in said, said
    assert "Check that images and poses belong to the same session" in said and " deg" in said, said
    assert not list((lab.folder / "wrong").rglob("calibration*")), "no result of such poses"
