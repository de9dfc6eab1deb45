"""Inner loops compiled by Numba, once a machine: the cache is found by what the code says.

Numba keeps compiled code beside the source file, so that every clone compiles anew, and it does not
notice when a function that the loop calls has changed in another file. Here compiled code lies in
one folder of the user (`$NUMBA_CACHE_DIR`, or `realsim/numba` in `$XDG_CACHE_HOME`). Its name is a
hash of the loop's file, of each compiled function and constant that it uses, and of the version.
Where neither that folder nor the one of the source can be written, compiled code lies in a passing
one, which this process and those that it starts share.
"""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, overload

import numba
import numpy as np
from numba.core import caching
from numba.core.cpu import CPUTargetOptions
from numba.core.registry import CPUDispatcher

from realsim.user_cache import user_cache

Loop = TypeVar("Loop", bound=Callable[..., Any])
DIGITS = 24  # of the hash, in the names of the files


@overload
def njit(function: Loop, /) -> Loop: ...
@overload
def njit(**options: Any) -> Callable[[Loop], Loop]: ...
def njit(function: Any = None, /, *, allocates: bool = True, **options: Any) -> Any:
    """Compile a function in Numba's nopython mode, cached; use it as `@njit` or `@njit(...)`.

    Args:
        function: The function, when used without brackets.
        allocates: False where it makes no array. Numba then does not count the users of those it
            is given, which costs the loops of pictures a fifth of their time. A version of Numba
            without that switch, which is not part of its documented interface, counts them.
        options: Numba's own: `inline`, `fastmath`, `error_model`, `nogil`, `parallel`.
    """
    if not allocates and hasattr(CPUTargetOptions, "_nrt"):
        options["_nrt"] = False
    compiler = numba.njit(cache=True, **options)
    return compiler if function is None else compiler(function)


def cache_folder() -> Path:
    """Return the folder that compiled code is kept in."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    return user_cache("numba")


@cache
def _key(function: Any) -> str:
    """Return a hash of all that decides what a function compiles to."""
    said = hashlib.sha256(f"{numba.__version__}{function.__qualname__}".encode())
    said.update(Path(function.__code__.co_filename).read_bytes())
    for used in _used_by(function):
        if isinstance(used, CPUDispatcher):
            said.update(_key(used.py_func).encode())
        elif isinstance(used, np.ndarray | np.generic):
            said.update(f"{used.dtype}{used.shape}".encode() + used.tobytes())
        elif isinstance(used, int | float | str | tuple):
            said.update(repr(used).encode())
    return said.hexdigest()[:DIGITS]


def _used_by(function: Any) -> Iterator[Any]:
    """Yield what a function names, also by way of a module: `point_loops.bent`."""
    names = sorted(function.__code__.co_names)
    for name in names:
        used = function.__globals__.get(name)
        yield used
        if isinstance(used, ModuleType) and used.__name__.startswith("realsim"):
            yield from (vars(used).get(inner) for inner in names)


class _ByContent(caching._CacheLocator):  # pyright: ignore[reportPrivateUsage]
    """Find the compiled code of one of realsim's functions by `_key`."""

    def __init__(self, function: Any) -> None:
        self._stamp = _key(function)
        self._folder = cache_folder() / function.__module__

    def get_cache_path(self) -> Any:
        return str(self._folder)

    def get_source_stamp(self) -> Any:
        return self._stamp

    def get_disambiguator(self) -> Any:
        return self._stamp  # versions of a function lie side by side

    @classmethod
    def from_function(cls, py_func: Any, py_file: Any) -> Any:
        """Return the place of a function of realsim's; None for others and read-only homes."""
        if not py_func.__module__.startswith("realsim"):
            return None
        with contextlib.suppress(OSError):
            place = cls(py_func)
            place.ensure_cache_path()
            return place
        return None


class _ForThisRun(_ByContent):
    """Find compiled code in a folder that goes when this process ends."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: Any) -> Any:
        """Return the place of a function, in the folder that all others are kept in from now on."""
        cls.kept = tempfile.TemporaryDirectory(prefix="realsim-numba-")
        os.environ["NUMBA_CACHE_DIR"] = cls.kept.name
        return super().from_function(py_func, py_file)


_places: Any = caching.CacheImpl._locator_classes  # pyright: ignore[reportPrivateUsage]
_places.insert(0, _ByContent)
_places.append(_ForThisRun)
