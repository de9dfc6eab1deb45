"""A frame source in memory: what the importers give, with what can be wrong with it."""

import numpy as np

from realsim.errors import InputError
from realsim.formats.frame_source import SourceFrame
from realsim.geometry import se3
from realsim.records import CameraIntrinsics

CAMERA = CameraIntrinsics(
    width=40, height=30, fx=35.1, fy=35.2, cx=20.3, cy=14.7, distortion=np.array([0.1, -0.02])
)


def frame_of(k: int) -> SourceFrame:
    rng = np.random.default_rng(k)
    return SourceFrame(
        name=f"f{k}", time_s=1.7e9 + k / 30, rgb=rng.integers(0, 256, (30, 40, 3), dtype=np.uint8),
        depth_counts=rng.integers(0, 2**16, (30, 40)).astype(np.uint16),
        joints=rng.uniform(-3, 3, 6), T_base_ee=se3.random_transform(rng, spread=0.3),
        T_world_cam=se3.look_at(rng.uniform(0.2, 0.5, 3), [0, 0, 0]),
    )  # fmt: skip


class Recording:
    """A source in memory: what the importers give, with what can be wrong with it."""

    def __init__(self, frames, *, camera=CAMERA, stop=None, content="a") -> None:
        self.name, self.intrinsics, self.depth_unit_m = "recording", camera, 1e-4
        self.notes = ("a note with [square] brackets.",)
        self.extra = {"content_key": content, "path": "/somewhere"}
        self.made, self.stop, self.read = list(frames), stop, []

    def __len__(self) -> int:
        return len(self.made)

    def frames(self, start: int = 0):
        for k in range(start, len(self.made)):
            if k == self.stop:
                raise InputError(f"frame {k} cannot be read.")
            self.read.append(k)
            yield self.made[k]


def ten() -> list[SourceFrame]:
    return [frame_of(k) for k in range(10)]
