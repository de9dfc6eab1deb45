"""Mount and work cell files: what is written is read back, what is wrong is named."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from given_plans import BENCH
from realsim.errors import RealsimError, UnitError
from realsim.geometry import se3
from realsim.robots.arm import UR5
from realsim.robots.shapes import Mount, Shape
from realsim_capture_plans.collision.cell_files import read_mount, read_work_cell_obstacles
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.collision.mount import CAMERA_BODIES, d405_mount, plain_bracket
from refusals import refused

GOOD = """
name = "left bracket"
camera = "D405"
translation_m = [0.0, -0.065, 0.035]
rotation_vector_rad = [0.0, 0.0, 0.0]
"""
NO_TURN = "rotation_vector_rad = [0.0, 0.0, 0.0]"
TETRAHEDRON = "v 0 0 0\nv 40 0 0\nv 0 40 0\nv 0 0 40\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def written(folder: Path, text: str, name: str = "mount.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def text_of(mount: Mount, folder: Path) -> str:
    """A mount as its file; the hulls of its convex pieces are written beside it."""
    top = {
        "name": mount.name, "camera": mount.camera, "cover_m": mount.cover_m,
        "translation_m": mount.T_ee_cam[:3, 3].tolist(),
        "matrix": mount.T_ee_cam[:3, :3].tolist(),
    }  # fmt: skip
    lines = [lines_of(top), "" if mount.bracket else "bracket = []"]
    for k, piece in enumerate(mount.bracket):
        T = piece.T_frame_shape
        turn, at = se3.log_so3(T[:3, :3]).tolist(), T[:3, 3].tolist()
        table = {"kind": piece.kind, "position_m": at, "rotation_vector_rad": turn}
        if piece.points is None:
            table["size_m"] = list(piece.size_m)
        else:
            table |= {"file": f"{k}.obj", "unit": "m"}
            trimesh.convex.convex_hull(piece.points).export(folder / f"{k}.obj", digits=17)
        lines += ["[[bracket]]", lines_of(table)]
    return "\n".join(lines)


def lines_of(table: dict[str, object]) -> str:
    return "\n".join(f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in table.items())


def same(a: Mount, b: Mount) -> bool:
    return (
        (a.name, a.camera, a.cover_m, len(a.bracket))
        == (b.name, b.camera, b.cover_m, len(b.bracket))
        and np.abs(a.T_ee_cam - b.T_ee_cam).max() < 1e-12
        and all(
            (p.kind, p.part, p.frame) == (q.kind, q.part, q.frame)
            and np.allclose(p.size_m, q.size_m, atol=1e-12)
            and np.abs(p.T_frame_shape - q.T_frame_shape).max() < 1e-9
            and (p.points is None or bool(np.allclose(np.sort(p.points, 0), np.sort(q.points, 0))))
            for p, q in zip(a.bracket, b.bracket, strict=True)
        )
    )


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10**6), name=st.text(min_size=1).filter(str.strip))
def test_what_is_written_is_read_back(
    seed: int, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if any(not c.isprintable() for c in name):
        name = repr(name)
    rng = np.random.default_rng(seed)
    kinds = {"box": 3, "capsule": 2, "cylinder": 2, "sphere": 1, "convex": 0}
    pieces = [
        Shape(
            part="bracket", frame=6, kind=kind, size_m=tuple(rng.uniform(0.01, 0.1, lengths)),
            points=rng.normal(0, 0.02, (4, 3)) if kind == "convex" else None,
            T_frame_shape=se3.random_transform(rng, spread=0.05),
        )
        for kind, lengths in kinds.items()
    ]  # fmt: skip
    camera, cover_m = str(rng.choice(list(CAMERA_BODIES))), float(rng.choice([0.0, 0.004]))
    T, bracket = se3.random_transform(rng, spread=0.05), tuple(pieces[: rng.integers(0, 6)])
    mount = Mount(name=name, camera=camera, T_ee_cam=T, bracket=bracket, cover_m=cover_m)
    folder = tmp_path_factory.mktemp("mount")
    assert same(read_mount(written(folder, text_of(mount, folder))), mount)


def test_three_ways_to_say_the_same_rotation(tmp_path: Path) -> None:
    R = se3.exp_so3([0.4, -0.2, 0.9])
    w, x, y, z = se3.quaternion_wxyz(R)
    ways = [
        "rotation_vector_rad = [0.4, -0.2, 0.9]",
        f"quaternion_xyzw = [{x:.5f}, {y:.5f}, {z:.5f}, {w:.5f}]",
        f"matrix = {np.round(R, 12).tolist()}",
    ]
    for way in ways:
        path = written(tmp_path, GOOD.replace(NO_TURN, way))
        assert np.abs(read_mount(path).T_ee_cam[:3, :3] - R).max() < 2e-5


def test_without_a_bracket_a_plain_one_is_assumed(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD.replace("left bracket", d405_mount().name))
    assert same(read_mount(path), d405_mount())
    assert read_mount(written(tmp_path, GOOD + "bracket = []\n")).bracket == ()


def test_a_mesh_is_taken_in_its_unit_beside_the_file(tmp_path: Path) -> None:
    written(tmp_path, TETRAHEDRON, "part.obj")
    table = (
        '[[bracket]]\nkind = "convex"\nfile = "part.obj"\nunit = "mm"\nposition_m = [0, 0, 0.01]'
    )
    (piece,) = read_mount(written(tmp_path, GOOD + table)).bracket
    assert piece.points is not None
    assert np.sort(piece.points, axis=0)[-1] == pytest.approx([0.04, 0.04, 0.04])
    assert piece.T_frame_shape[2, 3] == 0.01
    # The same lengths in metres are larger than anything on a flange.
    with pytest.raises(UnitError, match=r"reaches 40 m.*unit"):
        read_mount(written(tmp_path, GOOD + table.replace('"mm"', '"m"')))


WRONG = {
    "translation_m.*millimetres": GOOD.replace("[0.0, -0.065, 0.035]", "[0, -65, 35]"),
    "'translaton_m' is not known. Was 'translation_m' meant": GOOD.replace(
        "translation_m", "translaton_m"
    ),
    "'D450' is not known; there are D405": GOOD.replace('"D405"', '"D450"'),
    "rotation_vector_rad and quaternion_xyzw given; exactly one": GOOD
    + "quaternion_xyzw = [0, 0, 0, 1]",
    "length 2.0000; 1 is needed": GOOD.replace(NO_TURN, "quaternion_xyzw = [0, 0, 0, 2]"),
    "Were degrees given": GOOD.replace("rad = [0.0, 0.0, 0.0]", "rad = [0.0, 0.0, 90.0]"),
    "mirrored": GOOD.replace(NO_TURN, "matrix = [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]"),
    "name is missing": GOOD.replace('name = "left bracket"', ""),
    "is not TOML": GOOD + "cover_m = 5 mm",
    "bracket 1: size_m is .* list of 3": GOOD + '[[bracket]]\nkind = "box"\nsize_m = [0.1, 0.1]',
    'unit = "mm" or unit = "m" is needed': GOOD + '[[bracket]]\nkind = "convex"\nfile = "a.stl"',
    "flat.obj holds no solid": GOOD + '[[bracket]]\nkind = "convex"\nfile = "flat.obj"\nunit = "m"',
}


@pytest.mark.parametrize("says", WRONG)
def test_what_is_wrong_is_named(says: str, tmp_path: Path) -> None:
    written(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "flat.obj")
    said = refused(says, read_mount, written(tmp_path, WRONG[says]), error=RealsimError)
    assert "mount.toml" in said


@pytest.mark.parametrize("camera", CAMERA_BODIES)
def test_the_plain_bracket_joins_flange_and_camera(camera: str) -> None:
    """It touches the flange's face and the camera, in one piece, without entering the wrist."""
    import coal

    from realsim.robots.coal_geometry import coal_shape
    from realsim_capture_plans.collision.mount import camera_shape

    T = se3.from_translation([-0.09, 0.09, 0.0])
    mount = Mount(name="m", camera=camera, T_ee_cam=T, bracket=plain_bracket(T, camera))

    def gap(a: Shape, b: Shape) -> float:
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        places = [coal.Transform3s(s.T_frame_shape[:3, :3], s.T_frame_shape[:3, 3]) for s in (a, b)]
        return coal.distance(coal_shape(a), places[0], coal_shape(b), places[1], request, result)

    for a, b in pairwise([*mount.bracket, camera_shape(mount)]):
        assert gap(a, b) <= 1e-6
    assert CollisionModel(UR5, mount, BENCH, 0.01).mount_gap_m > 0


def test_obstacles_are_read_and_wrong_ones_named(tmp_path: Path) -> None:
    wall = '[[obstacles]]\nname = "wall"\nlower_m = [-2.0, 0.7, -inf]\nupper_m = [2.0, 0.75, inf]\n'
    (name, box), *rest = read_work_cell_obstacles(written(tmp_path, wall))
    assert (name, rest) == ("wall", [])
    assert box.lower == (-2.0, 0.7, -np.inf)
    assert box.upper == (2.0, 0.75, np.inf)
    for wrong, says in {
        wall + wall: "two obstacles are called 'wall'",
        wall.replace("0.75", "0.65"): "'wall'.*below upper_m",
        wall.replace("0.75", "750"): "Were millimetres",
        wall.replace("lower_m", "lowr_m"): "'lowr_m' is not known. Was 'lower_m' meant",
        "": "no \\[\\[obstacles\\]\\]",
        wall.replace("0.75", "nan"): "NaN",
    }.items():
        refused(says, read_work_cell_obstacles, written(tmp_path, wrong))
