"""`realsim demonstrations`: attempts of the school as a LeRobot data set with pictures."""

import hashlib
import itertools
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console, shortened
from realsim.app.outputs import require_outside
from realsim.app.school.files import stored_grasps
from realsim.app.school.inputs import CACHE, SchoolInputs, SchoolRequest, is_session, weighed
from realsim.arrays import evenly
from realsim.errors import InputError
from realsim.formats.export_folder import STATE, ExportFolder
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.lerobot.episodes import INFO, NOTES
from realsim.formats.lerobot.spool import EncodedEpisode, encoded, import_av
from realsim.geometry import se3
from realsim.many import Outcome, PoolConfig, Sent, Task, at_most, open_pool, run_many
from realsim.models.model_records import KnownSolid
from realsim.records import Scene
from realsim.untrusted.own_json import read_object

if TYPE_CHECKING:
    from realsim.formats.lerobot.writer import Take
    from realsim_sim_bridge.demonstrations.front_view import FrontView
    from realsim_sim_bridge.demonstrations.lerobot_episodes import LeRobotDemonstrations
    from realsim_sim_bridge.demonstrations.records import DemonstrationCamera
    from realsim_sim_bridge.demonstrations.source import DemonstrationSource

TASKS = ("grasp", "place")
OUTCOMES = ("all", "success", "failure")
PAGE = "demonstrations.html"


