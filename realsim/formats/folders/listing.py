"""The images of a folder, and which files belong to one frame.

Files join by their name or the number in it, never by order: a list that lost one entry would pair
every later one wrongly.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.images import MOST_PIXELS
from realsim.untrusted.files import require_permission

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
    require_permission(path)
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


KIND_WORDS = frozenset(
    "aligned color colour rgb image img depth d pose poses joint joints robot tcp cam".split()
)
"""Words that say what a file is and not which frame it belongs to."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameState:
    """What is known of a frame besides its images; joined to it by the name."""

    name: str
    """The image's name, or a name or number of its own; "" = nothing but the row's number."""
    where: str
    """Where it stands, for messages: "line 12", "poses/3.yaml"."""
    T_base_ee: Array | None = None
    """(4, 4) flange in the robot's base [m]."""
    T_world_cam: Array | None = None
    """(4, 4) camera in world [m]."""
    joints: Array | None = None
    """(6,) [rad]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Join:
    """Pairs of two lists of names."""

    pairs: dict[int, int]
    """Left -> right."""
    sentence: str
    """By what they were joined, with an example."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which the numbers in names count as numbers: 9 before 10."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), p) if p.isdecimal() else (1, 0, p.lower()) for p in parts if p]


def frame_key(name: str) -> str:
    """Return what a file's name says of the frame: without kind words, numbers without zeros.

    "frame-000007.color", "frame-000007.depth" and "frame_7" are one frame; "rgb_7" and "7" too.
    """
    parts = [w for w in re.split(r"[^a-z0-9]+", name.lower()) if w]
    words: list[str] = []
    for part in parts:
        letters = re.fullmatch(r"([a-z]+)(\d+)", part)  # "depth0007" has a kind word, too
        pieces = [letters[1], letters[2]] if letters and letters[1] in KIND_WORDS else [part]
        words += [p for p in pieces if p not in KIND_WORDS]
    return "_".join(re.sub(r"\d+", lambda m: str(int(m[0])), w) for w in words)


def require_unique(names: Sequence[str], stems: Sequence[str], what: str) -> list[str]:
    """Return the frame keys of names, all different.

    Raises:
        InputError: two names mean the same frame.
    """
    seen: dict[str, str] = {}
    keys = [frame_key(s) for s in stems]
    for name, key in zip(names, keys, strict=True):
        if key in seen:
            raise InputError(
                f"{seen[key]} and {name} are two {what} of one frame: which one counts is not "
                "known. Keep one of them, or move the other elsewhere."
            )
        seen[key] = name
    return keys


def running_numbers(keys: Sequence[str]) -> list[int] | None:
    """Return the number that runs through names alike but for it, None where there is none."""
    parts = [re.split(r"(\d+)", k) for k in keys]
    if not parts or any(p[::2] != parts[0][::2] for p in parts):
        return None
    columns = list(zip(*(tuple(map(int, p[1::2])) for p in parts), strict=True))
    running = [c for c in columns if len(set(c)) > 1] if len(keys) > 1 else columns
    if len(running) != 1 or len(set(running[0])) != len(keys):
        return None
    return list(running[0])


def join_names(left: Sequence[str], right: Sequence[str], left_is: str, right_is: str) -> Join:
    """Return which left belongs to which right, by equal names or by equal numbers in them.

    Args:
        left: frame keys, all different.
        right: frame keys, all different.
        left_is: what the left ones are, for messages: "colour images".
        right_is: what the right ones are.

    Raises:
        InputError: neither names nor numbers agree, or the numbers are shifted as a whole.
    """
    at = {key: k for k, key in enumerate(right)}
    pairs = {k: at[key] for k, key in enumerate(left) if key in at}
    if pairs:
        k, j = next(iter(pairs.items()))
        return Join(pairs=pairs, sentence=f"by name ('{left[k]}' with '{right[j]}')")
    numbers, others = running_numbers(left), running_numbers(right)
    names = f"{left_is}: {shown(left)}; {right_is}: {shown(right)}"
    if numbers is None or others is None:
        raise InputError(
            f"the names do not say which {right_is} belong to which {left_is}: no name is on both "
            f"sides, and no single number runs through them ({names}). Rename one side so that "
            "what belongs together has the same number, such as rgb_0001.png and depth_0001.png."
        )
    at_number = {n: k for k, n in enumerate(others)}
    pairs = {k: at_number[n] for k, n in enumerate(numbers) if n in at_number}
    differences = {a - b for a, b in zip(sorted(numbers), sorted(others), strict=False)}
    shift = differences.pop() if len(differences) == 1 and len(left) == len(right) else 0
    if not pairs or shift:
        why = f"all numbers differ by {shift:+d}" if shift else "no number is on both sides"
        raise InputError(
            f"the {left_is} and the {right_is} cannot be joined by number: {why} ({names}). Do the "
            "two count from different starts, or is the first of one side and the last of the "
            "other missing? Rename one side."
        )
    k, j = next(iter(pairs.items()))
    return Join(pairs=pairs, sentence=f"by the number in the name ('{left[k]}' with '{right[j]}')")


def join_states(keys: Sequence[str], states: Sequence[FrameState]) -> Join:
    """Return which state belongs to which frame: by its name, else by the row's number.

    A row without a name belongs to the image of its number, if the images are numbered 0 to n - 1
    or 1 to n without a gap; anything else is refused.

    Raises:
        InputError: no names, and the numbers do not fit; or two states of one frame.
    """
    named = [bool(s.name) for s in states]
    if all(named):
        stems = [PurePosixPath(s.name.replace("\\", "/")).name for s in states]
        stems = [_without_ending(s) for s in stems]
        return join_names(
            keys, require_unique([s.where for s in states], stems, "poses"), "images", "poses"
        )
    if any(named):
        first = states[named.index(False)]
        raise InputError(
            f"the pose of {first.where} names no image, the others do. Add its name, or delete it."
        )
    numbers, n = running_numbers(keys), len(states)
    if numbers is not None and sorted(numbers) in (list(range(n)), list(range(1, n + 1))):
        start = min(numbers)
        return Join(
            pairs={k: number - start for k, number in enumerate(numbers)},
            sentence=f"by row number ('{keys[numbers.index(start)]}' with {states[0].where})",
        )
    raise InputError(
        f"there are {len(keys)} images ({shown(keys)}) and {n} poses without names, and the "
        f"images are not numbered 0 to {n - 1} or 1 to {n}: which belong together is not known, "
        "and the order does not tell after a gap. Write the image's name beside each pose."
    )


def _without_ending(name: str) -> str:
    """Return a name without an image's ending: "a.color.png" becomes "a.color"."""
    return re.sub(r"\.(png|jpe?g|bmp|tiff?|webp|p[gp]m|json|ya?ml|txt)$", "", name, flags=re.I)


def plain_values(states: Sequence[FrameState]) -> list[Any]:
    """Return states as plain values, for a digest of the content."""
    return [
        [s.name, *(None if a is None else np.asarray(a).tolist()
                   for a in (s.T_base_ee, s.T_world_cam, s.joints))]
        for s in states
    ]  # fmt: skip
