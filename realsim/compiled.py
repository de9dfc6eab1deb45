"""Inner loops compiled by Numba, once a machine: the cache is found by what the code says.

Numba keeps compiled code beside the source file, so that every clone compiles anew, and it does not
notice when a function that the loop calls has changed in another file. Here compiled code lies in
one folder of the user (`$NUMBA_CACHE_DIR`, or `realsim/numba` in `$XDG_CACHE_HOME`). Its name is a
hash of the loop's file, of each compiled function and constant that it uses, and of the version.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
import numpy as np
from numba.core import caching
from numba.core.registry import CPUDispatcher

Loop = TypeVar("Loop", bound=Callable[..., Any])
DIGITS = 24  # of the hash, in the names of the files
_keys: dict[int, str] = {}  # by id of a compiled function


@overload
def njit(function: Loop, /) -> Loop: ...
@overload
def njit(**options: Any) -> Callable[[Loop], Loop]: ...
def njit(function: Any = None, /, **options: Any) -> Any:
    """Compile a function in Numba's nopython mode, cached; use it as `@njit` or `@njit(...)`.

    Args:
        function: The function, when used without brackets.
        options: Numba's own: `inline`, `fastmath`, `error_model`, `nogil`, `parallel`.
    """
    if function is None:
        return lambda loop: njit_with(loop, options)  # pyright: ignore[reportUnknownLambdaType]
    return njit_with(function, options)


def njit_with(function: Any, options: dict[str, Any]) -> Any:
    """Return the compiled form of a function with Numba's options."""
    compiled = numba.njit(cache=True, **options)(function)
    _keys[id(compiled)] = _key(function)
    return compiled


def cache_folder() -> Path:
    """Return the folder that compiled code is kept in."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "realsim" / "numba"


def _key(function: Any) -> str:
    """Return a hash of all that decides what a function compiles to."""
    code = function.__code__
    said = hashlib.sha256(f"{numba.__version__}{code.co_name}".encode())
    said.update(Path(code.co_filename).read_bytes())
    for name in sorted(code.co_names):
        used = function.__globals__.get(name)
        if isinstance(used, CPUDispatcher):
            said.update(_keys.get(id(used), str(name)).encode())
        elif isinstance(used, int | float | tuple | np.ndarray):
            said.update(np.asarray(used).tobytes())
    return said.hexdigest()[:DIGITS]


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


places: Any = caching.CacheImpl._locator_classes  # pyright: ignore[reportPrivateUsage]
places.insert(0, _ByContent)
