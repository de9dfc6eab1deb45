"""The registered scene of a session as one that can be rendered: table, light and looks."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.app.render.light import ObservedLook, matched_look, neutral_environment, upright
from realsim.app.render.request import RenderRequest
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import slab_mesh
from realsim.records import ObjectModel, Scene
from realsim.rendering.appearance import Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore
from realsim_sim_bridge.synthetic.scene import SyntheticScene

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
