"""XML of others: elements, attributes and text, and nothing that names other files.

A doctype can define entities that unfold a kilobyte into gigabytes or fetch files; no format of
scenes needs one, so it is refused where it begins.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from realsim.errors import InputError
from realsim.untrusted.files import checked_bytes

MOST_BYTES = 20e6
"""Largest file [bytes]; GraspNet's annotation of an image has 5 kB, a MuJoCo scene some 100."""
MOST_ELEMENTS = 1_000_000
DEEPEST = 100
"""Elements in elements; the kinematic chain of a robot is nested 30 deep."""


def read_xml(
    path: Path | str, *, most_bytes: float = MOST_BYTES, namespaces: bool = True
) -> ElementTree.Element:
    """Return the root of an XML file.

    Args:
        path: the file.
        most_bytes: largest file that is read [bytes].
        namespaces: whether prefixes stand for something; URDF has those that nobody declared.

    Raises:
        InputError: it is missing, too large, not XML, has a doctype or entities of its own, more
            than a million elements, or is nested deeper than 100.
    """
    path = Path(path)
    return parsed_xml(checked_bytes(path, most_bytes), str(path), namespaces)


def parsed_xml(data: bytes, where: str, namespaces: bool = True) -> ElementTree.Element:
    """Return the root of an XML document; `where` names it in messages.

    Raises:
        InputError: as `read_xml`.
    """
    builder = _Builder(where)
    parser = expat.ParserCreate(namespace_separator="}" if namespaces else None)
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.tree.data
    parser.StartDoctypeDeclHandler = builder.refuse
    parser.EntityDeclHandler = builder.refuse
    parser.ExternalEntityRefHandler = builder.refuse
    try:
        parser.Parse(data, True)
        return builder.tree.close()
    except (expat.ExpatError, LookupError, ValueError, AssertionError, MemoryError) as error:
        raise InputError(
            f"{where} is not XML that can be read ({str(error)[:200]}). Write it again with the "
            "program that made it."
        ) from error


class _Builder:
    """Builds the tree and watches its size; the parser calls it."""

    def __init__(self, where: str) -> None:
        self.tree = ElementTree.TreeBuilder()
        self._where, self._depth, self._count = where, 0, 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._count += 1
        if self._depth > DEEPEST:
            raise InputError(f"{self._where} is nested deeper than {DEEPEST} elements.")
        if self._count > MOST_ELEMENTS:
            raise InputError(f"{self._where} has more than {MOST_ELEMENTS} elements.")
        self.tree.start(_name(tag), {_name(key): value for key, value in attributes.items()})

    def end(self, tag: str) -> None:
        self._depth -= 1
        self.tree.end(_name(tag))

    def refuse(self, *_: Any) -> int:
        raise InputError(
            f"{self._where} has a doctype or entities; they can fetch other files and unfold into "
            "gigabytes, so they are not read. Remove the lines <!DOCTYPE ...> and <!ENTITY ...>."
        )


def _name(name: str) -> str:
    """Return a name as ElementTree writes those with a namespace: {address}name."""
    return "{" + name if "}" in name else name
