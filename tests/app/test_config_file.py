"""Settings: the command line over variables over the file over defaults, and errors that help."""

import json
import re
from pathlib import Path
from typing import Any

import click
import pytest

from realsim.app.cli import commands
from realsim.app.command import default_of, settable, spelling, walk
from realsim.app.config.settings import find_config, read_config, settings_of
from realsim.app.config.template import template, toml_value
from realsim.app.option_values import Numbers
from realsim.app.outputs import OutputFile
from realsim.app.report.run import read_limits
from realsim.untrusted.toml_text import MOST_BYTES, parsed_toml, read_toml
from refusals import refused
from typed_commands import complained, finished, realsim

EVERY = walk(commands)


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, and no settings of the person who runs the tests."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    for name in ("REALSIM_CONFIG", "REALSIM_REGISTER_VIEWS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def written(text: str, path: str = "settings.toml") -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def read(text: str) -> dict[str, Any]:
    return settings_of(commands, read_config(written(text), "", is_named=True))


def in_force(command: str, option: str, *before: str) -> tuple[Any, str]:
    told = json.loads(finished(*before, "config", "show", *command.split(), "--json").stdout)
    (row,) = [o for o in told["options"] if (o["command"], o["option"]) == (command, option)]
    return row["value"], row["origin"]


# --- the template is the whole truth ------------------------------------------------------------


def test_the_template_without_its_comment_marks_sets_every_option_to_its_default() -> None:
    settings = read(re.sub(r"^# (?=[a-z0-9-]+ = )", "", template(EVERY), flags=re.MULTILINE))
    for path, command in EVERY.items():
        here: Any = settings
        for name in path:
            here = here.get(name, {})
        for option in settable(command):
            assert option.name is not None
            default = default_of(option)
            if option.name not in here:
                assert default is None, (path, option.name)
                continue
            ctx = click.Context(command)
            found = option.type_cast_value(ctx, here[option.name])
            wanted = option.type_cast_value(ctx, default)
            assert found == wanted, (path, option.name)


# --- who wins -----------------------------------------------------------------------------------


def test_the_command_line_wins_over_variables_over_the_file_over_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written("[register]\nviews = 64\n[school.run]\nforce = 20\n", "realsim.toml")
    assert in_force("register", "views") == (64, "realsim.toml, line 2")
    assert in_force("school run", "force") == (20.0, "realsim.toml, line 4")
    assert in_force("register", "method") == ("joint", "default")
    monkeypatch.setenv("REALSIM_REGISTER_VIEWS", "32")
    assert in_force("register", "views") == (32, "REALSIM_REGISTER_VIEWS")
    assert views_of_a_run() == 32
    assert views_of_a_run("--views", "16") == 16
    monkeypatch.delenv("REALSIM_REGISTER_VIEWS")
    assert views_of_a_run() == 64
    Path("realsim.toml").unlink()
    assert views_of_a_run() == "all"


def views_of_a_run(*more: str) -> int | str:
    """Return what `realsim register` would get as --views."""
    seen: list[int | str] = []
    command = commands.get_command(click.Context(commands), "register")
    assert command is not None
    kept, command.callback = command.callback, lambda **options: seen.append(options["views"])
    try:
        finished("register", "s", *more)
    finally:
        command.callback = kept
    return seen[0]


