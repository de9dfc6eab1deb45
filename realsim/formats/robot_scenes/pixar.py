"""Pixar's library, which comes with an extra."""

import importlib
from typing import Any

from realsim.errors import MissingLibraryError

MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdSemantics", "UsdShade", "Vt")


class Pixar:
    """Pixar's modules, imported when a scene is written."""

    def __init__(self) -> None:
        """Import them.

        Raises:
            MissingLibraryError: the extra is not installed.
        """
        try:
            found = {name: importlib.import_module(f"pxr.{name}") for name in MODULES}
        except ImportError as error:
            raise MissingLibraryError(
                f"writing USD needs Pixar's library, which cannot be imported ({error}). Install "
                "the extra: `pip install 'realsim[usd]'` (or `uv sync --extra usd`), or write URDF "
                "or MJCF."
            ) from error
        self.Gf: Any = found["Gf"]
        self.Sdf: Any = found["Sdf"]
        self.Usd: Any = found["Usd"]
        self.UsdGeom: Any = found["UsdGeom"]
        self.UsdPhysics: Any = found["UsdPhysics"]
        self.UsdSemantics: Any = found["UsdSemantics"]
        self.UsdShade: Any = found["UsdShade"]
        self.Vt: Any = found["Vt"]
