"""A capture plan as a JSON file with a schema version and a hash of its content.

The file holds the content (what the plan is made of, under the hash), and beside it what follows
from the content: expected flange and camera poses, and for every move all that a controller needs.
Another program drives the plan from the file alone; on reading, what follows is compared with the
chain, so that a plan of another robot or in other units is found before anything moves.
"""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, RealsimError, UnitError
from realsim.robots.arm import known_chains
from realsim.untrusted.json_text import read_json
from realsim_capture_plans.plan_files import evidence
from realsim_capture_plans.planning.record import (
    CapturePlan,
    hash_of,
    plan_content,
    plan_of,
    segments,
)

SCHEMA = "realsim capture plan"
SCHEMA_VERSION = 2
LARGEST_BYTES = 64_000_000
"""A plan of 256 views has 0.5 MB; a file beyond a hundred times that is something else."""
POSE_M = 1e-5
"""Expected positions may differ from the chain's by this [m]: what rounding to 5 digits does."""
POSE_RAD = 1e-5
"""The same for orientations [rad]."""
SAME_JOINT_RAD = 1e-9
"""Corners of the segments may differ from the content's joints by this [rad]."""
EXPECTED = {"Ts_base_ee": "flange", "Ts_base_cam": "camera"}
"""Poses (N, 4, 4) in base [m] that a file holds beside the joints, and whose they are."""


def plan_to_json(plan: CapturePlan) -> dict[str, Any]:
    """Return the plan as plain JSON values, with its schema, version and content hash."""
    content = plan_content(plan)
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "sha256": hash_of(content),
        "content": content,
        "expected": {name: getattr(plan, name).tolist() for name in EXPECTED},
        "segments": segments(plan),
    }


def plan_from_json(data: Any, source: str = "the plan") -> CapturePlan:
    """Return the plan of plain JSON values.

    Args:
        data: what `plan_to_json` returned.
        source: what the data is called in errors.

    Raises:
        InputError: not a plan, another version, a content that does not match its hash, or poses
            that do not follow from it.
        UnitError: joints in degrees, lengths in millimetres.
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
        content: dict[str, Any] = data["content"]
        _check_units(content, source)
        plan = plan_of(content)
        _check_model(plan, source)
        _check_poses(plan, data["expected"], source)
        _check_segments(plan, data["segments"], source)
    except RealsimError as error:
        raise type(error)(_named(str(error), source)) from error
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            f"{source} is incomplete or has a field that is not known ({error}). Restore the file, "
            "or make the plan anew."
        ) from error
    if (found := hash_of(content)) != data.get("sha256"):
        raise InputError(
            f"{source} was changed after it was checked: its content has the sha256 "
            f"{found[:12]}..., the file says {str(data.get('sha256'))[:12]}... A "
            "changed plan may collide; make it anew."
        )
    return plan


def save_plan(plan: CapturePlan, path: Path | str) -> None:
    """Write the plan as JSON, whole or not at all."""
    from realsim.store.atomic import write_text

    write_text(Path(path), readable_json(plan_to_json(plan)))


def load_plan(path: Path | str) -> CapturePlan:
    """Return the plan of a file.

    Raises:
        InputError: no such file, too large, not JSON, or not an unchanged plan of this version.
        UnitError: joints in degrees, lengths in millimetres.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no plan at {path}; make one with `realsim plan`.")
    return plan_from_json(read_json(path, most_bytes=LARGEST_BYTES), str(path))


def readable_json(value: Any) -> str:
    """Return JSON that people can read: one view, row or move per line, not one number per line.

    Floats come back bit for bit: Python writes the shortest text that reads as the same number.
    """
    return _lines(value, 0, expand=True) + "\n"


def _lines(value: Any, indent: int, *, expand: bool) -> str:
    pad, end = " " * (indent + 1), " " * indent
    if isinstance(value, dict) and value and expand:
        rows = [
            f"{pad}{json.dumps(k)}: {_lines(v, indent + 1, expand=True)}" for k, v in value.items()
        ]
        return "{\n" + ",\n".join(rows) + f"\n{end}}}"
    if isinstance(value, list) and any(isinstance(v, list | dict) for v in value) and expand:
        rows = [pad + _lines(v, indent + 1, expand=False) for v in value]
        return "[\n" + ",\n".join(rows) + f"\n{end}]"
    return json.dumps(value, allow_nan=False)


def _named(message: str, source: str) -> str:
    return message if source in message else f"{source}: {message}"


