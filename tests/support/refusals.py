"""Hold that a call is refused, and with which words."""

from collections.abc import Callable

import pytest

from realsim.errors import DegenerateError, InputError


def refused(
    why: str, call: Callable[..., object], *args: object, error: type[Exception] = InputError,
    **options: object,
) -> str:  # fmt: skip
    """Hold that `call(*args, **options)` raises an error that says `why` (a pattern); return it."""
    with pytest.raises(error, match=why) as caught:
        call(*args, **options)
    return str(caught.value)


def undetermined(why: str, call: Callable[..., object], *args: object, **options: object) -> str:
    """Hold that what is given does not determine the answer, as `refused` does of bad input."""
    return refused(why, call, *args, error=DegenerateError, **options)
