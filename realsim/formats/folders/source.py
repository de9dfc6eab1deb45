"""Colour, depth and robot states of a folder as frames, complete ones only, in natural order."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim import images
from realsim.errors import InputError
from realsim.formats.folders.depth_evidence import (
    DepthCoding,
    coding_of,
    decoded,
    depth_evidence,
    require_unit,
)
from realsim.formats.folders.listing import (
    FrameState,
    ImageFile,
    ImageFolder,
    Join,
    join_names,
    join_states,
    list_folder,
    natural_key,
    plain_values,
    require_unique,
    shown,
)
from realsim.formats.frame_source import SourceFrame
from realsim.records import CameraIntrinsics

DIGEST_BYTES = 4096
"""Bytes read from a file's beginning and end for the content key: enough to tell images apart,
and a folder of any size costs no second reading."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FolderChoice:
    """What the folder itself does not say."""

    colour: str = ""
    """Subfolder of the colour images; "" = found by its name."""
    depth: str = ""
    """Subfolder of the depth images; "" = found by its name."""
    use_depth: bool = True
    """Whether depth is imported; without, depth that is not on the colour's pixels is no error."""
    depth_unit_m: float | None = None
    """Metres per count; no image file says it."""
    depth_coding: str = "auto"
    """"plain", "apc" (bits turned by three) or "auto" (recognised)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Row:
    """The parts of one frame."""

    colour: ImageFile
    depth: ImageFile | None
    states: tuple[FrameState, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FolderSource:
    """A folder of images, opened and checked; made by `open_folder`."""

    root: Path
    intrinsics: CameraIntrinsics
    """The camera that was given."""
    rows: tuple[_Row, ...]
    """The complete frames, in natural order of the colour names."""
    depth_unit_m: float | None
    """Metres per count; None without depth."""
    coding: DepthCoding
    notes: tuple[str, ...]
    """How frames were joined, and what was left out."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.root.resolve().name

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: kind, files of every frame, depth coding, content key."""
        files = [[self._relative(r.colour), self._relative(r.depth)] for r in self.rows]
        return {
            "kind": "folder",
            "path": str(self.root.resolve()),
            "depth_coding": self.coding if self.depth_unit_m else None,
            "frames": files,
            "content_key": self._content_key(),
        }

    def _relative(self, image: ImageFile | None) -> str | None:
        return None if image is None else image.path.relative_to(self.root).as_posix()

    def _content_key(self) -> str:
        digest = hashlib.sha256()
        for row in self.rows:
            for image in (row.colour, row.depth):
                if image is not None:
                    digest.update(file_digest(image.path, str(self._relative(image))))
            digest.update(json.dumps(plain_values(row.states)).encode())
        return digest.hexdigest()

    def __len__(self) -> int:
        """Return the number of complete frames."""
        return len(self.rows)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the frames from number `start` on, in natural order of the colour names.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for k in range(start, len(self.rows)):
            row = self.rows[k]
            counts = None
            if row.depth is not None:
                counts = decoded(images.read_counts(row.depth.path), self.coding)
            known = {
                name: next(
                    (v for v in (getattr(s, name) for s in row.states) if v is not None), None
                )
                for name in ("joints", "T_base_ee", "T_world_cam")
            }
            yield SourceFrame(
                name=str(self._relative(row.colour)), time_s=float(k),
                rgb=images.read_rgb(row.colour.path), depth_counts=counts, **known,
            )  # fmt: skip


def file_digest(path: Path, name: str) -> bytes:
    """Return a digest of a file's name, size, beginning and end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(DIGEST_BYTES)
        file.seek(max(size - DIGEST_BYTES, 0))
        return hashlib.sha256(f"{name}:{size}:".encode() + head + file.read()).digest()


def open_folder(
    root: Path | str,
    camera: CameraIntrinsics | None,
    states: Sequence[Sequence[FrameState]] = (),
    *,
    choice: FolderChoice | None = None,
    listing: ImageFolder | None = None,
) -> FolderSource:
    """Return a folder of images as a frame source.

    Args:
        root: the folder.
        camera: the colour camera; an error if None, since nothing can be measured without it.
        states: lists of poses or joints, each joined to the images by name.
        choice: what the folder does not say.
        listing: its images, if they were listed already.

    Raises:
        InputError: no images, several sizes, no camera, names that do not say what belongs
            together, depth without unit or not on the colour's pixels, or no complete frame.
        UnitError: the depth unit contradicts the images.
    """
    root, choice = Path(root), choice or FolderChoice()
    listing = listing or list_folder(root, colour=choice.colour, depth=choice.depth)
    camera = _checked_camera(listing, camera)
    depth = listing.depth if choice.use_depth else ()
    _require_aligned(listing.root, depth, camera)
    notes = list(listing.ignored)
    if listing.depth and not depth:
        notes.append(f"{len(listing.depth)} depth images were left out, as asked.")
    rows = _joined(listing, depth, states, notes)
    unit_m: float | None = None
    coding: DepthCoding = "plain"
    if depth:
        paths = [r.depth.path for r in rows if r.depth is not None]
        evidence = depth_evidence(paths)
        coding, why = coding_of(evidence, choice.depth_coding, str(root))
        notes += [why] if why else []
        unit_m = require_unit(choice.depth_unit_m, evidence, coding, str(root))
        notes.append(
            f"depth: {100 * evidence.filled:.0f} % of the pixels, median "
            f"{evidence.median(coding) * unit_m:.3g} m with {unit_m:g} m per count."
        )
    return FolderSource(
        root=listing.root,
        intrinsics=camera,
        rows=tuple(rows),
        depth_unit_m=unit_m,
        coding=coding,
        notes=tuple(notes),
    )


