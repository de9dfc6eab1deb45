"""What the command line says as text: lists of numbers, points, whether a port is free."""

import errno
import re
import socket

import click

LARGEST_RANGE = 100_000
"""Numbers of one range: more are a typing error, not views."""


def numbers_of(text: str) -> tuple[int, ...]:
    """Return the numbers of a comma-separated list such as 1-3,7; a range includes its ends.

    Raises:
        click.BadParameter: it is no such list.
    """
    numbers: list[int] = []
    for part in text.split(",") if text else ():
        found = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", part)
        if found is None:
            raise click.BadParameter(
                f"'{text}' is not a comma-separated list of numbers and ranges, such as 1-3,7"
            )
        first = int(found[1])
        last = int(found[2] or first)
        if not 0 <= last - first < LARGEST_RANGE:
            raise click.BadParameter(f"'{part.strip()}' is no range from a number to a larger one")
        numbers += range(first, last + 1)
    return tuple(numbers)


def port_in_use(host: str, port: int) -> bool:
    """Return whether another program listens at the port."""
    try:
        place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(place[0], place[1]) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place[4])
    except OSError as error:  # whatever else is wrong is named by who listens
        return error.errno == errno.EADDRINUSE
    return False


def point_of(text: str) -> tuple[float, float] | None:
    """Return x,y [m] of a text, None for an empty one.

    Raises:
        InputError: it is no point on a table.
    """
    from realsim.errors import InputError

    if not text:
        return None
    number = r"\s*([-+]?(?:\d+\.?\d*|\.\d+))\s*"
    found = re.fullmatch(f"{number},{number}", text)
    if found is None:
        raise InputError(f"--at '{text}' is no point; x,y in metres, such as 0.40,-0.05, is one.")
    x, y = float(found[1]), float(found[2])
    # An arm that grasps reaches no further than this: beyond, millimetres were typed.
    if max(abs(x), abs(y)) > 3.0:
        raise InputError(
            f"--at {text} lies {max(abs(x), abs(y)):g} m from the robot; at most 3 m is accepted. "
            "Were millimetres typed? Metres are expected."
        )
    return x, y
