"""Folders of robots: found by name, read with limits, and what their files stand for.

A robot is a folder with a `robot.toml`, and where it has a URDF, with that and its meshes. Robots
are found by the folder's name among those that ship, in the folders that `REALSIM_ROBOTS` names,
and by a path. Capitals, hyphens and underscores do not matter: "UR5e" is the folder `ur5e`.

The `robot.toml` of a hand, as `realsim.robots.hand` reads it.
"""

import hashlib
import os
import re
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

from msgspec import structs

from realsim.errors import InputError, MissingLibraryError
from realsim.untrusted.files import checked_bytes
from realsim.untrusted.own_json import OwnFile, from_json
from realsim.untrusted.toml_text import read_toml

Kind = Literal["arm", "hand"]
KINDS: tuple[Kind, ...] = ("arm", "hand")
FILE = "robot.toml"
VARIABLE = "REALSIM_ROBOTS"
"""Folders of robots of the user's own, divided as in PATH."""
SHIPPED = Path(__file__).parent / "shipped"
PACKAGE = "package://"
NAME = re.compile(r"[\w][\w .+-]{0,59}")
MOST_FILES = 500
"""A robot's folder holds a few dozen files; a folder with more is another one."""
MOST_BYTES = 100e6
"""Largest file of a robot [bytes]."""


class RobotFile(OwnFile, frozen=True, kw_only=True):
    """What every `robot.toml` says."""

    name: str
    """As people write it: "UR5e"."""
    title: str = ""
    """The whole name: "Universal Robots UR5e"."""
    sources: tuple[str, ...] = ()
    """Where the figures come from."""


Declared = TypeVar("Declared", bound=RobotFile)


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotFolder:
    """Where a robot was found."""

    path: Path
    name: str
    """The folder's name, by which the robot is found."""
    digest: str
    """SHA-256 of all files in the folder: two robots of one name are told apart by it."""

    def file(self, named: str, what: str) -> Path:
        """Return a file that `robot.toml` or a URDF names.

        Args:
            named: relative to the folder, or `package://PACKAGE/...` in an installed Python
                package, or in a ROS package in the folder or beside it.
            what: the file's role, for messages.

        Raises:
            InputError: it is not there.
            MissingLibraryError: its package is not installed.
        """
        if not named.startswith(PACKAGE):
            found = self.path / named
            if found.is_file() and found.resolve().is_relative_to(self.path.resolve()):
                return found
            raise InputError(
                f"{self.path / FILE}: {what} '{named[:200]}' is not in the folder {self.path}. "
                "Put it there and name it relative to the folder, or as package://PACKAGE/FILE."
            )
        package, _, rest = named.removeprefix(PACKAGE).partition("/")
        for root in self._roots(package):
            found = root / rest
            if found.is_file() and found.resolve().is_relative_to(root.resolve()):
                return found
        raise MissingLibraryError(
            f"{self.path / FILE}: {what} '{named[:200]}' is not there: neither an installed Python "
            f"package '{package}' nor a folder '{package}' beside {self.path} holds it."
        )

    def _roots(self, package: str) -> list[Path]:
        roots = [self.path / package, self.path.parent / package, self.path]
        if package.isidentifier():
            spec = find_spec(package)
            if spec is not None and spec.submodule_search_locations:
                roots.insert(0, Path(next(iter(spec.submodule_search_locations))))
        return roots


def robot_file(name: str, kind: type[Declared]) -> tuple[Declared, RobotFolder]:
    """Return what a robot's `robot.toml` says, and its folder.

    Args:
        name: of a robot that ships or lies in a folder of `REALSIM_ROBOTS`, or a path.
        kind: the declaration of an arm or a hand; its field `kind` says which.

    Raises:
        InputError: there is no such robot, it is of the other kind, or its file is not as declared.
    """
    word: Kind = next(f.default for f in structs.fields(kind) if f.name == "kind")
    path = _folder(name, word)
    where = path / FILE
    _, values = read_toml(where)
    found = values.get("kind")
    if found != word:
        told = f"is a '{found}'" if found in ("arm", "hand") else "does not say its kind"
        raise InputError(f'{where} {told}; kind = "{word}" is needed here. {_known(word)}')
    file = from_json(values, kind, str(where))
    if not NAME.fullmatch(file.name):
        raise InputError(
            f"{where}: name is {file.name[:80]!r}; 1 to 60 letters, digits, spaces, dots, hyphens "
            "and underscores are needed."
        )
    return file, RobotFolder(path=path, name=path.name, digest=_digest(path))


