"""A capture plan as a file and as a picture."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim_capture_plans.plan_record import CapturePlan, PlanConfig

SCHEMA = "realsim capture plan"
SCHEMA_VERSION = 1


def plan_to_json(plan: CapturePlan) -> dict[str, Any]:
    """Return the plan as plain JSON values, with its schema, version and content hash."""
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "sha256": plan.content_hash,
        "content": plan.content,
    }


def plan_from_json(data: Any, source: str = "the plan") -> CapturePlan:
    """Return the plan of plain JSON values.

    Args:
        data: what `plan_to_json` returned.
        source: what the data is called in errors.

    Raises:
        InputError: not a plan, a newer version, or a content that does not match its hash.
    """
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(f"{source} is not a '{SCHEMA}': the key 'schema' does not say so.")
    version = data.get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{source} has schema version {version!r}; this realsim reads version "
            f"{SCHEMA_VERSION}. Make the plan anew, or use the realsim that wrote it."
        )
    try:
        plan = _plan_of(data["content"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{source} is incomplete or has a field that is not known ({error}). Restore the file, "
            "or make the plan anew."
        ) from error
    if plan.content_hash != data.get("sha256"):
        raise InputError(
            f"{source} was changed after it was checked: its content has the sha256 "
            f"{plan.content_hash[:12]}..., the file says {str(data.get('sha256'))[:12]}... A "
            "changed plan may collide; make it anew."
        )
    return plan


def _plan_of(content: dict[str, Any]) -> CapturePlan:
    """Return the record of a plan's content."""
    config: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in content["config"].items()
    }
    known = {
        "kind", "robot", "home", "joints", "Ts_base_ee", "Ts_base_cam", "T_ee_cam_nominal",
        "center_world", "reference_view", "metrics",
    }  # fmt: skip
    if extra := set(content) - known - {"config", "vias"}:
        raise ValueError(f"unknown fields {sorted(extra)}")
    return CapturePlan(
        **{name: content[name] for name in known},
        vias=tuple((int(k), np.array(q)) for k, q in content["vias"]),
        config=PlanConfig(**config),
    )


def save_plan(plan: CapturePlan, path: Path | str) -> None:
    """Write the plan as JSON, whole or not at all."""
    from realsim.store.atomic import write_json

    write_json(Path(path), plan_to_json(plan))


def load_plan(path: Path | str) -> CapturePlan:
    """Return the plan of a file.

    Raises:
        InputError: no such file, not JSON, or not an unchanged plan of this version.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no plan at {path}; make one and save it with save_plan.")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            f"{path} is not JSON ({error}); a saved capture plan is needed."
        ) from error
    return plan_from_json(data, str(path))


def plan_picture(plan: CapturePlan, path: Path | str) -> None:
    """Draw the views' directions seen from above, in tour order, as a PNG.

    The radius of the polar plot is the angle from straight above; colour is the distance.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    directions = plan.directions()
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    from_top = 90.0 - np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    distance = np.linalg.norm(plan.Ts_base_cam[:, :3, 3] - plan.center_world, axis=-1)
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot(projection="polar")
    axes.plot(azimuth, from_top, color="0.75", linewidth=0.8, zorder=1)
    for k, _ in plan.vias:
        axes.plot(azimuth[max(k - 1, 0) : k + 1], from_top[max(k - 1, 0) : k + 1], "r--", zorder=2)
    dots = axes.scatter(azimuth, from_top, c=distance, cmap="viridis", s=36, zorder=3)
    top = plan.reference_view
    axes.scatter(azimuth[top], from_top[top], s=160, facecolors="none", edgecolors="k", zorder=4)
    axes.set_rlim(0.0, 90.0)
    axes.set_rlabel_position(22.5)
    figure.colorbar(dots, ax=axes, label="distance to the scene centre [m]", shrink=0.7)
    m = plan.metrics
    hole = f", greatest hole {m['hole_deg']:.1f} deg" if "hole_deg" in m else ""
    axes.set_title(
        f"{len(plan)} {plan.kind} views, {plan.robot}{hole}\n"
        f"{m['seconds']:.0f} s of motion, dashed: over via points, ring: reference view\n"
        "radius: angle from straight above [deg]; the base is towards 180 deg"
    )
    figure.savefig(str(path), dpi=120)
