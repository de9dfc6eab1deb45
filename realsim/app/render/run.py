"""`realsim render`: from a registered session to synthetic views, their figures and pictures.

The registered scene of a session as one that can be rendered: table, light and looks.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.app.render import compare
from realsim.app.render.light import ObservedLook, matched_look, neutral_environment, upright
from realsim.app.render.request import RenderRequest, wanted_views
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import slab_mesh
from realsim.images import image_size
from realsim.records import ObjectModel, Scene
from realsim.rendering.appearance import Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore
from realsim.store.session_store import rgb_path
from realsim_sim_bridge.synthetic.claim import require_claimable
from realsim_sim_bridge.synthetic.scene import SyntheticScene
from realsim_sim_bridge.synthetic.write import SyntheticSummary, write_session

TABLE_M = 4.0
"""Edge of the rendered table [m]: the label transfer's, larger than what any view sees."""
TABLE_THICKNESS_M = 0.02
TABLE_STREAM = 11
"""Stream of chance of the table's material, apart from those of the frames."""
LOWEST_TABLE_M = 0.002
"""How far under the fitted plane the table may be put [m]: the label transfer's clearance."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TwinScene:
    """A session's scene, ready to be rendered, and how its look came about."""

    synthetic: SyntheticScene
    look: ObservedLook | None
    """What the photographs said of light and table; None = nothing was asked of them."""
    notes: tuple[str, ...]


def require_shown(store: SessionStore, scene: Scene, models: dict[int, ObjectModel]) -> None:
    """Raise if there is nothing to render.

    Raises:
        InputError: no object is left to be shown, or one has no model.
    """
    shown = [o for o in scene.objects if o.verdict != "rejected"]
    if not shown:
        raise InputError(
            f"session '{store.folder}' has no object that is not rejected; there is nothing to "
            f"render. Look at the registration: `realsim review {store.folder}`."
        )
    missing = sorted({o.obj_id for o in shown} - set(models))
    if missing:
        raise InputError(
            f"session '{store.folder}' shows objects {missing} without a model; put them into "
            f"{store.folder / 'models'}."
        )


def twin_scene(
    store: SessionStore, scene: Scene, models: dict[int, ObjectModel], request: RenderRequest
) -> TwinScene:
    """Return the registered scene of a session, lit and painted as its photographs look.

    Raises:
        InputError: an unknown material was asked for, or a panorama is none.
    """
    notes: list[str] = []
    top_m = 0.0
    surroundings: tuple[PlacedMesh, ...] = ()
    given = table_material(request)
    if scene.plane is None:
        notes.append("the session has no supporting plane: the objects are rendered in mid-air.")
    else:
        top_m = table_top_m(scene, models)
        T_world_top = scene.plane.T_world_table @ se3.from_translation([0.0, 0.0, top_m])
        scene = replace(scene, plane=replace(scene.plane, T_world_table=T_world_top))
        material = given or Material(roughness=0.6, name="as photographed")
        slab = slab_mesh(TABLE_M, TABLE_THICKNESS_M)
        surroundings = (PlacedMesh(BACKGROUND, slab, T_world_top, material),)
    environment = neutral_environment()
    if request.hdri is not None:
        from realsim.rendering.procedural.hdri import read_environment

        environment = read_environment(request.hdri, notes=notes)
    if scene.plane is not None:
        environment = upright(environment, scene.plane.T_world_table[:3, 2])
    provenance: dict[str, Any] = {
        "session": store.session.name,
        "registered": True,
        "table_below_plane_m": -top_m,
        "table_material": "photographs" if given is None else given.name,
        "environment": "photographs" if request.hdri is None else request.hdri.name,
    }
    synthetic = SyntheticScene(
        name=f"{store.session.name}, synthetic",
        scene=scene,
        models=models,
        environment=environment,
        surroundings=surroundings,
        provenance=provenance,
    )
    look = matched_look(store, synthetic, keeps_table=given is not None,
                        keeps_hue=request.hdri is not None)  # fmt: skip
    if look is None:
        notes.append("no photograph shows the objects: light and table are left neutral.")
        return TwinScene(synthetic=synthetic, look=None, notes=tuple(notes))
    if look.paints:
        names = sorted({models[scene.object(i).obj_id].name for i in look.paints})
        notes.append(
            f"models without colours ({', '.join(names)}) are painted in the mean colour that the "
            "photographs show of them."
        )
    if not look.has_colors:
        notes.append("no model has colours: only the brightness of the light was matched.")
    synthetic = replace(
        synthetic, environment=look.environment, materials=look.paints,
        surroundings=tuple(
            PlacedMesh(p.instance, p.mesh, p.T_world_obj, look.table) for p in surroundings
        ),
    )  # fmt: skip
    return TwinScene(synthetic=synthetic, look=look, notes=tuple(notes))


def table_top_m(scene: Scene, models: dict[int, ObjectModel]) -> float:
    """Return the height of the rendered table over the fitted plane [m], 0 or less.

    Plane and poses are off by fractions of a millimetre; the table is lowered to the deepest vertex
    so that no object sinks in, but no further than the label transfer does.
    """
    if scene.plane is None:
        return 0.0
    T_table_world = se3.invert(scene.plane.T_world_table)
    shown = [o for o in scene.objects if o.verdict != "rejected"]
    lowest = [
        se3.transform(T_table_world @ o.T_world_obj, models[o.obj_id].mesh.vertices)[:, 2].min()
        for o in shown
    ]
    return float(np.clip(min(lowest), -LOWEST_TABLE_M, 0.0))


def table_material(request: RenderRequest) -> Material | None:
    """Return the material that was asked for; None = that of the photographs.

    Raises:
        InputError: not table=KIND, or an unknown kind.
    """
    if not request.materials:
        return None
    from realsim.rendering.procedural.choose import KINDS, random_material

    *others, asked = request.materials
    if others:
        raise InputError("--material is given once, as table=KIND: only the table can be chosen.")
    what, mark, kind = asked.partition("=")
    if what != "table" or not mark or kind not in KINDS:
        raise InputError(
            f"--material '{asked}' is not known; table=KIND is expected, where KIND "
            f"is one of: {', '.join(KINDS)}. Without it the table is as in the photographs."
        )
    return random_material(np.random.default_rng([request.seed, TABLE_STREAM]), kind)


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

    from realsim.app.annotate.current import grasps_of_scene
    from realsim.app.stages import judged_scene, note, open_session, require_sound, session_models
    from realsim.rendering.overlay import save_png
    from realsim.store import load_grasps, provenance

    store = open_session(session)
    scene = judged_scene(store)
    require_sound(store)
    models = session_models(store)
    require_shown(store, scene, models)
    grasps = grasps_of_scene(store, scene, load_grasps(store), console)
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
