"""The sampler of the sim branch: a table, objects of the pool at random sizes, dropped on it.

Scene k of a seed depends on the seed, on k, on the pool and on the settings: not on which other
scenes are made, by how many processes, or in which order. Each purpose has a generator of its own.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.models.mesh_topology import open_edges
from realsim.models.model_records import KnownSolid
from realsim.models.properties import physical_properties
from realsim.records import ObjectModel
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.drop import Resting, drop
from realsim_sim_bridge.table_scenes.pool import ObjectPool, PoolObject, read_object
from realsim_sim_bridge.table_scenes.table_shapes import table, table_names
from realsim_sim_bridge.table_scenes.tables import TableModel

# --- What a scene is made of: table, objects, sizes and poses, as it is kept in the scene's folder


LAYOUT_FORMAT = 1


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LaidObject:
    """An object of a pool that lies in a scene."""

    source: int
    """Number of the pool's source."""
    key: str
    """Which object of it."""
    name: str
    scale: float
    """Metres per unit of the mesh's numbers."""
    size_m: float
    """Its largest extent [m]."""
    T_table_obj: Array
    """(4, 4) [m]."""
    open_edges: int = 0
    """Edges with one face only: its surface is not closed, so that its volume is not known."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """A scene's table, and what came to rest on it."""

    number: int
    """Number of the scene."""
    seed: int
    table: str
    """Kind of the table; its sizes follow from seed and number."""
    side_m: float
    """Longer side of the table [m]."""
    objects: tuple[LaidObject, ...]
    drawn: int
    """How many objects were wanted."""
    tried: int
    """How many were let go."""
    fell: tuple[str, ...] = ()
    """Names of those that left the table."""
    overhung: tuple[str, ...] = ()
    """Names of those that came to rest over the rim, and were taken off."""
    restless: tuple[str, ...] = ()
    """Names of those that did not come to rest, and were taken off."""
    skipped: tuple[str, ...] = ()
    """Meshes that could not be used, and why, a sentence each."""
    figures: dict[str, float] = field(default_factory=dict[str, float])
    """moved_mm and penetration_mm of the final state, simulated_s."""


def layout_to_json(layout: Layout) -> dict[str, Any]:
    """Return plain JSON values; poses come back bit for bit."""
    value = asdict(layout)
    value["objects"] = [o | {"T_table_obj": o["T_table_obj"].tolist()} for o in value["objects"]]
    return {"format": LAYOUT_FORMAT} | value


def layout_from_json(value: dict[str, Any], where: str) -> Layout:
    """Return a layout.

    Raises:
        InputError: it is of another format, or incomplete.
    """
    if value.get("format") != LAYOUT_FORMAT:
        raise InputError(
            f"{where} has the format {value.get('format')!r}; {LAYOUT_FORMAT} is known. Delete it: "
            "the scene is laid out again from its seed."
        )
    try:
        objects = tuple(
            LaidObject(**(row | {"T_table_obj": np.array(row["T_table_obj"], dtype=np.float64)}))
            for row in value["objects"]
        )
        rest = {k: v for k, v in value.items() if k not in ("format", "objects")}
        for name in ("fell", "overhung", "restless", "skipped"):
            rest[name] = tuple(rest[name])
        return Layout(objects=objects, **rest)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where} is damaged ({error}). Delete it: the scene is laid out again from its seed."
        ) from error


Purpose = Literal["table", "objects", "fall", "looks", "cameras", "noise"]
PURPOSES: tuple[Purpose, ...] = ("table", "objects", "fall", "looks", "cameras", "noise")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SizedObject:
    """An object of the pool at the size it has in a scene."""

    source: int
    key: str
    name: str
    scale: float
    model: ObjectModel
    solid: KnownSolid

    @property
    def body(self) -> SlipBody:
        """What the engine needs of it."""
        return SlipBody.of(self.solid.parts, self.solid.matter)


def generator(seed: int, scene: int, purpose: Purpose) -> np.random.Generator:
    """Return the random numbers of one purpose in one scene."""
    return np.random.default_rng([seed, scene, PURPOSES.index(purpose)])


def scene_table(
    seed: int, scene: int, config: TableSceneConfig
) -> tuple[TableModel, np.random.Generator]:
    """Return the table of a scene, and the generator, which goes on with the room."""
    rng = generator(seed, scene, "table")
    names = config.tables or table_names()
    return table(names[int(rng.integers(len(names)))], rng), rng


def sized(
    found: PoolObject, scale: float, obj_id: int, density: float, *, centred: bool = True
) -> tuple[ObjectModel, KnownSolid]:
    """Return model and solid of a pool's object at a size.

    Args:
        found: in its file's numbers.
        scale: metres per number.
        obj_id: of the model in its scene.
        density: [kg/m^3].
        centred: whether the origin is moved to the middle of the box (files of CAD programs may
            have it metres away).

    Raises:
        InputError: the mesh is flat.
    """
    origin = found.middle if centred else np.zeros(3)
    old = found.mesh
    mesh = replace(old, vertices=scale * (old.vertices - origin))
    moved = tuple(scale * (part - origin) for part in found.parts.parts)
    parts = replace(found.parts, parts=moved)
    symmetries = found.symmetries.copy()
    for S in symmetries:
        S[:3, 3] = scale * (S[:3, 3] - origin + S[:3, :3] @ origin)
    axes = tuple(
        (axis, _three(scale * (np.array(point) - origin))) for axis, point in found.symmetry_axes
    )
    model = ObjectModel(
        obj_id=obj_id, name=found.name, mesh=mesh, symmetries=symmetries, symmetry_axes=axes,
        density=density,
    )  # fmt: skip
    matter = physical_properties(mesh, density=density, parts=parts)
    return model, KnownSolid(parts=parts, matter=matter)


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


