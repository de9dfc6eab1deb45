"""One run of Robot School: from what the user asked for to its outcome."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.app.console import Console
from realsim.app.school.files import SchoolOutcome, write_outcome
from realsim.app.school.inputs import (
    CACHE,
    SchoolInputs,
    SchoolRequest,
    base_on_table,
    read_inputs,
    session_inputs,
    spread_of,
)
from realsim.app.school.settle import warn_of_falls
from realsim.app.stages import note
from realsim.errors import InputError
from realsim.records import Scene
from realsim.robots.robot_files import same_name
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim.robots.hand import Hand
    from realsim_sim_bridge.school import SchoolConfig


MADE_FROM = ("registration/scene.json", "review/journal.jsonl", "models/*", "models/collision/*")
"""Files of a session that a school is made of."""


def config_of(request: SchoolRequest, scene: Scene) -> "SchoolConfig":
    """Return the school's config for a request.

    Raises:
        InputError: an arm, a hand or an engine that is not there or not installed, or a base
            pose that cannot be read.
    """
    from realsim.robots.hand import find_hand
    from realsim.untrusted.own_json import read_own
    from realsim_sim_bridge.arm.reach_config import chosen_arm
    from realsim_sim_bridge.hold.calibration import Calibration
    from realsim_sim_bridge.hold.draws import HoldConfig
    from realsim_sim_bridge.school import SchoolConfig
    from realsim_sim_bridge.school.sweep import SweepConfig
    from realsim_sim_bridge.slip.engines import make_engine, settings_of

    hand = find_hand(request.hand)
    config = SchoolConfig.of(hand)
    arm = chosen_arm(request.arm)
    arm.found()  # as with the engine below: what is not there is said at once
    config = replace(config, reach=replace(config.reach, arm=arm))
    config = replace(config, seed=request.seed, max_candidates=request.grasps)
    changed: dict[str, Any] = {}
    physics = config.slip.physics
    if request.force_n is not None:
        _require_force(hand, request.force_n)
        changed["force_n"] = request.force_n
    if request.friction is not None:
        changed["friction"] = request.friction
    if request.stiffness_n_per_m is not None and physics.pads:
        stiff = request.stiffness_n_per_m
        changed["pads"] = replace(physics.pads, pad_stiffness_n_per_m=stiff)
    physics = replace(physics, **changed)  # at once: a force may need these very pads
    hold = HoldConfig(seed=request.seed, draws=request.draws, **spread_of(request.cell_error))
    if request.friction is not None:  # what is stated is not uncertain
        hold = replace(hold, friction=(request.friction,))
    curve = None if request.calibration is None else read_own(request.calibration, Calibration)
    config = replace(config, hold=hold, calibration=curve)
    engine = settings_of(request.engine)
    make_engine(engine)  # not in a worker, minutes later: what is not installed is said at once
    config = replace(config, slip=replace(config.slip, physics=physics, engine=engine))
    asked = {"surface_points": request.points, "rotations": request.rotations}
    candidates = replace(config.candidates, **{k: n for k, n in asked.items() if n is not None})
    config = replace(config, candidates=candidates)
    if request.cross_check:
        second = settings_of("mujoco" if request.engine == "pybullet" else "pybullet")
        make_engine(second)
        config = replace(config, second_engine=second)
    if request.sweep:
        config = replace(config, sweep=SweepConfig())
    if request.base_pose is not None:
        rows = tuple(tuple(row) for row in base_on_table(request.base_pose, scene).tolist())
        config = replace(config, reach=replace(config.reach, T_table_base=rows))
    return config


def _require_force(hand: "Hand", force_n: float) -> None:
    """Raise if a hand cannot press so hard."""
    if force_n > hand.greatest_force_n:
        raise InputError(
            f"--force {force_n:g} N is more than {hand.title} ({hand.name}) can: "
            f"{hand.least_force_n:g} to {hand.greatest_force_n:g} N. Give another force, or a "
            "hand of your own whose robot.toml says more."
        )


def run(source: Path, out: Path | None, request: SchoolRequest, console: Console) -> SchoolOutcome:
    """Try grasps on a scene and write everything that comes out of it.

    Args:
        source: a session, or a BOP scene, GraspNet scene or scene.yaml.
        out: folder for the results of a source that is no session.
        request: what is asked for.
        console: progress and notes go there.

    Raises:
        InputError: something given cannot be used, or the folder holds results of other parameters.
    """
    from realsim.store.atomic import only_run_in

    inputs = read_inputs(source, out, request, console)
    inputs.folder.mkdir(parents=True, exist_ok=True)
    config = config_of(request, inputs.scene)
    with only_run_in(inputs.folder):
        return try_grasps(inputs, config, request, console)


def run_in_session(store: SessionStore, request: SchoolRequest, console: Console) -> SchoolOutcome:
    """Try grasps on the registered objects of a session that is open and held by the caller.

    Models that came from a library bring their convex parts, mass, centre of mass and inertia; they
    are taken as long as the session's mesh is the one they were computed of. Of other models the
    School makes the parts itself, and takes the mass from the mesh and its density.

    Raises:
        InputError: as `run`.
    """
    inputs = session_inputs(store, request, console)
    return try_grasps(inputs, config_of(request, inputs.scene), request, console)


def try_grasps(
    inputs: SchoolInputs, config: "SchoolConfig", request: SchoolRequest, console: Console
) -> SchoolOutcome:
    """Run the school and write everything that comes out of it."""
    _say_arm(inputs, config, console)
    warn_of_falls(inputs, console)
    outcome = _tried(inputs, config, request, console)
    with console.stage("write", "files and pictures"):
        write_outcome(outcome)
    read = MADE_FROM if inputs.store is not None else ()
    note(
        inputs.store or inputs.folder, "school", console, request=request, config=config,
        inputs=read,
    )  # fmt: skip
    return outcome


def _say_arm(inputs: SchoolInputs, config: "SchoolConfig", console: Console) -> None:
    """Say in a line that another arm grasps than the one that held the camera."""
    captured = "" if inputs.store is None else str(inputs.store.extra.get("arm", ""))
    name = config.reach.arm.found().name
    if captured and not same_name(captured, name):
        console.say(f"arm       {name} grasps; the session was captured with {captured}")


def _tried(
    inputs: SchoolInputs, config: "SchoolConfig", request: SchoolRequest, console: Console
) -> SchoolOutcome:
    """Run the school."""
    from realsim_sim_bridge.school.school import run_school_results

    with console.stage("school", f"up to {request.grasps} grasps an object") as tick:
        results = run_school_results(
            inputs.scene, inputs.models, config, workers=request.where, cache=inputs.folder / CACHE,
            progress=tick, solids=inputs.solids, restart=request.restart,
        )  # fmt: skip
    return SchoolOutcome(
        inputs=inputs,
        sets=[r.grasp_set for r in results],
        trajectories={
            r.grasp_set.instance: r.trajectories for r in results if r.trajectories is not None
        },
        unfinished={r.grasp_set.instance: r.unfinished for r in results if r.unfinished},
    )