def names_of(kind: Kind) -> dict[str, Path]:
    """Return the folders of all arms or hands that are found by name, sorted by name."""
    found = {p.name: p for root in reversed(_shelves()) for p in _on_shelf(root, kind)}
    return dict(sorted(found.items()))


def kind_of(name: str) -> Kind:
    """Return whether a robot, by its name or folder, is an arm or a hand.

    Raises:
        InputError: there is none, or its file does not say.
    """
    given = Path(name).expanduser()
    if os.sep not in name:
        for kind in KINDS:
            if any(same_name(known, name) for known in names_of(kind)):
                return kind
        known = "; ".join(f"{kind}s: {', '.join(names_of(kind))}" for kind in KINDS)
        if not given.is_dir():
            raise InputError(f"there is no robot '{name[:80]}'. There are {known}.")
    if not (given / FILE).is_file():
        raise InputError(f"the folder {given} has no {FILE}; a robot is a folder with one.")
    found = read_toml(given / FILE)[1].get("kind")
    if found in KINDS:
        return found
    raise InputError(f'{given / FILE} has kind = {found!r}; "arm" and "hand" are accepted.')


def same_name(first: str, second: str) -> bool:
    """Return whether two names are of one robot: capitals and hyphens do not matter."""
    return _plain(first) == _plain(second)


def _folder(name: str, kind: Kind) -> Path:
    given = Path(name).expanduser()
    if os.sep not in name:
        # A folder that is called so, or whose file says so: plans keep the name of the file.
        paths = [p for root in _shelves() for p in _on_shelf(root, kind)]
        found = [p for p in paths if same_name(p.name, name)]
        found += [
            p for p in paths if p not in found and same_name(str(_said(p / FILE, "name")), name)
        ]
        if len(found) > 1:
            raise InputError(
                f"more than one {kind} is called '{name[:80]}': "
                f"{', '.join(str(p) for p in found)}. Give the folder of the one that is meant, or "
                "rename one."
            )
        if found:
            return found[0]
        if not given.is_dir():
            raise InputError(f"there is no {kind} '{name[:80]}'. {_known(kind)}")
    if not (given / FILE).is_file():
        there = "has no" if given.is_dir() else "does not exist and so has no"
        raise InputError(
            f"the folder {given} {there} {FILE}. A robot is a folder with a {FILE}; "
            "`realsim robots` lists those that are found by name."
        )
    return given


def _on_shelf(root: Path, kind: Kind) -> list[Path]:
    return [f.parent for f in sorted(root.glob(f"*/{FILE}")) if _said(f, "kind") == kind]


def _known(kind: Kind) -> str:
    return (
        f"There are: {', '.join(names_of(kind))}. For one of your own give its folder, or name the "
        f"folder above it in {VARIABLE}."
    )


