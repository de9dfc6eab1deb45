"""The chain of turning joints in a URDF, and the shapes of its links."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.robot_files import PACKAGE, RobotFolder
from realsim.untrusted.xml_tree import read_xml

TURNING = ("revolute", "continuous")
MOST_TURNS_RAD = 4 * np.pi
"""A joint that turns farther than two turns each way has its limits in degrees."""


class UrdfShape(NamedTuple):
    """A collision or visual shape of a URDF."""

    kind: str
    """box, cylinder, sphere, capsule or mesh."""
    size_m: tuple[float, ...]
    """As `Shape.size_m`; of a mesh its scale."""
    T_link_shape: Array
    """(4, 4), in the frame of the moving link that it is fixed to [m]."""
    file: Path | None
    """A mesh's."""
    link: str
    """Name of the link that it stands under."""
    points: Array | None = None
    """(P, 3) of a mesh that was read already [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UrdfChain:
    """Joints from a base link to a flange link."""

    joint_names: tuple[str, ...]
    steps: Array
    """(n + 1, 4, 4) from the base to the first joint's frame, z its axis, and so on; the last from
    the last joint to the flange [m]."""
    lower: Array
    """(n,) [rad]; infinite of a continuous joint."""
    upper: Array
    speed: Array
    """(n,) [rad/s]; NaN where none is given."""
    torque: Array
    """(n,) [N m]; NaN where none is given."""
    collision: tuple[tuple[UrdfShape, ...], ...]
    """(n + 1) of the base and each moving link, in its joint's frame."""
    visual: tuple[tuple[UrdfShape, ...], ...]
    mass_kg: float
    """Mass of base and links together; 0 = not given."""


def R_from_rpy(rpy: ArrayLike) -> Array:
    """Return the rotation (3, 3) of roll, pitch, yaw (3,) [rad] about fixed axes x, y, z."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    x, y, z = (
        se3.exp_so3(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    )
    product: Array = z @ y @ x
    return product


def origin_of(element: Element, where: str) -> Array:
    """Return the transform (4, 4) of an element's <origin>; without one it is the identity."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz = floats(origin.get("xyz", "0 0 0"), (3,), f"the xyz of an origin of {where}")
    rpy = floats(origin.get("rpy", "0 0 0"), (3,), f"the rpy of an origin of {where}")
    return se3.from_rt(R_from_rpy(rpy), xyz)


def floats(text: str, counts: tuple[int, ...], name: str) -> Array:
    """Return the finite numbers of an attribute.

    Raises:
        InputError: other than as many finite numbers as one of the counts.
    """
    try:
        values = np.array([float(word) for word in text.split()], dtype=np.float64)
    except ValueError:
        values = np.full(1, np.nan)
    if len(values) not in counts or not np.all(np.isfinite(values)):
        wanted = " or ".join(map(str, counts))
        raise InputError(f"{name} is '{text[:60]}'; {wanted} finite numbers are expected.")
    return values


def sizes(shape: Element, key: str, count: int, where: str) -> Array:
    """Return the positive lengths (count,) [m] of a shape's attribute."""
    values = floats(shape.get(key, ""), (count,), f"the {key} of a {shape.tag} of {where}")
    if not np.all((values > 0) & (values < 1e3)):
        raise InputError(f"{where} has a {shape.tag} of {values.tolist()} m; positive ones are.")
    return values


def mimicked(mimic: Element, joint: str, names: Collection[str], path: Path) -> str:
    """Return the joint of a file that another one follows by its <mimic>.

    Raises:
        InputError: it is none of them.
    """
    asked = mimic.get("joint", "")
    if asked not in names:
        raise InputError(
            f"{path}: the joint '{joint[:60]}' mimics '{asked[:60]}', which is no "
            f"joint of this file. Its joints: {', '.join(sorted(names))}."
        )
    return asked


def read_chain(folder: RobotFolder, file: str, base: str, flange: str) -> UrdfChain:
    """Return the chain between two links of a URDF.

    Args:
        folder: the robot's.
        file: as `robot.toml` names the URDF.
        base: link that the robot is bolted down with.
        flange: link that tools are bolted to, z out of it.

    Raises:
        InputError: no URDF, no such links, no chain between them, a joint that does not turn, a
            mimic joint, limits in degrees, a mesh that is not there.
    """
    path = folder.file(file, "the URDF")
    root = read_xml(path, namespaces=False)
    if root.tag != "robot":
        raise InputError(f"{path} begins with <{root.tag[:60]}>; a URDF begins with <robot>.")
    return _Reader(folder, path, root).chain(base, flange)


