"""The command line: quick to answer, and clear about what it cannot use.

The laws of the command line: every option is explained, and the same thing is spelled alike.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest

from realsim import app
from realsim.app.cli import commands
from realsim.app.command import context_of, settable, spelling, variable, walk
from realsim.app.config import settings
from realsim.app.front import COMMANDS, GROUPS, help_text
from realsim.app.meanings import MEANINGS, OLD_NAMES
from realsim.app.options import two_meanings
from stored_sessions import flip, make_whole
from typed_commands import complained, realsim, started, wait_until

MAIN = "from realsim.app.cli import main; main()"
HEAVY = "numpy open3d pybullet gtsam cv2 viser trimesh scipy numba matplotlib".split()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, click\n"
        "from realsim.app import cli\n"
        "try: cli.commands(['--help'], standalone_mode=False)\n"
        "except SystemExit: pass\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "print('HEAVY', heavy)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "HEAVY []" in done.stdout, done.stdout + done.stderr


def test_a_folder_that_is_no_session_is_named(tmp_path: Path) -> None:
    for command in ("calibrate", "register", "school", "annotate", "report"):
        said = complained(command, tmp_path)
        assert str(tmp_path) in said and "session.json" in said
        assert list(tmp_path.iterdir()) == []


# --- exit codes ---------------------------------------------------------------------------------


def test_0_is_done(tmp_path: Path) -> None:
    assert realsim("board", "tag:7,size=80mm", "--out", tmp_path / "b").returncode == 0


def test_1_is_done_but_a_check_failed(tmp_path: Path) -> None:
    make_whole(tmp_path / "s")
    assert realsim("check", str(tmp_path / "s")).returncode == 0
    flip(next((tmp_path / "s/rgb").iterdir()), 100)
    done = realsim("check", str(tmp_path / "s"), "--json")
    assert done.returncode == 1 and json.loads(done.stdout)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["schol"], "Did you mean 'school'?"),
        (["school", "run"], "Missing argument"),
        (["scan", "lst"], "Did you mean 'list'?"),
        (["register", "s", "--view", "3"], "Did you mean"),
        (["demo", "--views", "3"], "4<=x<=1024"),
        (["demo", "--views", "abc"], "'abc' is not a whole number"),
        (["export", "s", "--to", "bob", "--out", "o"], "bop"),
        ([], "Prepare:"),
    ],
)
def test_2_is_bad_input(
    args: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = realsim(*args)
    assert done.returncode == 2 and says in done.stderr + done.stdout
    assert "Traceback" not in done.stderr and list(tmp_path.iterdir()) == []


def test_130_is_interrupted(tmp_path: Path) -> None:
    words = ("demo", "--out", tmp_path / "d", "--workers", "1")
    with started(*words, stderr=subprocess.PIPE) as process:
        wait_until((tmp_path / "d/demo.json").is_file, process)
        # A compiler that calls back into Python swallows what is raised there: asked until it ends.
        for _ in range(5):
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
                break
        _, said = process.communicate(timeout=10)
    assert process.returncode == 130 and "interrupted" in said and "Traceback" not in said


def test_a_reader_that_goes_away_is_no_error() -> None:
    script = f"{sys.executable} -c '{MAIN}' config template | head -1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=100)
    assert done.returncode in (0, 141) and done.stderr == ""
    assert done.stdout.startswith("# Settings")


@pytest.mark.parametrize("place", [0, 1, 2])
def test_no_color_may_stand_anywhere(place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "")  # restored in the end, whatever the command sets
    words = ["config", "template"]
    words.insert(place, "--no-color")
    assert realsim(*words).returncode == 0 and os.environ["NO_COLOR"] == "1"


def test_demo_takes_nobodys_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert "not empty" in complained("demo", "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_unwritable_output_is_one_paragraph() -> None:
    # /proc refuses new folders for everybody, root included.
    assert "/proc" in complained("demo", "--out", "/proc/realsim-demo")


def test_upgrade_names_a_folder_without_scenes(tmp_path: Path) -> None:
    assert "scene" in complained("upgrade", tmp_path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


EVERY = walk(commands)
OPTIONS = [(path, option) for path, command in EVERY.items() for option in settable(command)]
WITHOUT_RESULT = {("completion",), ("config", "template")}
"""These print a text that is their result; JSON of it would help nobody."""
SHARED = {
    "json": (click.types.BoolParamType, True), "quiet": (click.types.BoolParamType, True),
    "overwrite": (click.types.BoolParamType, True), "restart": (click.types.BoolParamType, True),
    "no-pictures": (click.types.BoolParamType, True), "workers": (click.IntRange, False),
    "seed": (click.IntRange, False), "out": (click.Path, False), "json-file": (click.Path, False),
    "port": (click.IntRange, False),
}  # fmt: skip
"""Option -> its type, and whether it is a flag, wherever it is."""
OTHER_SPELLINGS = {
    "output": "out", "out-dir": "out", "output-dir": "out", "outdir": "out", "jobs": "workers",
    "processes": "workers", "n-workers": "workers", "random-seed": "seed", "force-overwrite":
    "overwrite", "replace": "overwrite", "silent": "quiet", "color": "no-color", "verbose": "quiet",
    "json-out": "json-file", "as-json": "json",
}  # fmt: skip


def named(path: tuple[str, ...], option: click.Option) -> str:
    return f"{' '.join(path)} --{spelling(option)}"


def test_every_option_is_explained_and_spelled_in_one_way() -> None:
    for path, option in OPTIONS:
        name, said = spelling(option), named(path, option)
        assert option.help and len(option.help) <= 160, said
        assert re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name), said
        assert name not in OTHER_SPELLINGS, f"{said}: say --{OTHER_SPELLINGS.get(name)}"
        if name in SHARED:
            kind, is_flag = SHARED[name]
            assert isinstance(option.type, kind), said
            assert option.is_flag == is_flag, said


def test_what_a_command_needs_is_asked_for(tmp_path: Path) -> None:
    needy = [(path, c) for path, c in EVERY.items() if any(o.required for o in settable(c))]
    assert {path[0] for path, _ in needy} >= {"upgrade", "export", "demonstrations", "capture"}
    for path, c in needy:
        given = [str(tmp_path) for p in c.params if isinstance(p, click.Argument) and p.required]
        context = click.Context(c, info_name=" ".join(path))
        with pytest.raises(click.MissingParameter):
            c.parse_args(context, given)


def test_every_command_that_works_has_json_and_quiet() -> None:
    for path in EVERY.keys() - WITHOUT_RESULT:
        assert {"json", "quiet"} <= {spelling(option) for option in settable(EVERY[path])}, path


def test_the_shared_options_say_the_same_everywhere() -> None:
    for name in ("json", "quiet"):
        helps = {o.help for path, o in OPTIONS if spelling(o) == name}
        assert len(helps) == 1, helps


def test_each_variable_is_of_one_option() -> None:
    names = [variable(path, option) for path, option in OPTIONS]
    assert len(set(names)) == len(names)
    assert "REALSIM_REGISTER_VIEWS" in names and "REALSIM_SCHOOL_RUN_FORCE" in names
    for path, option in OPTIONS:
        assert option.envvar == variable(path, option)


def test_every_command_is_listed_with_a_whole_sentence() -> None:
    ctx = click.Context(commands, info_name="realsim")
    lines = commands.get_help(ctx).splitlines()
    for title, group in GROUPS.items():
        at = lines.index(f"{title}:") + 1
        listed = [f"  {name:15} {does}." for name, does in group.items()]
        assert listed == lines[at : at + len(group)]
    for name in COMMANDS:
        command = commands.get_command(ctx, name)
        assert command is not None and command.name == name
        assert not command.get_short_help_str(200).endswith("..."), name
    assert help_text() == commands.get_help(ctx) + "\n"


def test_no_option_has_two_meanings() -> None:
    assert two_meanings(EVERY) == {}
    other = click.Command("other", params=[click.Option(["--views"], help="Other views.")])
    assert set(two_meanings({**EVERY, ("other",): other})) == {"views"}
    taken = {spelling(o) for _, o in OPTIONS}
    assert MEANINGS.keys() - taken == set(), "no command takes these"


def test_rare_options_are_shown_by_help_all_alone() -> None:
    short = realsim("import", "--help").stdout
    every = realsim("import", "--help-all").stdout
    shown = [o for path, o in OPTIONS if path == ("import",) and o.opts[0] in short]
    assert len(shown) <= 12 and "--help-all" in short and "--ee-frame" not in short
    assert all(o.opts[0] in every for path, o in OPTIONS if path == ("import",))
    assert realsim("demo", "--help-all").stdout == realsim("demo", "--help").stdout


def test_old_names_work_with_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for path, names in OLD_NAMES.items():
        command = EVERY[tuple(path.split())]
        known = {spelling(o) for o in settable(command)}
        assert set(names.values()) <= known and not known & names.keys(), path
    command = EVERY["capture",]
    typed, parent = [str(tmp_path / "out"), "--plan=p"], context_of(commands, ())
    more = ["--views=1-3", "--camera", "7"]
    ctx = command.make_context("capture", [*typed, *more], parent=parent)
    assert ctx.params["views"] == (1, 2, 3) and ctx.params["camera"] == "7"
    said = capsys.readouterr().err
    assert "--views is now called --only-views" in said and "--camera-serial" in said
    monkeypatch.setenv("REALSIM_CAPTURE_CAMERA", "8")
    monkeypatch.setenv("REALSIM_CAPTURE_CAMERA_SERIAL", "")
    monkeypatch.delenv("REALSIM_CAPTURE_CAMERA_SERIAL")  # unset again at the end
    ctx = command.make_context("capture", typed, parent=parent)
    assert ctx.params["camera"] == "8"
    (tmp_path / "s.toml").write_text('[render]\ncamera = "d435"\n')
    done = realsim("--config", tmp_path / "s.toml", "config", "show", "render")
    assert "camera is now called sensor" in done.stderr and "d435" in done.stdout


def test_the_help_fits_a_terminal_of_80_columns() -> None:
    for path, command in EVERY.items():
        ctx = click.Context(command, info_name="realsim", terminal_width=80)
        text = command.get_help(ctx).partition("Examples:")[0]
        assert max(len(line) for line in text.splitlines()) <= 80, path


# --- what is missing is named with what installs it ---------------------------------------------

LOST_LIBRARY = "libstdc++.so.6: cannot open shared object file: No such file or directory"


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        (ImportError(LOST_LIBRARY, name="pinocchio"),
         ("pinocchio", "libstdc++6", "apt-get install")),
        (ModuleNotFoundError("No module named 'numba'", name="numba"),
         ("numba is not installed", "uv sync")),
        (ModuleNotFoundError("No module named 'realsim.nowhere'", name="realsim.nowhere"), ()),
    ],
    ids=lambda of: getattr(of, "name", ""),
)  # fmt: skip
def test_what_is_missing_ends_with_what_to_install_and_a_bug_with_its_place(
    missing: ImportError, words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def load(*_: object, **__: object) -> None:
        raise missing

    monkeypatch.setattr(settings, "apply_config", load)
    monkeypatch.setattr(sys, "argv", ["realsim", "config", "show"])
    with pytest.raises(SystemExit if words else ModuleNotFoundError) as stop:
        app.main()
    if words:
        assert getattr(stop.value, "code", None) == 2
        said = capsys.readouterr().err
        assert all(w in said for w in (*words, "realsim doctor"))


# --- output that nobody wants (`>&-`, `2>&-`, a reader that has gone) -----------------------------

CLOSED = "<&- >&- 2>&-"


def run(script: str, arguments: str, closed: str) -> subprocess.CompletedProcess[str]:
    """Run a script of Python by a shell that closes streams first."""
    line = f"exec '{sys.executable}' -c '{script}' {arguments} {closed}"
    return subprocess.run(
        ["sh", "-c", line], capture_output=True, text=True, timeout=120, check=False
    )


def test_the_result_is_that_of_a_run_whose_streams_are_open(
    small_session: Path, tmp_path: Path
) -> None:
    files = [tmp_path / "open.json", tmp_path / "closed.json"]
    assert realsim("stats", small_session, "--json-file", files[0]).returncode == 0
    done = run(MAIN, f"stats '{small_session}' --json-file '{files[1]}'", CLOSED)
    assert done.returncode == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_what_a_library_prints_never_lands_in_a_file(tmp_path: Path) -> None:
    script = (
        "import os, sys; from realsim.app.console import open_missing_streams; "
        "open_missing_streams(); file = open(sys.argv[1], \"w\"); "
        "os.write(1, b\"noise\"); os.write(2, b\"noise\"); os.system(\"echo noise\"); "
        "print(\"noise\"); file.write(\"kept\"); file.close()"
    )  # fmt: skip
    path = tmp_path / "file"
    assert run(script, f"'{path}'", CLOSED).returncode == 0
    assert path.read_text() == "kept"


@pytest.mark.parametrize("words", [["--help"], ["check", "S"], ["check", "S", "--json"], ["no"]])
@pytest.mark.parametrize("also_errors", [False, True])
def test_a_reader_that_has_gone_is_no_failed_check(
    words: list[str], also_errors: bool, small_session: Path
) -> None:
    typed = [str(small_session) if w == "S" else w for w in words]
    reading, writing = os.pipe()
    os.close(reading)
    errors = writing if also_errors else subprocess.PIPE
    process = started(*typed, stdout=writing, stderr=errors)
    said = process.communicate(timeout=120)[1]
    os.close(writing)
    writes = also_errors or words != ["no"]
    assert process.returncode == (128 + signal.SIGPIPE if writes else 2)
    assert not said or "Traceback" not in said


def test_pycolmap_leaves_the_answer_to_sigterm_alone() -> None:
    script = """if True:
        import os, signal, sys, time
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        from realsim.interop import import_pycolmap
        import_pycolmap()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == 143 and b"stack trace" not in done.stderr


