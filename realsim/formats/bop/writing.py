"""Any labelled scene as a BOP scene, frame by frame.

    SPLIT/000001/{rgb|gray, depth, mask, mask_visib}/000012.png, 000012_000003.png
    SPLIT/000001/scene_camera.json, scene_gt.json, scene_gt_info.json, scene_gt_coco.json

A frame is a piece of the `ExportFolder`: its images are on the disk and its rows are noted; the
documents are put together when all frames are there. An export that was interrupted goes on with
the next frame and ends with the same bytes.

Colour and depth images of any source as BOP holds them: copied where they already fit.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim import images
from realsim.arrays import Mask
from realsim.errors import InputError
from realsim.formats.bop import coco
from realsim.formats.bop.labels import image_entry
from realsim.formats.bop.layout import ONBOARDING, SceneLayout, scene_number
from realsim.formats.bop.row_writing import camera_row, info_rows, object_row
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.folders.listing import image_header
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene, WrittenScene
from realsim.untrusted.values import number

ColourFormat = Literal["copy", "png", "jpeg"]
ENDINGS = {"PNG": ".png", "JPEG": ".jpg", "TIFF": ".tif"}
"""Endings that BOP's data sets have, by Pillow's names of formats."""
GREY_MODES = ("1", "L", "LA", "I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of one channel."""
TAIL_BYTES = 32


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageContent:
    """An image as it is to be written."""

    content: Content
    """Bytes, or the file to copy."""
    ending: str
    grey: bool
    """Whether it has one channel and belongs in gray/."""
    changed: bool
    """Whether its pixels are not those of the source: JPEG loses some."""


def colour_content(path: Path, wanted: ColourFormat, jpeg_quality: int) -> ImageContent:
    """Return a colour (or grey) image in the wanted format; copied byte for byte if it has it.

    Raises:
        InputError: it is missing, truncated or not an image.
    """
    form, grey = _form(path)
    keeps = {"copy": tuple(ENDINGS), "png": ("PNG",), "jpeg": ("JPEG",)}[wanted]
    if form in keeps:
        return ImageContent(content=path, ending=ENDINGS[form], grey=grey, changed=False)
    pixels = images.read_grey(path) if grey else images.read_rgb(path)
    if wanted == "jpeg":
        import cv2

        bgr = pixels if grey else pixels[..., ::-1]
        is_done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
        if not is_done:
            raise InputError(f"{path} cannot be written as JPEG.")
        return ImageContent(
            content=np.asarray(data).tobytes(), ending=".jpg", grey=grey, changed=True
        )
    return ImageContent(content=images.png_bytes(pixels), ending=".png", grey=grey, changed=False)


def depth_content(path: Path) -> ImageContent:
    """Return a 16-bit depth image, to be copied byte for byte.

    Raises:
        InputError: it is missing, truncated, or not one channel of 16 bit.
    """
    form, grey = _form(path)
    if not (grey and image_header(path).deep):
        raise InputError(f"{path} is no depth image: one channel of 16 bit is expected.")
    if form in ("PNG", "TIFF"):
        return ImageContent(content=path, ending=ENDINGS[form], grey=True, changed=False)
    return ImageContent(
        content=images.png_bytes(images.read_image(path)), ending=".png", grey=True, changed=False
    )


def _form(path: Path) -> tuple[str, bool]:
    """Return the format by content, and whether the image is grey; a truncated one is refused."""
    from PIL import Image

    image_header(path)
    with Image.open(path) as image:
        form, grey = str(image.format), image.mode in GREY_MODES
    if form == "PNG":
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - TAIL_BYTES, 0))
            if images.PNG_END not in file.read():
                raise InputError(
                    f"{path} is truncated. Copy it again from where it came, or delete it."
                )
    return form, grey


Json = dict[str, Any]
Masks = list[tuple[Mask | None, Mask | None]]
SCENES = "bop/scenes"
"""Rows of the export, one per scene that is whole: for the files of the root."""
VISIBLE_ENOUGH = 0.1
"""Visible fraction from which BOP asks for an object (test_targets_bop19.json)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BopWriteConfig:
    """How a scene is written."""

    colour: ColourFormat = "copy"
    """'copy' keeps the files' bytes where they are PNG, JPEG or TIFF: nothing is lost and nothing
    is computed. 'jpeg' is a fifth of the size."""
    jpeg_quality: int = 95
    """[percent] of 'jpeg': mean error 1 of 255."""
    masks: bool = True
    """Whether mask/, mask_visib/ and scene_gt_coco.json are written: half of the files."""
    camera: str | None = None
    """Type of the camera, added to the names of files; '' = none, None = the scene's own."""
    split: str | None = None
    """None = the scene's own."""
    number: int | None = None
    """Number of the scene; None = the scene's own."""

    def __post_init__(self) -> None:
        """Check what cannot be."""
        if not 1 <= self.jpeg_quality <= 100:
            raise InputError(f"the JPEG quality is {self.jpeg_quality}; 1 to 100 is accepted.")
        if self.number is not None and not 0 <= self.number <= 999_999:
            raise InputError(f"the scene number is {self.number}; 0 to 999999 is accepted.")
        for name in ("camera", "split"):
            value = getattr(self, name)
            if value and not all(c.isalnum() or c in "_-" for c in value):
                raise InputError(f"{name} is '{value}'; letters, digits, _ and - are accepted.")


