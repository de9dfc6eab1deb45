"""`realsim school reality`: what labels tell of grasps that a real robot has tried."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.app.console import Console
from realsim.app.school.inputs import named_mass, spread_of
from realsim.errors import InputError
from realsim.json_values import json_value
from realsim.store import atomic

if TYPE_CHECKING:
    from realsim_sim_bridge.hold.reality import Reality, RealityConfig

HEADER = ["predictor", "AUC", "95 % by object", "within objects", "average precision"]
WORDS = {
    "p_hold": "p_hold",
    "draws": "draws alone",
    "safety": "safety factor, nominal pose",
    "score": "score, one nominal attempt",
    "score_old": "score with limits in closing",
    "dexnet_closure": "force closure (Dex-Net)",
    "closure_friction": "least friction that closes (GraspNet)",
    "ferrari_canny": "Ferrari-Canny",
    "object": "the object's other trials",
    "always holds": "always holds",
}


def judge(
    folder: Path, options: dict[str, Any], out: Path | None, fit: Path | None, console: Console
) -> None:
    """Judge every predictor by the trials of a folder; show, and write, how well each does.

    Args:
        folder: GRASPA's layout.
        options: engine, draws, cell_error, calibration, masses and cache of the command line.
        out: folder for the report and the picture.
        fit: file for a calibration that is fitted on these trials.
        console: progress and tables go there.

    Raises:
        InputError: the folder is of another layout, or the trials cannot be judged.
    """
    from realsim.formats.grasps.graspa import read_graspa
    from realsim.untrusted.own_json import read_own
    from realsim_sim_bridge.hold.calibration import Calibration, shipped
    from realsim_sim_bridge.hold.reality import calibrate, judge_trials, reality_of

    given = options["calibration"]
    if fit is not None and given is not None:
        raise InputError(
            "--fit makes a calibration and --p-hold-calibration takes one; give one of them."
        )
    objects = read_graspa(folder, _masses(options))
    names = {obj.name for obj in objects}
    config = _config(options)
    with console.stage("reality", "trials") as tick:
        judged = judge_trials(objects, config, options["cache"], tick)
    console.warn(*judged.notes)
    fitted = None
    if fit is not None:
        fitted = calibrate(judged, str(folder.resolve().name))
        fitted.write(fit)
        console.say(f"calibration {fit}")
    calibration = fitted or (read_own(given, Calibration) if given else shipped())
    found = reality_of(judged, calibration)
    held = int(judged.held.sum())
    if held in (0, len(judged.held)):
        console.warn("all trials ended alike, so nothing can be told apart: no AUC is given.")
    title = f"{len(judged.held)} trials of {len(names)} objects, {held} held; {judged.engine}"
    _show(found, title, sorted(names & set(calibration.objects)), console)
    document = _document(found, asdict(config), judged.notes)
    if out is not None:
        atomic.write_json(out / "reality.json", document)
        atomic.write_bytes(out / "reliability.png", reliability_picture(found))
        console.say(f"report    {out / 'reality.json'} and {out / 'reliability.png'}")
    console.result(document)


def _masses(options: dict[str, Any]) -> dict[str, float]:
    """Return the masses given on the command line, by object [kg]; check the cache's folder."""
    masses = [named_mass(text) for text in options["masses"]]
    if len(dict(masses)) < len(masses):
        raise InputError("--weighed names an object twice; give it once.")
    if options["cache"] is not None and not options["cache"].is_dir() and options["cache"].exists():
        raise InputError(f"--cache {options['cache']} is a file; a folder is expected.")
    return dict(masses)


def _config(options: dict[str, Any]) -> "RealityConfig":
    """Return what the options ask for, with the hand of the trials."""
    from realsim.robots.hand import find_hand
    from realsim_sim_bridge.hold.draws import HoldConfig
    from realsim_sim_bridge.hold.reality import RealityConfig
    from realsim_sim_bridge.slip.engines import settings_of
    from realsim_sim_bridge.slip.slip_test import SlipConfig

    hand = find_hand()
    return RealityConfig(
        hand=hand,
        hold=HoldConfig(draws=options["draws"], **spread_of(options["cell_error"])),
        slip=replace(SlipConfig.of(hand), engine=settings_of(options["engine"])),
    )


def _show(found: "Reality", title: str, shared: list[str], console: Console) -> None:
    """Show the predictors, p_hold's own figures, and whether they are of trials that were fitted.

    Args:
        found: the figures.
        title: of the table.
        shared: objects that the calibration was fitted on, too.
        console: takes them.
    """
    rows = [
        [WORDS[row.name], _number(row.auc), f"{_number(row.auc_low)} to {_number(row.auc_high)}",
         _number(row.within), _number(row.average_precision)]
        for row in found.rows
    ]  # fmt: skip
    console.table(title, HEADER, rows)
    console.say(
        f"p_hold: expected calibration error {found.ece:.3f}, balanced accuracy "
        f"{_number(found.balanced_accuracy)}; AUC {_number(found.gain, '+.3f')} over the score "
        f"with limits in closing, 95 % {_number(found.gain_low)} to {_number(found.gain_high)} "
        "by object."
    )
    if found.in_sample:
        console.say(
            "The calibration was fitted on these very trials: both figures are of curves fitted "
            "on the other objects."
        )
    elif shared:
        console.warn(
            f"the calibration was fitted on trials of {', '.join(shared)} too, though not on these "
            "alone or not on all of them: both figures may be too good."
        )


def reliability_picture(found: "Reality") -> bytes:
    """Return a PNG: how often grasps of like p_hold held, and how many there were."""
    import numpy as np

    from realsim.pages import plots

    drawn, (left, right) = plots.columns(2)
    left.plot([0, 1], [0, 1], color=plots.MUTED, linewidth=1, linestyle="--")
    p = np.array([r.predicted for r in found.reliability])
    held = np.array([r.held for r in found.reliability])
    trials = np.array([r.trials for r in found.reliability])
    # A binomial's standard error, as if one trial more had ended each way.
    shared = (held * trials + 1) / (trials + 2)
    error = np.sqrt(shared * (1 - shared) / (trials + 2))
    left.errorbar(p, held, yerr=error, fmt="o-", color=plots.SERIES[0], capsize=3)
    left.set_xlim(0, 1)
    left.set_ylim(0, 1)
    plots.titled(
        left, f"Of grasps with p_hold so and so many held (error {found.ece:.3f})", "p_hold", "held"
    )
    counts = np.histogram(found.p_hold, bins=10, range=(0.0, 1.0))[0]
    plots.share_bars(right, counts, "Trials", "p_hold", "trials")
    return plots.png(drawn)


def _document(found: "Reality", config: dict[str, Any], notes: tuple[str, ...]) -> dict[str, Any]:
    """Return the report as plain values; null where nothing is known."""
    document = asdict(replace(found, p_hold=found.p_hold.tolist()))
    document["predictors"] = {row.pop("name"): row for row in document.pop("rows")}
    return json_value(document | {"config": config, "notes": list(notes)})


def _number(value: float, form: str = ".3f") -> str:
    """Return a figure, or a dash."""
    return format(value, form) if math.isfinite(value) else "-"
