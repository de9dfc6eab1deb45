"""Files of settings and limits that no editor writes: each is refused in one sentence."""

from pathlib import Path

import pytest

from realsim.app.report.run import read_limits
from realsim.errors import InputError
from realsim.untrusted.toml_text import MOST_BYTES, parsed_toml, read_toml
from typed_commands import refused

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
def test_it_is_refused_with_the_name_of_the_file_as_settings_and_as_limits(
    name: str, tmp_path: Path
) -> None:
    text, named = HOSTILE[name]
    path = tmp_path / "strange.toml"
    path.write_text(text)
    with pytest.raises(InputError) as limits:
        read_limits(path)
    for said in (refused("--config", path, "config", "show"), str(limits.value)):
        assert named in said and "strange.toml" in said and len(said) < 600


def test_plain_files_are_read_as_they_stand(tmp_path: Path) -> None:
    text = '# 1.2.3. and so on ......................... \n[a.b]\nc = "x.y.z.' + "a." * 3 + '"\n'
    path = tmp_path / "plain.toml"
    path.write_text(text, encoding="utf-8-sig")
    read, values = read_toml(path)
    assert (read, values) == (text, {"a": {"b": {"c": "x.y.z.a.a.a."}}})
    assert parsed_toml("a = 9223372036854775807", "f")["a"] == 2**63 - 1


def test_a_home_that_nobody_has_is_no_path(tmp_path: Path) -> None:
    path = tmp_path / "home.toml"
    path.write_text('[review]\nstatic = "~nobody-of-this-name/page.html"')
    assert "home" in refused("--config", path, "config", "show")
