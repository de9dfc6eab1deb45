"""The table of annotated objects, as the terminal and the page show it."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.summary import ObjectSummary

HEADER = [
    "object", "verdict", "frames seen", "visible [%]", "agrees with depth [%]",
    "hidden by unknown [%]", "in frames",
]  # fmt: skip


def object_row(o: "ObjectSummary") -> list[str]:
    """Return one object's row of the table."""
    return [
        f"{o.instance} {o.name}",
        o.verdict,
        str(o.frames_seen),
        _percent(o.mean_visibility),
        _percent(o.agreement, 1),
        _percent(o.hidden_by_unknown, 1),
        str(o.frames_hidden),
    ]


def _percent(share: float, digits: int = 0) -> str:
    """Return a share in percent, or a dash where nothing was measured."""
    return "-" if np.isnan(share) else f"{100 * share:.{digits}f}"
