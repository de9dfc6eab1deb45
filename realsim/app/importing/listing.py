"""`realsim import --list`: what a recording, folder or data set holds."""

from collections.abc import Sequence
from pathlib import Path

from realsim.app.console import Console
from realsim.app.importing.folder import describe_folder
from realsim.app.importing.source import ImportRequest, is_archive, kind_of, require_fitting
from realsim.errors import InputError


def list_source(request: ImportRequest, console: Console) -> None:
    """Print what a recording, folder or data set holds, without importing it.

    Raises:
        InputError: what it is is not known, or it cannot be read.
    """
    rows: Sequence[Sequence[object]]
    if is_archive(request.source):
        from realsim.untrusted.archives import members

        rows = [(m.name, m.size) for m in members(request.source)]
        _show(request, "archive", ("file", "bytes"), rows, console)
        return
    kind = kind_of(request, console)
    require_fitting(request, kind)
    if kind == "bag":
        from realsim.formats.bags.recording import Recording

        with Recording(request.source) as recording:
            topics = sorted(recording.topics.values(), key=lambda t: t.name)
        rows = [(t.name, t.msgtype, t.count) for t in topics]
        _show(request, kind, ("topic", "type", "messages"), rows, console)
        return
    if kind == "folder":
        rows = describe_folder(request)
        for what, text in rows:
            console.say(f"{what}: {text}")
        console.result({"source": request.source, "kind": kind, "holds": dict(rows)})
        return
    rows_of = {"bop": _bop_rows, "graspnet": _graspnet_rows, "nerfstudio": _nerfstudio_rows}
    _show(request, kind, *rows_of.get(kind, _colmap_rows)(request.source), console)


def _show(
    request: ImportRequest,
    kind: str,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    console: Console,
) -> None:
    """Print the table, and give it to a program by the names of its columns."""
    console.table(str(request.source), header, rows)
    holds = [dict(zip(header, row, strict=True)) for row in rows]
    console.result({"source": request.source, "kind": kind, "holds": holds})


def _bop_rows(root: Path) -> tuple[Sequence[str], list[Sequence[object]]]:
    from realsim.formats.bop.scene import find_scenes, read_scene

    rows: list[Sequence[object]] = []
    for ref in find_scenes(root):
        place = f"{ref.split}/{ref.folder.name}"
        try:
            scene = read_scene(ref)
        except InputError as error:
            rows.append((ref.scene_id, place, "-", "-", "-", str(error)))
            continue
        camera = scene.session.intrinsics
        posed = len(scene.session.Ts_world_cam)
        rows.append(
            (ref.scene_id, place, len(scene.session.views), len(scene.depth_files), posed,
             f"{camera.width}x{camera.height}, fx {camera.fx:.2f}")
        )  # fmt: skip
    return ("scene", "folder", "images", "with depth", "with camera pose", "camera"), rows


def _colmap_rows(root: Path) -> tuple[Sequence[str], list[Sequence[object]]]:
    from realsim.formats.colmap.model import find_model, read_model

    model = read_model(find_model(root) or root)
    rows: list[Sequence[object]] = []
    for k, camera in sorted(model.cameras.items()):
        count = sum(i.camera_id == k for i in model.images)
        size = f"{camera.width}x{camera.height}"
        rows.append((k, count, size, f"{camera.fx:.3f}", f"{camera.fy:.3f}"))
    return ("camera", "images", "size [px]", "fx [px]", "fy [px]"), rows


def _graspnet_rows(root: Path) -> tuple[Sequence[str], list[Sequence[object]]]:
    from realsim.formats.graspnet.opening import is_graspnet_frame, open_graspnet_frame, open_scene
    from realsim.formats.graspnet.scene import open_graspnet

    rows: list[Sequence[object]] = []
    if is_graspnet_frame(root):
        frame = open_graspnet_frame(root)
        objects = len(frame.frame(frame.indices[0]).objects)
        return ("scene", "camera", "images", "objects in the first"), [
            (frame.number, frame.camera, len(frame.indices), objects)
        ]
    for ref in open_graspnet(root).scenes:
        try:
            scene = open_scene(ref)
        except InputError as error:
            rows.append((ref.number, ref.camera, "-", str(error)))
            continue
        objects = len(scene.frame(scene.indices[0]).objects)
        rows.append((ref.number, ref.camera, len(scene.indices), objects))
    return ("scene", "camera", "images", "objects in the first"), rows


def _nerfstudio_rows(root: Path) -> tuple[Sequence[str], list[Sequence[object]]]:
    from realsim.formats.nerfstudio.transforms import find_transforms, read_transforms

    path = find_transforms(root)
    if path is None:
        raise InputError(f"{root} has no transforms.json.")
    found = read_transforms(path)
    return ("file", "frames"), [(path.name, len(found.frames))]
