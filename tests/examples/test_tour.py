"""What the documents tell a reader to type exists: commands, options, Python names, files."""

import ast
import importlib
import re
from pathlib import Path

import click
import pytest

from realsim.app.cli import commands
from realsim.app.school.cli import RunByDefault

ROOT = Path(__file__).parents[2]
CHAPTERS = sorted((ROOT / "docs" / "tour").glob("*.md"))
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"^```.*?^```$|^(?: {4}|\t).*$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?<!from )(?<!import )\brealsim ([a-z][a-z-]*)\b([^\n`#]*)")
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")


def snippets(document: Path) -> list[str]:
    return PYTHON.findall(document.read_text(encoding="utf-8"))


def commands_of(text: str) -> list[tuple[str, list[str]]]:
    """Return every `realsim COMMAND --option ...` that stands in code.

    A command of a group comes with the group's name before it: `scan import`. Where a group runs
    one by default, a path or a NAME in capitals is that one's argument.
    """
    code = "\n".join(CODE.findall(text))
    found: list[tuple[str, list[str]]] = []
    for name, rest in COMMAND.findall(code):
        first = (rest.split() or [""])[0]
        group = commands.commands.get(name)
        if isinstance(group, click.Group) and re.fullmatch(r"[a-z][a-z-]*", first):
            name = f"{name} {first}"
        elif isinstance(group, RunByDefault):
            name = f"{name} run"
        found.append((name, re.findall(r"--[a-z-]+", rest)))
    return found


def command_of(name: str) -> click.Command | None:
    """Return a command by its name, that of its group first; None if there is none."""
    command: click.Command | None = commands
    for word in name.split():
        if not isinstance(command, click.Group):
            return None
        command = command.get_command(click.Context(command), word)  # some are loaded by name only
    return command


def options_of(command: click.Command) -> set[str]:
    return {flag for p in command.params if isinstance(p, click.Option) for flag in p.opts}


def test_commands_are_found_in_code_only() -> None:
    text = (
        "realsim turns\n\n    uv run realsim demo --out x  # realsim\n\nand `realsim fly --high`.\n"
    )
    assert commands_of(text) == [("demo", ["--out"]), ("fly", ["--high"])]
    assert commands_of("    from realsim import View\n") == []
    assert commands_of("`realsim scan import MESH --unit m`") == [("scan import", ["--unit"])]
    assert commands_of("`realsim school a/b --seed 1`") == [("school run", ["--seed"])]
    assert commands_of("`realsim school settle A --out B`") == [("school settle", ["--out"])]
    assert command_of("scan fly") is None and command_of("demo fly") is None


def test_there_is_a_chapter_for_every_stage() -> None:
    names = " ".join(p.stem for p in CHAPTERS)
    for stage in (
        "plan",
        "capture",
        "calibrate",
        "register",
        "school",
        "annotate",
        "review",
        "models",
    ):
        assert stage in names
    assert sum(len(snippets(p)) for p in CHAPTERS) >= 7


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda p: p.stem)
def test_snippets_compile_and_import_what_exists(chapter: Path) -> None:
    for code in snippets(chapter):
        tree = ast.parse(code, filename=chapter.name)
        compile(tree, chapter.name, "exec")
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                missing = [a.name for a in node.names if not hasattr(module, a.name)]
                assert not missing, f"{chapter.name}: {node.module} has no {missing}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_named_commands_and_options_exist(document: Path) -> None:
    for name, options in commands_of(document.read_text(encoding="utf-8")):
        command = command_of(name)
        assert command is not None, f"`realsim {name}` is not a command"
        unknown = set(options) - options_of(command)
        assert not unknown, f"`realsim {name}` has no {sorted(unknown)}"


def test_the_readme_names_commands() -> None:
    assert {"demo", "upgrade"} <= {name for name, _ in commands_of(DOCUMENTS[0].read_text())}


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda p: p.stem)
def test_links_lead_somewhere(chapter: Path) -> None:
    for target in LINK.findall(chapter.read_text(encoding="utf-8")):
        assert "://" in target or (chapter.parent / target).exists(), target


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda p: p.stem)
def test_chapters_stay_short(chapter: Path) -> None:
    assert chapter.read_text(encoding="utf-8").count("\n") <= 50