class _Reader:
    def __init__(self, folder: RobotFolder, path: Path, root: Element) -> None:
        self._folder, self._path = folder, path
        self._links = {e.get("name", ""): e for e in root.findall("link")}
        self._joints = root.findall("joint")
        self._above: dict[str, Element] = {}
        for joint in self._joints:
            child = self._end(joint, "child")
            if child in self._above:
                raise InputError(
                    f"{path}: the link '{child[:60]}' hangs on two joints, "
                    f"'{self._above[child].get('name', '')[:60]}' and "
                    f"'{joint.get('name', '')[:60]}'; links form a tree."
                )
            self._above[child] = joint
        self._check_mimics()

    def _check_mimics(self) -> None:
        names = {j.get("name", "") for j in self._joints}
        for joint in self._joints:
            if (mimic := joint.find("mimic")) is not None:
                mimicked(mimic, joint.get("name", ""), names, self._path)

    def _end(self, joint: Element, end: str) -> str:
        element = joint.find(end)
        link = "" if element is None else element.get("link", "")
        if link not in self._links:
            raise InputError(
                f"{self._path}: the joint '{joint.get('name', '')[:60]}' has the {end} "
                f"'{link[:60]}', which is no link of this file."
            )
        return link

    def chain(self, base: str, flange: str) -> UrdfChain:
        for role, name in (("base", base), ("flange", flange)):
            if name not in self._links:
                raise InputError(
                    f"{self._path} has no link '{name[:60]}', which {self._folder.path} names as "
                    f"the {role}. Its links: {', '.join(sorted(self._links))[:600]}."
                )
        joints: list[Element] = []
        link = flange
        while link != base:
            joint = self._above.get(link)
            if joint is None or len(joints) > len(self._joints):
                raise InputError(
                    f"{self._path}: no joints lead from the base '{base}' to the flange '{flange}'."
                )
            joints.insert(0, joint)
            link = self._end(joint, "parent")
        return self._of(base, flange, joints)

    def _of(self, base: str, flange: str, joints: list[Element]) -> UrdfChain:
        steps: list[Array] = []
        names: list[str] = []
        rows: list[Array] = []
        bodies: list[list[tuple[str, Array]]] = [[(base, np.eye(4))]]
        T, R_axis = np.eye(4), np.eye(4)
        for joint in joints:
            where = f"the joint '{joint.get('name', '')[:60]}' of {self._path}"
            T = T @ origin_of(joint, where)
            if joint.get("type") in TURNING and joint.find("mimic") is not None:
                raise InputError(
                    f"{where} follows another joint (<mimic>); an arm's joints are driven one by "
                    "one. Such a linkage has no chain that can be planned."
                )
            if joint.get("type") in TURNING:
                R_axis = onto_z(_axis(joint, where))
                steps.append(T @ R_axis)
                names.append(joint.get("name", ""))
                rows.append(_limits(joint, where))
                # The link's frame in the joint's frame whose z is the axis.
                T = se3.invert(R_axis)
                bodies.append([])
            elif joint.get("type") != "fixed":
                raise InputError(
                    f"{where} is of the type '{str(joint.get('type'))[:40]}'; an arm's joints from "
                    f"'{base}' to '{flange}' are revolute, continuous or fixed."
                )
            bodies[-1].append((self._end(joint, "child"), T))
        steps.append(T)
        if not rows:
            raise InputError(f"{self._path}: no joint turns between '{base}' and '{flange}'.")
        lower, upper, speed, torque = np.stack(rows, axis=1)
        frames = [self._with_fixed(body, flange) for body in bodies]
        return UrdfChain(
            joint_names=tuple(names), steps=np.stack(steps), lower=lower, upper=upper,
            speed=speed, torque=torque,
            collision=tuple(self._shapes(body, "collision") for body in frames),
            visual=tuple(self._shapes(body, "visual") for body in frames),
            mass_kg=sum(self._mass(link) for body in frames for link, _ in body),
        )  # fmt: skip

    def _with_fixed(self, body: list[tuple[str, Array]], flange: str) -> list[tuple[str, Array]]:
        """Return a body's links with all that hangs on them by fixed joints, the tool left out."""
        seen, todo = dict(body), list(body)
        while todo:
            parent, T = todo.pop()
            if parent == flange:
                continue
            for joint in self._joints:
                child = self._end(joint, "child")
                if joint.get("type") == "fixed" and child not in seen:
                    if self._end(joint, "parent") != parent:
                        continue
                    seen[child] = T @ origin_of(joint, f"a joint of {self._path}")
                    todo.append((child, seen[child]))
        return list(seen.items())

    def _shapes(self, body: list[tuple[str, Array]], tag: str) -> tuple[UrdfShape, ...]:
        return tuple(
            self._shape(element, link, T)
            for link, T in body
            for element in self._links[link].findall(tag)
        )

    def _shape(self, element: Element, link: str, T_joint_link: Array) -> UrdfShape:
        where = f"the link '{link}' of {self._path}"
        geometry = element.find("geometry")
        shapes = [] if geometry is None else list(geometry)
        if len(shapes) != 1:
            raise InputError(f"{where}: a <{element.tag}> has {len(shapes)} shapes; one is needed.")
        shape, T = shapes[0], T_joint_link @ origin_of(element, where)
        if shape.tag == "mesh":
            scale = floats(shape.get("scale", "1 1 1"), (3,), f"the scale of a mesh of {where}")
            file = self._mesh(shape.get("filename", ""), where)
            return UrdfShape("mesh", tuple(scale.tolist()), T, file, link)
        keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"),
                "capsule": ("radius", "length")}.get(shape.tag)  # fmt: skip
        if keys is None:
            raise InputError(
                f"{where} has a <{shape.tag[:40]}>; mesh, box, cylinder, capsule and sphere are "
                "read."
            )
        counts = [3 if key == "size" else 1 for key in keys]
        numbers = [sizes(shape, key, n, where) for key, n in zip(keys, counts, strict=True)]
        return UrdfShape(shape.tag, tuple(np.concatenate(numbers).tolist()), T, None, link)

    def _mesh(self, named: str, where: str) -> Path:
        """Return a mesh's file: beside the URDF, or of a ROS package in whose folder it stands."""
        rest = named.removeprefix(PACKAGE)
        tries = [self._path.parent / rest]
        if rest != named:
            package, _, inside = rest.partition("/")
            tries += [p.parent / rest for p in self._path.parents if p.name == package]
            tries += [self._path.parent / inside, self._folder.path / inside]
        for found in tries:
            if found.is_file():
                return found
        raise InputError(
            f"{where} names the mesh '{named[:200]}', which is not there. Looked for: "
            f"{', '.join(str(t) for t in dict.fromkeys(tries))}. Put it there, or correct the URDF."
        )

    def _mass(self, link: str) -> float:
        element = self._links[link].find("inertial/mass")
        if element is None:
            return 0.0
        value = element.get("value", "")
        return float(floats(value, (1,), f"the mass of the link '{link}' of {self._path}")[0])


