"""Plans that come with realsim, and how a plan is named: by its file, or `shipped:NAME`."""

from importlib.resources import files
from pathlib import Path

from realsim.errors import InputError
from realsim_capture_plans.plan_files.plan_json import load_plan, plan_from_json
from realsim_capture_plans.planning.record import CapturePlan

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
