"""Which of Mitsuba's variants this process can use: compiled with LLVM, or scalar."""

import os
import sys
from dataclasses import dataclass
from typing import Any, Literal

from realsim.errors import InputError
from realsim.interop import import_extra
from realsim.rendering.photoreal.llvm_probe import LEAST_LLVM, find_llvm

Wanted = Literal["auto", "llvm", "scalar"]
LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
MITSUBA = (
    "mitsuba", "photo", "the photoreal renderer", "The embedded renderer needs no extra.",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MitsubaVariant:
    """Mitsuba, and the variant of it that is used."""

    module: Any
    """The module `mitsuba`."""
    name: str
    """`llvm_ad_rgb` or `scalar_rgb`."""
    notes: tuple[str, ...]
    """What a person should know: why it is not the fast one."""

    def activate(self) -> Any:
        """Return the module, set to this variant: the setting is global to the process."""
        if self.module.variant() != self.name:
            self.module.set_variant(self.name)
        return self.module

    @property
    def is_compiled(self) -> bool:
        """Whether arrays of rays are traced by compiled code."""
        return self.name == LLVM


def load_mitsuba(wanted: Wanted = "auto") -> MitsubaVariant:
    """Return Mitsuba with the fastest variant that works here.

    Args:
        wanted: `auto` = LLVM if there is a library that works, else scalar with a note;
            `llvm` = LLVM or an error; `scalar` = scalar.

    Raises:
        InputError: `llvm` is wanted and no library works.
        MissingLibraryError: Mitsuba is not installed.
    """
    why_not = "" if wanted == "scalar" else _prepare_llvm()
    if why_not and wanted == "llvm":
        raise InputError(
            f"photoreal pictures: the variant 'llvm' was asked for, and {why_not} The variant "
            "'scalar' (or 'auto') works without LLVM and takes several times as long."
        )
    mitsuba = import_extra(*MITSUBA)
    name = SCALAR if wanted == "scalar" or why_not else LLVM
    mitsuba.set_variant(name)
    notes = (
        (f"photoreal pictures are rendered without LLVM, several times slower: {why_not}",)
        if why_not
        else ()
    )
    return MitsubaVariant(module=mitsuba, name=name, notes=notes)


def _prepare_llvm() -> str:
    """Name a working LLVM library to Dr.Jit; return why that is not possible, "" = it is done.

    Dr.Jit loads the library when it is imported and never again, so a process that has imported
    it before has the library it then found.
    """
    if "drjit" in sys.modules:
        import drjit

        loaded = tuple(drjit.detail.llvm_version())
        if loaded and loaded[0] >= LEAST_LLVM:
            return ""
        version = ".".join(map(str, loaded)) if any(loaded) else "none"
        return (
            f"Dr.Jit was imported before with the LLVM version {version}, and {LEAST_LLVM} or "
            "newer is needed. Set DRJIT_LIBLLVM_PATH to a newer one before the program starts."
        )
    _import_drjit_metadata()
    search = find_llvm()
    if search.library is None:
        return str(search)
    os.environ["DRJIT_LIBLLVM_PATH"] = str(search.library)
    return ""


def _import_drjit_metadata() -> None:
    """Fail with the extra's name if Mitsuba is absent, before libraries are tried out with it."""
    from importlib.util import find_spec

    if find_spec("mitsuba") is None or find_spec("drjit") is None:
        import_extra(*MITSUBA)
