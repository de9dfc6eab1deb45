"""The commands that the documents tell a reader to type, as the tests type them."""

import shlex
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def command_lines(document: str) -> list[str]:
    """Return the command lines of a document: indented or fenced, without their remarks."""
    lines, fenced = [], False
    for line in (ROOT / document).read_text().splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            lines.append(line.split("  #")[0].strip())
    return [line for line in lines if line]


def documented(document: str, *words: str) -> str:
    """Return the first command line of a document in which all words stand, or fail."""
    for line in command_lines(document):
        if all(word in line.split() for word in words):
            return line
    raise AssertionError(f"{document} has no command with {' '.join(words)}")


def as_arguments(line: str, **replaced: str) -> list[str]:
    """Return what to start for a line `[uv run] realsim ...`: the program that is installed.

    Args:
        line: as of `documented`.
        replaced: words in capitals, such as FOLDER, and what stands for them.
    """
    words = shlex.split(line)
    assert "realsim" in words, line
    words = words[words.index("realsim") + 1 :]
    program = str(Path(sys.executable).with_name("realsim"))
    return [program, *(replaced.get(word, word) for word in words)]