def _shelves() -> list[Path]:
    """Return the folders in which robots lie, the user's first."""
    own = [Path(p).expanduser() for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    for path in own:
        if not path.is_dir():
            raise InputError(f"{VARIABLE} names {path}, which is no folder.")
    return [*own, SHIPPED]


def _said(file: Path, key: str) -> Any:
    try:
        return read_toml(file)[1].get(key)
    except InputError:
        return None  # told when it is asked for by name


def _plain(name: str) -> str:
    if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise InputError(f"a robot is called {name!r}; its name, or its folder as text, is needed.")
    return name.casefold().replace("-", "_").replace(" ", "_")


def _digest(folder: Path) -> str:
    files = sorted(f for f in folder.rglob("*") if f.is_file() and "__pycache__" not in f.parts)
    if len(files) > MOST_FILES:
        raise InputError(
            f"{folder} holds {len(files)} files; a robot's folder has {MOST_FILES} at the most. "
            "Give the folder of the robot itself."
        )
    total = hashlib.sha256()
    for file in files:
        total.update(f"{file.relative_to(folder).as_posix()}\0".encode())
        total.update(hashlib.sha256(checked_bytes(file, MOST_BYTES)).digest())
    return total.hexdigest()


Point = tuple[float, float, float]


STIFFEST_N_PER_M = 5e5
"""Greatest normal stiffness of a pad with which both engines pass the validation suite [N/m]."""


def soft_n_per_m(patch_m: tuple[float, float]) -> float:
    """Return the normal stiffness of 4 mm of silicone over a patch [N/m]: E A / t.

    Silicone of Shore A 40 has E = 2.0 MPa (lg E = 0.0235 S - 0.6403, Larson 2016, Dow Corning
    11-3716); the layer is taken to be free to bulge. Shore A 30 to 50 and 2 to 4 mm span 0.6 to 3.4
    times as much. Large patches get `STIFFEST_N_PER_M`.
    """
    return min(2.0e6 * patch_m[0] * patch_m[1] / 4e-3, STIFFEST_N_PER_M)


class PadFile(OwnFile, frozen=True, kw_only=True):
    """The pads, as a `robot.toml` has them."""

    width_m: float | None = None
    """Along x [m]; the finger's own width where it is left away."""
    length_m: float | None = None
    """Along z, about the middle of the pad [m]; as long as wide, but no longer than the finger."""
    patch_m: tuple[float, float] | None = None
    """Along x and z, what presses on a large object [m]; the whole pad where it is left away."""
    friction: float = 1.0
    """Coulomb coefficient on the objects; 1.0 is the paper's."""
    normal_stiffness_n_per_m: float | None = None
    """Stiffness of one pad on which a flat object lies whole [N/m]; `soft_n_per_m` where left
    away."""


class ArcFile(OwnFile, frozen=True, kw_only=True):
    """The circle on which the pads run."""

    radius_m: float
    """Distance of the crank's two joints [m]."""
    axis_y_m: float
    """y of the crank's axis, moved as the crank's other end is to the middle of the pad's face [m];
    for the finger at +y."""


class BoxFile(OwnFile, frozen=True, kw_only=True):
    """A box in frame `grasp`."""

    low_m: Point
    high_m: Point


class BarFile(OwnFile, frozen=True, kw_only=True):
    """A bar of the linkage at +y that turns with the crank."""

    pivot_m: tuple[float, float]
    """y and z of the axis about which it turns, as the crank does [m], frame `grasp`."""
    from_m: tuple[float, float]
    to_m: tuple[float, float]
    """y and z of its ends when the hand is closed [m]."""
    half_width_m: float
    """Along x [m]."""
    half_thickness_m: float
    """Around the line between its ends [m]."""


class MountFile(OwnFile, frozen=True, kw_only=True):
    """How the hand sits on an arm's flange."""

    distance_m: float | None = None
    """From the flange to the origin of `grasp` [m]; to the palm's back where it is left away."""
    turn_deg: float = 0.0
    """Turn of `grasp` about the flange's z [deg], as the hand's maker mounts it."""


class ForceFile(OwnFile, frozen=True, kw_only=True):
    """Force of each finger on the object."""

    least_n: float = 1.0
    greatest_n: float = 140.0
    usual_n: float = 70.0
    """What the slip test uses unless it is told another [N]."""


class HandFile(RobotFile, frozen=True, kw_only=True):
    """The `robot.toml` of a hand: four numbers are needed, everything else has a stated default."""

    kind: Literal["hand"] = "hand"
    max_opening_m: float
    """Distance of the pads when fully open [m]."""
    finger_length_m: float
    """Up from the tip [m]."""
    finger_width_m: float
    """Across the closing axis [m]."""
    finger_thickness_m: float
    """Along the closing axis [m]."""
    tip_beyond_grasp_m: float | None = None
    """How far the tip reaches past the middle of the pad [m]; half the pad where left away."""
    pad: PadFile = PadFile()
    arc: ArcFile | None = None
    """None = the fingers slide along y."""
    palm: tuple[BoxFile, ...] = ()
    """What does not move; one box behind the fingers where it is left away."""
    finger: tuple[BoxFile, ...] = ()
    """What else the finger at +y is made of besides the box of the sizes above, hand closed."""
    bar: tuple[BarFile, ...] = ()
    mount: MountFile = MountFile()
    force: ForceFile = ForceFile()
    mass_kg: float = 0.7
    """Mass of the whole hand [kg]; the default is about Franka's."""
    finger_mass_kg: float = 0.1
    """Mass of a finger as the physics moves it [kg]."""
    closing_speed_m_s: float = 0.1
    """Greatest speed of each finger [m/s]; the default is Franka's."""
    frame_link: str = ""
    """Link of its URDF at the mounting face, z = approach, y = closing; the folder's name where it
    is left away."""
    joint: str = ""
    """Joint that drives it, as its URDF calls it; '' = not known."""
    joint_zero_m: float = 0.0
    """Opening at which that joint is at 0 [m]: of an arc, whose joint closes it."""
    urdf: str = ""
    """The hand's URDF; '' = none. `realsim robots check` compares its pads' path with the law."""
    urdf_pads: tuple[str, ...] = ()
    """The links of its pads, at +y and -y."""
    urdf_pad_face_m: Point = (0.0, 0.0, 0.0)
    """Middle of the first pad's face in that link's frame [m]."""
