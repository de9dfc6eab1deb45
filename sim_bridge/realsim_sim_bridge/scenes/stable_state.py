"""What becomes of a scene when physics starts: who stands, jumps, falls, floats, sits in another.

Poses come from images and are off by millimetres; an object that starts inside the table is thrown
out by the engine, one above it drops. Nothing is damped: what moves here moves in the school, too.

A picture of what physics did to a scene: outlines before and after, from above and the side.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array, Int32, Mask
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.geometry.mesh import welded_mesh
from realsim.pages.plots import png
from realsim.records import Mesh
from realsim_sim_bridge.scenes.school_scene import SchoolScene
from realsim_sim_bridge.scenes.table_world import TABLE, TableWorld

Standing = Literal["stands", "jumps", "falls", "inside another", "floats"]


# When an object is said to stand, and how long it is watched.
LONGEST_S = 3.0
"""Simulated time at most [s]: a fall from 20 cm takes 0.2, rocking dies within 2."""
SHORTEST_S = 0.5
"""Time at least [s]: what stands on its edge takes a while to begin to fall."""
REST_S = 0.25
"""Rest has to last so long [s]: a body is slow at the top of its bounce, too."""
REST_M_S = 0.002
"""Centres of mass slower than this rest [m/s]: 0.5 mm in the time above."""
REST_RAD_S = 0.02
"""Greatest turning speed of an object at rest [rad/s]."""
STANDS_M = 0.002
"""What moved no more still stands where it did [m]: poses are not known better."""
STANDS_DEG = 2.0
"""What turned no more still stands as it did [deg]."""
JUMP_WINDOW_S = 0.05
"""How long after the start a speed counts as a jump [s]: free fall is left out of it."""
JUMP_M_S = 0.1
"""Upward or sideways speed of a jump [m/s]: it lifts a body by 0.5 mm."""
SUNK_M = 0.0005
"""Penetration from which a speed is put down to it [m]; resting contacts have 0.01 mm."""
INSIDE_M = 0.003
"""Penetration from which an object is inside another [m]: more than two poses' errors."""
FLOAT_M = 0.002
"""Distance to everything from which an object floats [m]."""
FELL_OVER_DEG = 30.0
"""What turned more has fallen over [deg]."""
REACH_M = 0.1
"""Distances are looked for up to this [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectStand:
    """What became of one object."""

    instance: int
    name: str
    verdict: Standing
    sentence: str
    """What happened, with figures."""
    moved_m: float
    """Motion of the centre of mass [m]."""
    turned_deg: float
    jump_m_s: float
    """Largest upward and sideways speed in the first moments [m/s]."""
    gap_m: float
    """Distance to the nearest thing before the start [m]; negative = penetration, inf = far."""
    into: dict[str, float]
    """Name of what it penetrates before the start -> how deep [m]."""
    at_rest: bool
    """Whether it rested in the end."""
    T_world_before: Array
    T_world_after: Array
    """(4, 4) object in world, before and after [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StandReport:
    """What became of a scene."""

    objects: tuple[ObjectStand, ...]
    inside: tuple[tuple[str, str, float], ...]
    """Pairs of which one is inside the other, and how deep [m]; the deepest first."""
    simulated_s: float
    notes: tuple[str, ...]
    """Shapes that cannot be trusted: parts too large, meshes without volume."""
    settings: dict[str, float] = field(default_factory=dict[str, float])
    """Settings of the engine, read back."""

    @property
    def stable(self) -> bool:
        """Whether every object stands."""
        return all(o.verdict == "stands" for o in self.objects)


HEADERS = ("object", "verdict", "moved [mm]", "turned [deg]", "jump [m/s]", "sunk [mm]", "what")


def stand_rows(report: StandReport) -> list[tuple[str, ...]]:
    """Return a row for each object, by `HEADERS`."""
    return [
        (
            o.name,
            o.verdict,
            f"{1e3 * o.moved_m:.1f}",
            f"{o.turned_deg:.1f}",
            f"{o.jump_m_s:.2f}",
            f"{1e3 * max(o.into.values(), default=0.0):.1f}",
            "" if o.verdict == "stands" else o.sentence,
        )
        for o in report.objects
    ]


def stable_state(world: TableWorld) -> StandReport:
    """Let physics run until everything rests, or the time is over, and say what happened.

    Args:
        world: as it was built; it is in its final state afterwards.

    Raises:
        RealsimError: the engine's numbers are no longer finite.
    """
    distances = _distances(world, REACH_M)
    instances = list(world.bodies)
    before, centers = {i: world.pose(i) for i in instances}, world.centers()
    jump, seconds, resting = _run(world)
    moved = np.linalg.norm(world.centers() - centers, axis=1)
    if not np.all(np.isfinite(moved)):
        raise RealsimError(
            "PyBullet's positions are no longer finite: the physics exploded. Are masses or sizes "
            "of the objects extreme?"
        )
    assert world.scene.scene.plane is not None
    T_world_table = world.scene.scene.plane.T_world_table
    stands: list[ObjectStand] = []
    for k, i in enumerate(instances):
        after = world.pose(i)
        near = distances[i]
        stand = ObjectStand(
            instance=i,
            name=world.names[world.bodies[i]],
            verdict="stands",
            sentence="",
            moved_m=float(moved[k]),
            turned_deg=float(np.degrees(se3.angle(se3.invert(before[i]) @ after))),
            jump_m_s=float(jump[k]),
            gap_m=min(near.values(), default=float("inf")),
            into={n: -d for n, d in near.items() if d < -SUNK_M},
            at_rest=bool(resting[k]),
            T_world_before=T_world_table @ before[i],
            T_world_after=T_world_table @ after,
        )
        verdict, sentence = _judged(stand, float(world.centers()[k, 2]), seconds)
        stands.append(replace(stand, verdict=verdict, sentence=sentence))
    return StandReport(
        objects=tuple(stands),
        inside=_pairs(stands),
        simulated_s=seconds,
        notes=tuple(world.notes),
        settings=world.settings(),
    )


def _distances(world: TableWorld, reach_m: float) -> dict[int, dict[str, float]]:
    """Return each object's distances to what is near, by instance and name [m]."""
    found: dict[int, dict[str, float]] = {i: {} for i in world.bodies}
    bodies = list(world.bodies.items())
    for k, (i, body) in enumerate(bodies):
        for other in world.statics:
            found[i][world.names[other]] = world.distance(body, other, reach_m)
        for j, other in bodies[:k]:
            d = world.distance(body, other, reach_m)
            found[i][world.names[other]] = found[j][world.names[body]] = d
    return found


def _run(world: TableWorld) -> tuple[Array, float, Mask]:
    """Return every object's jump [m/s], the simulated time [s], and whether it rests."""
    jump = np.zeros(len(world.bodies))
    resting = np.zeros(len(world.bodies), dtype=np.bool_)
    quiet = seconds = 0.0
    for n in range(1, round(LONGEST_S / world.dt) + 1):
        world.step()
        seconds = n * world.dt
        twists = world.twists()
        if seconds <= JUMP_WINDOW_S:
            v = twists[:, 3:].copy()
            v[:, 2] = np.maximum(v[:, 2], 0.0)
            jump = np.maximum(jump, np.linalg.norm(v, axis=1))
        slow = np.linalg.norm(twists[:, 3:], axis=1) < REST_M_S
        resting = slow & (np.linalg.norm(twists[:, :3], axis=1) < REST_RAD_S)
        quiet = quiet + world.dt if resting.all() else 0.0
        if seconds >= SHORTEST_S and quiet >= REST_S:
            break
    return jump, seconds, resting


def _judged(o: ObjectStand, height_m: float, seconds: float) -> tuple[Standing, str]:
    """Return the verdict and the sentence."""
    deepest = max(o.into, key=lambda name: o.into[name], default="")
    depth_mm = 1e3 * o.into.get(deepest, 0.0)
    others = {n: d for n, d in o.into.items() if n != TABLE and d > INSIDE_M}
    travel = f"moved by {1e3 * o.moved_m:.1f} mm and turned by {o.turned_deg:.1f} deg"
    end = "" if o.at_rest else f"; after {seconds:.1f} s it still moves"
    if others:
        listed = ", ".join(f"{n} ({1e3 * d:.1f} mm)" for n, d in others.items())
        return "inside another", f"it is inside {listed}; {travel}{end}."
    if o.into and o.jump_m_s > JUMP_M_S:
        return "jumps", (
            f"it starts {depth_mm:.1f} mm inside {deepest} and is thrown out at {o.jump_m_s:.2f} "
            f"m/s; {travel}{end}."
        )
    if o.gap_m > FLOAT_M:
        above = f"{1e3 * o.gap_m:.1f}" if np.isfinite(o.gap_m) else f"over {1e3 * REACH_M:g}"
        return "floats", f"it hangs {above} mm from everything and drops; {travel}{end}."
    if o.moved_m <= STANDS_M and o.turned_deg <= STANDS_DEG:
        return "stands", f"{travel}{end}."
    if height_m < 0:
        how = "it fell off the table"
    else:
        fell_over = o.turned_deg > FELL_OVER_DEG
        how = f"it {'fell over' if fell_over else 'does not stay where it is'}: {travel}"
    return "falls", f"{how}{end}."


def _pairs(stands: list[ObjectStand]) -> tuple[tuple[str, str, float], ...]:
    """Return the pairs that are inside one another, each once; the table is no partner."""
    found: dict[tuple[str, str], float] = {}
    for o in stands:
        for name, depth in o.into.items():
            if name != TABLE and depth > INSIDE_M and (name, o.name) not in found:
                found[o.name, name] = depth
    deepest_first = sorted(found.items(), key=lambda item: -item[1])
    return tuple((a, b, depth) for (a, b), depth in deepest_first)


COLORS: dict[Standing, str] = {
    "stands": "#5b7f95",
    "jumps": "#d1495b",
    "falls": "#e07a1f",
    "inside another": "#8e44ad",
    "floats": "#2a9d8f",
}
VIEWS = (("from above", 0, 1, 2), ("from the side", 0, 2, 1))
"""Title, the axes drawn to the right and upwards, and the axis looked along."""
MOST_FACES = 8_000
"""Most faces of a mesh that is drawn; a picture of 1600 pixels shows no more."""


def stand_picture(scene: SchoolScene, report: StandReport) -> bytes:
    """Return a PNG: dashed grey before, filled and coloured by verdict after, arrows for the way.

    Table's frame, millimetres.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 12), dpi=110, layout="constrained")
    meshes = {i: _light(m.mesh) for i, m in scene.models.items()}
    axes: Any = figure.subplots(len(VIEWS), 1, sharex=True)
    for ax, (title, right, up, along) in zip(axes, VIEWS, strict=True):
        for o, stand in zip(scene.scene.objects, report.objects, strict=True):
            _draw(ax, scene, meshes[o.obj_id], stand, (right, up, along))
        ax.set_title(title)
        ax.set_xlabel(f"{'xyz'[right]} of the table [mm]")
        ax.set_ylabel(f"{'xyz'[up]} of the table [mm]")
        ax.set_aspect("equal")
        ax.autoscale_view()
        if up == 2:
            ax.axhline(0.0, color="#333333", linewidth=1.2)
        ax.grid(alpha=0.2)
    _legend(figure, report)
    # Without Matplotlib's version and a date the same scene gives the same bytes; by this name the
    # command knows a picture of its own, which it may replace.
    return png(figure, "realsim settle")


def _light(mesh: Mesh) -> Mesh:
    """Return the bare surface, thinned out where it is fine."""
    from realsim.models.simplify import simplified

    return simplified(welded_mesh(mesh), MOST_FACES)


def _draw(
    ax: Any, scene: SchoolScene, mesh: Mesh, stand: ObjectStand, axes: tuple[int, int, int]
) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patheffects import withStroke

    right, up, along = axes
    color, is_moved = COLORS[stand.verdict], stand.verdict != "stands"
    before, after = (
        1e3 * se3.transform(scene.T_table_world @ T, mesh.vertices)
        for T in (stand.T_world_before, stand.T_world_after)
    )
    flat: Any = after[mesh.faces][:, :, [right, up]]
    ax.add_collection(PolyCollection(flat, facecolors=color, edgecolors="none", alpha=0.25))
    lines = outline(after, mesh.faces, along)[:, :, [right, up]]
    ax.add_collection(LineCollection(list(lines), colors=color, linewidths=0.8))
    if is_moved:
        lines = outline(before, mesh.faces, along)[:, :, [right, up]]
        ax.add_collection(
            LineCollection(list(lines), colors="#777777", linewidths=0.6, linestyles="dashed")
        )
    start, end = before.mean(axis=0)[[right, up]], after.mean(axis=0)[[right, up]]
    if is_moved and np.linalg.norm(end - start) > 1.0:
        arrow = {"arrowstyle": "->", "color": color, "lw": 2.0}
        ax.annotate("", xy=end, xytext=start, arrowprops=arrow, zorder=4)
    words = ax.annotate(
        stand.name, xy=end, color=color, ha="center", va="bottom", fontsize=8, zorder=5
    )
    words.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def outline(vertices: Array, faces: Int32, along: int) -> Array:
    """Return the edges (E, 2, 3) between a face towards the viewer and one away, and open edges."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    towards = np.cross(b - a, c - a)[:, along] > 0
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    facing = np.tile(towards, 3).astype(np.int64)
    key = edges.min(axis=1) * len(vertices) + edges.max(axis=1)
    unique, index, counts = np.unique(key, return_inverse=True, return_counts=True)
    seen = np.bincount(index, weights=facing, minlength=len(unique))
    chosen = (counts == 1) | ((seen > 0) & (seen < counts))
    return vertices[np.stack([unique[chosen] // len(vertices), unique[chosen] % len(vertices)], 1)]


def _legend(figure: Any, report: StandReport) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(color=color, label=f"{verdict} ({n})", alpha=0.6)
        for verdict, color in COLORS.items()
        if (n := sum(o.verdict == verdict for o in report.objects))
    ]
    handles.append(Line2D([], [], color="#777777", linestyle="dashed", label="before"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    worst = [o for o in report.objects if o.verdict != "stands"]
    title = "every object stands" if not worst else f"{len(worst)} of {len(report.objects)} move"
    figure.suptitle(f"{title} when physics runs for {report.simulated_s:.1f} s")