def _checked_camera(listing: ImageFolder, camera: CameraIntrinsics | None) -> CameraIntrinsics:
    """Return the camera if it is the one of all colour images."""
    width, height = require_one_size(listing.colour, "colour images")
    if camera is None:
        raise InputError(
            f"{listing.root}: the camera of the images ({width}x{height} px) is not known, and "
            "without it nothing can be measured in them. Give --intrinsics FILE: OpenCV YAML or "
            "XML, ROS camera_info YAML, JSON with fx fy cx cy width height, a BOP camera.json, "
            "COLMAP's cameras.txt, or a text file with the 3x3 matrix."
        )
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{listing.root}: the camera is of {camera.width}x{camera.height} px, the images are "
            f"{width}x{height} px. Give the camera of these images; a crop or a resize changes it."
        )
    return camera


def require_one_size(files: Sequence[ImageFile], what: str) -> tuple[int, int]:
    """Return the (width, height) [px] that all images have.

    Raises:
        InputError: there are several; names the images of the rarer ones.
    """
    sizes = Counter(f.size for f in files)
    common = sizes.most_common(1)[0][0]
    if len(sizes) > 1:
        odd = [f"{f.path.name} is {f.width}x{f.height}" for f in files if f.size != common]
        raise InputError(
            f"the {what} have several sizes: {sizes[common]} are {common[0]}x{common[1]} px, but "
            f"{shown(odd)}. One session has one camera: move the others to a folder of their own."
        )
    return common


def _require_aligned(root: Path, depth: Sequence[ImageFile], camera: CameraIntrinsics) -> None:
    if not depth:
        return
    width, height = require_one_size(depth, "depth images")
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{root}: the depth images are {width}x{height} px, the colour images "
            f"{camera.width}x{camera.height} px: depth is not on the colour's pixels, and to bring "
            "it there the depth camera's intrinsics and its place beside the colour camera are "
            "needed. Align it with the camera's own software and give it with --depths, or import "
            "the colour alone with --no-depth."
        )


def _joined(
    listing: ImageFolder, depth: Sequence[ImageFile], states: Sequence[Sequence[FrameState]],
    notes: list[str],
) -> list[_Row]:  # fmt: skip
    """Return the complete frames; says how they were joined and what each missing one lacks."""
    colour = sorted(listing.colour, key=lambda f: natural_key(f.path.stem))
    keys = require_unique([f.path.name for f in colour], [f.path.stem for f in colour], "images")
    missing: dict[int, list[str]] = {}
    of_depth: dict[int, int] = {}
    if depth:
        others = require_unique(
            [f.path.name for f in depth], [f.path.stem for f in depth], "depth images"
        )
        join = join_names(keys, others, "colour images", "depth images")
        of_depth = join.pairs
        _tell(join, keys, [f.path.name for f in depth], "depth image", missing, notes)
    of_state: list[dict[int, int]] = []
    for rows in states:
        join = join_states(keys, rows)
        of_state.append(join.pairs)
        _tell(join, keys, [s.name or s.where for s in rows], "pose", missing, notes)
    complete = [k for k in range(len(colour)) if k not in missing]
    if missing:
        parts = [f"{colour[k].path.name} (no {' and no '.join(m)})" for k, m in missing.items()]
        notes.append(
            f"{len(missing)} of {len(colour)} images were left out, their frames are not complete: "
            f"{shown(parts, 12)}."
        )
    if not complete:
        raise InputError(f"{listing.root} has no complete frame. {' '.join(notes)}")
    return [
        _Row(
            colour=colour[k],
            depth=depth[of_depth[k]] if depth else None,
            states=tuple(rows[at[k]] for rows, at in zip(states, of_state, strict=True)),
        )
        for k in complete
    ]


def _tell(
    join: Join, keys: Sequence[str], right: Sequence[str], what: str,
    missing: dict[int, list[str]], notes: list[str],
) -> None:  # fmt: skip
    """Note how a join was made, the images without a partner, and the partners without image."""
    notes.append(f"{len(join.pairs)} {what}s joined {join.sentence}.")
    for k in range(len(keys)):
        if k not in join.pairs:
            missing.setdefault(k, []).append(what)
    taken = set(join.pairs.values())
    left = [name for k, name in enumerate(right) if k not in taken]
    if left:
        notes.append(f"{len(left)} {what}s have no image and were left out: {shown(left, 12)}.")
    twice = [j for j, n in Counter(join.pairs.values()).items() if n > 1]
    if twice:
        raise InputError(f"the {what} {right[twice[0]]} belongs to several images.")
