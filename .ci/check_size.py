"""Print code lines and files by room, and fail where the tree has outgrown its bars.

Code lines are what a reader must follow: docstrings (of fields too), comments and blank lines are
not counted. The bars stand in pyproject.toml, `[tool.realsim.size]`: raising one is a decision that
the change's reviewer sees. Run it as `uv run python .ci/check_size.py [--depth N]`.
"""

import argparse
import ast
import io
import subprocess
import sys
import tokenize
import tomllib
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ("realsim", "calibration", "capture_plans", "sim_bridge")
IDLE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, slots=True)
class File:
    """One Python file."""

    path: str
    lines: int
    code: int
    functions: tuple[int, ...]
    """Code lines of each function, inner ones included in the outer."""


def measure(path: str, source: str) -> File:
    """Count a file's code lines and those of its functions."""
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in IDLE:
            code.update(range(token.start[0], token.end[0] + 1))
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            if isinstance(node.value.value, str):
                code -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    functions = [
        sum(n in code for n in range(node.lineno, (node.end_lineno or node.lineno) + 1))
        for node in ast.walk(tree) if isinstance(node, Function)
    ]  # fmt: skip
    return File(path, source.count("\n"), len(code), tuple(functions))


def tracked() -> list[File]:
    """Measure every Python file that git knows."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    return [measure(p, (ROOT / p).read_text()) for p in listed if (ROOT / p).is_file()]


def print_rooms(files: list[File], depth: int) -> None:
    """Print code lines and files of each folder down to a depth."""
    rooms: dict[str, list[File]] = defaultdict(list)
    for file in files:
        rooms["/".join(file.path.split("/")[:-1][:depth]) or "."].append(file)
    print(f"{'room':44} {'code lines':>10} {'files':>6}")
    for room, inside in sorted(rooms.items()):
        print(f"{room:44} {sum(f.code for f in inside):10,} {len(inside):6}")


def figures_of(files: list[File]) -> dict[str, float]:
    """Return the figures that have a bar, by the bar's name."""
    product = [f for f in files if f.path.startswith(tuple(p + "/" for p in PRODUCT))]
    functions = [n for f in product for n in f.functions]
    return {
        "product_code_lines": sum(f.code for f in product),
        "product_files": len(product),
        "test_code_lines": sum(f.code for f in files if f.path.startswith("tests/")),
        "benchmark_code_lines": sum(f.code for f in files if f.path.startswith("benchmarks/")),
        "file_lines": max(f.lines for f in files),
        "function_median": median(functions),
        "function_p90": quantiles(functions, n=10)[-1],
    }


def main() -> None:
    """Print the rooms and the figures beside their bars; exit with 1 above a bar."""
    parser = argparse.ArgumentParser(description="Code lines by room.")
    parser.add_argument("--depth", type=int, default=3, help="of the folders that are printed")
    files = tracked()
    print_rooms(files, parser.parse_args().depth)
    bars = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["realsim"]["size"]
    figures = figures_of(files)
    print(f"\n{'figure':44} {'now':>10} {'bar':>10}")
    for name, value in figures.items():
        print(f"{name:44} {value:10,.0f} {bars[name]:10,}")
    above = [n for n, v in figures.items() if v > bars[n]]
    longest = max(files, key=lambda f: f.lines)
    print(f"longest file: {longest.path}")
    if above:
        sys.exit(f"above the bar of pyproject.toml [tool.realsim.size]: {', '.join(above)}")


if __name__ == "__main__":
    main()
