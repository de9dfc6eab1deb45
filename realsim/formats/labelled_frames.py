"""A labelled scene as a frame source: what is imported into a session, image by image."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.errors import InputError
from realsim.formats.folders.source import file_digest
from realsim.formats.frame_source import SourceFrame
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene

SAME_K_PX = 1e-6
"""Camera matrices that differ by less are one camera, written by another program."""


class LabelledFrames:
    """A `FrameSource` of a `LabelledScene`; a session has one camera, which is checked here."""

    def __init__(self, scene: LabelledScene, kind: str, *, use_depth: bool = True) -> None:
        """Check that all images are of one camera and one depth unit.

        Args:
            scene: the scene.
            kind: of the data set, for the session's notes: 'bop', 'graspnet'.
            use_depth: whether depth is imported.

        Raises:
            InputError: it has no image, or several cameras, depth units or image sizes.
        """
        self.scene, self._kind = scene, kind
        self.name = scene.name
        """The scene's name."""
        frames = [scene.frame(i) for i in scene.indices]
        if not frames:
            raise InputError(f"{scene.name} has no images; there is nothing to import.")
        self.intrinsics = frames[0].intrinsics
        """The camera of all images."""
        for frame in frames[1:]:
            _require_same_camera(frames[0], frame, scene.name)
        deep = [f for f in frames if f.depth_unit_m is not None] if use_depth else []
        units_m = sorted({f.depth_unit_m for f in deep if f.depth_unit_m is not None})
        if len(units_m) > 1:
            raise InputError(
                f"{scene.name} has depth in units of {units_m[0]:g} and {units_m[-1]:g} m, and a "
                "session has one. Convert it with `realsim export` instead, or import a part."
            )
        self.depth_unit_m = units_m[0] if units_m else None
        """Metres per count; None = no depth."""
        taken = deep if deep else frames
        self.indices = tuple(f.index for f in taken)
        """Numbers of the images, in the order of the frames."""
        notes = list(scene.notes)
        if len(taken) < len(frames):
            notes.append(
                f"{len(frames) - len(taken)} of {len(frames)} images have no depth and were left "
                "out, their frames are not complete."
            )
        self.notes = tuple(notes)
        """What a person should know."""

    @property
    def extra(self) -> dict[str, Any]:
        """Where it came from: scene, image numbers, content key."""
        return {
            "kind": self._kind,
            "path": str(self._colour(self.indices[0]).parent.parent),
            "scene": self.scene.number,
            "frames": list(self.indices),
            "content_key": self._content_key(),
        }

    def _colour(self, index: int) -> Path:
        return self.scene.colour_file(index)

    def _content_key(self) -> str:
        digest = hashlib.sha256()
        for index in self.indices:
            for path in (self._colour(index), self.scene.depth_file(index)):
                if path is not None:
                    digest.update(file_digest(path, path.name))
        return digest.hexdigest()

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.indices)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the images from place `start` on, in the order of their numbers.

        Raises:
            InputError: an image cannot be read; the message names it.
        """
        for index in self.indices[start:]:
            deep = self.scene.depth_file(index) if self.depth_unit_m is not None else None
            yield SourceFrame(
                name=f"image {index} of {self.scene.name}",
                time_s=float(index),
                rgb=images.read_rgb(self._colour(index)),
                depth_counts=None if deep is None else images.read_counts(deep),
                T_world_cam=self.scene.frame(index).T_world_cam,
            )


def _require_same_camera(first: LabelledFrame, other: LabelledFrame, name: str) -> None:
    a, b = first.intrinsics, other.intrinsics
    same_size = (a.width, a.height) == (b.width, b.height)
    same_lens = np.array_equal(a.distortion, b.distortion)
    if not same_size or not same_lens or np.abs(a.K - b.K).max() > SAME_K_PX:
        raise InputError(
            f"images {first.index} and {other.index} of {name} have different cameras "
            f"({a.width}x{a.height}, fx {a.fx:.3f}, cx {a.cx:.3f}; {b.width}x{b.height}, fx "
            f"{b.fx:.3f}, cx {b.cx:.3f}), and a session has one. `realsim export` converts such "
            "data sets without a session."
        )
