"""A scene as physics engines take it: rigid bodies, where they stand, a table, gravity, cameras.

Writers of URDF, MJCF and USD take one. World is the scene's world, in metres,
kilograms and seconds. One body may stand in several places.

Meshes as Wavefront OBJ in metres, with the look that engines show: one texture, or one colour.

Engines do not read colours per vertex, so that these become a texture: every triangle gets a small
square of its own in its mean colour.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.formats.labelled_scene import WrittenScene
from realsim.geometry import se3
from realsim.geometry.mesh_shape import hull_triangles
from realsim.images.png import encode_png
from realsim.records import CameraIntrinsics, Mesh, ObjectModel
from realsim.records.checked_arrays import frozen, rigid

GRAVITY = 9.81
"""[m/s^2]."""
TRIANGLE_TOLERANCE = 1e-6
"""Moments of inertia of any body obey a + b >= c; by so much of the largest, rounding may miss."""
NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]+")
TABLE_NAME, WORLD_NAME = "table", "world"
"""Names that the files need for themselves."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RigidBody:
    """What a physics engine needs of an object, wherever it stands."""

    model: ObjectModel
    """Its id is the body's; its mesh is what is seen."""
    mass_kg: float
    center_of_mass: Array
    """(3,) in the object's frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, along the object's axes [kg m^2]."""
    friction: float
    """Coulomb coefficient against a surface of friction 1, such as the written table. Two bodies
    meet with the product of theirs in PyBullet and PhysX, with the larger in MuJoCo."""
    parts: tuple[Mesh, ...] | None = None
    """Convex parts that collide; None = the hull of the mesh does."""

    def __post_init__(self) -> None:
        """Check that there can be such a body."""
        name = f"object '{self.model.name}' ({self.model.obj_id})"
        if not (math.isfinite(self.mass_kg) and self.mass_kg > 0):
            raise InputError(f"the mass of {name} is {self.mass_kg} kg; it must be positive.")
        if not (math.isfinite(self.friction) and self.friction >= 0):
            raise InputError(f"the friction of {name} is {self.friction}; 0 or more is needed.")
        if self.parts is not None and len(self.parts) == 0:
            raise InputError(f"{name} has no convex parts; give None where its hull collides.")
        com = frozen(self.center_of_mass, np.float64, (3,), f"the centre of mass of {name}")
        inertia = frozen(self.inertia, np.float64, (3, 3), f"the inertia of {name}")
        if not (np.all(np.isfinite(com)) and np.all(np.isfinite(inertia))):
            raise InputError(f"the matter of {name} holds NaN or infinite numbers.")
        _require_inertia(inertia, name)
        object.__setattr__(self, "center_of_mass", com)
        object.__setattr__(self, "inertia", inertia)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlacedObject:
    """A body in the scene."""

    instance: int
    """Unique in the scene."""
    name: str
    """Unique in the scene: letters, digits and underscores, no digit first."""
    obj_id: int
    """Object id of its body."""
    T_world_obj: Array
    """(4, 4) [m]."""

    def __post_init__(self) -> None:
        """Check the name and that the pose is rigid."""
        if self.name != file_name(self.name):
            raise InputError(
                f"an object is called '{self.name}'; letters, digits and underscores are accepted, "
                f"such as '{file_name(self.name)}'."
            )
        object.__setattr__(self, "T_world_obj", rigid(self.T_world_obj, f"pose of '{self.name}'"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TableBox:
    """The table: a box that stands still."""

    T_world_table: Array
    """(4, 4) middle of the top face, z up out of it [m]."""
    size_m: tuple[float, float]
    """Along x and y [m]."""
    thickness_m: float
    """[m]."""

    def __post_init__(self) -> None:
        """Check the pose and the sizes."""
        object.__setattr__(self, "T_world_table", rigid(self.T_world_table, "T_world_table"))
        sizes = (*self.size_m, self.thickness_m)
        if len(sizes) != 3 or not all(math.isfinite(s) and s > 0 for s in sizes):
            raise InputError(f"the table's sizes are {sizes} m; three positive ones are needed.")

    @property
    def T_world_box(self) -> Array:
        """(4, 4) centre of the box [m]."""
        centre: Array = self.T_world_table @ se3.from_translation([0, 0, -self.thickness_m / 2])
        return centre


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneCamera:
    """A camera to look at the scene with."""

    name: str
    """As of an object."""
    intrinsics: CameraIntrinsics
    T_world_cam: Array
    """(4, 4) OpenCV axes [m]."""

    def __post_init__(self) -> None:
        """Check the name and that the pose is rigid."""
        if self.name != file_name(self.name):
            raise InputError(
                f"a camera is called '{self.name}'; letters, digits and underscores are accepted."
            )
        object.__setattr__(self, "T_world_cam", rigid(self.T_world_cam, f"pose of '{self.name}'"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlacedScene:
    """A scene that can be simulated."""

    name: str
    bodies: dict[int, RigidBody]
    """By object id."""
    objects: tuple[PlacedObject, ...]
    table: TableBox
    gravity: Array
    """(3,) acceleration in world [m/s^2]."""
    cameras: tuple[SceneCamera, ...] = ()
    notes: tuple[str, ...] = ()
    """What was assumed."""

    def __post_init__(self) -> None:
        """Check that names and instances are unique and every object has its body."""
        g = frozen(self.gravity, np.float64, (3,), "the gravity")
        if not np.all(np.isfinite(g)):
            raise InputError(f"the gravity is {g.tolist()} m/s^2; three finite numbers are needed.")
        object.__setattr__(self, "gravity", g)
        # Some file systems take Mug and mug for one name.
        names = [o.name.lower() for o in self.objects] + [c.name.lower() for c in self.cameras]
        taken = {TABLE_NAME, WORLD_NAME}
        twice = sorted({n for n in names if names.count(n) > 1 or n in taken})
        if twice:
            raise InputError(
                f"scene '{self.name}': the name '{twice[0]}' is used twice; names of objects and "
                f"cameras must differ from each other and from {TABLE_NAME} and {WORLD_NAME}."
            )
        instances = [o.instance for o in self.objects]
        if len(set(instances)) != len(instances):
            raise InputError(f"scene '{self.name}' has two objects with the same instance number.")
        for o in self.objects:
            if o.obj_id not in self.bodies:
                raise InputError(f"'{o.name}' of scene '{self.name}' has no body {o.obj_id}.")
        for obj_id, body in self.bodies.items():
            if body.model.obj_id != obj_id:
                raise InputError(f"body {obj_id} of '{self.name}' has the id {body.model.obj_id}.")

    def body(self, placed: PlacedObject) -> RigidBody:
        """Return the body of an object."""
        return self.bodies[placed.obj_id]

    @property
    def down(self) -> tuple[Array, float]:
        """The direction of gravity (3,), -z where there is none, and its size [m/s^2]."""
        strength = float(np.linalg.norm(self.gravity))
        return (self.gravity / strength if strength > 0 else np.array([0.0, 0.0, -1.0])), strength

    def body_names(self) -> dict[int, str]:
        """Return a name for the files of each body that stands somewhere, by object id."""
        used = {o.obj_id for o in self.objects}
        bodies = {i: body.model.name for i, body in self.bodies.items() if i in used}
        return unique_names(bodies)


def told(
    scene: PlacedScene, folder: Path, counts: dict[str, int], notes: Iterable[str] = ()
) -> WrittenScene:
    """Return what a writer tells of a scene that it wrote into a folder."""
    return WrittenScene(
        name=scene.name,
        folder=folder,
        frames=0,
        frames_written=0,
        objects=len(scene.objects),
        notes=(*scene.notes, *notes),
        counts=counts,
    )


def without_lens(scene: PlacedScene, format_name: str) -> list[str]:
    """Return a note where cameras are distorted, which a format cannot say."""
    lens = [c.name for c in scene.cameras if c.intrinsics.is_distorted]
    return [f"{format_name} has no place for the distortion of {', '.join(lens)}."] if lens else []


def seen_from(scene: PlacedScene, T_world_new: Array) -> PlacedScene:
    """Return the same scene in another world frame, such as the table's (z up).

    Args:
        scene: the scene.
        T_world_new: (4, 4) the new frame in the scene's world [m].
    """
    T = se3.invert(se3.check_rigid(T_world_new, "T_world_new"))
    return replace(
        scene,
        objects=tuple(replace(o, T_world_obj=T @ o.T_world_obj) for o in scene.objects),
        table=replace(scene.table, T_world_table=T @ scene.table.T_world_table),
        gravity=T[:3, :3] @ scene.gravity,
        cameras=tuple(replace(c, T_world_cam=T @ c.T_world_cam) for c in scene.cameras),
    )


# --- names --------------------------------------------------------------------------------------


def file_name(text: str) -> str:
    """Return a name of letters, digits and underscores: right in XML, in USD and as a file."""
    name = NOT_IN_NAMES.sub("_", text.strip()).strip("_") or "object"
    return f"_{name}" if name[0].isdigit() else name


def unique_names(texts: dict[int, str]) -> dict[int, str]:
    """Return different names by key; where two are equal, the key is added to both."""
    names = {k: file_name(text) for k, text in texts.items()}
    low = [n.lower() for n in names.values()]
    reserved = (TABLE_NAME, WORLD_NAME)
    found = {
        k: f"{n}_{k}" if low.count(n.lower()) > 1 or n.lower() in reserved else n
        for k, n in names.items()
    }
    low = [n.lower() for n in found.values()]
    # `can` beside `can_2`: the number that was added may make the very name of another.
    return {k: n if low.count(n.lower()) == 1 else f"object_{k}" for k, n in found.items()}


# --- inertia ------------------------------------------------------------------------------------


def principal_inertia(inertia: Array) -> tuple[Array, Array]:
    """Return the moments (3,) [kg m^2], rising, and R_obj_principal (3, 3), right-handed."""
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return moments, axes


def _require_inertia(inertia: Array, name: str) -> None:
    largest = float(np.abs(inertia).max())
    if not np.allclose(inertia, inertia.T, atol=1e-9 * largest):
        raise InputError(f"the inertia of {name} is not symmetric: {inertia.tolist()}.")
    a, b, c = np.linalg.eigvalsh(inertia).tolist()
    if not (a > 0 and a + b >= (1.0 - TRIANGLE_TOLERANCE) * c):
        raise InputError(
            f"the moments of inertia of {name} are {a:.4g}, {b:.4g}, {c:.4g} kg m^2; positive ones "
            "of which two exceed the third are what a body can have. Is it about the centre of "
            "mass, and in kg m^2?"
        )


def spaced(values: Iterable[float]) -> str:
    """Return numbers as XML's formats have them; they are read back bit for bit."""
    return " ".join(repr(float(v)) for v in values)


PLAIN_RGB = (0.7, 0.7, 0.7)
"""Colour of meshes without colours."""
TABLE_RGB = (0.72, 0.66, 0.58)
CELL_PX = 4
"""Side of a triangle's square: its middle is two pixels from the next colour, so that smoothing
does not mix them."""
VISUAL, MATERIAL, TEXTURE = "visual.obj", "visual.mtl", "texture.png"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Look:
    """What a mesh looks like, as every engine can show it."""

    corner_uv: Array | None
    """(F, 3, 2) texture coordinates of the faces' corners, v up; None = there is no texture."""
    texture: UInt8 | None
    """(H, W, 3) RGB, first row at v = 1."""


def look_of(mesh: Mesh) -> Look:
    """Return the look of a mesh."""
    if mesh.uv is not None and mesh.texture is not None:
        return Look(corner_uv=mesh.uv[mesh.faces], texture=mesh.texture)
    if mesh.colors is None:
        return Look(corner_uv=None, texture=None)
    colors = np.rint(mesh.colors[mesh.faces].mean(axis=1)).astype(np.uint8)
    side = math.ceil(math.sqrt(len(colors)))
    rows = math.ceil(len(colors) / side)
    cells = np.zeros((rows * side, 3), dtype=np.uint8)
    cells[: len(colors)] = colors
    texture = cells.reshape(rows, side, 3).repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
    row, column = np.divmod(np.arange(len(colors)), side)
    middle = np.stack([(column + 0.5) / side, 1.0 - (row + 0.5) / rows], axis=-1)
    return Look(corner_uv=np.repeat(middle[:, None], 3, axis=1), texture=texture)


def visual_files(mesh: Mesh) -> dict[str, bytes]:
    """Return the files of a mesh that is seen: OBJ [m], MTL and, where it has one, its texture."""
    look = look_of(mesh)
    files: dict[str, bytes] = {}
    r, g, b = PLAIN_RGB if look.texture is None else (1.0, 1.0, 1.0)
    material = ["newmtl surface", f"Ka {r} {g} {b}", f"Kd {r} {g} {b}", "Ks 0 0 0", "d 1"]
    if look.texture is not None:
        files[TEXTURE] = encode_png(np.ascontiguousarray(look.texture))
        material.append(f"map_Kd {TEXTURE}")
    files[MATERIAL] = _text(material)
    lines = ["# realsim: metres", f"mtllib {MATERIAL}", "o visual", *_vertices(mesh)]
    if look.corner_uv is None:
        faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    else:
        uv, index = np.unique(look.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in uv.tolist()]
        corners = np.stack([mesh.faces, index.reshape(-1, 3)], axis=-1).reshape(-1, 6) + 1
        faces = [f"f {a}/{i} {b}/{j} {c}/{k}" for a, i, b, j, c, k in corners.tolist()]
    files[VISUAL] = _text([*lines, "usemtl surface", *faces])
    return files


def part_name(k: int) -> str:
    """Return the name of a convex part."""
    return f"part_{k:03d}"


def mesh_files(home: str, mesh: Mesh, parts: Sequence[Mesh]) -> dict[str, bytes]:
    """Return the files of a body in a folder: of the mesh that is seen, and of each convex part."""
    files = {f"{home}/{name}": data for name, data in visual_files(mesh).items()}
    return files | {f"{home}/{part_name(k)}.obj": part_file(p) for k, p in enumerate(parts)}


def part_file(part: Mesh) -> bytes:
    """Return one convex part as OBJ [m]; coordinates come back bit for bit."""
    faces = [f"f {a} {b} {c}" for a, b, c in (part.faces + 1).tolist()]
    return _text(["# realsim: convex part, metres", "o part", *_vertices(part), *faces])


def _vertices(mesh: Mesh) -> list[str]:
    return [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("ascii")


# --- what collides ------------------------------------------------------------------------------


def convex_part(points: ArrayLike, name: str) -> Mesh:
    """Return the hull of points (V, 3) [m] as a mesh, its faces outward.

    Raises:
        InputError: the points are flat: engines need a volume (MuJoCo four corners and more).
    """
    from scipy.spatial import QhullError

    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    try:
        corners, faces = hull_triangles(points)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"{name} ({len(points)} points) is flat: it has no volume that could be collided with. "
            "Leave it out."
        ) from error
    return Mesh(vertices=corners, faces=faces.astype(np.int32))


def collision_parts(body: RigidBody) -> tuple[Mesh, ...]:
    """Return the convex meshes that collide for a body.

    Raises:
        InputError: the mesh is flat.
    """
    if body.parts is not None:
        return body.parts
    return (convex_part(body.model.mesh.vertices, f"the mesh of '{body.model.name}'"),)
