"""LLVM for the photoreal renderer's compiled variant, named before anything loads Dr.Jit."""

import os

import pytest

from realsim.rendering.photoreal import find_llvm

SEARCH = find_llvm()
NEEDS_LLVM = pytest.mark.skipif(SEARCH.library is None, reason=str(SEARCH))
if SEARCH.library is not None:
    # Dr.Jit keeps the library that it finds when it is imported, by whichever test comes first.
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(SEARCH.library))