def _axis(joint: Element, where: str) -> Array:
    element = joint.find("axis")
    text = "1 0 0" if element is None else element.get("xyz", "1 0 0")
    axis = floats(text, (3,), f"the axis of {where}")
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        raise InputError(f"{where} has the axis {axis.tolist()}; a direction is needed.")
    return axis / length


def onto_z(axis: Array) -> Array:
    """Return a turn (4, 4) whose z is an axis (3,) of length 1, x and y as near as can be."""
    normal = np.cross([0.0, 0.0, 1.0], axis)
    sine = float(np.linalg.norm(normal))
    if sine < 1e-12:
        return np.eye(4) if axis[2] > 0 else np.diag([1.0, -1.0, -1.0, 1.0])
    angle = float(np.arctan2(sine, axis[2]))
    return se3.from_rt(se3.exp_so3(normal / sine * angle), np.zeros(3))


def _limits(joint: Element, where: str) -> Array:
    """Return lower, upper, speed and torque (4,) of a joint."""
    limit = joint.find("limit")
    values: list[float] = []
    for key in ("lower", "upper", "velocity", "effort"):
        text = None if limit is None else limit.get(key)
        if text is None:
            values.append(np.nan)
        else:
            values.append(float(floats(text, (1,), f"the limit '{key}' of {where}")[0]))
    if joint.get("type") == "continuous":
        values[:2] = [-np.inf, np.inf]
    elif not np.all(np.isfinite(values[:2])):
        raise InputError(f"{where} has no <limit lower= upper=>; a revolute joint needs both.")
    elif max(abs(values[0]), abs(values[1])) > MOST_TURNS_RAD:
        raise InputError(
            f"{where} has the limits {values[0]:g} to {values[1]:g} rad. Are these degrees? A URDF "
            f"holds radians: {np.radians(values[0]):.4f} to {np.radians(values[1]):.4f}."
        )
    elif values[0] > values[1]:
        raise InputError(
            f"{where} has the limits lower={values[0]:g} and upper={values[1]:g}; lower must be "
            "below upper. Are they swapped?"
        )
    return np.array(values)
