"""What stands on the table: meshes, known objects, their poses, the supporting plane, the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from realsim.arrays import Array, Int32, UInt8
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.checked_arrays import freeze, frozen, numbered, rigid
from realsim.untrusted.own_json import Real

Verdict = Literal["accepted", "doubtful", "rejected", "unchecked"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """A triangle mesh in metres, with colours per vertex or a texture."""

    vertices: Array
    """(V, 3) [m]."""
    faces: Int32
    """(F, 3) vertex numbers, counter-clockwise seen from outside."""
    colors: UInt8 | None = None
    """(V, 3) RGB per vertex."""
    uv: Array | None = None
    """(V, 2) texture coordinates, v up (OBJ's convention)."""
    texture: UInt8 | None = None
    """(H, W, 3) RGB texture, first row at v = 1."""

    def __post_init__(self) -> None:
        """Check indices and freeze the arrays."""
        v = frozen(self.vertices, np.float64, (None, 3), "mesh vertices")
        f = frozen(self.faces, np.int32, (None, 3), "mesh faces")
        if len(v) == 0 or len(f) == 0:
            raise InputError(f"the mesh is empty ({len(v)} vertices, {len(f)} faces).")
        if not np.all(np.isfinite(v)):
            raise InputError("the mesh has vertices that are not finite numbers.")
        if f.min() < 0 or f.max() >= len(v):
            raise InputError(f"the mesh's faces name vertex {f.max()} of {len(v)}.")
        object.__setattr__(self, "vertices", v)
        object.__setattr__(self, "faces", f)
        freeze(self, np.uint8, colors=(len(v), 3), texture=(None, None, 3))
        freeze(self, uv=(len(v), 2))

    @property
    def bounds(self) -> Array:
        """(2, 3) least and greatest corner [m]."""
        # By columns: over rows of three, NumPy takes twenty times as long.
        return np.array([[f(column) for column in self.vertices.T] for f in (np.min, np.max)])

    @property
    def extent(self) -> Array:
        """(3,) size of the axis-aligned box [m]."""
        return np.subtract(*self.bounds[::-1])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectModel:
    """A known object: its mesh at metric scale, its symmetries and its matter."""

    obj_id: int
    """BOP object id, 1 or more."""
    name: str
    mesh: Mesh
    symmetries: Array = field(default_factory=lambda: np.eye(4)[None])
    """(S, 4, 4) discrete symmetries T_obj_obj, the identity first."""
    symmetry_axes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """Continuous symmetries: (axis, point on it [m])."""
    density: float = 1000.0
    """[kg/m^3]; the paper's value for every object."""

    def __post_init__(self) -> None:
        """Check the id, the symmetries and the density."""
        if self.obj_id < 1:
            raise InputError(f"object '{self.name}' has the id {self.obj_id}; BOP ids start at 1.")
        if not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"object '{self.name}' has the density {self.density} kg/m^3.")
        S = se3.check_rigid(np.atleast_3d(self.symmetries), f"symmetries of '{self.name}'")
        object.__setattr__(self, "symmetries", frozen(S, np.float64, (None, 4, 4), "symmetries"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectPose:
    """Where one instance of an object is, how sure that is, and what was checked."""

    obj_id: int
    instance: int
    """Number of this instance in the scene, 0 or more; unique in the scene."""
    T_world_obj: Array
    """(4, 4) object in world [m]."""
    covariance: Array | None = None
    """(6, 6) of the right perturbation, rotation first [rad, m]."""
    checks: dict[str, Real] = field(default_factory=dict[str, Real])
    """Named checks without ground truth, e.g. agree (share of pixels that agree with the depth)."""
    verdict: Verdict = "unchecked"
    reasons: tuple[str, ...] = ()
    """Why the verdict is not 'accepted'."""

    def __post_init__(self) -> None:
        """Check that the pose is rigid and freeze the arrays."""
        numbered(self.obj_id, "obj_id")
        numbered(self.instance, f"the instance of object {self.obj_id}")
        if self.verdict not in (known := get_args(Verdict)):
            raise InputError(f"the verdict is {self.verdict!r}; {', '.join(known)} are accepted.")
        name = f"T_world_obj of object {self.obj_id} (instance {self.instance})"
        object.__setattr__(self, "T_world_obj", rigid(self.T_world_obj, name))
        freeze(self, covariance=(6, 6))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SupportPlane:
    """The plane the objects stand on; frame `table`: origin on the plane, z up out of it."""

    T_world_table: Array
    """(4, 4) table in world [m]."""
    rms_m: Real = 0.0
    """RMS distance of the points that carry the plane [m]."""
    inliers: int = 0
    """How many points carry it."""

    def __post_init__(self) -> None:
        """Check that the frame is rigid and freeze it."""
        object.__setattr__(self, "T_world_table", rigid(self.T_world_table, "T_world_table"))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scene:
    """A registered scene: objects on a support plane."""

    name: str
    objects: tuple[ObjectPose, ...]
    plane: SupportPlane | None = None

    def __post_init__(self) -> None:
        """Check that the instances are unique."""
        instances = [o.instance for o in self.objects]
        if len(set(instances)) != len(instances):
            raise InputError(f"scene '{self.name}' has two objects with the same instance number.")

    def object(self, instance: int) -> ObjectPose:
        """Return the object with this instance number.

        Raises:
            InputError: there is none.
        """
        for o in self.objects:
            if o.instance == instance:
                return o
        raise InputError(
            f"instance {instance} is not in scene '{self.name}'; it has "
            f"{', '.join(str(o.instance) for o in self.objects) or 'no objects'}."
        )


def names_of(models: Sequence[ObjectModel]) -> str:
    """Return the models as 'name (id)' for an error message."""
    return ", ".join(f"{m.name} ({m.obj_id})" for m in models) or "none"
