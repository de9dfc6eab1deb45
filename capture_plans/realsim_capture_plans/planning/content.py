"""A capture plan as plain JSON values, and the hash that names it.

The content is what a plan is made of. What follows from it (flange and camera poses, corners and
times of the moves) is written beside it for other programs, and compared with the chain when the
file is read: it is no part of the hash, whose last bits it would make depend on the machine.
"""

import hashlib
import json
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from realsim_capture_plans.arms.kinematics import DhChain, JointLimits
from realsim_capture_plans.collision.shapes import Box, Mount, Shape, WorkCell
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig


def plan_content(plan: CapturePlan) -> dict[str, Any]:
    """Return what the plan is made of as plain JSON values.

    A change of these keys, or of the fields of `PlanConfig`, changes every hash: it needs a new
    schema version of the file.
    """
    chain = plan.chain
    numbers = [f.name for f in fields(DhChain) if f.name not in ("name", "limits")]
    return {
        "kind": plan.kind,
        "robot": chain.name,
        "dh": {name: getattr(chain, name).tolist() for name in numbers},
        "limits": {f.name: getattr(chain.limits, f.name).tolist() for f in fields(JointLimits)},
        "mount": {
            "name": plan.mount.name,
            "camera": plan.mount.camera,
            "T_ee_cam": plan.mount.T_ee_cam.tolist(),
            "cover_m": plan.mount.cover_m,
            "bracket": [_shape_json(s) for s in plan.mount.bracket],
        },
        "cell": {
            "table": _box_json(plan.cell.table),
            "keep_out": _box_json(plan.cell.keep_out),
            "obstacles": [[name, _box_json(box)] for name, box in plan.cell.obstacles],
        },
        "home": plan.home.tolist(),
        "center_world": plan.center_world.tolist(),
        "reference_view": plan.reference_view,
        "joints": plan.joints.tolist(),
        "vias": [[k, q.tolist()] for k, q in plan.vias],
        "config": {
            k: list(v) if isinstance(v, tuple) else v for k, v in asdict(plan.config).items()
        },
        "metrics": plan.metrics,
    }


def expected_poses(plan: CapturePlan) -> dict[str, Any]:
    """Return the (N, 4, 4) poses of flange and nominal camera in base [m] as JSON values."""
    return {"Ts_base_ee": plan.Ts_base_ee.tolist(), "Ts_base_cam": plan.Ts_base_cam.tolist()}


def segments(plan: CapturePlan) -> list[dict[str, Any]]:
    """Return all that a controller needs for each move, so that it needs nothing else.

    `corners` are the joints [rad] from the move's start over its via points to the view; the arm
    goes straight from one to the next in joint space and stops at each. `seconds` is the time of
    the motion, the settling that follows not included.
    """
    from realsim_capture_plans.planning.ordering import move_seconds

    c = plan.config
    rows: list[dict[str, Any]] = []
    for k in range(len(plan)):
        corners = plan.move(k)
        leading = np.abs(np.diff(corners, axis=0)).max(-1)
        rows.append(
            {
                "view": k,
                "seconds": round(float(np.sum(move_seconds(leading, c))), 6),
                "speed_rad_s": c.speed,
                "acceleration_rad_s2": c.acceleration,
                "settle_s": c.settle_s,
                "corners": corners.tolist(),
            }
        )
    return rows


def content_hash(plan: CapturePlan) -> str:
    """Return the sha256 of the content, written as JSON with sorted keys and no spaces."""
    return hash_of(plan_content(plan))


def hash_of(content: dict[str, Any]) -> str:
    """Return the sha256 of a content."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _box_json(box: Box) -> dict[str, Any]:
    """Return a box; an infinite bound is null."""
    return {
        name: [float(v) if np.isfinite(v) else None for v in getattr(box, name)]
        for name in ("lower", "upper")
    }


def _box_of(data: dict[str, Any]) -> Box:
    lower = [-np.inf if v is None else float(v) for v in data["lower"]]
    upper = [np.inf if v is None else float(v) for v in data["upper"]]
    return Box(lower=(lower[0], lower[1], lower[2]), upper=(upper[0], upper[1], upper[2]))


def _shape_json(shape: Shape) -> dict[str, Any]:
    return {
        "part": shape.part,
        "frame": shape.frame,
        "kind": shape.kind,
        "size_m": list(shape.size_m),
        "T_frame_shape": shape.T_frame_shape.tolist(),
        "points": None if shape.points is None else shape.points.tolist(),
    }


def plan_of(content: dict[str, Any]) -> CapturePlan:
    """Return the record of a plan's content."""
    config: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in content["config"].items()
    }
    mount, cell = content["mount"], content["cell"]
    return CapturePlan(
        kind=content["kind"],
        chain=DhChain(
            name=content["robot"], **content["dh"], limits=JointLimits(**content["limits"])
        ),
        mount=Mount(
            name=mount["name"],
            camera=mount["camera"],
            T_ee_cam=mount["T_ee_cam"],
            cover_m=float(mount["cover_m"]),
            bracket=tuple(Shape(**s) for s in mount["bracket"]),
        ),
        cell=WorkCell(
            table=_box_of(cell["table"]),
            keep_out=_box_of(cell["keep_out"]),
            obstacles=tuple((str(name), _box_of(box)) for name, box in cell["obstacles"]),
        ),
        home=content["home"],
        joints=content["joints"],
        center_world=content["center_world"],
        reference_view=content["reference_view"],
        metrics=content["metrics"],
        vias=tuple((int(k), np.array(q)) for k, q in content["vias"]),
        config=PlanConfig(**config),
    )
