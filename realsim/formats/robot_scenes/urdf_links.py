"""The links of a URDF: where they are, their shapes and their matter.

Rigid things are read: links without joints between them but fixed and floating ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.robot_scenes.mesh_reading import colliding, scene_mesh
from realsim.geometry.mesh import mass_properties, merged, transformed
from realsim.records import Mesh
from realsim.robots.urdf import floats, origin_of, sizes
from realsim.untrusted.xml_tree import read_xml

MOST_LINKS = 10_000
ROUND_SIDES = 48
"""Sides of a cylinder that is made a mesh."""
MADE_UP_DENSITY = 1000.0
"""[kg/m^3] of a link without matter."""
Movement = Literal["root", "fixed", "floating"]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LinkMatter:
    """What a link weighs."""

    mass_kg: float
    center_of_mass: Array
    """(3,) in the link's frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, along the link's axes [kg m^2]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Link:
    """A link with a shape."""

    name: str
    T_root_link: Array
    """(4, 4), joints at zero [m]."""
    movement: Movement
    """How it hangs on the root: 'floating' if one of the joints between is."""
    visual: Mesh
    """In the link's frame [m]; of a link that is not seen, what collides."""
    parts: tuple[Mesh, ...]
    """Convex; none = nothing collides."""
    matter: LinkMatter
    friction: float | None
    """None: the file does not tell."""
    box: tuple[Array, Array] | None
    """(T_link_box, (3,) size [m]) where the only thing that collides is a box."""


def read_links(path: Path, folder: Path, notes: list[str]) -> tuple[str, list[Link]]:
    """Return the robot's name and the links that have a shape, in the order of the file.

    Args:
        path: a URDF.
        folder: which no mesh may lead out of; names are relative to the URDF's folder.
        notes: what was assumed is added.

    Raises:
        InputError: damaged, a mesh missing or outside, or joints that move otherwise.
        UnitError: a mesh whose size contradicts its unit.
    """
    root = read_xml(path)
    if root.tag != "robot":
        raise InputError(f"{path} begins with <{root.tag[:60]}>; a URDF begins with <robot>.")
    elements = root.findall("link")
    names = [_name(e, f"a link of {path}") for e in elements]
    if not 0 < len(names) <= MOST_LINKS or len(set(names)) < len(names):
        raise InputError(
            f"{path} has {len(names)} links with {len(set(names))} names; 1 to {MOST_LINKS} with "
            "names of their own are expected."
        )
    poses = _poses(root, names, path)
    reader = _LinkReader(path, folder, notes)
    found = [
        reader.link(e, n, *poses[n])
        for e, n in zip(elements, names, strict=True)
        if e.find("visual") is not None or e.find("collision") is not None
    ]
    return root.get("name", path.stem), found


def _poses(root: Element, names: list[str], path: Path) -> dict[str, tuple[Array, Movement]]:
    """Return T_root_link and how each link hangs on the root."""
    above: dict[str, tuple[str, str, Array]] = {}
    for joint in root.findall("joint"):
        where = f"the joint '{joint.get('name', '')[:60]}' of {path}"
        ends: list[str] = []
        for end in ("parent", "child"):
            element = joint.find(end)
            link = "" if element is None else element.get("link", "")
            if link not in names:
                raise InputError(f"{where} has the {end} '{link[:60]}', which is no link.")
            ends.append(link)
        kind = joint.get("type", "")
        if kind not in ("fixed", "floating"):
            raise InputError(
                f"{where} is of the type '{kind[:40]}'; scenes of rigid things are read, whose "
                "joints are fixed or floating."
            )
        if ends[1] in above:
            raise InputError(f"{path}: the link '{ends[1]}' hangs on two joints.")
        above[ends[1]] = (ends[0], kind, origin_of(joint, where))
    return {n: _pose(n, above, path) for n in names}


def _pose(
    name: str, above: Mapping[str, tuple[str, str, Array]], path: Path
) -> tuple[Array, Movement]:
    T: Array = np.eye(4)
    kinds: list[str] = []
    while name in above:
        name, kind, T_parent_child = above[name]
        T, kinds = T_parent_child @ T, [*kinds, kind]
        if len(kinds) > len(above):
            raise InputError(f"{path}: the joints of the link '{name}' go in a circle.")
    if kinds.count("floating") > 1 or ("floating" in kinds and kinds[0] != "floating"):
        raise InputError(
            f"{path} hangs links on a floating link ('{name}' is the root); single bodies are read."
        )
    if not kinds:
        return T, "root"
    return T, "floating" if "floating" in kinds else "fixed"


