"""Every command shows how it is used, and what it shows is so: one example of each kind is run.

Completion in a real bash: commands, options, choices, plans and files, quickly.
"""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from documents import parse
from example_inputs import make_inputs
from realsim.app.cli import commands
from realsim.app.command import Group, walk
from typed_commands import realsim

COMMANDS = walk(commands)
QUICK = (
    "realsim board charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11 --paper A3",
    "realsim check dataset",
    "realsim import frames imported --intrinsics camera.json --depth-unit 0.001 --no-poses",
    "realsim plan-convert shipped:ur5_d405_hemisphere_256 hemisphere.script",
)
"""The other commands' examples are of the kinds that the tests of those commands type."""
LONG = (
    "realsim depth-fit demo/session --only-views 0-3 --out table.json --json",
    "realsim export dataset --to nerfstudio --out as_nerfstudio --only-scenes 1",
    "realsim generate near --scenes 1 --views 2 --objects 2 --size 320x240 --range d405",
    "realsim report demo/session --json --fail-on 'registration.accepted<5'",
    "realsim review demo/session --static scene.html",
    "realsim scan scale generated.obj --measured longest=120.4mm+-0.3mm --out scaled",
    "realsim school export demo/session --to isaac --out isaac --least-score 0.5",
    "realsim school settle demo/session --json",
    "realsim school summary demo/session --json",
)
MAY_FAIL_A_CHECK = ("scan", "report")
"""Commands whose verdict on these small inputs, exit code 1, is not the example's fault."""


def printed_examples(command: click.Command, path: tuple[str, ...]) -> list[str]:
    """Return the lines under `Examples:`, the last block of a command's help."""
    text = command.get_help(click.Context(command, info_name=" ".join(("realsim", *path))))
    _, found, block = text.rpartition("Examples:\n")
    assert found, f"realsim {' '.join(path)} --help has no examples"
    return [line.strip() for line in block.splitlines()]


def groups(group: Group, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Group]:
    found = {path: group}
    ctx = click.Context(group, info_name="realsim")
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        if isinstance(command, Group):
            found |= groups(command, (*path, name))
    return found


def words_of(line: str) -> list[str]:
    """Return the arguments of a line without the shell's `> FILE`."""
    words = shlex.split(line)
    assert words[0] == "realsim"
    return words[1 : words.index(">") if ">" in words else None]


EXAMPLES = {
    path: printed_examples(command, path) for path, command in (COMMANDS | groups(commands)).items()
}


# --- that they are there, and are real ----------------------------------------------------------


def test_every_command_ends_its_help_with_examples_of_itself() -> None:
    for path, lines in EXAMPLES.items():
        own = " ".join(("realsim", *path))
        short = own.removesuffix(" run")  # `realsim school SESSION` is `realsim school run SESSION`
        assert lines, own
        for line in lines:
            assert line.startswith((own, short)), line
            assert len(line) <= 98, "wider than the help"
            assert "..." not in line and "<" not in line.replace("'registration.accepted<5'", "")


def test_every_example_has_options_and_arguments_that_there_are() -> None:
    for line in {line for lines in EXAMPLES.values() for line in lines}:
        parse(line.partition(" > ")[0])


# --- that they run ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    make_inputs(root := tmp_path_factory.mktemp("plain"), grasps=False)
    return root


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs with grasps and labels."""
    make_inputs(root := tmp_path_factory.mktemp("tried"), grasps=True)
    return root


@pytest.mark.parametrize(
    ("line", "inputs"),
    [
        *((line, "plain") for line in QUICK),
        *(pytest.param(line, "tried", marks=pytest.mark.slow) for line in LONG),
    ],
)
def test_examples_run(
    line: str, inputs: str, request: pytest.FixtureRequest, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    assert any(line in lines for lines in EXAMPLES.values()), "the help shows another example"
    shutil.copytree(request.getfixturevalue(inputs), tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("REALSIM_CONFIG", "")
    before = set(tmp_path.rglob("*"))
    args = words_of(line)
    result = CliRunner().invoke(commands, args)
    said = f"{result.output[-2000:]}\n{result.exception!r}"
    assert result.exception is None or isinstance(result.exception, SystemExit), said
    assert result.exit_code in ({0, 1} if args[0] in MAY_FAIL_A_CHECK else {0}), said
    assert result.output.strip() or set(tmp_path.rglob("*")) - before


BASH = shutil.which("bash")
PLAN = "ur5_d405_hemisphere_256"


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a program `realsim`, as an installation has."""
    folder = tmp_path_factory.mktemp("bin")
    program = folder / "realsim"
    program.write_text(f"#!{sys.executable}\nfrom realsim.app.cli import main\nmain()\n")
    program.chmod(0o755)
    return folder


def bash(shim: Path, script: str, cwd: Path) -> str:
    assert BASH is not None
    done = subprocess.run(
        [BASH, "--norc", "-c", f'eval "$(realsim completion bash)"\n{script}'],
        capture_output=True, text=True, cwd=cwd, timeout=120,
        env=os.environ | {"PATH": f"{shim}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout


def completed(shim: Path, cwd: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of the words."""
    typed = " ".join(f"'{w}'" for w in ("realsim", *words))
    script = (
        f"COMP_WORDS=({typed})\nCOMP_CWORD={len(words)}\n"
        "compopt() { :; }\n"  # readline's own, which only knows what a person types
        "_realsim_completion realsim\nprintf '%s\\n' \"${COMPREPLY[@]}\""
    )
    return bash(shim, script, cwd).split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("scho",), ["school"]),
        (("scan", "s"), ["show", "scale", "sfm"]),
        (("register", "--find"), ["--find-all"]),
        (("register", "--method", "t"), ["top-down"]),
        (("capture", "out", "--plan", "shipped", ":", "ur"), [PLAN]),
        (("capture", "out", "--plan", "shipped", ":", "xyz"), []),
        (("capture", "out", "--plan", ""), [f"shipped:{PLAN}", "mine.json"]),
    ],
    ids=" ".join,
)
def test_bash_completes(
    words: tuple[str, ...], offered: list[str], shim: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine.json").write_text("{}")
    assert completed(shim, tmp_path, *words) == offered


def test_bash_completes_files_where_a_file_is_wanted(shim: Path, tmp_path: Path) -> None:
    script = (
        'COMP_WORDS=(realsim check de)\nCOMP_CWORD=2\ncompopt() { echo "files: $*"; }\n'
        "_realsim_completion realsim"
    )
    assert bash(shim, script, tmp_path).split() == ["files:", "-o", "default"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_its_script(shell: str, tmp_path: Path) -> None:
    done = realsim("completion", shell)
    assert done.returncode == 0 and f"_REALSIM_COMPLETE={shell}_complete" in done.stdout
    parser = shutil.which(shell)
    if parser is not None:
        script = tmp_path / "script"
        script.write_text(done.stdout)
        assert subprocess.run([parser, "-n", script]).returncode == 0
