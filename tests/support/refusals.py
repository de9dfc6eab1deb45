"""Hold that a call is refused, and with which words."""

from collections.abc import Callable

import pytest

from realsim.errors import InputError


def refused(
    why: str, call: Callable[..., object], *args: object, error: type[Exception] = InputError,
    **options: object,
) -> str:  # fmt: skip
    """Hold that `call(*args, **options)` raises an error that says `why` (a pattern); return it."""
    with pytest.raises(error, match=why) as caught:
        call(*args, **options)
    return str(caught.value)