def _check_units(content: dict[str, Any], source: str) -> None:
    """Raise if joints are not the arm's, look like degrees, or lengths like millimetres."""
    rows, count = [content["home"], *content["joints"]], len(content["dh"]["a"])
    names = ["home", *(f"view {k}" for k in range(len(rows) - 1))]
    for name, row in zip(names, rows, strict=True):
        if len(row) != count:
            raise InputError(
                f"{source}: {name} has {len(row)} joint angles, and its arm, a "
                f"{content['robot']}, has {count} joints. Make the plan anew for the arm that "
                "will drive it: `realsim plan --arm`."
            )
    joints = np.array(rows, dtype=np.float64)
    evidence.check_joint_unit(joints, "rad", names, source)
    lengths = {
        "center_world": np.array(content["center_world"], dtype=np.float64),
        "the mount's T_ee_cam": np.array(content["mount"]["T_ee_cam"], dtype=np.float64)[:3, 3],
        **{
            name: np.array(content["dh"][name], dtype=np.float64)[:3, 3]
            for name in ("T_base_0", "T_n_ee")
            if name in content["dh"]
        },
        "dh a": np.array(content["dh"]["a"], dtype=np.float64),
        "dh d": np.array(content["dh"]["d"], dtype=np.float64),
    }
    for name, length in lengths.items():
        if np.any(np.abs(length) > evidence.MILLIMETRES_FROM_M):
            raise UnitError(
                f"{source}: {name} is {length.tolist()} m, farther than any arm reaches. "
                "These look like millimetres; write metres."
            )


def _check_model(plan: CapturePlan, source: str) -> None:
    """Raise if the arm has the name of one model and the numbers of another."""
    arms = known_chains(plan.chain.joints)
    if plan.robot not in arms:
        return
    if not evidence.same_arm(plan.chain, arms[plan.robot]):
        alike = [name for name in arms if evidence.same_arm(plan.chain, arms[name])]
        whose = f"those of a {alike[0]}" if alike else "of no known model"
        raise InputError(
            f"{source} says that its robot is a {plan.robot}, but its DH numbers are {whose}. "
            "Make the plan anew for the robot that will drive it."
        )


def _check_poses(plan: CapturePlan, expected: dict[str, Any], source: str) -> None:
    """Raise if the file's poses do not follow from its joints, with the likely cause."""
    for name, what in EXPECTED.items():
        written = np.array(expected[name], dtype=np.float64)
        own: Array = getattr(plan, name)
        if written.shape != own.shape or not np.all(np.isfinite(written)):
            raise InputError(
                f"{source}: {name} has the shape {written.shape}; {own.shape} finite numbers are "
                "needed, one pose per view."
            )
        gap = np.linalg.norm(written[:, :3, 3] - own[:, :3, 3], axis=-1)
        turn = np.linalg.norm(written[:, :3, :3] - own[:, :3, :3], axis=(-2, -1)) / np.sqrt(2)
        if gap.max() <= POSE_M and turn.max() <= POSE_RAD:
            continue
        if what == "camera":
            why = f"the mount '{plan.mount.name}' is not the one that the poses were made with"
            if np.abs(written[:, :3, 3]).max() > evidence.MILLIMETRES_FROM_M:
                why = "the poses are in millimetres; metres are needed"
        else:
            why = evidence.why_poses_disagree(plan.joints, written, plan.chain)
        k = int(np.argmax(gap))
        raise InputError(
            f"{source}: the {what} poses do not follow from the joints of its {plan.robot}: "
            f"{1e3 * float(np.median(gap)):.4g} mm apart in the middle, most at view {k} "
            f"({1e3 * float(gap[k]):.4g} mm). Likely cause: {why}. Make the plan anew for the "
            "robot and the mount that will drive it."
        )


def _check_segments(plan: CapturePlan, written: list[dict[str, Any]], source: str) -> None:
    """Raise if the moves for other programs are not those of the content."""
    own = segments(plan)
    if len(written) != len(own):
        raise InputError(f"{source} has {len(written)} segments and {len(own)} views.")
    for mine, row in zip(own, written, strict=True):
        corners = np.array(row["corners"], dtype=np.float64)
        needed = np.array(mine["corners"])
        same = corners.shape == needed.shape and np.all(np.abs(corners - needed) <= SAME_JOINT_RAD)
        numbers = ("view", "speed_rad_s", "acceleration_rad_s2", "settle_s")
        if not same or any(row[key] != mine[key] for key in numbers):
            raise InputError(
                f"{source}: the segment of view {mine['view']} is not the move of the content: it "
                "was changed after the plan was checked and may collide. Make the plan anew."
            )


PREFIX = "shipped:"
_FOLDER = "realsim_capture_plans.plan_files.shipped"


def shipped_plans() -> list[str]:
    """Return the names of the plans that come with realsim."""
    names = [f.name for f in files(_FOLDER).iterdir() if f.name.endswith(".json")]
    return sorted(name.removesuffix(".json") for name in names)


def shipped_plan(name: str) -> CapturePlan:
    """Return a plan that comes with realsim.

    Raises:
        InputError: there is none of this name.
    """
    import json

    if name not in shipped_plans():
        there = ", ".join(shipped_plans()) or "none in this installation"
        raise InputError(f"no plan '{name}' comes with realsim; there is: {there}.")
    text = (files(_FOLDER) / f"{name}.json").read_text(encoding="utf-8")
    return plan_from_json(json.loads(text), PREFIX + name)


def resolve_plan(text: str | Path) -> CapturePlan:
    """Return the plan of a file, or of `shipped:NAME`.

    Raises:
        InputError: no such file or name, or not an unchanged plan of this version.
    """
    if str(text).startswith(PREFIX):
        return shipped_plan(str(text).removeprefix(PREFIX))
    if not Path(text).is_file() and str(text) in shipped_plans():
        raise InputError(f"there is no file {text}; did you mean {PREFIX}{text}?")
    return load_plan(text)