def test_every_option_can_be_set_in_the_file_and_by_its_variable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each to another value than its default, by the place that the option has in the tree."""
    for path, command in EVERY.items():
        for option in settable(command):
            other = another_value(option)
            text = f"[{'.'.join(path)}]\n{spelling(option)} = {toml_value(other)}\n"
            here: Any = read(text)
            for name in path:
                here = here[name]
            ctx = click.Context(command, default_map=here)
            wanted = option.type_cast_value(click.Context(command), other)
            value, source = option.consume_value(ctx, {})
            assert source is click.core.ParameterSource.DEFAULT_MAP, (path, option.name)
            assert option.type_cast_value(ctx, value) == wanted
            assert isinstance(option.envvar, str)
            single = other[0] if isinstance(other, list) else other
            words = " ".join([str(single)] * option.nargs)
            monkeypatch.setenv(option.envvar, words)
            value, source = option.consume_value(ctx, {})
            assert source is click.core.ParameterSource.ENVIRONMENT
            assert option.type_cast_value(ctx, value) == wanted, (path, option.name)
            monkeypatch.delenv(option.envvar)


def another_value(option: click.Option) -> Any:
    kind = option.type
    if option.is_flag:
        return True
    if isinstance(kind, click.Choice):
        value: Any = list(kind.choices)[-1]
    elif isinstance(kind, click.IntRange):
        value = int(kind.max if kind.max is not None else (kind.min or 0) + 7)
    elif isinstance(kind, click.FloatRange):
        value = kind.max if kind.max is not None and kind.max < 0.75 else 0.75
    elif kind is click.INT:
        value = 11
    elif isinstance(kind, Numbers):
        value = "2-4,9"
    elif kind is click.FLOAT:
        value = 0.125
    elif isinstance(kind, OutputFile):
        value = f"another{next(iter(kind.own))}"
    else:
        value = "another"
    if option.nargs > 1:
        return [value] * option.nargs
    return [value] if option.multiple else value


# --- which file ---------------------------------------------------------------------------------


def test_the_first_file_that_is_there_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def views(*before: str) -> Any:
        return in_force("register", "views", *before)[0]

    assert views() == "all"
    for k, path in enumerate(("home/realsim/config.toml", "realsim.toml", "variable.toml")):
        written(f"[register]\nviews = {k + 1}\n", path)
        assert views() == min(k + 1, 2)
    monkeypatch.setenv("REALSIM_CONFIG", "variable.toml")
    assert views() == 3
    written("[register]\nviews = 4\n", "named.toml")
    assert views("--config", "named.toml") == 4
    assert "Give one" in complained(*["--config", "named.toml"] * 2, "config", "show")
    assert "before the command" in complained("register", "s", "--config", "named.toml")
    assert read("[plan]\ncenter = [0.4, 0, 0.05]")["plan"]["center"] == "0.4,0,0.05"
    monkeypatch.setenv("REALSIM_CONFIG", "")
    assert views() == "all"
    assert find_config(None) is None


def test_a_file_in_the_current_folder_is_told_once_and_not_to_the_quiet() -> None:
    written("[board]\npaper = 'A3'\n", "realsim.toml")
    loud = realsim("board", "tag:7,size=80mm", "--out", "a", "--json")
    assert loud.returncode == 0 and loud.stderr.count("realsim.toml") == 1
    assert json.loads(loud.stdout)["paper"] == "A3"
    quiet = realsim("board", "tag:7,size=80mm", "--out", "b", "--quiet")
    assert quiet.returncode == 0 and quiet.stderr == ""
    named = realsim("--config", "realsim.toml", "board", "tag:7,size=80mm", "--out", "c")
    assert named.returncode == 0 and named.stderr == ""


def test_a_named_file_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, args in (("--config", ["--config", "gone.toml"]), ("REALSIM_CONFIG", [])):
        if not args:
            monkeypatch.setenv(name, "gone.toml")
        said = complained(*args, "scan", "list")
        assert "gone.toml" in said and name in said


# --- what it refuses ----------------------------------------------------------------------------

REFUSED = {
    "[registre]\nviews = 3": ["settings.toml, line 1", "[registre]", "did you mean register"],
    "\n[register]\nmethod = 'joint'\nVIEW = 3": [
        "settings.toml, line 4", "no option 'VIEW'", "did you mean views", "depth-bias",
    ],
    "[register]\nmethod = 'both'": ["line 2", '"both"', "joint", "top-down"],
    "[register]\nviews = 2.5": ["line 2", "is not a whole number"],
    "[demo]\nviews = 2": ["line 2", "2", "4<=x<=1024"],
    "[demo]\nviews = true": ["line 2", "true", "a whole number"],
    "[demo]\nquiet = 'yes'": ["line 2", "true or false"],
    "[register]\ndepth-bias = 'off'\ndepth_bias = 'off'": ["twice"],
    "[school]\nforce = 20": ["line 2", "'force'", "school.run"],
    "[school.rum]\nforce = 20": ["line 1", "did you mean run"],
    "workers = 8": ["line 1", "'workers'", "outside of a command's table"],
    "[register]\nsession = 'a'": ["no option 'session'"],
    "[register\nviews = 1": ["settings.toml is not TOML", "line 1"],
}  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_what_cannot_be_used_is_named_with_its_line_and_what_would_do(text: str) -> None:
    said = refused(".", read, text)
    for words in REFUSED[text]:
        assert words in said, said
    assert "\n" not in said


def test_a_wrong_file_stops_work_but_not_help_doctor_and_config_template() -> None:
    written("[registre]\n", "realsim.toml")
    for args in (["scan", "list"], ["config", "show"]):
        complained(*args)
    for args in (["--help"], ["config", "template"], ["completion", "bash"]):
        assert realsim(*args).returncode == 0


def test_bytes_that_are_no_text_are_named() -> None:
    Path("realsim.toml").write_bytes(b"\xff\xfe\x00")
    assert "realsim.toml" in complained("config", "show")


def test_a_variable_that_cannot_be_used_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REALSIM_DEMO_VIEWS", "many")
    assert "REALSIM_DEMO_VIEWS" in complained("demo")


# --- files that no editor writes: each is refused in one sentence --------------------------------

HOSTILE = {
    "deep": ("a = " + "[" * 5000, "nested deeper"),
    "tables": ("a = {" + "b = {" * 3000, "nested deeper"),
    "digits": ("a = " + "9" * 6000, "thousands of digits"),
    "hexadecimal": ("[register]\nviews = 0x" + "f" * 6000, "64 bits"),
    "zero": ('[review]\nstatic = "\\u0000"', "static has a text with the character zero"),
    "zero in a name": ('"a\\u0000b" = 1', "character zero"),
    "parts": ("a" + ".a" * 100_000 + " = 1", "more than 20 parts"),
    "parts inside": ("x = {a" + ".a" * 100_000 + " = 1}", "more than 20 parts"),
    "large": ("#" * int(MOST_BYTES + 1), "at most 1 MB"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_it_is_refused_with_the_name_of_the_file_as_settings_and_as_limits(name: str) -> None:
    text, named = HOSTILE[name]
    path = written(text, "strange.toml")
    for said in (complained("--config", path, "config", "show"), refused(".", read_limits, path)):
        assert named in said and "strange.toml" in said and len(said) < 600


def test_plain_files_are_read_as_they_stand() -> None:
    text = '# 1.2.3. and so on ......................... \n[a.b]\nc = "x.y.z.' + "a." * 3 + '"\n'
    path = Path("plain.toml")
    path.write_text(text, encoding="utf-8-sig")
    read, values = read_toml(path)
    assert (read, values) == (text, {"a": {"b": {"c": "x.y.z.a.a.a."}}})
    assert parsed_toml("a = 9223372036854775807", "f")["a"] == 2**63 - 1


def test_a_home_that_nobody_has_is_no_path() -> None:
    path = written('[review]\nstatic = "~nobody-of-this-name/page.html"', "home.toml")
    assert "home" in complained("--config", path, "config", "show")
