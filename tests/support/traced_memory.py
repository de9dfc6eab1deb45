"""Hold that what Python takes stays below a bound."""

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def below(most_bytes: float) -> Iterator[None]:
    """Hold that the block takes no more memory at any time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()
