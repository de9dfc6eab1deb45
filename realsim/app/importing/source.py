"""`realsim import`: what kind of recording a path is, by its content, and opening it as such.

A data set in a zip or tar archive: unpacked for the time of its import.
"""

import contextlib
import re
import shutil
import tempfile
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.importing.folder import ImportRequest, camera_of_file, open_image_folder
from realsim.app.importing.session import ImportSummary, import_session
from realsim.app.stages import changed_fields
from realsim.errors import InputError
from realsim.formats.folders.listing import ENDINGS, shown
from realsim.formats.frame_source import FrameSource
from realsim.store.header import SESSION_FILE
from realsim.store.opening import CAMERA_FILE, require_header

ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz")


@contextlib.contextmanager
def unpacked(source: Path, out: Path, console: Console) -> Generator[Path]:
    """Yield what is imported; of an archive, what was in it for the time being."""
    from realsim.untrusted.archives import extract

    if not is_archive(source):
        yield source
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    room = shutil.disk_usage(out.parent).free / 2
    # Beside the session: there is room for the images, a system's /tmp may be small.
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as place:
        console.say(f"{source} is an archive: unpacking it beside {out}.")
        extract(source, Path(place) / "content", most_bytes=room)
        yield content_of(Path(place) / "content")


def is_archive(path: Path) -> bool:
    """Return whether a file is a zip or tar archive, by its name."""
    return path.is_file() and path.name.lower().endswith(ARCHIVES)


def content_of(folder: Path) -> Path:
    """Return what an archive holds: its only folder, or all of it."""
    inside = [p for p in folder.iterdir() if not p.name.startswith((".", "__MACOSX"))]
    return content_of(inside[0]) if len(inside) == 1 and inside[0].is_dir() else folder


ROS1_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
MAGIC = ((ROS1_MAGIC, "a ROS1 bag"), (MCAP_MAGIC, "an MCAP file"), (SQLITE_MAGIC, "a sqlite3 bag"))
"""First bytes of recordings."""
BAG_ENDINGS = (".bag", ".mcap", ".db3")
HEAD_SHOWN = 16
"""First bytes of a file that is no bag, shown to a person."""
ACCEPTED = (
    "accepted are a ROS1 .bag, a ROS2 .mcap or .db3 or its folder, a RealSense recording, a BOP "
    "scene (scene_camera.json), a GraspNet scene (annotations/0000.xml), a COLMAP project (cameras "
    "and images), a nerfstudio folder (transforms.json), a folder of images, or one of these in a "
    "zip or tar archive."
)
KINDS = ("auto", "bag", "folder", "bop", "graspnet", "colmap", "nerfstudio", "realsense")
ONLY_FOR: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("colour_topic", "depth_topic", "joints_topic", "camera_info_topic",
         "depth_camera_info_topic", "joint_prefix", "base_frame", "ee_frame", "world_frame",
         "clock", "max_pair_gap", "only_still"),
        ("bag",),
    ),
    **dict.fromkeys(
        ("depth_coding", "poses", "reading", "key", "poses_of", "no_poses"),
        ("folder",),
    ),
    "depth_unit": ("folder", "bag", "colmap", "nerfstudio"),
    "depths": ("folder", "colmap"),
    "images": ("folder", "colmap", "nerfstudio"),
    "intrinsics": ("folder", "bag"),
    "no_depth": ("folder", "bag", "bop", "graspnet", "colmap", "nerfstudio"),
    "arm": ("folder", "bag"),
    "scene": ("bop", "graspnet"),
    "camera_name": ("bop", "graspnet"),
    "models": ("bop", "graspnet"),
    "no_labels": ("bop", "graspnet"),
    "camera_id": ("colmap", "nerfstudio"),
    "scale": ("colmap", "nerfstudio"),
}  # fmt: skip
"""Options that say something of some kinds only; with another they are refused, not ignored."""
BAG_OPTIONS = {
    **{what: f"{what}_topic"
       for what in ("colour", "depth", "joints", "camera_info", "depth_camera_info")},
    **{name: name for name in ("intrinsics", "joint_prefix", "base_frame", "ee_frame",
                               "world_frame", "clock", "only_still")},
    "depth_unit_m": "depth_unit", "without_depth": "no_depth", "joint_names": "arm",
    "max_pair_gap_s": "max_pair_gap",
}  # fmt: skip
"""What the fields of BagChoice are called in the request, and on the command line."""


def run_import(
    request: ImportRequest, out: Path, console: Console, *, overwrite: bool = False
) -> ImportSummary:
    """Import a recording, a folder or a data set into a session.

    Raises:
        InputError: it is not known what it is, or it cannot be read or joined.
    """
    from realsim.app.importing.labels import labels_of, require_models
    from realsim.formats.bags.source import BagSource

    if out.resolve() == request.source.resolve():
        raise InputError(f"{out} is the source itself: give another folder for the session.")
    with unpacked(request.source, out, console) as place:
        given = replace(request, source=place)
        source = open_source(given, console)
        labels = None if request.no_labels else labels_of(given, source)
        if labels is not None and request.models is not None:
            require_models(*labels, request.models)
        # A recording that is cut off keeps what could be read; files are mended one by one.
        whole = not isinstance(source, BagSource)
        return import_session(source, out, console, overwrite=overwrite, whole=whole, labels=labels)


