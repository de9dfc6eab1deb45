"""The documents of the project, and what stands in them: commands, snippets, links."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from realsim.app.cli import commands

ROOT = Path(__file__).parents[2]
TRACKED = subprocess.run(
    ["git", "ls-files", "README.md", "*/README.md", "docs/*.md"],
    cwd=ROOT, check=True, capture_output=True, text=True,
).stdout.splitlines()  # fmt: skip
DOCUMENTS = tuple(ROOT / name for name in TRACKED)
FENCE = re.compile(r"^(?P<mark>```+)(?P<info>[^\n`]*)\n(?P<text>.*?)^(?P=mark)\s*$", re.M | re.S)
INDENTED = re.compile(r"(?:^(?: {4}|\t)\S[^\n]*\n(?:^(?: {4}|\t)[^\n]*\n|^\s*\n(?=^ {4}))*)", re.M)
INLINE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.*?) *$", re.M)
COMMAND = re.compile(r"^(?:\$ )?(?:uv run (?:--\S+ )*)?realsim(?= |$)")
TYPED = ("", "sh", "bash", "shell", "console")
"""Kinds of blocks whose lines are typed; in a console's, those behind a dollar sign."""
REDIRECTION = re.compile(r"(?<=\s)\d?>{1,2}\s?\S+")
NAMED = re.compile(r"(?<!from )(?<!import )\brealsim ([a-z][a-z-]*)\b([^`#\n]*)")


@dataclass(frozen=True, kw_only=True, slots=True)
class Block:
    """A fenced or indented block of a document."""

    kind: str
    """What stands after the fence: sh, python, text ...; "" for an indented block."""
    text: str
    start: int
    """Where it begins in the document [characters]."""


def blocks(text: str) -> list[Block]:
    """Return the blocks of a document in their order."""
    found: list[Block] = []
    for m in FENCE.finditer(text):
        found.append(Block(kind=m["info"].strip(), text=m["text"], start=m.start()))
    rest = FENCE.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
    for m in INDENTED.finditer(rest):
        lines = [line[4:] for line in m[0].splitlines()]
        found.append(Block(kind="", text="\n".join(lines), start=m.start()))
    return sorted(found, key=lambda b: b.start)


def prose(text: str) -> str:
    """Return a document without its blocks."""
    return INDENTED.sub("\n", FENCE.sub("\n", text))


def typed_commands(text: str) -> list[str]:
    """Return the lines that a reader is to type which call realsim, without `uv run`."""
    lines: list[str] = []
    for block in blocks(text):
        if block.kind in TYPED:
            for line in block.text.replace("\\\n", " ").splitlines():
                for part in re.split(r"\s(?:&&|\|\||\||;)\s|;\s", line):
                    part = REDIRECTION.sub("", part)
                    if COMMAND.match(part.strip()):
                        lines.append(COMMAND.sub("realsim", part.strip()))
    return lines


def documented(document: str, *words: str) -> str:
    """Return the first command line of a document in which all words stand, or fail."""
    for block in blocks((ROOT / document).read_text()):
        for line in block.text.splitlines():
            if all(word in line.split() for word in words):
                return line.split("  #")[0].strip()
    raise AssertionError(f"{document} has no command with {' '.join(words)}")


def as_arguments(line: str, **replaced: str) -> list[str]:
    """Return what to start for a line `[uv run] realsim ...`: the program that is installed.

    Args:
        line: as of `documented`.
        replaced: words in capitals, such as FOLDER, and what stands for them.
    """
    words = shlex.split(line)
    words = words[words.index("realsim") + 1 :]
    program = str(Path(sys.executable).with_name("realsim"))
    return [program, *(replaced.get(word, word) for word in words)]


def named_commands(text: str) -> Iterator[tuple[str, str]]:
    """Yield (name, rest) of every `realsim NAME ...` within a line of code."""
    for m in INLINE.finditer(prose(text)):
        yield from ((n[1], n[2]) for n in NAMED.finditer(m[1]))
    for block in blocks(text):
        if block.kind in (*TYPED, "text"):
            code = re.sub(r"(?m)(?:^|\s)#\s.*$", "", block.text)
            yield from ((n[1], n[2]) for n in NAMED.finditer(code))


def parse(line: str) -> None:
    """Let click parse a line `realsim ...` as it would be typed; nothing is run.

    Raises:
        click.UsageError: no such command, option or value, or an argument is missing.
    """
    words = shlex.split(line, comments=True)[1:]
    command: click.Command = commands
    name, context = "realsim", None
    while True:
        try:
            context = command.make_context(name, words, parent=context)
        except click.exceptions.Exit:  # --help, --version
            return
        rest = [*getattr(context, "_protected_args", ()), *context.args]
        if not isinstance(command, click.Group) or not rest:
            return
        found, inner, words = command.resolve_command(context, rest)
        assert inner is not None
        name, command = str(found), inner


def unknown_of(name: str, rest: str) -> list[str]:
    """Return what of `realsim NAME ... --option` does not exist."""
    command: click.Command | None = commands.get_command(click.Context(commands), name)
    if command is None:
        return [name]
    options = set(re.findall(r"(?<!\S)--[a-z][a-z-]*", rest))
    known = {"--help"} | _options(command)
    if isinstance(command, click.Group):
        context = click.Context(command)
        first = (rest.split() or [""])[0]
        inner = (
            command.get_command(context, first) if re.fullmatch(r"[a-z][a-z-]*", first) else None
        )
        default = command.get_command(context, "run")
        known |= _options(inner or default or command)
    return sorted(options - known)


def _options(command: click.Command) -> set[str]:
    return {
        flag
        for p in command.params
        if isinstance(p, click.Option)
        for flag in (*p.opts, *p.secondary_opts)
    }


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    heads = HEADING.findall(FENCE.sub("", text))
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", h).lower() for h in heads)
    return {re.sub(r"[^\w\- ]", "", h).replace(" ", "-") for h in plain}