@dataclass(frozen=True, kw_only=True, slots=True)
class DemonstrationRequest:
    """What the user asked for."""

    fps: int = 20
    """Steps per second."""
    task: str = "grasp"
    """'grasp', or 'place': the object is put somewhere, which the task says in words."""
    outcome: str = "all"
    """'all', 'success' or 'failure' of the grasp."""
    grasps: tuple[str, ...] = ()
    """INSTANCE:GRASP each; () = every attempt."""
    limit: int | None = None
    """Attempts at most, spread over all that are left; None = all."""
    width: int = 320
    height: int = 240
    """Height of the pictures [px]."""
    view: int | None = None
    """View of the session that the fixed camera stands at; None = beside the table."""
    hand_eye: bool = False
    """Whether the hand's camera is mounted as the session's hand-eye calibration says."""
    depth: bool = False
    """Whether depth is written beside the pictures."""
    masses: tuple[str, ...] = ()
    """NAME=KG, as the school was told; the density it was told is kept with the grasps."""
    episodes_per_file: int = 50
    name: str = ""
    licence: str = ""
    models_licence: str = ""
    attribution: str = ""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: one that cannot be; its option is named.
        """
        if self.task not in TASKS:
            raise InputError(f"--task '{self.task}' is unknown; there are {', '.join(TASKS)}.")
        if self.outcome not in OUTCOMES:
            raise InputError(
                f"--outcome '{self.outcome}' is unknown; there are {', '.join(OUTCOMES)}."
            )
        for option, value in (("width", self.width), ("height", self.height)):
            if value % 2 or not 16 <= value <= 4096:
                raise InputError(
                    f"a {option} of {value} px cannot be: a video takes even numbers, here from "
                    "16 to 4096."
                )
        if self.limit is not None and self.limit < 1:
            raise InputError(f"--limit {self.limit} leaves nothing; 1 or more is accepted.")


@dataclass(frozen=True, kw_only=True, slots=True)
class DemonstrationsResult:
    """What was written."""

    folder: Path
    page: Path
    written: WrittenScene
    successes: int
    not_attempted: int
    """Grasps that there is no attempt of."""


def open_source(
    source: Path, request: DemonstrationRequest, console: Console
) -> "DemonstrationSource":
    """Return the attempts of a session, or of a folder of the school's results.

    Raises:
        InputError: no results there, or they cannot be replayed.
    """
    from realsim_sim_bridge.demonstrations.place_source import PlacingSource
    from realsim_sim_bridge.demonstrations.records import DemonstrationConfig
    from realsim_sim_bridge.demonstrations.source import DemonstrationSource

    grasps, models = stored_grasps(source)
    solids: Mapping[int, KnownSolid] = {}
    models_folder = source / "models"
    if models_folder.is_dir():
        from realsim.models.library_session import known_solids

        solids = known_solids(models_folder, [s.obj_id for s in grasps.sets])[0]
    given = SchoolInputs(
        scene=Scene(name=grasps.name, objects=()), models=dict(models), solids=dict(solids),
        folder=source, store=None,
    )  # fmt: skip
    if request.masses:
        given = _weighed(given, grasps, request)
    kind = PlacingSource if request.task == "place" else DemonstrationSource
    return kind(
        grasps,
        given.models,
        DemonstrationConfig(rate_hz=request.fps),
        cameras=_cameras(source, grasps, request, console),
        solids=given.solids,
        cache=source / CACHE,
    )


def _weighed(
    given: SchoolInputs, grasps: SceneGrasps, request: DemonstrationRequest
) -> SchoolInputs:
    """Return the objects with the masses that the school was told."""
    from realsim.records import ObjectPose

    objects = tuple(
        ObjectPose(obj_id=s.obj_id, instance=s.instance, T_world_obj=np.eye(4)) for s in grasps.sets
    )
    asked = SchoolRequest(masses=request.masses)
    return weighed(replace(given, scene=Scene(name=grasps.name, objects=objects)), asked)


def _cameras(
    source: Path, grasps: SceneGrasps, request: DemonstrationRequest, console: Console
) -> "list[DemonstrationCamera | FrontView]":
    """Return a fixed camera and one in the hand.

    Raises:
        InputError: a view or a calibration is asked for that there is not.
    """
    from realsim_sim_bridge.demonstrations.front_view import (
        FRONT,
        FrontView,
        sees_fingertips,
        view_camera,
        wrist_camera,
    )
    from realsim_sim_bridge.demonstrations.school_settings import school_config_of

    size = request.width, request.height
    if (request.view is not None or request.hand_eye) and not is_session(source):
        raise InputError(
            f"'{source}' is no session, so that it has neither views nor a hand-eye calibration; "
            "leave --view and --hand-eye away."
        )
    fixed: DemonstrationCamera | FrontView = FrontView(size_px=size)
    if request.view is not None:
        intrinsics, T_world_cam = _view(source, request.view)
        assert grasps.T_world_table is not None, "a session's school has had a table"
        T_table_cam = se3.invert(grasps.T_world_table) @ T_world_cam
        fixed = view_camera(FRONT, intrinsics, T_table_cam, request.width)
    hand = school_config_of(grasps.sets[0]).hand
    wrist = wrist_camera(None, size, hand)
    if request.hand_eye:
        from realsim.app.stages import open_session
        from realsim.store import load_hand_eye

        store = open_session(source)
        if not store.has("calibration/hand_eye.json"):
            raise InputError(
                f"session '{source}' has no hand-eye calibration; leave --hand-eye away."
            )
        wrist = wrist_camera(load_hand_eye(store).T_ee_cam, size, hand)
        if not sees_fingertips(wrist):
            console.warn(
                "mounted on the arm's flange as the session's hand-eye calibration says, the "
                "hand's camera does not see its fingertips: the session's robot or tool frame is "
                "another one. Without --hand-eye it is on the usual mount."
            )
    return [fixed, wrist]


def _view(source: Path, index: int) -> tuple[Any, Any]:
    """Return intrinsics and T_world_cam of a view of the session."""
    from realsim.app.stages import open_session

    store = open_session(source)
    views = store.session.views
    if not 0 <= index < len(views):
        raise InputError(
            f"--view {index} is not among the {len(views)} views of session '{source}'."
        )
    T_world_cam = views[index].T_world_cam
    if T_world_cam is None:
        raise InputError(f"it is not known where view {index} of '{source}' was taken from.")
    return store.session.intrinsics, T_world_cam


def chosen_attempts(source: "DemonstrationSource", request: DemonstrationRequest) -> list[int]:
    """Return the numbers of the attempts that are asked for.

    Raises:
        InputError: a grasp that there is no attempt of is asked for, or nothing is left.
    """
    numbers = list(range(len(source)))
    if request.grasps:
        numbers = [source.number_of(*_named(text)) for text in dict.fromkeys(request.grasps)]
    if request.outcome != "all":
        wanted = request.outcome == "success"
        numbers = [k for k in numbers if source.succeeded(k) is wanted]
    if not numbers:
        raise InputError(
            f"no attempt is a {request.outcome} among the {len(source)} that there are; ask for "
            "--outcome all."
        )
    return numbers if request.limit is None else evenly(numbers, request.limit)


def _named(text: str) -> tuple[int, int]:
    """Return instance and grasp of INSTANCE:GRASP."""
    instance, mark, grasp = text.partition(":")
    if not (mark and instance.isdecimal() and grasp.isdecimal()):
        raise InputError(f"--grasp '{text}' is none; INSTANCE:GRASP is expected, such as 0:12.")
    return int(instance), int(grasp)


def export_demonstrations(
    source: Path,
    out: Path,
    request: DemonstrationRequest,
    console: Console,
    where: PoolConfig | None = None,
) -> DemonstrationsResult:
    """Write attempts of the school as a LeRobot v3.0 data set with a page and a card.

    Args:
        source: a session, or a folder of the school's results.
        out: a new or empty folder, or one that the same request has begun to fill.
        request: which attempts, seen from where.
        console: progress and notes go there.
        where: processes that render and encode; None = this one alone. All give the same bytes.

    Raises:
        InputError: something given cannot be used, PyAV is missing, or `out` holds something else.
    """
    from realsim.app.check.checksums import require_as_written
    from realsim.app.demonstrations.page import demonstrations_card, page_file
    from realsim.app.export.card import CARD_FILE
    from realsim.formats.lerobot.writer import write_lerobot
    from realsim.store.atomic import only_run_in

    import_av()
    require_outside(out, [source])
    attempts, episodes = _episodes(source, request, console)
    asked = _asked(source, attempts, request)
    if ExportFolder.is_finished(out, asked):
        require_as_written(out, console)
        shutil.rmtree(out / STATE, ignore_errors=True)  # left by a run that ended just there
        frames = int(read_object(out / INFO)["total_frames"])
        written = WrittenScene(
            name=episodes.name, folder=out, frames=frames, frames_written=0, objects=frames,
            counts={"episodes": len(episodes), "tasks": len(episodes.tasks)},
        )  # fmt: skip
        return _result(out, attempts, written)
    folder = ExportFolder.begin(out, asked)
    if folder.resumed:
        console.say(f"going on with the demonstrations in {out}.")
    with only_run_in(out):
        done = itertools.count(1)
        with console.stage("demonstrations", f"{len(episodes)} attempts") as tick:
            pool = where or PoolConfig(workers=1)
            encode = partial(_encode, source, request, episodes, pool, console)
            written = write_lerobot(
                episodes, folder, episodes_per_file=request.episodes_per_file,
                progress=lambda: tick(next(done), len(episodes)), encode=encode,
            )  # fmt: skip
        with console.stage("page"):
            folder.write_piece("page", page_file(folder.folder, attempts.config.rate_hz, PAGE))
        result = _result(out, attempts, written)
        names = {m.obj_id: m.name for m in attempts.scenery.models.values()}
        card = demonstrations_card(request, written, names, result.successes, out)
        from realsim.app.stages import made_of
        from realsim.store import provenance

        record, run = made_of(
            "demonstrations", console, request=asdict(request) | {"source": source},
            config=attempts.config,
            inputs={f"{provenance.GIVEN}source": provenance.sha256_of(source)},
        )  # fmt: skip
        folder.finish({CARD_FILE: card, provenance.FOLDER_FILE: provenance.record_bytes(record)})
        provenance.write(out, record, run)
    return result


def _result(
    out: Path, attempts: "DemonstrationSource", written: WrittenScene
) -> DemonstrationsResult:
    """Return what is there when all is written."""
    notes = (out / NOTES).read_text().splitlines()
    return DemonstrationsResult(
        folder=out, page=out / PAGE, written=written,
        successes=sum(bool(json.loads(line)["success"]) for line in notes),
        not_attempted=len(attempts.not_attempted),
    )  # fmt: skip


def _episodes(
    source: Path, request: DemonstrationRequest, console: Console
) -> "tuple[DemonstrationSource, LeRobotDemonstrations]":
    """Return the attempts, and those that are asked for as episodes."""
    from realsim_sim_bridge.demonstrations.lerobot_episodes import LeRobotDemonstrations

    attempts = open_source(source, request, console)
    chosen = chosen_attempts(attempts, request)
    name = source.resolve().name
    return attempts, LeRobotDemonstrations(attempts, name, chosen, depth=request.depth)


def _encode(
    source: Path, request: DemonstrationRequest, episodes: "LeRobotDemonstrations",
    where: PoolConfig, console: Console, numbers: "Sequence[int]", take: "Take",
) -> None:  # fmt: skip
    """Hand each episode of these numbers on as it ends; say after the first what all cost.

    They are rendered and encoded by this process, or by others that open the source again.
    """
    costs: list[float] = []

    def cost(cpu_s: float) -> None:
        costs.append(cpu_s)
        if len(costs) == 1 and len(numbers) > 1:
            minutes = cpu_s * (len(numbers) - 1) / 60.0
            console.say(
                f"the first of {len(numbers)} attempts took {cpu_s:.1f} CPU s; the others "
                f"will take about {minutes:.1f} CPU min."
            )

    where = at_most(where, len(numbers))
    if where.workers == 1 and not where.address:
        for k in numbers:
            begun = time.process_time()
            episode = encoded(episodes, k)
            cost(time.process_time() - begun)
            take(k, episode)
        return

    def done(outcome: Outcome) -> None:
        k, episode, cpu_s = outcome.found()
        cost(cpu_s)
        take(k, episode)

    sent = Sent(source)
    tasks = (Task(name=f"attempt {k}", fn=_encoded, args=(sent, request, k)) for k in numbers)
    with open_pool(where) as pool:
        run_many(tasks, pool, done)


def _encoded(
    source: Path, request: DemonstrationRequest, k: int
) -> "tuple[int, EncodedEpisode, float]":
    """Return an episode's number, the episode encoded, and what it took [CPU s]."""
    begun = time.process_time()
    episode = encoded(_opened(source, request), k)
    return k, episode, time.process_time() - begun