class ObjectDraw:
    """Objects of a pool, drawn one after the other at random sizes; what is broken is skipped."""

    def __init__(
        self,
        pool: ObjectPool,
        config: TableSceneConfig,
        side_m: float,
        rng: np.random.Generator,
        cache: Path | None,
    ) -> None:
        """Take over the generator; see `next`."""
        self.pool, self.config, self.side_m, self.cache = pool, config, side_m, cache
        self.drawn: list[SizedObject] = []
        self.skipped: list[str] = []
        self._rng = rng
        self._used: set[tuple[int, str]] = set()
        self._refused: set[tuple[int, str]] = set()

    def next(self, number: int) -> SlipBody:
        """Return the body of the next object; it is kept in `drawn` under its number.

        No object comes twice before all have come once.

        Raises:
            InputError: too many meshes in a row cannot be used; the last reasons are named.
        """
        failures: list[str] = []
        size = float(self._rng.uniform(*self.config.sizes)) * self.side_m
        while len(failures) < self.config.pool.tries:
            source, key = self._draw()
            try:
                found = read_object(self.pool.sources[source], key, self.config.pool, self.cache)
                scale = size / float(np.max(found.mesh.extent))
                keep = self.config.pool.keep_size
                model, solid = sized(
                    found, 1.0 if keep else scale, number + 1,
                    found.density if keep and found.density else self.config.density,
                    centred=not keep,
                )  # fmt: skip
            except (InputError, DegenerateError) as error:
                failures.append(str(error))
                self._refused.add((source, key))
                if len(self._refused) >= len(self.pool):
                    break
                continue
            self.skipped += failures
            self.drawn.append(
                SizedObject(
                    source=source,
                    key=key,
                    name=found.name,
                    scale=1.0 if keep else scale,
                    model=model,
                    solid=solid,
                )
            )
            return self.drawn[-1].body
        raise InputError(
            f"{len(failures)} meshes of the pool {self._labels()} in a row cannot be used. The "
            f"last: {' | '.join(failures[-3:])} Name another pool, or mend these files."
        )

    def _draw(self) -> tuple[int, str]:
        if len(self._used) >= len(self.pool):
            self._used = set(self._refused)
        while True:
            drawn = self.pool.draw(self._rng)
            if drawn not in self._used:
                self._used.add(drawn)
                return drawn
            source = self.pool.sources[drawn[0]]
            if all((drawn[0], k) in self._used for k in source.keys):
                # A small source that is weighted may repeat; broken ones are not tried again.
                self._used -= {(drawn[0], k) for k in source.keys} - self._refused
                if all((drawn[0], k) in self._refused for k in source.keys):
                    raise InputError(
                        f"none of the {len(source.keys)} meshes of the pool '{source.label}' can "
                        f"be used. {' | '.join(self.skipped[-3:])} Leave this pool away, or mend "
                        "its files."
                    )

    def _labels(self) -> str:
        return ", ".join(f"'{s.label}'" for s in self.pool.sources)


def sample_layout(
    seed: int, scene: int, pool: ObjectPool, config: TableSceneConfig, cache: Path | None = None
) -> Layout:
    """Return scene `scene` of a seed: drawn, dropped, at rest.

    Args:
        seed: of the data set.
        scene: number of the scene, from 0.
        pool: where objects come from.
        config: how many, how large, how they fall.
        cache: folder for convex parts of meshes.

    Raises:
        InputError: the pool has nothing that can be used, or nothing stays on the table.
    """
    model, _ = scene_table(seed, scene, config)
    rng = generator(seed, scene, "objects")
    wanted = int(rng.integers(config.objects[0], config.objects[1] + 1))
    side = float(np.max(model.size_m))
    objects = ObjectDraw(pool, config, side, rng, cache)
    fall = generator(seed, scene, "fall")
    rest = drop(model, (config.objects[0], wanted), objects.next, config.drop, fall)
    if not rest.Ts_table_obj:
        raise InputError(
            f"scene {scene}: none of the {len(objects.drawn)} objects that were dropped stayed on "
            f"the table '{model.name}'. Are they too large (--object-sizes) or all balls?"
        )
    return _layout(seed, scene, wanted, model, objects, rest)


def _layout(
    seed: int, scene: int, wanted: int, model: TableModel, objects: ObjectDraw, rest: Resting
) -> Layout:
    def names(numbers: tuple[int, ...]) -> tuple[str, ...]:
        return tuple(objects.drawn[k].name for k in numbers)

    laid = tuple(
        LaidObject(
            source=objects.drawn[k].source, key=objects.drawn[k].key, name=objects.drawn[k].name,
            scale=objects.drawn[k].scale,
            size_m=float(np.max(objects.drawn[k].model.mesh.extent)),
            T_table_obj=se3.check_rigid(T, "a pose of PyBullet"),
            open_edges=open_edges(objects.drawn[k].model.mesh),
        )
        for k, T in sorted(rest.Ts_table_obj.items())
    )  # fmt: skip
    return Layout(
        number=scene, seed=seed, table=model.name, side_m=float(np.max(model.size_m)),
        objects=laid, drawn=wanted, tried=len(objects.drawn), fell=names(rest.fell),
        overhung=names(rest.overhung), restless=names(rest.restless),
        skipped=tuple(objects.skipped),
        figures={
            "moved_mm": 1e3 * rest.moved_m,
            "penetration_mm": 1e3 * rest.penetration_m,
            "simulated_s": rest.simulated_s,
        },
    )  # fmt: skip
