"""Which files of a folder are colour images and which are depth, by their headers and names."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from realsim.errors import InputError
from realsim.images import MOST_PIXELS

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""Endings of image files."""
COLOUR_FOLDERS = ("rgb", "color", "colour", "colors", "images", "image", "img", "imgs", "gray")
"""Names of subfolders that hold the colour images."""
DEPTH_FOLDERS = ("depth", "depths", "depth_aligned", "aligned_depth", "depth_to_color")
"""Names of subfolders that hold the depth images."""
OTHER_KINDS = frozenset(
    "mask masks label labels seg segm segmentation normal normals ir infra infrared left right "
    "confidence heatmap overlay vis preview thumb thumbnail colormap disparity".split()
)
"""Words in a file's name by which it is neither the colour nor the depth of a frame."""
DEEP_MODES = ("I;16", "I;16B", "I;16L", "I", "F")
"""PIL's modes of more than 8 bits a channel."""
EXIF_ORIENTATION = 0x0112
PNG_DEPTH_AT = 24
"""Byte of a PNG file that says how many bits a channel has."""
JPEG_END = b"\xff\xd9"
JPEG_TAIL_BYTES = 4096
"""A JPEG's end mark stands within its last so many bytes, or the file was cut off."""
MAX_IMAGES = 50_000
"""Images in one folder; more are a whole data set of many scenes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageFile:
    """An image file and what its header says."""

    path: Path
    width: int
    """[px]."""
    height: int
    """[px]."""
    deep: bool
    """Whether it has more than 8 bits a channel: depth."""

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) [px]."""
        return self.width, self.height


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageFolder:
    """The image files of a folder, not joined yet."""

    root: Path
    colour: tuple[ImageFile, ...]
    depth: tuple[ImageFile, ...]
    ignored: tuple[str, ...]
    """Sentences about what was left aside."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters: "frame-01.Color" has frame, 01 and color."""
    return [w for w in re.split(r"[^a-z0-9]+", name.lower()) if w]


def image_header(path: Path) -> ImageFile:
    """Return what the header of an image file says.

    Raises:
        InputError: it is not an image, was cut off, or is marked to be shown turned.
    """
    from PIL import Image

    if not path.is_file():  # opening a pipe would wait for ever
        raise InputError(f"{path} is not a regular file; an image is expected there.")
    size = path.stat().st_size
    try:
        with Image.open(path) as image:
            deep = image.mode in DEEP_MODES
            if image.format == "PNG" and not deep:  # PIL calls 48-bit colour "RGB"
                with path.open("rb") as file:
                    deep = file.read(PNG_DEPTH_AT + 1)[PNG_DEPTH_AT] == 16
            # Pillow decodes a whole PNG to look for marks behind its pixels; none are there.
            marked = image.format != "PNG" or any("exif" in str(key) for key in image.info)
            turned = image.getexif().get(EXIF_ORIENTATION, 1) if marked else 1
            width, height = image.size
            is_jpeg = image.format == "JPEG"
    except Exception as error:  # decoders raise nearly anything on damaged files
        raise InputError(
            f"{path} is not an image that can be read ({size} bytes; {error}). Copy it again from "
            "where it came, or delete it: its frame is then left out."
        ) from error
    if width * height > MOST_PIXELS:
        raise InputError(f"{path} claims {width}x{height} pixels; at most {MOST_PIXELS} are read.")
    if turned not in (0, 1):
        raise InputError(
            f"{path} is marked to be shown turned (EXIF orientation {turned}): tools differ in "
            "whether they obey. Store it upright without the mark, all images alike."
        )
    if is_jpeg and not _jpeg_ends(path, size):
        raise InputError(
            f"{path} is truncated: the JPEG's end mark is missing ({size} bytes), and decoders "
            "fill the rest in grey without a word. Copy it again, or delete it."
        )
    return ImageFile(path=path, width=width, height=height, deep=deep)


def _jpeg_ends(path: Path, size: int) -> bool:
    with path.open("rb") as file:
        file.seek(max(size - JPEG_TAIL_BYTES, 0))
        return JPEG_END in file.read()


