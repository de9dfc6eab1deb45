"""What a BOP data set asks to be found: test_targets_bop19.json and its successors.

bop19               [{"scene_id", "im_id", "obj_id", "inst_count"}]    localisation
bop24               [{"scene_id", "im_id"}]                            detection
multiview_bop25     [{"scene_id", "im_ids": [...]}]                    detection, several images
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.json_text import read_json
from realsim.untrusted.values import mapping, whole

BOP19 = "test_targets_bop19.json"
BOP24 = "test_targets_bop24.json"
MULTIVIEW = "test_targets_multiview_bop25.json"
FILES = (BOP19, BOP24, MULTIVIEW)


@dataclass(frozen=True, kw_only=True, slots=True)
class BopTarget:
    """One entry of a list of targets."""

    scene_id: int
    image_ids: tuple[int, ...]
    """One image, or those that may be used together."""
    obj_id: int | None = None
    """What to find; None = everything."""
    count: int | None = None
    """How many of it are there."""


def read_targets(path: Path | str) -> tuple[BopTarget, ...]:
    """Return the targets of a list, of any of the three kinds.

    Raises:
        InputError: not such a list.
    """
    data = read_json(path)
    if not isinstance(data, list):
        raise InputError(f"{path} is no list of targets; [{{scene_id, im_id, ...}}] is expected.")
    items: list[Any] = data
    return tuple(_target(item, f"target {k} of {path}") for k, item in enumerate(items))


def targets_file(root: Path | str) -> Path:
    """Return the list of targets of a data set: bop19's, else bop24's, else multiview's.

    Raises:
        InputError: there is none.
    """
    for name in FILES:
        if (Path(root) / name).is_file():
            return Path(root) / name
    raise InputError(f"{root} has no list of targets; {', '.join(FILES)} were looked for.")


def _target(data: Any, name: str) -> BopTarget:
    row = mapping(data, name)
    images = row.get("im_ids", row.get("im_id"))
    listed: list[Any] = images if isinstance(images, list) else [images]
    if not listed:
        raise InputError(f"{name} has no image.")
    obj_id, count = row.get("obj_id"), row.get("inst_count")
    return BopTarget(
        scene_id=whole(row.get("scene_id"), f"scene_id of {name}", 0),
        image_ids=tuple(whole(i, f"im_id of {name}", 0) for i in listed),
        obj_id=None if obj_id is None else whole(obj_id, f"obj_id of {name}", 0),
        count=None if count is None else whole(count, f"inst_count of {name}", 1),
    )
