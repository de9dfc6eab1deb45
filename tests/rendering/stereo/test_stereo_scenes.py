"""What a stereo camera loses and where: shadows, blank surfaces, mirrors; and reproducibility."""

from dataclasses import replace

import numpy as np

from grey_planes import grey_plane
from plain_meshes import square
from realsim.geometry import camera as lens
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.profiles import DepthProfile, profile
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import PlacedMesh
from realsim.rendering.stereo import StereoCamera, StereoConfig, StereoDepth
from refusals import refused

CAMERA = CameraIntrinsics(width=360, height=240, fx=360, fy=360, cx=179.5, cy=119.5)
RICH = StereoConfig(texture_contrast=0.25)
BLANK = StereoConfig(texture_contrast=0.0)
FAR, NEAR = 0.8, 0.5
WIDE = replace(profile("d435"), pattern="none", quantum_px=0.0)


def card(z: float, half: float, material: Material) -> PlacedMesh:
    mesh = Mesh(vertices=square(half).vertices, faces=square().faces[:, ::-1])
    return PlacedMesh(0, mesh, se3.from_translation([0, 0, z]), material)


MATTE = Material(base_color=(0.6, 0.6, 0.6), roughness=1.0)
CARD_BEFORE_WALL = [grey_plane(CAMERA, FAR), card(NEAR, 0.08, MATTE)]


def seen(
    scene: list[PlacedMesh], camera: DepthProfile, config: StereoConfig, seed: int = 0
) -> StereoDepth:
    rng = np.random.default_rng(seed)
    return StereoCamera(scene, camera, config).measure(CAMERA, np.eye(4), rng)


def test_shadows_lie_left_of_near_things_and_nowhere_else() -> None:
    camera = replace(profile("d435"), quantum_px=0.0, baseline_m=0.05)
    hole = seen(CARD_BEFORE_WALL, camera, RICH).depth_m == 0
    # The card spans u = 179.5 +- 57.6, v = 119.5 +- 57.6; it hides fB (1/near - 1/far) columns.
    left, right, top, bottom = 122, 237, 62, 177
    shadow = int(360 * 0.05 * (1 / NEAR - 1 / FAR))
    assert shadow == 13
    rows = slice(top + 8, bottom - 8)
    # The edge of the card is fattened into its shadow by up to half a window.
    assert hole[rows, left - shadow + 1 : left - 4].mean() > 0.8
    slack = 6
    elsewhere = np.ones(hole.shape, bool)
    elsewhere[top - slack : bottom + slack, left - shadow - slack : left + slack] = False
    elsewhere[:, : int(360 * 0.05 / FAR) + slack] = False  # left of the second eye's picture
    elsewhere[:, -slack:] = False
    assert hole[elsewhere].mean() < 0.01
    assert hole[rows, right + 4 : right + 4 + shadow].mean() < 0.05
    assert hole[top - 4 - shadow : top - 4, left:right].mean() < 0.05


def test_a_blank_wall_has_no_depth_until_dots_fall_on_it() -> None:
    def fill(name: str, config: StereoConfig) -> float:
        depth = seen([grey_plane(CAMERA, 0.6)], profile(name), config).depth_m
        return float(np.mean(depth[10:-10, 50:-10] > 0))

    assert fill("d405", BLANK) < 0.1
    assert fill("d405", RICH) > 0.98
    assert fill("d435", BLANK) > 0.98
    assert fill("d435", replace(BLANK, dot_power=0.0)) < 0.1


def test_a_highlight_of_polished_metal_misleads_or_is_lost_and_matte_paint_is_not() -> None:
    def good(material: Material) -> float:
        scene = [grey_plane(CAMERA, FAR), card(NEAR, 0.1, material)]
        on = seen(scene, WIDE, StereoConfig()).depth_m[80:160, 140:220]
        return float(np.mean(np.abs(on - NEAR) < 0.005))

    assert good(MATTE) > 0.98
    assert good(Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.1)) < 0.5


def test_dark_things_far_away_are_lost_by_structured_light() -> None:
    def fill(grey: float, z: float) -> float:
        paint = Material(base_color=(grey,) * 3, roughness=1.0)
        d = seen([card(z, z, paint)], profile("structured_light"), StereoConfig()).depth_m
        return float(np.mean(d[40:-40, 60:-40] > 0))

    assert fill(0.5, 0.6) == 1.0 and fill(0.5, 2.0) == 1.0
    assert fill(0.01, 0.6) > 0.9 and fill(0.01, 2.0) < 0.1


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    camera = StereoCamera(CARD_BEFORE_WALL, profile("d435"), RICH)
    first, again, other = (
        camera.measure(CAMERA, np.eye(4), np.random.default_rng(seed)) for seed in (5, 5, 6)
    )
    for b in (again, seen(CARD_BEFORE_WALL, profile("d435"), RICH, seed=5)):
        assert first.depth_m.tobytes() == b.depth_m.tobytes()
        assert first.left.tobytes() == b.left.tobytes()
        assert first.right.tobytes() == b.right.tobytes()
    assert first.left.tobytes() != other.left.tobytes()


def test_a_distorted_camera_reports_depth_on_its_raw_pixels() -> None:
    raw = replace(CAMERA, distortion=[-0.15, 0.05])
    exact = LabelRenderer(CARD_BEFORE_WALL).render(raw, np.eye(4)).depth_m
    rng = np.random.default_rng(0)
    found = StereoCamera(CARD_BEFORE_WALL, WIDE, RICH).measure(raw, np.eye(4), rng)
    assert found.depth_m.shape == (240, 360)
    known = (found.depth_m > 0) & (exact > 0)
    assert known[:, 40:].mean() > 0.9
    assert np.mean(np.abs(found.depth_m - exact)[known] < 0.01) > 0.96
    # The card's corners bulge: the undistorted camera would miss the border by 3 px there.
    assert abs(lens.project(raw, np.array([[0.08, 0.08, NEAR]]))[0][0] - (179.5 + 57.6)) > 0.4


def test_moving_the_world_and_the_camera_together_changes_nothing() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [0.3, -0.2, 0.1]
    moved = [replace(p, T_world_obj=T @ p.T_world_obj) for p in CARD_BEFORE_WALL]
    dark = replace(RICH, ambient=0.0)  # the room's light does not move with them
    here, there = (
        StereoCamera(scene, profile("d435"), dark).measure(CAMERA, pose, np.random.default_rng(0))
        for scene, pose in ((CARD_BEFORE_WALL, np.eye(4)), (moved, T))
    )
    both = (here.depth_m > 0) & (there.depth_m > 0)
    assert both.mean() > 0.8
    assert np.mean(np.abs(here.depth_m - there.depth_m)[both] < 1e-3) > 0.99


def test_what_a_configuration_cannot_be_is_named() -> None:
    for field, value in (("window_px", 8), ("full_well", 0.0), ("mean_level", 1.5),
                         ("read_noise", -1.0), ("texture_contrast", float("nan"))):  # fmt: skip
        refused(field if field != "window_px" else "window", StereoConfig, **{field: value})
