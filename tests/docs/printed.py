"""Compare what a command prints with what the documents say that it prints.

Words must be equal. A figure may be off as the tour's first page states: a count by 10 %, another
figure by 25 % or two units of its last digit. Frames of tables and runs of blanks do not count.
"""

import re

FRAME = re.compile(r"[│┃┏┓┗┛┡┩┳┻╇┴└┘┌┐├┤━─╭╮╰╯]+")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
COUNT_SHARE = 0.10
SHARE = 0.25
LAST_DIGITS = 2.0


def plain(line: str) -> str:
    """Return a line without frames of tables and runs of blanks."""
    return " ".join(FRAME.sub(" ", line).split())


def agrees(said: str, printed: str) -> bool:
    """Return whether a printed line is the one that the document says."""
    a, b = plain(said), plain(printed)
    if " ".join(NUMBER.sub("#", a).split()) != " ".join(NUMBER.sub("#", b).split()):
        return False
    pairs = zip(NUMBER.findall(a), NUMBER.findall(b), strict=True)
    return all(near(x, y) for x, y in pairs)


def near(said: str, printed: str) -> bool:
    """Return whether two figures are near enough."""
    x, y = float(said), float(printed)
    if "." not in said and "e" not in said:
        return abs(x - y) <= COUNT_SHARE * abs(x)
    digits = len(said.partition(".")[2].partition("e")[0])
    return abs(x - y) <= max(SHARE * abs(x), LAST_DIGITS * 10.0**-digits * 1.0001)


def missing_lines(said: str, printed: str) -> list[str]:
    """Return the lines of a document's block that were not printed, in their order."""
    rest = printed.splitlines()
    missing: list[str] = []
    for line in said.splitlines():
        if not plain(line) or plain(line) == "...":
            continue
        place = next((k for k, other in enumerate(rest) if agrees(line, other)), None)
        if place is None:
            missing.append(line)
        else:
            rest = rest[place + 1 :]
    return missing