def list_folder(root: Path | str, *, colour: str = "", depth: str = "") -> ImageFolder:
    """Return the colour and the depth images of a folder.

    They lie together in it (8 bit and 16 bit), or in subfolders such as rgb/ and depth/.

    Args:
        root: the folder.
        colour: subfolder of the colour images; "" = found by name.
        depth: subfolder of the depth images; "" = found by name.

    Raises:
        InputError: no folder, no colour images, several folders of them, or a damaged file.
    """
    root = Path(root)
    if not root.is_dir():
        what = "is a file" if root.is_file() else "does not exist"
        raise InputError(f"{root} {what}; a folder of images is expected.")
    own = _image_paths(root)
    colour_folder = _named(root, colour) if colour else None
    if colour_folder is None and not own:
        colour_folder = _only(root, COLOUR_FOLDERS, "colour", "--images")
    depth_folder = _named(root, depth) if depth else _only(root, DEPTH_FOLDERS, "depth", "--depths")
    paths = _image_paths(colour_folder) if colour_folder else own
    if not paths:
        raise InputError(_nothing(colour_folder or root))
    ignored: list[str] = []
    headers = _headers(paths, root, ignored)
    found_colour = [h for h in headers if not h.deep and not _says_depth(h.path.stem)]
    shallow = [h for h in headers if not h.deep and _says_depth(h.path.stem)]
    found_depth = [h for h in headers if h.deep]
    if depth_folder is not None and depth_folder != colour_folder:
        if found_depth and not depth:
            raise InputError(
                f"{root} holds {len(found_depth)} images of 16 bit beside the colour "
                f"({found_depth[0].path.name}) and others in {depth_folder.name}/. Say which are "
                f"the depth: --depths {depth_folder.name}, or --depths . for those beside."
            )
        below = _headers(_image_paths(depth_folder), root, ignored)
        found_depth, shallow = [h for h in below if h.deep], [h for h in below if not h.deep]
    if shallow:
        raise InputError(
            f"{_where(shallow[0].path, root)} has 8 bits a channel: a picture of the depth, not "
            f"the depth ({len(shallow)} such files). 16-bit images are needed; give their folder "
            "with --depths, or leave depth out with --no-depth."
        )
    if not found_colour:
        raise InputError(
            f"{colour_folder or root} holds {len(found_depth)} images of 16 bit and no colour "
            "image of 8 bit. Give the folder of the colour images with --images."
        )
    return ImageFolder(
        root=root, colour=tuple(found_colour), depth=tuple(found_depth), ignored=tuple(ignored)
    )


def _headers(paths: Sequence[Path], root: Path, ignored: list[str]) -> list[ImageFile]:
    """Return the headers of all that may be colour or depth; say what else there is."""
    other = [p for p in paths if OTHER_KINDS & set(words_of(p.stem))]
    if other:
        ignored.append(
            f"{len(other)} images are neither colour nor depth by their names and were left "
            f"aside: {shown([_where(p, root) for p in other])}."
        )
    left = set(other)
    return [image_header(p) for p in paths if p not in left]


def _image_paths(folder: Path) -> list[Path]:
    files = sorted(
        p
        for p in folder.iterdir()
        if p.suffix.lower() in ENDINGS and p.is_file() and not p.name.startswith(".")
    )
    if len(files) > MAX_IMAGES:
        raise InputError(
            f"{folder} holds {len(files)} images; at most {MAX_IMAGES} are one session. Give the "
            "folder of one scene."
        )
    return files


def _says_depth(stem: str) -> bool:
    return "depth" in words_of(stem)


def _named(root: Path, name: str) -> Path:
    folder = root / name
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; {root} holds {_contents(root)}.")
    return folder


def _only(root: Path, names: Sequence[str], what: str, option: str) -> Path | None:
    """Return the subfolder with one of these names, None where there is none."""
    found = sorted(p for p in root.iterdir() if p.is_dir() and p.name.lower() in names)
    found = [p for p in found if _image_paths(p)]
    if len(found) > 1:
        raise InputError(
            f"{root} has several folders of {what} images: {', '.join(p.name for p in found)}. "
            f"Say which: {option} {found[0].name}."
        )
    return found[0] if found else None


def _nothing(folder: Path) -> str:
    below = sorted(d.name for d in folder.iterdir() if d.is_dir() and _image_paths(d))
    advice = f" There are images in {shown(below)}: give that folder." if below else ""
    return f"{folder} holds no images ({', '.join(ENDINGS)}): {_contents(folder)}.{advice}"


def _contents(folder: Path) -> str:
    return shown(sorted(p.name for p in folder.iterdir())) or "nothing"


def _where(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def shown(names: Sequence[str], most: int = 6) -> str:
    """Return names for a message, at most so many."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])}, ... and {len(names) - most + 1} more"