@pytest.mark.parametrize(
    ("cause", "code"), [("cli.Terminated()", 143), ("KeyboardInterrupt()", 130), ("None", 1)]
)
def test_sigterm_in_a_compiled_call_while_a_module_is_loaded_is_no_bug(
    cause: str, code: int
) -> None:
    script = f"""if True:
        import sys
        from realsim.app import cli
        def work():
            try:
                raise SystemError("returned a result with an exception set") from {cause}
            except SystemError as error:
                raise ImportError("initialization failed") from error
        cli.commands.command("work")(work)
        sys.argv = ["realsim", "work"]
        cli.main()
    """
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == code and (b"goes on from here" in done.stderr) == (code != 1)


def test_a_second_sigterm_does_not_break_into_the_ending() -> None:
    script = """if True:
        import sys, time
        from realsim.app import cli
        from realsim.many import open_pool
        def work():
            with open_pool(2) as pool:
                pool.submit(time.sleep, 0.0).result()
                print("ready", flush=True)
                time.sleep(60)
        if __name__ == "__main__":
            cli.commands.command("work")(work)
            sys.argv = ["realsim", "work"]
            cli.main()
    """
    run = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, text=True)  # fmt: skip
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    while run.poll() is None:
        run.terminate()
        time.sleep(0.01)
    told = run.communicate()[1].strip()
    assert (run.returncode, told) == (143, "interrupted; the same command goes on from here.")