def kinds_of(path: Path) -> dict[str, str]:
    """Return every kind that a path's content fits -> what speaks for it.

    Raises:
        InputError: there is no such path.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; a recording, a folder or a data set is expected.")
    if path.is_file():
        return _of_file(path)
    fits: dict[str, str] = {}
    bags = sorted(p.name for p in path.iterdir() if p.suffix.lower() in BAG_ENDINGS)
    if (path / "metadata.yaml").is_file() and bags:
        fits["bag"] = f"it has metadata.yaml and {shown(bags)}"
    elif bags:
        fits["bag"] = f"it holds {shown(bags)}"
    cameras = f"{Path(CAMERA_FILE).stem}*.json"
    for pattern in (cameras, f"*/{cameras}", f"*/*/{cameras}"):
        if any(path.glob(pattern)):
            fits["bop"] = f"it has {pattern}"
            break
    if _is_graspnet(path):
        fits["graspnet"] = "it has annotations/*.xml, or meta.mat"
    from realsim.formats.colmap.model import find_model
    from realsim.formats.nerfstudio.transforms import find_transforms

    if find_transforms(path) is not None:
        fits["nerfstudio"] = "it has transforms.json"
    model = find_model(path)
    if model is not None:
        place = model.relative_to(path).as_posix()
        where = "in it" if place == "." else f"in {place}"
        fits["colmap"] = f"cameras and images of a model are {where}"
    if not fits:
        found = _images_below(path)
        if found:
            fits["folder"] = f"it holds image files ({found})"
    return fits


def _is_graspnet(path: Path) -> bool:
    """Return whether a folder is a GraspNet data set, one of its scenes, or a scene's camera."""
    from realsim.formats.graspnet.opening import is_graspnet_frame

    return is_graspnet_frame(path) or any(
        any(path.glob(f"{above}annotations/*.xml")) and any(path.glob(f"{above}rgb"))
        for above in ("", "*/", "*/*/", "*/*/*/")
    )


def _of_file(path: Path) -> dict[str, str]:
    with path.open("rb") as file:
        head = file.read(max(len(magic) for magic, _ in MAGIC))
    found = next((what for magic, what in MAGIC if head.startswith(magic)), None)
    return {} if found is None else {"bag": f"its first bytes are those of {found}"}


def _check_bag_file(path: Path) -> None:
    """Refuse a file that does not begin as a recording does.

    Raises:
        InputError: it is empty, or no bag by its first bytes.
    """
    if _of_file(path):
        return
    with path.open("rb") as file:
        head = file.read(HEAD_SHOWN)
    if not head:
        raise InputError(f"{path} is empty; {ACCEPTED}")
    begins = ", ".join(f"{magic!r} ({what})" for magic, what in MAGIC)
    raise InputError(
        f"{path} is no bag: its first bytes are {head!r}; a bag begins with {begins}. Is the copy "
        "complete, and is it the recording itself?"
    )


def _images_below(path: Path) -> str:
    """Return an example of an image in a folder or one level below, "" where there is none."""
    for pattern in ("*", "*/*"):
        for p in sorted(path.glob(pattern)):
            if p.suffix.lower() in ENDINGS and p.is_file():
                return p.relative_to(path).as_posix()
    return ""


def kind_of(request: ImportRequest, console: Console) -> str:
    """Return the kind that was said, or the only one that fits; says why.

    Raises:
        InputError: none fits, or several do.
    """
    path = request.source
    if request.kind not in KINDS:
        raise InputError(f"the kind '{request.kind}' is not known; {', '.join(KINDS)} are.")
    if request.kind != "auto":
        if not path.exists():
            raise InputError(f"{path} does not exist.")
        if request.kind in ("bag", "realsense") and path.is_file():
            _check_bag_file(path)
        return "bag" if request.kind == "realsense" else request.kind
    require_header(path)
    fits = kinds_of(path)
    if path.is_dir() and (path / SESSION_FILE).is_file():
        raise InputError(
            f"{path} is a session already ({SESSION_FILE}): use it as it is. To import its images "
            "and cameras as a BOP scene, say --kind bop."
        )
    if not fits:
        if path.is_dir() and not any(path.iterdir()):
            raise InputError(f"{path} is empty; {ACCEPTED}")
        if path.is_file() and (path.suffix.lower() in BAG_ENDINGS or not path.stat().st_size):
            _check_bag_file(path)
        what = "a file" if path.is_file() else "a folder"
        raise InputError(f"{path} is {what} of no known kind; {ACCEPTED}")
    if len(fits) > 1:
        listed = "; ".join(f"{kind}: {why}" for kind, why in fits.items())
        raise InputError(f"{path} may be several things ({listed}). Say which: --kind KIND.")
    ((kind, why),) = fits.items()
    console.say(f"{path} is read as {kind}: {why}.")
    return kind


