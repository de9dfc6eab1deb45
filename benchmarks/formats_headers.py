"""What opening a data set costs before any image is decoded: rows, headers of images, checks.

Imported by `formats.py`. A BOP scene of 1000 frames with 15 objects: scene_camera, scene_gt and
scene_gt_info, 2000 images, 30,000 masks (all of them files; masks are links to a few), models. All
frames are asked for. The rival is `json.loads` of the three documents, which every reader pays.
"""

import contextlib
import io
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from figures import Found
from formats_scene import LongScene, long_scene

from realsim.app.console import Console
from realsim.app.importing.listing import list_source
from realsim.app.importing.source import ImportRequest
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.opening import open_scene
from realsim.formats.graspnet.scene import open_graspnet
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.formats.labelled_scene import LabelledScene

BOP_FRAMES, GRASPNET_FRAMES, OBJECTS = 1000, 256, 15
REPEATS, QUICK_REPEATS = 5, 1
MASKS = (("mask", False), ("mask_visib", True))
DOCUMENTS = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")


def header_cost(seed: int, quick: bool) -> Found:
    """Return the CPU of opening scenes and of asking for all their frames."""
    repeats = QUICK_REPEATS if quick else REPEATS
    found = Found()
    with tempfile.TemporaryDirectory() as home:
        source = long_scene(Path(home) / "images", BOP_FRAMES, OBJECTS, with_info=True)
        bop = _write_bop(source, Path(home) / "bop")
        found.add("bop_headers_s", _least(lambda: _all_frames(open_labelled_bop(bop)), repeats))
        folder = next(bop.glob("*/*/scene_gt.json")).parent
        texts = [(folder / name).read_text() for name in DOCUMENTS]
        plain = _least(lambda: [json.loads(t) for t in texts], repeats)
        size = sum(len(t) for t in texts) / 1e6
        found.over["bop_headers_s"] = (
            f"{BOP_FRAMES} frames, {OBJECTS} objects, {size:.1f} MB of JSON; the least of {repeats}"
        )
        found.rivals["bop_headers_s"] = f"json.loads alone {plain:.2f}"
        console = Console(quiet=True)
        request = ImportRequest(source=bop)
        found.add("bop_list_s", _least(lambda: _list(request, console), repeats))
        source = long_scene(Path(home) / "images", GRASPNET_FRAMES, OBJECTS)
        tree = ExportFolder.begin(Path(home) / "graspnet", {})
        write_graspnet_scene(source, tree, GraspnetWriteConfig())
        found.add("graspnet_headers_s", _least(lambda: _open_graspnet(tree.folder), repeats))
        found.over["graspnet_headers_s"] = (
            f"{GRASPNET_FRAMES} frames, {OBJECTS} objects: annotations (XML) and meta files (MAT)"
        )
    return found


def _least(work: Callable[[], object], repeats: int) -> float:
    """Return the least CPU [s] of some runs; the first one imports, and is not counted."""
    times: list[float] = []
    for _ in range(repeats + 1):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times[1:])


def _list(request: ImportRequest, console: Console) -> None:
    nowhere = io.StringIO()
    with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        list_source(request, console)


def _all_frames(scene: LabelledScene) -> int:
    return sum(len(scene.frame(i).objects) for i in scene.indices)


def _open_graspnet(root: Path) -> int:
    return sum(_all_frames(open_scene(ref)) for ref in open_graspnet(root).scenes)


def _write_bop(source: LongScene, root: Path) -> Path:
    """Write the scene; its masks are links to those of the first frame."""
    export = ExportFolder.begin(root, {})
    written = write_bop_scene(source, export, BopWriteConfig(masks=False))
    write_bop_models(source.models(), export)
    write_bop_root(export, name="headers")
    export.finish({})
    from realsim import images

    for kind, visible in MASKS:
        folder = written.folder / kind
        folder.mkdir()
        for k in range(source.objects):
            first = folder / f"{0:06d}_{k:06d}.png"
            mask = source.mask(0, k, visible=visible)
            assert mask is not None
            first.write_bytes(images.png_bytes(mask))
            for index in source.indices[1:]:
                os.link(first, folder / f"{index:06d}_{k:06d}.png")
    return root
