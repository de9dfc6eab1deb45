"""How Sphinx makes the pages: `sphinx-build -W --keep-going -b html docs OUT`; needs no network."""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util import logging

from realsim import __version__

project = "realsim"
copyright = "the realsim authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"realsim {release}"
html_copy_source = False

myst_heading_anchors = 3
default_role = "code"  # a name in single back quotes is code, as on GitHub
highlight_language = "none"  # blocks of commands and of output have no language
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 90
napoleon_numpy_docstring = False
napoleon_use_ivar = True

DOCS = Path(__file__).parent
ROOT = DOCS.parent
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?![a-z]+:)([^)#\s]+)(#[^)\s]*)?\)")
CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)
BARS = re.compile(r"(?<!\\)\|(?=[^`]*(?:`[^`]*`[^`]*)*$)")
logger = logging.getLogger(__name__)


def name_what_lies_outside(app: Sphinx, docname: str, source: list[str]) -> None:
    """Turn links that leave docs/ into the names of the files: the site has pages of docs/ only.

    A link to what does not exist is a warning, and so an error of the build.
    """
    page = Path(app.env.doc2path(docname))
    if page.suffix != ".md":
        return

    def named(match: re.Match[str]) -> str:
        text, target = match[1], match[2]
        path = Path(os.path.normpath(page.parent / target))
        if not path.exists():
            logger.warning("the link '%s' leads nowhere", target, location=docname)
        if path.is_relative_to(DOCS) and path.suffix == ".md":
            return match[0]
        where = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
        return f"{text} (`{where}`)" if str(where) != text.strip("`") else f"`{where}`"

    parts, end = [], 0
    for code in CODE.finditer(source[0]):
        parts += [LINK.sub(named, source[0][end : code.start()]), code[0]]
        end = code.end()
    source[0] = "".join([*parts, LINK.sub(named, source[0][end:])])


def plain_text_as_markup(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Read bars as they are meant, and an indented block of a module as it stands.

    |x| is a magnitude in formulas, not a substitution.
    """
    lines[:] = [BARS.sub(r"\\|", line) for line in lines]
    if what != "module":
        return
    k = 1
    while k < len(lines):
        begins = lines[k].startswith("    ") and not lines[k - 1].strip()
        before = next((x for x in reversed(lines[:k]) if x.strip()), "")
        if begins and not before.startswith(" ") and not before.endswith("::"):
            lines[k:k] = ["::", ""]
            k += 2
        k += 1


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the hooks."""
    app.connect("source-read", name_what_lies_outside)
    app.connect("autodoc-process-docstring", plain_text_as_markup)
    return {"parallel_read_safe": True}
