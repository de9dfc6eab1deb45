"""Which file of settings is in force, and where in it a setting stands."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.toml_text import read_toml
from realsim.user_cache import home

VARIABLE = "REALSIM_CONFIG"
"""Names the file; empty: none is read."""
HERE = Path("realsim.toml")
"""In the current folder: the settings of a project."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ConfigFile:
    """A file of settings as it was read."""

    path: Path
    text: str
    tables: Mapping[str, Any]
    """As TOML has them."""
    is_named: bool
    """Whether a person named it; otherwise it was found, and that is told."""

    def place(self, tables: Sequence[str], key: str = "") -> str:
        """Return the file and, where it can be told, the line of a table or of a key in it."""
        line = line_of(self.text, tables, key)
        return f"{self.path}, line {line}" if line else f"{self.path}"


def own_file() -> Path:
    """Return the file of a person's own settings."""
    folder = os.environ.get("XDG_CONFIG_HOME") or home() / ".config"
    return Path(folder) / "realsim" / "config.toml"


def find_config(named: Path | None) -> ConfigFile | None:
    """Return the file in force: the named one, that of REALSIM_CONFIG, ./realsim.toml, one's own.

    Raises:
        InputError: a named file is not there, or a file is not TOML.
    """
    variable = os.environ.get(VARIABLE)
    if named is not None:
        return read_config(named, "--config names", is_named=True)
    if variable is not None:
        if not variable:
            return None
        return read_config(Path(variable), f"{VARIABLE} names", is_named=True)
    for path in (HERE, own_file()):
        if os.path.isfile(path):  # no, too, in a home that may not be looked into
            return read_config(path, "", is_named=path != HERE)
    return None


def read_config(path: Path, who: str, *, is_named: bool) -> ConfigFile:
    """Read a file of settings.

    Raises:
        InputError: it is not there, cannot be read, or is not TOML that `read_toml` takes.
    """
    if not path.is_file():
        raise InputError(
            f"{who} {path}, which is {'no file' if path.exists() else 'not there'}. Give a TOML "
            "file; `realsim config template` prints one."
        )
    text, tables = read_toml(path)
    return ConfigFile(path=path, text=text, tables=tables, is_named=is_named)


def line_of(text: str, tables: Sequence[str], key: str = "") -> int | None:
    """Return the line (from 1) where a table begins, or where a key of it stands.

    Plain tables and keys are found, which is what people write; None for others.
    """
    here: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        head = re.match(r"\s*\[\s*([^\[\]]+?)\s*\]", line)
        if head is not None:
            here = _names(head[1])
            if not key and here[: len(tables)] == list(tables):
                return number
            continue
        entry = re.match(r"\s*([\w\"'.-]+(?:\s*\.\s*[\w\"'-]+)*)\s*=", line)
        if entry is None:
            continue
        full = [*here, *_names(entry[1])]
        wanted = [*tables, key] if key else list(tables)
        if full[: len(wanted)] == wanted:
            return number
    return None


def _names(dotted: str) -> list[str]:
    return [part.strip().strip("\"'") for part in dotted.split(".")]
