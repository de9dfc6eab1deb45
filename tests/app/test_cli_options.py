"""The laws of the command line: every option is explained, and the same thing is spelled alike."""

import re

import click

from realsim.app.cli import COMMANDS, commands
from realsim.app.command import settable, spelling, variable, walk

EVERY = walk(commands)
OPTIONS = [(path, option) for path, command in EVERY.items() for option in settable(command)]
WITHOUT_RESULT = {("completion",), ("config", "template")}
"""These print a text that is their result; JSON of it would help nobody."""
SHARED = {
    "json": (click.types.BoolParamType, True),
    "quiet": (click.types.BoolParamType, True),
    "overwrite": (click.types.BoolParamType, True),
    "restart": (click.types.BoolParamType, True),
    "no-pictures": (click.types.BoolParamType, True),
    "workers": (click.IntRange, False),
    "seed": (click.IntRange, False),
    "out": (click.Path, False),
    "json-file": (click.Path, False),
    "port": (click.IntRange, False),
}
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
    text = " ".join(commands.get_help(ctx).split())
    for name in COMMANDS:
        command = commands.get_command(ctx, name)
        assert command is not None and command.name == name
        sentence = command.get_short_help_str(200)
        assert not sentence.endswith("..."), name
        assert f"{name} {sentence}" in text


def test_the_help_fits_a_terminal_of_80_columns() -> None:
    for path, command in EVERY.items():
        ctx = click.Context(command, info_name="realsim", terminal_width=80)
        text = command.get_help(ctx).partition("Examples:")[0]
        assert max(len(line) for line in text.splitlines()) <= 80, path
