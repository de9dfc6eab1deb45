"""A capture plan as a JSON file with a schema version and a hash of its content."""

import json
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim_capture_plans.planning.content import hash_of, plan_content, plan_of
from realsim_capture_plans.planning.record import CapturePlan

SCHEMA = "realsim capture plan"
SCHEMA_VERSION = 2


def plan_to_json(plan: CapturePlan) -> dict[str, Any]:
    """Return the plan as plain JSON values, with its schema, version and content hash."""
    content = plan_content(plan)
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "sha256": hash_of(content),
        "content": content,
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
        plan = plan_of(data["content"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{source} is incomplete or has a field that is not known ({error}). Restore the file, "
            "or make the plan anew."
        ) from error
    if (found := hash_of(data["content"])) != data.get("sha256"):
        raise InputError(
            f"{source} was changed after it was checked: its content has the sha256 "
            f"{found[:12]}..., the file says {str(data.get('sha256'))[:12]}... A "
            "changed plan may collide; make it anew."
        )
    return plan


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
        raise InputError(f"there is no plan at {path}; make one with `realsim plan`.")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            f"{path} is not JSON ({error}); a saved capture plan is needed."
        ) from error
    return plan_from_json(data, str(path))
