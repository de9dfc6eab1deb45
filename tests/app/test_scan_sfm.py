"""`realsim scan sfm` on photographs that cannot be used: each one is named."""

from pathlib import Path

import numpy as np
import pytest

from realsim.app.console import Console
from realsim.app.scan.sfm.run import SfmRequest, run_scan_sfm
from realsim.errors import DegenerateError, InputError
from realsim.images import png_bytes


def put(folder: Path, sizes: list[tuple[int, int]]) -> Path:
    """Write even grey pictures (height, width)."""
    folder.mkdir()
    for k, size in enumerate(sizes):
        (folder / f"{k:03d}.png").write_bytes(png_bytes(np.full((*size, 3), 120, np.uint8)))
    return folder


def refused(folder: Path, **options: object) -> str:
    with pytest.raises((InputError, DegenerateError)) as caught:
        run_scan_sfm(SfmRequest(images=folder, **options), Console(quiet=True))  # pyright: ignore[reportArgumentType]
    return str(caught.value)


def test_bad_photographs_are_named(tmp_path: Path) -> None:
    assert "is not a folder" in refused(tmp_path / "missing")
    assert "holds no images" in refused(put(tmp_path / "empty", []))
    assert "2 photograph(s)" in refused(put(tmp_path / "two", [(48, 64)] * 2))
    told = refused(put(tmp_path / "sizes", [(48, 64), (48, 64), (64, 48)]))
    assert "2 of 64x48" in told and "1 of 48x64 (002.png)" in told
    torn = put(tmp_path / "torn", [(48, 64)] * 3)
    (torn / "001.png").write_bytes((torn / "001.png").read_bytes()[:60])
    assert "001.png" in refused(torn)


def test_bare_pictures_say_what_to_do(tmp_path: Path) -> None:
    told = refused(put(tmp_path / "bare", [(120, 160)] * 4))
    assert "no texture" in told and "newspaper" in told and "000.png (0)" in told


def test_poses_and_depth_of_a_plain_folder_are_refused(tmp_path: Path) -> None:
    folder = put(tmp_path / "plain", [(48, 64)] * 3)
    assert "plain folder" in refused(folder, poses="refined")
    assert "no depth images" in refused(folder, dense=True)