def require_fitting(request: ImportRequest, kind: str) -> None:
    """Raise if an option was given that says nothing of this kind."""
    given = changed_fields(request, ImportRequest(source=request.source))
    wrong = [name for name in given if kind not in ONLY_FOR.get(name, (kind,))]
    if wrong:
        options = ", ".join(
            f"--{name.replace('_', '-')} (for {' and '.join(ONLY_FOR[name])})" for name in wrong
        )
        raise InputError(
            f"{request.source} is read as {kind}, where these options say nothing: {options}. "
            "Leave them out, or give the right --kind."
        )


def open_source(request: ImportRequest, console: Console) -> FrameSource:
    """Return the source of a request, opened and checked.

    Raises:
        InputError: what it is is not known, or it cannot be read or joined.
    """
    kind = kind_of(request, console)
    require_fitting(request, kind)
    openers: dict[str, Callable[[ImportRequest, Console], FrameSource]] = {
        "bag": _open_bag, "folder": _open_folder, "bop": _open_bop, "colmap": _open_colmap,
        "graspnet": _open_graspnet, "nerfstudio": _open_nerfstudio,
    }  # fmt: skip
    return openers[kind](request, console)


def _open_folder(request: ImportRequest, console: Console) -> FrameSource:
    source, notes = open_image_folder(request)
    console.say(*notes)
    return source


def _open_bop(request: ImportRequest, console: Console) -> FrameSource:
    from realsim.formats.bop.source import open_bop

    return open_bop(
        request.source, scene=request.scene, camera=request.camera_name,
        use_depth=not request.no_depth,
    )  # fmt: skip


def _open_graspnet(request: ImportRequest, _: Console) -> FrameSource:
    from realsim.formats.graspnet.opening import is_graspnet_frame, open_graspnet_frame, open_scene
    from realsim.formats.graspnet.scene import open_graspnet
    from realsim.formats.labelled_scene import LabelledFrames

    if is_graspnet_frame(request.source):
        frame = open_graspnet_frame(request.source, models=request.models)
        return LabelledFrames(frame, "graspnet", use_depth=not request.no_depth)
    tree = open_graspnet(
        request.source,
        scenes=None if request.scene is None else (request.scene,),
        cameras=(request.camera_name,) if request.camera_name else None,
        models=request.models,
    )
    if len(tree.scenes) > 1:
        listed = shown([r.name for r in tree.scenes], 12)
        raise InputError(
            f"{request.source} has {len(tree.scenes)} scenes: {listed}, and a session holds one by "
            "one camera. Choose with --scene N and --camera-name kinect or realsense."
        )
    return LabelledFrames(
        open_scene(next(iter(tree.scenes))), "graspnet", use_depth=not request.no_depth
    )


def _open_nerfstudio(request: ImportRequest, _: Console) -> FrameSource:
    from realsim.formats.nerfstudio.source import open_nerfstudio

    return open_nerfstudio(request.source, **_project(request))


def _open_colmap(request: ImportRequest, console: Console) -> FrameSource:
    from realsim.formats.colmap.source import open_colmap

    return open_colmap(request.source, depth_folder=request.depths or None, **_project(request))


def _project(request: ImportRequest) -> dict[str, Any]:
    """Return what is asked of a COLMAP or nerfstudio project."""
    return {
        "images_folder": request.images or None, "camera_id": request.camera_id,
        "metres_per_unit": request.scale, "depth_unit_m": request.depth_unit,
        "use_depth": not request.no_depth,
    }  # fmt: skip


def _open_bag(request: ImportRequest, console: Console) -> FrameSource:
    from realsim.formats.bags import BagChoice, open_bag

    camera = None if request.intrinsics is None else camera_of_file(request.intrinsics, None)
    given = {field: getattr(request, option) for field, option in BAG_OPTIONS.items()}
    given |= {"intrinsics": camera}
    del given["joint_names"]
    if request.arm is not None:
        from realsim.robots.arm import find_arm

        given["joint_names"] = find_arm(request.arm).joint_names
    choice = BagChoice(**given)
    try:
        return open_bag(request.source, choice)
    except InputError as error:
        raise type(error)(option_names(str(error))) from error


def option_names(message: str) -> str:
    """Return a message in which the fields of BagChoice are called as on the command line."""
    names = "|".join(sorted(BAG_OPTIONS, key=len, reverse=True))
    message = re.sub(r"\bwithout_depth\b(?!=)", "--no-depth", message)
    said = re.sub(
        rf"(?<![\w-])({names})=(True\b)?",
        lambda m: f"--{BAG_OPTIONS[m[1]].replace('_', '-')} ", message,
    )  # fmt: skip
    return re.sub(r" +([),.;]| )", r"\1", said)


def request_of(source: Path, **options: Any) -> ImportRequest:
    """Return the request of command-line options; those that were not given keep their default."""
    request = ImportRequest(source=source)
    return replace(request, **{k: v for k, v in options.items() if v is not None})
