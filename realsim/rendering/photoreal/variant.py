"""Which of Mitsuba's variants this process can use: compiled with LLVM, or scalar.

Finds an LLVM library that Mitsuba's compiled variant can run on.

Dr.Jit, Mitsuba's compiler, needs LLVM 19 or newer. On an older one (Debian 12's default is 14) it
does not raise: the process aborts. So each library is tried in a process of its own, which renders
one small picture, and the verdict is kept by the library's path, size and time.
"""

import contextlib
import glob
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from realsim.errors import InputError
from realsim.interop import import_extra
from realsim.store.atomic import write_text
from realsim.user_cache import user_cache

LEAST_LLVM = 19
"""Older ones cannot compile Dr.Jit's minimum and maximum (`fminimum`) and abort."""
VERDICTS = "llvm_libraries.json"
"""The file that keeps the verdicts between processes."""
PROBE_TIMEOUT_S = 120.0
"""A trial takes 2 s; a machine busy with other work may need many times that."""
HOW_TO_GET = (
    "`pip install karellen-llvm-core` puts one into the Python environment; "
    "`apt install libllvm19` (Debian 12, Ubuntu 24.10 or newer) into the system; "
    "DRJIT_LIBLLVM_PATH names any other (the path of libLLVM.so)"
)
_TRIAL = """
import numpy, mitsuba as mi
mi.set_variant('llvm_ad_rgb')
scene = mi.load_dict({
    'type': 'scene', 'integrator': {'type': 'path', 'max_depth': 3},
    'ball': {'type': 'sphere', 'bsdf': {'type': 'twosided', 'of': {'type': 'principled'}}},
    'sky': {'type': 'constant'},
    'sensor': {'type': 'perspective', 'film': {'type': 'hdrfilm', 'width': 8, 'height': 8},
               'to_world': mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])}})
assert numpy.array(mi.render(scene, spp=1)).mean() > 0.1
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class LlvmSearch:
    """What the search for an LLVM library found."""

    library: Path | None
    """The newest library that works; None = there is none."""
    rejected: tuple[str, ...]
    """Each library that was passed over before, with the reason."""
    searched: tuple[str, ...]
    """The patterns of paths that were looked at."""

    def __str__(self) -> str:
        """Return the search in one sentence, for people."""
        if self.library is not None:
            return f"LLVM: {self.library}."
        found = "; ".join(self.rejected) if self.rejected else "none is there"
        return (
            f"no LLVM library of version {LEAST_LLVM} or newer was found ({found}). Looked at "
            f"DRJIT_LIBLLVM_PATH and {', '.join(self.searched)}. To get one: {HOW_TO_GET}."
        )


def library_patterns() -> tuple[str, ...]:
    """Return the patterns of paths where LLVM libraries lie: this environment, then the system."""
    triplet = str(sysconfig.get_config_var("MULTIARCH") or "x86_64-linux-gnu")
    return (
        f"{sys.prefix}/lib/libLLVM*.so*",
        f"/usr/lib/{triplet}/libLLVM*.so*",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/local/lib/libLLVM*.so*",
    )


def llvm_version(library: Path) -> int | None:
    """Return the major version that a library's file name tells; None = it tells none.

    Debian calls 15 `libLLVM-15.so.1` and 19 `libLLVM.so.19.1`.
    """
    match = re.search(r"libLLVM(?:-(\d+)|\.so\.(\d+))", library.name)
    return int(match[1] or match[2]) if match else None


def find_llvm(patterns: tuple[str, ...] | None = None) -> LlvmSearch:
    """Return the newest LLVM library that renders; DRJIT_LIBLLVM_PATH goes first.

    Args:
        patterns: where to look; None = `library_patterns()`.
    """
    return _find_llvm(
        library_patterns() if patterns is None else patterns,
        os.environ.get("DRJIT_LIBLLVM_PATH", ""),
    )


@lru_cache(maxsize=8)
def _find_llvm(patterns: tuple[str, ...], named: str) -> LlvmSearch:
    """Do what `find_llvm` does, once per process."""
    found = {Path(p).resolve() for pattern in patterns for p in glob.glob(pattern)}
    newest_first = sorted(found, key=lambda p: (-(llvm_version(p) or LEAST_LLVM), str(p)))
    rejected: list[str] = []
    for library in ([Path(named).resolve()] if named else []) + newest_first:
        reason = _why_not(library)
        if reason is None:
            return LlvmSearch(library=library, rejected=tuple(rejected), searched=patterns)
        rejected.append(f"{library}: {reason}")
    return LlvmSearch(library=None, rejected=tuple(dict.fromkeys(rejected)), searched=patterns)


def _why_not(library: Path) -> str | None:
    """Return why a library cannot be used; None = it can."""
    if not library.is_file():
        return "there is no such file"
    version = llvm_version(library)
    if version is not None and version < LEAST_LLVM:
        return f"version {version} is too old"
    status = library.stat()
    key = (
        f"{library} {status.st_size} {status.st_mtime_ns} "
        f"drjit {importlib.metadata.version('drjit')}"
    )
    verdicts = _read_verdicts()
    if key not in verdicts:
        verdicts[key] = _try_out(library)
        _write_verdicts(verdicts)
    return verdicts[key] or None


def _try_out(library: Path) -> str:
    """Return what went wrong when a process of its own rendered on a library; "" = nothing."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            env={**os.environ, "DRJIT_LIBLLVM_PATH": str(library)},
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"a trial picture was not done after {PROBE_TIMEOUT_S:g} s"
    if done.returncode == 0:
        return ""
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    how = f"signal {-done.returncode}" if done.returncode < 0 else f"exit {done.returncode}"
    said = next((line for line in lines if "LLVM" in line), lines[-1] if lines else "no message")
    return f"a trial picture ended with {how}: {said.strip()[:200]}"


def _read_verdicts() -> dict[str, str]:
    """Return the kept verdicts; an unreadable file counts as none."""
    try:
        kept = json.loads(user_cache(VERDICTS).read_text())
        return {str(k): str(v) for k, v in kept.items()}
    except (OSError, ValueError, AttributeError):
        return {}


def _write_verdicts(verdicts: dict[str, str]) -> None:
    """Keep the verdicts; where nothing can be written the next process tries again."""
    with contextlib.suppress(OSError):
        write_text(user_cache(VERDICTS), json.dumps(verdicts))


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