@lru_cache(maxsize=1)
def _opened(source: Path, request: DemonstrationRequest) -> "LeRobotDemonstrations":
    """Return the episodes of a source; a worker opens it once."""
    return _episodes(source, request, Console(quiet=True))[1]


def _asked(
    source: Path, attempts: "DemonstrationSource", request: DemonstrationRequest
) -> dict[str, Any]:
    """Return what a data set is told by: the request, and the very grasps."""
    digest = hashlib.sha256()
    for k, name in enumerate(attempts.attempts):
        digest.update(attempts.goal(k).language.encode())
        digest.update(np.ascontiguousarray(attempts.stored_joints(name)).tobytes())
    for camera in attempts.scenery.cameras.values():
        # All episodes are seen from the same place, whichever version goes on with them.
        digest.update(np.round(camera.T_frame_cam, 6).tobytes())
    return {
        "what": "demonstrations",
        "source": source.resolve().name,
        "attempts": digest.hexdigest(),
        "request": asdict(request),
    }


def show_demonstrations(result: DemonstrationsResult, console: Console) -> None:
    """Print what was written."""
    w = result.written
    console.table(
        f"demonstrations in {result.folder}",
        ("from", "attempts", "successful", "steps", "steps written now", "tasks"),
        [[w.name, w.counts["episodes"], result.successes, w.frames, w.frames_written,
          w.counts["tasks"]]],
    )  # fmt: skip
    if result.not_attempted:
        console.say(
            f"{result.not_attempted} of the session's grasps have no attempt: the arm does not get "
            "there."
        )
    console.warn(*shortened(w.notes, 10, "and {} more notes, in realsim/episodes.jsonl."))
    console.say(f"page      {result.page}")
