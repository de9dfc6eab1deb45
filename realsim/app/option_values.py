"""What is said on the command line as text: lists of numbers, and whether a port is free."""

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