class _LinkReader:
    """Reads the links of one file."""

    def __init__(self, path: Path, folder: Path, notes: list[str]) -> None:
        self._path, self._folder, self._notes = path, folder, notes

    def link(self, element: Element, name: str, T: Array, movement: Movement) -> Link:
        where = f"the link '{name}' of {self._path}"
        seen = [self._shape(e, where) for e in element.findall("visual")]
        hits = [self._shape(e, where) for e in element.findall("collision")]
        parts = tuple(colliding(m, f"a collision shape of {where}", self._notes) for m in hits)
        visual = merged(seen or hits)
        return Link(
            name=name,
            T_root_link=T,
            movement=movement,
            visual=visual,
            parts=parts,
            matter=self._matter(element, parts or (visual,), where),
            friction=_friction(element, where),
            box=_box(element, where),
        )

    def _shape(self, element: Element, where: str) -> Mesh:
        geometry = element.find("geometry")
        shapes = [] if geometry is None else list(geometry)
        if len(shapes) != 1:
            raise InputError(f"{where}: a <{element.tag}> has {len(shapes)} shapes; one is needed.")
        shape = shapes[0]
        if shape.tag == "mesh":
            mesh = self._mesh(shape, where)
        else:
            mesh = _primitive(shape, where)
        return transformed(mesh, origin_of(element, where))

    def _mesh(self, shape: Element, where: str) -> Mesh:
        scale = floats(shape.get("scale", "1 1 1"), (1, 3), f"the scale of a mesh of {where}")
        scale = np.full(3, scale[0]) if len(scale) == 1 else scale
        name = shape.get("filename", "")
        beside = self._path.parent.relative_to(self._folder)
        # A way that leads elsewhere stays as it is, to be refused.
        inner = name if name.startswith("/") or ":" in name else (beside / name).as_posix()
        return scene_mesh(self._folder, inner, scale, f"{where}", self._notes)

    def _matter(self, element: Element, shapes: tuple[Mesh, ...], where: str) -> LinkMatter:
        inertial = element.find("inertial")
        if inertial is None:
            solid = mass_properties(merged(shapes), MADE_UP_DENSITY)
            self._notes.append(
                f"{where} has no inertial; {solid.mass_kg:.3g} kg are assumed, {MADE_UP_DENSITY:g} "
                "kg/m^3 in its shape."
            )
            return LinkMatter(
                mass_kg=solid.mass_kg, center_of_mass=solid.center_of_mass, inertia=solid.inertia
            )
        mass, tensor = inertial.find("mass"), inertial.find("inertia")
        if mass is None or tensor is None:
            raise InputError(f"{where}: its inertial has no <mass> or no <inertia>.")
        xx, xy, xz, yy, yz, zz = (
            float(floats(tensor.get(f"i{a}", ""), (1,), f"i{a} of {where}")[0])
            for a in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        T = origin_of(inertial, where)
        I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])  # noqa: E741 - the tensor's letter
        turned = T[:3, :3] @ I @ T[:3, :3].T
        return LinkMatter(
            mass_kg=float(floats(mass.get("value", ""), (1,), f"the mass of {where}")[0]),
            center_of_mass=T[:3, 3],
            inertia=0.5 * (turned + turned.T),
        )


def _friction(element: Element, where: str) -> float | None:
    found = element.find("contact/lateral_friction")
    if found is None:
        return None
    return float(floats(found.get("value", ""), (1,), f"the friction of {where}")[0])


def _box(element: Element, where: str) -> tuple[Array, Array] | None:
    shapes = element.findall("collision")
    box = shapes[0].find("geometry/box") if len(shapes) == 1 else None
    if box is None:
        return None
    return origin_of(shapes[0], where), sizes(box, "size", 3, where)


def _primitive(shape: Element, where: str) -> Mesh:
    import trimesh

    if shape.tag == "box":
        solid = trimesh.creation.box(sizes(shape, "size", 3, where))
    elif shape.tag == "cylinder":
        radius, length = (float(sizes(shape, n, 1, where)[0]) for n in ("radius", "length"))
        solid = trimesh.creation.cylinder(radius, length, sections=ROUND_SIDES)
    elif shape.tag == "sphere":
        solid = trimesh.creation.icosphere(radius=float(sizes(shape, "radius", 1, where)[0]))
    else:
        raise InputError(
            f"{where} has a <{shape.tag[:40]}>; mesh, box, cylinder and sphere are read."
        )
    return Mesh(vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def _name(element: Element, where: str) -> str:
    name = element.get("name", "").strip()
    if not name:
        raise InputError(f"{where} has no name.")
    return name
