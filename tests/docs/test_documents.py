"""What the documents tell a reader to type, to open and to import exists."""

import ast
import importlib
import re
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import click
import pytest

from documents import (
    DOCUMENTS,
    LINK,
    ROOT,
    anchors,
    blocks,
    named_commands,
    parse,
    prose,
    typed_commands,
    unknown_of,
)

each = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))


def read(document: Path) -> str:
    return document.read_text(encoding="utf-8")


def has(module: ModuleType, name: str) -> bool:
    """Return whether `from module import name` works."""
    return hasattr(module, name) or find_spec(f"{module.__name__}.{name}") is not None


# --- the reader of documents itself ------------------------------------------------------------


def test_commands_are_found_in_code_only() -> None:
    text = (
        "realsim turns\n\n    uv run realsim demo --out x  # realsim\n\nand `realsim fly --high`.\n"
        "```sh\nrealsim check A && realsim check B\n```\n    from realsim import View\n"
    )
    text += "    realsim check C --json > c.json || echo bad | realsim demo 2> log\n"
    assert typed_commands(text) == [
        "realsim demo --out x  # realsim", "realsim check A", "realsim check B",
        "realsim check C --json", "realsim demo",
    ]  # fmt: skip
    names = [name for name, _ in named_commands(text)]
    assert names[0] == "fly" and sorted(set(names)) == ["check", "demo", "fly"]


@pytest.mark.parametrize(
    "line", ["realsim fly", "realsim demo --hihg 3", "realsim demo --views many", "realsim check"]
)
def test_what_click_would_refuse_is_refused(line: str) -> None:
    with pytest.raises(click.UsageError):
        parse(line)


def test_unknown_options_are_named() -> None:
    assert unknown_of("fly", "") == ["fly"]
    assert unknown_of("demo", " --out A --hihg") == ["--hihg"]
    assert unknown_of("school", " SESSION --force 20") == []
    assert unknown_of("scan", " import MESH --unit m --hihg") == ["--hihg"]


# --- the documents -----------------------------------------------------------------------------


@each
def test_typed_commands_parse(document: Path) -> None:
    wrong: list[str] = []
    for line in typed_commands(read(document)):
        try:
            parse(line)
        except click.UsageError as error:
            wrong.append(f"{line}: {error.format_message()}")
    assert not wrong, "\n".join(wrong)


@each
def test_named_commands_and_options_exist(document: Path) -> None:
    found = [(n, r, unknown_of(n, r)) for n, r in named_commands(read(document))]
    wrong = [f"realsim {n}{r}: {', '.join(u)}" for n, r, u in found if u]
    assert not wrong, "\n".join(wrong)


@each
def test_links_and_images_lead_somewhere(document: Path) -> None:
    wrong: list[str] = []
    for target in LINK.findall(prose(read(document))):
        path, _, anchor = target.partition("#")
        if "://" in target or target.startswith("mailto:"):
            continue
        there = document if not path else document.parent / path
        if not there.exists():
            wrong.append(target)
        elif anchor and there.suffix == ".md" and anchor not in anchors(read(there)):
            wrong.append(f"{target}: no such heading")
    assert not wrong, wrong


@each
def test_python_compiles_and_imports_what_exists(document: Path) -> None:
    for block in blocks(read(document)):
        if block.kind != "python":
            continue
        tree = ast.parse(block.text, filename=document.name)
        compile(tree, document.name, "exec")
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                missing = [a.name for a in node.names if not has(module, a.name)]
                assert not missing, f"{document.name}: {node.module} has no {missing}"


def test_the_documents_have_commands_snippets_and_links() -> None:
    texts = [read(d) for d in DOCUMENTS]
    assert len(DOCUMENTS) > 50
    assert sum(len(typed_commands(t)) for t in texts) > 150
    assert sum(b.kind == "python" for t in texts for b in blocks(t)) > 15
    assert sum(len(LINK.findall(t)) for t in texts) > 150


def test_the_figures_of_the_readme_are_those_that_were_measured() -> None:
    measured = read(ROOT / "docs/measured.md")
    told = re.findall(r"<!-- (\w+) -->([\d.]+)", read(ROOT / "README.md"))
    assert len(told) > 12
    for key, value in told:
        found = re.search(rf"(?<!\w){key} (?:\| )?([-\d.e]+)", measured)
        digits = len(value.partition(".")[2])
        assert found and f"{float(found[1].rstrip('.')):.{digits}f}" == value, (key, value)


def test_every_guide_is_on_the_entry_page() -> None:
    entry = read(ROOT / "docs/index.md")
    guides = sorted((ROOT / "docs/how-to").glob("*.md"))
    assert guides and not [g.name for g in guides if f"how-to/{g.name}" not in entry]


def test_every_guide_says_how_its_commands_are_typed() -> None:
    guides = {g.name: read(g) for g in sorted((ROOT / "docs/how-to").glob("*.md"))}
    assert not [n for n, text in guides.items() if typed_commands(text) and "`uv run`" not in text]


def test_every_command_is_in_a_document() -> None:
    from realsim.app.cli import commands

    told = {name for d in DOCUMENTS for name, _ in named_commands(read(d))}
    assert not set(commands.list_commands(click.Context(commands))) - told