def write_bop_scene(
    scene: LabelledScene,
    folder: ExportFolder,
    config: BopWriteConfig | None = None,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write a scene, or what is missing of it.

    scene_gt_info.json repeats the source's entries; where there are none they are counted in the
    masks, inside the image.

    Args:
        scene: any labelled scene.
        folder: the export; `finish` is called by whoever began it.
        config: how it is written.
        progress: called once per frame, also of frames that were there.

    Raises:
        InputError: an image is broken, or masks contradict each other.
        StorageError: the disk is full.
    """
    config = config or BopWriteConfig()
    layout = layout_of(scene, config)
    written = 0
    for index in scene.indices:
        piece = f"{layout.folder.as_posix()}{layout.suffix}/{index:06d}"
        if not folder.has(piece):
            _write_frame(scene, index, folder, piece, layout, config)
            written += 1
        if progress is not None:
            progress()
    found = _summary(folder, layout)
    _write_documents(scene, folder, layout, config, found)
    return WrittenScene(
        name=scene.name,
        folder=folder.folder / layout.folder,
        frames=len(scene.indices),
        frames_written=written,
        objects=found.objects,
        notes=_notes(found, config),
        counts={"masks": found.masks},
    )


def layout_of(scene: LabelledScene, config: BopWriteConfig) -> SceneLayout:
    """Return where the scene is written, relative to the export."""
    split = scene.split if config.split is None else config.split
    camera = scene.camera if config.camera is None else config.camera
    name = f"{scene.number if config.number is None else config.number:06d}"
    if config.number is None and split.startswith("onboarding"):
        # The side that is up is in no other place than the folder's name.
        own = scene.name.removeprefix(f"{scene.split}-").removesuffix(f"-{scene.camera}")
        if ONBOARDING.fullmatch(own) and scene_number(own) == scene.number:
            name = own
    return SceneLayout(folder=Path(split or "train") / name, camera=camera)


@dataclass(kw_only=True, slots=True)
class _Summary:
    """What all frames of a scene are, summed up: also of those that an earlier run wrote."""

    frames: int = 0
    objects: int = 0
    masks: int = 0
    ids: set[int] = field(default_factory=set[int])
    camera: Json | None = None
    """Camera of the first frame."""
    told: Counter[str] = field(default_factory=Counter[str])
    """Frames by what is to be told of them."""


def _summary(folder: ExportFolder, layout: SceneLayout) -> _Summary:
    found = _Summary()
    for _, fact in folder.rows(_facts(layout)):
        found.frames += 1
        found.objects += len(fact["objects"])
        found.masks += fact["masks"]
        found.ids |= set(fact["objects"])
        found.camera = found.camera or fact["camera"]
        found.told.update(fact["told"])
    return found


def _facts(layout: SceneLayout) -> str:
    return f"bop/{layout.folder.as_posix()}{layout.suffix}"


def _write_frame(
    scene: LabelledScene,
    index: int,
    folder: ExportFolder,
    piece: str,
    layout: SceneLayout,
    config: BopWriteConfig,
) -> None:
    frame = scene.frame(index)
    files: dict[str, Content] = {}
    colour = colour_content(scene.colour_file(index), config.colour, config.jpeg_quality)
    colour_file = layout.images("gray" if colour.grey else "rgb") / f"{index:06d}{colour.ending}"
    files[colour_file.as_posix()] = colour.content
    depth_file = scene.depth_file(index)
    if depth_file is not None:
        depth = depth_content(depth_file)
        path = layout.images("depth") / f"{index:06d}{depth.ending}"
        files[path.as_posix()] = depth.content
    needed = config.masks or any(o.gt_info is None for o in frame.objects)
    masks: Masks = [
        (scene.mask(index, k, visible=False), scene.mask(index, k, visible=True))
        if needed
        else (None, None)
        for k in range(len(frame.objects))
    ]
    if config.masks:
        for k, pair in enumerate(masks):
            for visible, mask in enumerate(pair):
                if mask is not None:
                    path = layout.mask_file(index, k, visible=bool(visible))
                    files[path.as_posix()] = images.png_bytes(mask)
    depth_m = None
    if depth_file is not None and frame.depth_unit_m and _counts_depth(frame, masks):
        depth_m = images.read_depth(depth_file, frame.depth_unit_m)
    infos = info_rows(frame.objects, masks, depth_m)
    key = str(index)
    rows: dict[str, tuple[str, Any]] = {
        layout.document("scene_camera").as_posix(): (key, camera_row(frame)),
        layout.document("scene_gt").as_posix(): (key, [object_row(o) for o in frame.objects]),
        _facts(layout): (key, _fact(frame, masks, infos, config, changed=colour.changed)),
    }
    if infos is not None:
        rows[layout.document("scene_gt_info").as_posix()] = (key, infos)
    if config.masks:
        name = colour_file.relative_to(layout.folder).as_posix()
        rows[layout.document("scene_gt_coco").as_posix()] = (
            key,
            _coco_row(frame, masks, infos, name),
        )
    folder.write_piece(piece, files, rows)


def _counts_depth(frame: LabelledFrame, masks: Masks) -> bool:
    """Return whether pixels with depth are to be counted."""
    return any(
        o.gt_info is None and whole is not None and visible is not None
        for o, (whole, visible) in zip(frame.objects, masks, strict=True)
    )


def _fraction(info: Json | None) -> float | None:
    if info is None or "visib_fract" not in info:
        return None
    return number(info["visib_fract"], "visib_fract")


def _coco_row(frame: LabelledFrame, masks: Masks, infos: list[Json] | None, name: str) -> Json:
    annotations = [
        coco.annotation_entry(
            frame.index,
            o.obj_id,
            masks[k],
            o.visible_fraction if infos is None else _fraction(infos[k]),
        )
        for k, o in enumerate(frame.objects)
    ]
    return {
        "image": image_entry(frame.index, name, frame.intrinsics),
        "annotations": [a for a in annotations if a is not None],
    }


def _fact(
    frame: LabelledFrame,
    masks: Masks,
    infos: list[Json] | None,
    config: BopWriteConfig,
    *,
    changed: bool,
) -> Json:
    """Return what the files of the root, and the notes, need to know of a frame."""
    asked: dict[str, int] = {}
    for k, o in enumerate(frame.objects):
        seen = o.visible_fraction if infos is None else _fraction(infos[k])
        if seen is None or seen >= VISIBLE_ENOUGH:
            asked[str(o.obj_id)] = asked.get(str(o.obj_id), 0) + 1
    camera = frame.intrinsics
    told = {
        "no info": infos is None,
        "counted": infos is not None and any(o.gt_info is None for o in frame.objects),
        "no visible masks": any(visible is None for _, visible in masks),
        "changed": changed,
        "no pose": frame.T_world_cam is None,
        "no depth": frame.depth_unit_m is None,
    }
    return {
        "objects": [o.obj_id for o in frame.objects],
        "asked": asked,
        "masks": sum(m is not None for pair in masks for m in pair) if config.masks else 0,
        "told": [word for word, holds in told.items() if holds],
        "camera": {
            "cx": camera.cx, "cy": camera.cy, "fx": camera.fx, "fy": camera.fy,
            "height": camera.height, "width": camera.width,
            "depth_scale": camera_row(frame)["depth_scale"],
        },
    }  # fmt: skip


def _write_documents(
    scene: LabelledScene,
    folder: ExportFolder,
    layout: SceneLayout,
    config: BopWriteConfig,
    found: _Summary,
) -> None:
    folder.write_json_object(layout.document("scene_camera").as_posix())
    folder.write_json_object(layout.document("scene_gt").as_posix())
    if not found.told["no info"]:
        folder.write_json_object(layout.document("scene_gt_info").as_posix())
    if config.masks and not found.told["no visible masks"]:
        document = layout.document("scene_gt_coco").as_posix()
        models = scene.models() if found.ids and not folder.has(f"document {document}") else {}
        names = {i: models[i].name if i in models else str(i) for i in found.ids}
        folder.write_document(
            document, coco.document_parts(scene.name, names, lambda: folder.rows(document))
        )
    key = f"{layout.folder.as_posix()}{layout.suffix}"
    row = {
        "split": layout.folder.parent.as_posix(),
        "folder": layout.folder.name,
        "camera_type": layout.camera,
        "facts": _facts(layout),
        "camera": found.camera,
    }
    folder.write_piece(f"scene {key}", {}, {SCENES: (key, row)})


def _notes(found: _Summary, config: BopWriteConfig) -> tuple[str, ...]:
    texts = {
        "no info": "have no masks to count visibility in: no scene_gt_info.json was written.",
        "counted": "had no scene_gt_info: it was counted in the masks, inside the image.",
        "no visible masks": "lack visible masks: no scene_gt_coco.json was written.",
        "changed": f"were written as JPEG of quality {config.jpeg_quality}: pixels changed.",
        "no pose": "have no camera pose (cam_R_w2c, cam_t_w2c).",
        "no depth": "have no depth; their depth_scale means nothing.",
    }
    if not config.masks:
        del texts["no visible masks"]
    return tuple(
        f"{found.told[word]} of {found.frames} frames {text}"
        for word, text in texts.items()
        if found.told[word]
    )
