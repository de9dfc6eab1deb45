"""`realsim render`: from a registered session to synthetic views, their figures and pictures."""

from dataclasses import dataclass
from pathlib import Path

from realsim.app.console import Console
from realsim.app.render import compare
from realsim.app.render.request import RenderRequest, wanted_views
from realsim.app.render.scene import TwinScene, require_shown, twin_scene
from realsim.errors import InputError
from realsim.images import image_size
from realsim.records import ObjectModel, Scene
from realsim.store import SessionStore
from realsim.store.session_store import rgb_path
from realsim_sim_bridge.synthetic.claim import require_claimable
from realsim_sim_bridge.synthetic.write import SyntheticSummary, write_session

FIGURES_HEADER = ["figure", "real", "synthetic", "together"]
MOST_NAMED = 8
"""Number of views that a message names."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RenderOutcome:
    """What a run rendered."""

    store: SessionStore
    """The real session."""
    twin: SessionStore
    """The synthetic one."""
    scene: Scene
    models: dict[int, ObjectModel]
    summary: SyntheticSummary
    figures: compare.TwinFigures | None
    """Real against synthetic; None = new views."""
    look: TwinScene
    real: tuple[int, ...] | None
    """Real view of each synthetic one; None = new views."""
    sheet: Path
    """Contact sheet."""
    page: Path
    """Page with sliders."""


def run_render(session: Path, request: RenderRequest, console: Console) -> RenderOutcome:
    """Render the registered scene of a session.

    Raises:
        InputError: no registered session, an option that cannot be, photographs of another size
            than the camera's, or another run works there.
    """
    from threadpoolctl import threadpool_limits

    from realsim.app.stages import judged_scene, note, open_session, require_sound, session_models
    from realsim.rendering.overlay import save_png
    from realsim.store import load_grasps, provenance

    store = open_session(session)
    scene = judged_scene(store)
    require_sound(store)
    models = session_models(store)
    require_shown(store, scene, models)
    grasps = load_grasps(store.folder / "grasps")
    folder = request.folder(store.folder)
    _refuse_folder(folder, store.folder)
    with threadpool_limits(limits=1):
        wanted = wanted_views(store, scene, request)
        _require_sizes(store)
        with console.stage("light and table", "from the photographs"):
            look = twin_scene(store, scene, models, request)
        with console.stage("render", f"{len(wanted.Ts_world_cam)} views") as tick:
            summary = write_session(
                folder, look.synthetic, wanted.intrinsics, wanted.Ts_world_cam,
                request.config(store), request.seed, grasps, tick, request.where,
                models_from=store.folder / "models",
            )  # fmt: skip
        twin = SessionStore.open(folder)
        figures = None
        if wanted.real is not None:
            with console.stage("compare", "real and synthetic"):
                figures = compare.compare_twins(
                    store, twin, wanted.real, request.config(store).profile
                )
        twin.path("reports").mkdir(exist_ok=True)
        save_png(twin.path(compare.SHEET_FILE), compare.sheet(twin, store, wanted.real))
        outcome = RenderOutcome(
            store=store, twin=twin, scene=scene, models=models, summary=summary, figures=figures,
            look=look, real=wanted.real, sheet=twin.path(compare.SHEET_FILE),
            page=twin.path(compare.PAGE_FILE),
        )  # fmt: skip
        write_page(outcome)
    read = ("rgb/*", "registration/scene.json", "models/*", "review/journal.jsonl")
    note(
        twin, "render", console, request=request, config=request.config(store),
        inputs=provenance.inputs_of(store, read),
    )  # fmt: skip
    return outcome


def _require_sizes(store: SessionStore) -> None:
    """Raise if a photograph that is looked at is not of the camera's size.

    Raises:
        InputError: it is not; it is named.
    """
    camera = store.session.intrinsics
    for index in store.session.Ts_world_cam:
        path = store.path(rgb_path(index))
        width, height = image_size(path)
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{path} is {width}x{height} pixels, the session's camera "
                f"{camera.width}x{camera.height}: nothing rendered would lie on the picture. "
                "Calibrate at the size of the images, or bring the images back to the camera's "
                "size."
            )


def _refuse_folder(folder: Path, session: Path) -> None:
    """Raise if the views would fall on the session itself or on something that is no session.

    Raises:
        InputError: the folder is the session, a file, or holds something else.
    """
    if folder.resolve() == session.resolve():
        raise InputError(
            f"--out '{folder}' is the session itself, which is only read; choose a folder of its "
            f"own, or leave --out away: {session / 'synthetic'}/... is taken."
        )
    require_claimable(folder)


def show_render(outcome: RenderOutcome, console: Console) -> None:
    """Print what was rendered, what it cost, how like the real frames it is, and what is odd."""
    summary, rows = outcome.summary, scene_rows(outcome)
    rows[0][1] += f" ({summary.rendered} rendered now)"
    rows += [[f"{part} of a frame", f"{cpu:.2f} CPU s"] for part, cpu in summary.cpu_s.items()]
    console.table("Synthetic views", ["what", "value"], rows)
    if outcome.figures is not None:
        console.table(_figures_title(outcome.figures), FIGURES_HEADER, outcome.figures.rows())
    console.warn(*notes_of(outcome))
    console.say(f"picture   {outcome.sheet}")
    console.say(f"page      {outcome.page}")
    console.say(f"session   {outcome.twin.folder}")


def render_document(outcome: RenderOutcome) -> dict[str, object]:
    """Return what a program wants to know, for `--json`."""
    return {
        "session": outcome.twin.folder,
        "views": outcome.summary.views,
        "rendered": outcome.summary.rendered,
        "cpu_s": outcome.summary.cpu_s,
        "figures": outcome.figures,
        "notes": notes_of(outcome),
        "picture": outcome.sheet,
        "page": outcome.page,
    }


def scene_rows(outcome: RenderOutcome) -> list[list[str]]:
    """Return what was rendered, as the page has it: the same, in however many runs it was made."""
    summary, look = outcome.summary, outcome.look
    return [
        ["views", str(summary.views)],
        ["objects", str(len(summary.labels.objects))],
        ["table", str(look.synthetic.provenance["table_material"])],
        ["light", look.synthetic.environment.name],
    ]


def _figures_title(figures: compare.TwinFigures) -> str:
    return f"Real frames and their twins ({figures.views} views)"


def write_page(outcome: RenderOutcome) -> None:
    """Write the page: real against synthetic under sliders, the layers, the figures."""
    from realsim.pages import Page
    from realsim.store.atomic import write_bytes

    summary = outcome.summary
    about = f"{len(summary.empty_views)} views without any object, "
    about += f"{len(summary.left_out)} objects left out"
    page = Page(title=f"Synthetic views of {outcome.store.session.name}", about=about)
    for note in notes_of(outcome):
        page.text(note, "note")
    if outcome.real is not None:
        page.section("Real and synthetic")
        page.sliders(compare.pairs(outcome.store, outcome.twin, outcome.real))
    page.section("Synthetic views")
    page.layers(compare.layers(outcome.twin))
    if outcome.figures is not None:
        page.section(_figures_title(outcome.figures))
        page.table(FIGURES_HEADER, outcome.figures.rows())
    page.section("The run")
    page.table(["what", "value"], scene_rows(outcome))
    write_bytes(outcome.page, page.encode())


def notes_of(outcome: RenderOutcome) -> list[str]:
    """Return what the user must know: objects and views that are not as they should be."""
    notes = [*outcome.look.notes, *outcome.summary.notes]
    for instance in outcome.summary.left_out:
        placed = outcome.scene.object(instance)
        model = outcome.models.get(placed.obj_id)
        name = f"object {placed.obj_id}" if model is None else model.name
        notes.append(f"{name} (instance {instance}) is rejected and was left out.")
    for view, instances in outcome.summary.camera_inside.items():
        names = ", ".join(outcome.models[outcome.scene.object(i).obj_id].name for i in instances)
        notes.append(
            f"the camera of view {view} stands inside of {names}: the view shows inner walls. It "
            "is written, and named in synthetic/scene.json."
        )
    empty = outcome.summary.empty_views
    if empty:
        which = ", ".join(map(str, empty[:MOST_NAMED]))
        which += ", ..." if len(empty) > MOST_NAMED else ""
        notes.append(f"{len(empty)} views show no object: {which}.")
    return notes
