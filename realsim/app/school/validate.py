"""`realsim school validate`: is the physics right, engine by engine?"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from realsim.app.console import Console
from realsim.store import atomic

if TYPE_CHECKING:
    from realsim_sim_bridge.validation.report import ValidationReport

HEADER = ["", "check", "found", "limit", "behind it"]


def validate_engines(
    names: Sequence[str], hand: str, quick: bool, json_file: Path | None, out: Path | None,
    console: Console,
) -> bool:  # fmt: skip
    """Run the validation suite, show its table, and return whether every check is green.

    Args:
        names: of the engines.
        hand: its name or folder.
        quick: the suite's short form.
        json_file: file for all reports.
        out: folder for a report and a picture each.
        console: progress and tables go there.

    Raises:
        InputError: an engine is not installed, or there is no such hand.
    """
    from realsim.robots.hand import find_hand
    from realsim_sim_bridge.slip.engines import make_engine, settings_of
    from realsim_sim_bridge.validation.config import ValidationConfig
    from realsim_sim_bridge.validation.suite import validate

    settings = {name: settings_of(name) for name in names}
    for each in settings.values():
        make_engine(each)  # before the first suite runs for minutes
    config = ValidationConfig.of(find_hand(hand))
    config = config.quick() if quick else config
    reports: dict[str, ValidationReport] = {}
    for name, each in settings.items():
        with console.stage("validate", name) as tick:
            report = validate(each, config, lambda _part, done, total, t=tick: t(done, total))
        reports[name] = report
        show_report(report, console)
        if out is not None:
            _write(report, name, out, console)
    console.result({name: r.to_json() for name, r in reports.items()}, json_file)
    return all(r.passed for r in reports.values())


def show_report(report: "ValidationReport", console: Console) -> None:
    """Print the table of one engine and its verdict."""
    title = f"{report.engine} {report.version}"
    console.table(title, HEADER, report.to_rows())
    red = [c for c in report.checks if not c.passed]
    if red:
        console.warn(f"{title}: {len(red)} of {len(report.checks)} checks are red: "
                     f"{', '.join(c.name for c in red)}. Do not trust its labels.")  # fmt: skip
    else:
        console.say(
            f"{title}: all {len(report.checks)} checks are green ({report.cpu_s:.0f} CPU s)."
        )


def _write(report: "ValidationReport", name: str, out: Path, console: Console) -> None:
    """Write the report of one engine and its picture."""
    from realsim_sim_bridge.validation.report import picture

    atomic.write_json(out / f"validation_{name}.json", report.to_json())
    atomic.write_bytes(out / f"validation_{name}.png", picture(report))
    console.say(f"report    {out / f'validation_{name}.json'} and .png")
