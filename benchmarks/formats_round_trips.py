"""What is left of numbers that go through a format and back.

Imported by `formats.py`. The conversions are those of the command line: `realsim import` makes a
session, `realsim export` writes the data set again. Pixels and texts are compared one by one.
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from figures import Found

from realsim.arrays import Array

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

from grasp_files import Acronym, GraspGen, IsaacGrasp
from labelled_scenes import labelled_scene
from realsim import images
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.annotations import object_fields, pose_of, read_objects
from realsim.formats.graspnet.grasp_group import grasp_group, read_grasp_group, write_grasp_group
from realsim.formats.graspnet.image_objects import read_meta
from realsim.formats.grasps.scene_grasps import executed, labelled
from realsim.geometry import se3
from realsim.records import GraspSet
from tried_grasps import tried_set

FRAMES, QUICK_FRAMES = 60, 8
POSES = 20_000
GRASPS = 2_000
BOUND_MM = 1e-4
"""Nine decimals of a metre, and the single precision of meta files."""
CAMERA_FILES = ("camera_poses.npy", "cam0_wrt_table.npy", "camK.npy")
SINGLE = 2e-7
"""What the single precision of the meta files, which are read, may change [m, entries]."""
SAME = 1e-12
"""[m, px] Matrices of double precision that were inverted and inverted back differ by less."""


def round_trips(seed: int, quick: bool) -> Found:
    """Return how many numbers differ, and how far poses are moved."""
    found = Found()
    frames = QUICK_FRAMES if quick else FRAMES
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        bop = _first_bop(home, frames)
        _bop(found, bop, home, frames)
        _graspnet(found, bop, home, frames)
        _poses(found, bop, home, seed)
        _grasps(found, home, seed)
    return found


def _run(*arguments: object) -> None:
    from click.testing import CliRunner

    from realsim.app.cli import commands

    given = [*(str(a) for a in arguments), "--quiet"]
    result = CliRunner().invoke(commands, given, catch_exceptions=False)
    if result.exit_code:
        raise RuntimeError(result.output)


def _first_bop(home: Path, frames: int) -> Path:
    scene = labelled_scene(home / "images", list(range(3, 3 + 2 * frames, 2)))
    export = ExportFolder.begin(home / "bop", {})
    write_bop_scene(scene, export)
    write_bop_models(scene.models(), export)
    write_bop_root(export, name="three boxes")
    export.finish({})
    return home / "bop"


# --- data sets ----------------------------------------------------------------------------------


def _bop(found: Found, bop: Path, home: Path, frames: int) -> None:
    _run("import", bop, home / "session")
    _run("export", home / "session", "--to", "bop", "--out", home / "bop2")
    a, b = (next(r.glob("*/*/scene_gt.json")).parent for r in (bop, home / "bop2"))
    numbers, differing = 0, 0
    for name in ("scene_camera.json", "scene_gt.json", "scene_gt_info.json"):
        texts = ((folder / name).read_text() for folder in (a, b))
        first, second = (
            list(_leaves(json.loads(t, parse_float=str, parse_int=str))) for t in texts
        )
        numbers += len(first)
        differing += _differing(first, second)
    pixels, wrong = _pixels(a, b, ("rgb", "depth", "mask", "mask_visib"))
    found.add(
        "bop_round_trip_diff", differing + wrong,
        f"{numbers} numbers as texts and {pixels} images of {frames} frames",
    )  # fmt: skip


def _graspnet(found: Found, bop: Path, home: Path, frames: int) -> None:
    table = "--table-is-world"
    _run("export", bop, "--to", "graspnet", "--out", home / "graspnet", table)
    _run("import", home / "graspnet", home / "session2")
    _run("export", home / "session2", "--to", "graspnet", "--out", home / "graspnet2")
    a, b = (next(r.glob("scenes/*/*/camK.npy")).parent for r in (home / "graspnet",
                                                                 home / "graspnet2"))  # fmt: skip
    numbers, differing, meta_numbers, meta_differing, off = 0, 0, 0, 0, 0.0
    for file in sorted((a / "annotations").iterdir()):
        pairs = [read_objects(f) for f in (file, b / "annotations" / file.name)]
        first, second = (np.array([o.T_cam_obj for o in objects]) for objects in pairs)
        numbers += first.size
        differing += int(np.count_nonzero(np.abs(first - second) > SINGLE))
    for file in sorted((a / "meta").iterdir()):
        metas = [read_meta(f) for f in (file, b / "meta" / file.name)]
        first, second = (np.concatenate([m.poses.ravel(), m.K.ravel()]) for m in metas)
        meta_numbers += first.size
        meta_differing += int(np.count_nonzero(first != second))
        off = max(off, float(np.abs(first - second).max()))
    for name in CAMERA_FILES:
        first, second = np.load(a / name), np.load(b / name)
        numbers += first.size
        differing += int(np.count_nonzero(np.abs(first - second) > SAME))
    pixels, wrong = _pixels(a, b, ("rgb", "depth", "label"))
    found.add(
        "graspnet_round_trip_diff", differing + wrong,
        f"{numbers} numbers (annotations to {SINGLE:g}, camera files to {SAME:g}) and "
        f"{pixels} images of {frames} frames",
    )  # fmt: skip
    found.add(
        "graspnet_meta_diff", meta_differing,
        f"of {meta_numbers} numbers of single precision in the meta files; the worst is {off:.2g} "
        "off: rotations are made orthonormal when they are read",
    )  # fmt: skip


def _leaves(value: Any, place: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key in sorted(value):
            yield from _leaves(value[key], f"{place}/{key}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _leaves(item, f"{place}/{k}")
    else:
        yield f"{place}={value}"


def _differing(first: Sequence[str], second: Sequence[str]) -> int:
    same = sum(x == y for x, y in zip(first, second, strict=False))
    return max(len(first), len(second)) - same


def _pixels(a: Path, b: Path, kinds: Sequence[str]) -> tuple[int, int]:
    """Return how many images were compared, and in how many anything differs."""
    count, wrong = 0, 0
    for kind in kinds:
        files = sorted((a / kind).iterdir())
        for file in files:
            pair = [images.read_image(f) for f in (file, b / kind / file.name)]
            count += 1
            wrong += not np.array_equal(*pair)
        wrong += abs(len(files) - len(list((b / kind).iterdir())))
    return count, wrong


# --- poses --------------------------------------------------------------------------------------


def _poses(found: Found, bop: Path, home: Path, seed: int) -> None:
    """Note what BOP -> GraspNet -> BOP loses: with the meta files, and by the annotations alone."""
    worst: dict[str, tuple[float, float]] = {}
    for name in ("meta", "annotations"):
        if name == "annotations":
            for folder in (home / "graspnet").glob("scenes/*/*/meta"):
                shutil.rmtree(folder)
        out = home / f"from_{name}"
        _run("export", home / "graspnet", "--to", "bop", "--out", out)
        before, after = open_labelled_bop(bop), open_labelled_bop(out)
        pairs = [
            (a.T_cam_obj, b.T_cam_obj)
            for i, j in zip(before.indices, after.indices, strict=True)
            for a, b in zip(before.frame(i).objects, after.frame(j).objects, strict=True)
        ]
        first, second = (np.stack(Ts) for Ts in zip(*pairs, strict=True))
        worst[name] = _worst(first, second)
    rng = np.random.default_rng(seed)
    Ts = se3.random_transform(rng, POSES, 1.5)
    random = _worst(Ts, np.stack([pose_of(object_fields(0, T)) for T in Ts]))
    mm, deg = (max(a, b) for a, b in zip(worst["annotations"], random, strict=True))
    words = f"the worst; random {POSES} poses {{:.4g}}, a scene {{:.4g}}, with meta files {{:.2g}}"
    parts = list(zip(random, worst["annotations"], worst["meta"], strict=True))
    found.add("bop_graspnet_mm", mm, words.format(*parts[0]))
    found.add("bop_graspnet_deg", deg, words.format(*parts[1]))


def _worst(first: Array, second: Array) -> tuple[float, float]:
    """Return the largest distance [mm] and angle [deg] of two stacks of poses."""
    mm = 1e3 * np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1)
    # |R - S|_F = 2 sqrt(2) sin(angle / 2): exact for small angles, where arccos is not
    apart = np.linalg.norm(first[:, :3, :3] - second[:, :3, :3], axis=(1, 2))
    angle = 2 * np.arcsin(np.clip(apart / np.sqrt(8), 0, 1))
    return float(mm.max()), float(np.degrees(angle.max()))


def _there(way: Any, home: Path, grasps: GraspSet) -> Array:
    """Return grasps that were written, as another program reads them."""
    return way.read(way.write(home / "grasps", grasps))


def _grasps(found: Found, home: Path, seed: int) -> None:
    """Note the worst grasp of each format, written and read."""
    grasps = tried_set(np.random.default_rng(seed), GRASPS)
    kept = grasps.Ts_obj_grasp[executed(grasps)]
    T = np.eye(4)
    scored = grasps.Ts_obj_grasp[~np.isnan(grasps.labels)]
    ways: dict[str, tuple[Array, Callable[[GraspSet], Array]]] = {
        "acronym": (kept, lambda s: _there(Acronym(), home, s)),
        "graspgen": (kept, lambda s: _there(GraspGen(), home, s)),
        "isaac": (grasps.Ts_obj_grasp[labelled(grasps)], lambda s: _there(IsaacGrasp(), home, s)),
        "graspgroup": (scored, lambda s: read_grasp_group(
            write_grasp_group(home / "g.npy", grasp_group([s], {s.instance: T}))).Ts_a_grasp),
    }  # fmt: skip
    for name, (expected, way) in ways.items():
        mm, deg = _worst(expected, way(grasps))
        found.add(f"{name}_mm", mm)
        found.add(f"{name}_deg", deg)
    found.over["grasp formats"] = (
        f"the worst of {len(kept)} grasps that were tried; a GraspGroup has single precision"
    )
