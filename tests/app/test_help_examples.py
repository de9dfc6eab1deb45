"""Every command shows how it is used, and what it shows is so: the examples are run."""

import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from example_inputs import board_inputs, make_inputs, mesh_files
from realsim.app.cli import commands
from realsim.app.command import Group, walk
from realsim.store.lock import only_run_in

COMMANDS = walk(commands)
HARDWARE = ("--robot-host",)
"""Examples with these need a robot: they are parsed to the end, not run."""
SERVES = ("realsim review demo/session",)
"""Run until Ctrl-C: it is pressed."""
ELSEWHERE = ("realsim demo",)
"""Minutes of work that tests/docs/test_tour.py types as well, and holds to what it prints."""
QUICK = (
    "board", "check", "completion", "config show", "config template", "import", "plan-convert",
    "plan-show", "scan list", "stats",
)  # fmt: skip
"""Commands whose examples take little time and no grasps; the others' are marked slow."""
NEEDS_A_DEMO = ("calibrate", "scan sfm", "scan scale")
"""Commands that need a session captured in the simulated lab, board and all."""
MAY_FAIL_A_CHECK = ("scan scale", "scan sfm", "scan import", "scan complete", "school validate",
                    "calibrate", "doctor", "report")  # fmt: skip
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


def name_of(line: str) -> str:
    """Return the command that a line runs."""
    args = words_of(line)
    paths = [p for p in COMMANDS if tuple(args[: len(p)]) == p]
    return " ".join(max(paths, key=len)) if paths else f"{args[0]} run"  # of `realsim school`


EVERY = list(dict.fromkeys(
    line
    for path, command in (COMMANDS | groups(commands)).items()
    for line in printed_examples(command, path)
))  # fmt: skip


def examples_of(keep: Callable[[str, str], bool]) -> list[str]:
    """Return the examples to keep, by the name of the command and by the line."""
    return [line for line in EVERY if keep(name_of(line), line)]


def is_run(line: str) -> bool:
    return line not in (*SERVES, *ELSEWHERE) and not any(word in line for word in HARDWARE)


# --- that they are there, and are real ----------------------------------------------------------


@pytest.mark.parametrize("path", [*COMMANDS, *groups(commands)], ids=" ".join)
def test_every_command_ends_its_help_with_examples_of_itself(path: tuple[str, ...]) -> None:
    command = COMMANDS.get(path) or groups(commands)[path]
    lines = printed_examples(command, path)
    own = " ".join(("realsim", *path))
    short = own.removesuffix(" run")  # `realsim school SESSION` is `realsim school run SESSION`
    assert lines
    for line in lines:
        assert line.startswith((own, short)), line
        assert len(line) <= 98, "wider than the help"
        assert "..." not in line and "<" not in line.replace("'registration.accepted<5'", "")


@pytest.mark.parametrize("line", EVERY)
def test_every_example_has_options_and_arguments_that_there_are(line: str) -> None:
    args = words_of(line)
    ctx = commands.make_context("realsim", args)
    try:
        while isinstance(ctx.command, Group):
            rest = [*ctx._protected_args, *ctx.args]
            name, command, left = ctx.command.resolve_command(ctx, rest)
            assert command is not None
            ctx = command.make_context(name, left, parent=ctx)
    except click.exceptions.Exit as end:  # --help
        assert end.exit_code == 0


# --- that they run ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs without grasps."""
    root = tmp_path_factory.mktemp("plain")
    make_inputs(root, grasps=False)
    library(root)
    return root


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs with grasps and labels."""
    root = tmp_path_factory.mktemp("tried")
    make_inputs(root, grasps=True)
    library(root)
    return root


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a small demo leaves, and photographs out of it."""
    root = tmp_path_factory.mktemp("demo")
    args = f"demo --out {root}/demo --views 12 --objects 2 --grasps 2 --workers 1 --quiet"
    result = CliRunner().invoke(commands, args.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    session = root / "demo/session"
    board_inputs(root, session)
    mesh_files(root)
    shutil.copytree(session, root / "captured")
    shutil.copyfile(session / "models/obj_000009.ply", root / "tube.ply")
    return root


def library(root: Path) -> None:
    """Put the mug into the folder `models`."""
    args = ["scan", "import", str(root / "mug.stl"), "--unit", "mm", "--no-parts", "--library",
            str(root / "models"), "--quiet"]  # fmt: skip
    assert CliRunner().invoke(commands, args, catch_exceptions=False).exit_code in (0, 1)


def run_in(folder: Path, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run an example in a folder of inputs, without what it is about to make."""
    args = words_of(line)
    made = args[args.index("--out") + 1] if "--out" in args else None
    if made == "plan.json":
        (folder / made).unlink()
    if args[:2] == ["scan", "import"]:
        shutil.rmtree(folder / "models")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("REALSIM_CONFIG", "")
    result = CliRunner().invoke(commands, args)
    allowed = {0, 1} if name_of(line) in MAY_FAIL_A_CHECK else {0}
    said = f"{result.output[-2000:]}\n{result.exception!r}"
    assert result.exception is None or isinstance(result.exception, SystemExit), said
    assert result.exit_code in allowed, said


@pytest.mark.parametrize("line", examples_of(lambda name, line: name in QUICK and is_run(line)))
def test_quick_examples_run(
    line: str, plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(plain, tmp_path, dirs_exist_ok=True)
    run_in(tmp_path, line, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    examples_of(lambda name, line: name not in (*QUICK, *NEEDS_A_DEMO) and is_run(line)),
)
def test_the_other_examples_run(
    line: str, tried: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(tried, tmp_path, dirs_exist_ok=True)
    if name_of(line) == "demo":
        shutil.rmtree(tmp_path / "demo")
    run_in(tmp_path, line, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", examples_of(lambda name, line: name in NEEDS_A_DEMO and is_run(line))
)
def test_examples_of_a_captured_session_run(
    line: str, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(demo, tmp_path, dirs_exist_ok=True)
    run_in(tmp_path, line, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("line", SERVES)
def test_what_serves_until_ctrl_c_ends_by_it(line: str, tried: Path) -> None:
    code = "from realsim.app.cli import main; main()"
    command = [sys.executable, "-c", code, *words_of(line), "--no-browser", "--port", "0"]
    with subprocess.Popen(
        command, cwd=tried, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        assert process.stdout is not None
        said = ""
        for text in process.stdout:
            said += text
            if "http" in text:
                break
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        said += process.stdout.read()
        assert process.wait(60) in (0, 130), said
    assert "http" in said and "Traceback" not in said
    with only_run_in(tried / "demo/session"):
        pass  # nothing is held


def test_only_what_needs_hardware_is_not_run() -> None:
    left = [line for line in EVERY if not is_run(line) and line not in (*SERVES, *ELSEWHERE)]
    assert left and all("--robot-host 192.168.1.10" in line for line in left)
