"""Archives of others are unpacked whole and inside the folder, or nothing of them is."""

import gzip
import io
import os
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from realsim.errors import InputError
from realsim.untrusted import archives
from realsim.untrusted.archives import Member, extract, members
from refusals import refused

FILES = {"train/000001/scene_gt.json": b"{}", "a" * 140 + ".bin": bytes(range(256)) * 9, "x": b""}


def _tar(path: Path, *entries: tuple[tarfile.TarInfo, bytes], mode: str = "w") -> Path:
    with tarfile.open(path, mode) as archive:  # pyright: ignore[reportCallIssue, reportArgumentType]
        for info, data in entries:
            archive.addfile(info, io.BytesIO(data))
    return path


def _info(
    name: str, size: int = 0, kind: bytes = tarfile.REGTYPE, link: str = ""
) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname = size, kind, link
    return info


def _zip(path: Path, files: dict[str, bytes], mode: int = 0) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = mode << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, data)
    return path


def _good(folder: Path, kind: str) -> Path:
    path = folder / f"good.{kind}"
    if kind == "zip":
        return _zip(path, {"folder/": b"", **FILES})
    entries = [(_info("folder", kind=tarfile.DIRTYPE), b"")]
    entries += [(_info(name, len(data)), data) for name, data in FILES.items()]
    return _tar(path, *entries, mode="w:gz" if kind == "tar.gz" else "w")


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz"])
def test_what_was_packed_is_unpacked(tmp_path: Path, kind: str) -> None:
    path = _good(tmp_path, kind)
    assert members(path) == tuple(Member(name, len(data)) for name, data in FILES.items())
    out = tmp_path / "out"
    assert extract(path, out, most_bytes=1e6) == tuple(out / name for name in FILES)
    assert {name: (out / name).read_bytes() for name in FILES} == FILES
    assert (out / "folder").is_dir()
    refused("holds something", extract, path, out, most_bytes=1e6)


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz"])
def test_every_cut_is_refused_and_leaves_nothing(tmp_path: Path, kind: str) -> None:
    path = _good(tmp_path, kind)
    raw = path.read_bytes()
    # The last kilobytes of a tar are zeros that nobody needs.
    ends = range(0, len(raw) - (9216 if kind == "tar" else 20), max(1, len(raw) // 60))
    read = 0
    for end in ends:
        path.write_bytes(raw[:end])
        try:
            found = extract(path, tmp_path / f"out{end}", most_bytes=1e6)
        except InputError:
            read += 1
            assert not (tmp_path / f"out{end}").exists()
        else:  # a tar may end after any of its files
            assert kind != "zip"
            assert all(
                f.read_bytes() == FILES[f.relative_to(tmp_path / f"out{end}").as_posix()]
                for f in found
            )
    assert read > len(ends) / 2
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


ESCAPES = ["a/../../x", "/etc/realsim-x", "a\\..\\..\\x", "C:/x", "a\nb", "a/" * 40 + "x"]


@pytest.mark.parametrize("name", ESCAPES)
@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_names_that_lead_out_are_refused(tmp_path: Path, name: str, kind: str) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    make: Callable[[], Path] = {
        "zip": lambda: _zip(tmp_path / "a.zip", {"good": b"1", name: b"2"}),
        "tar": lambda: _tar(tmp_path / "a.tar", (_info("good", 1), b"1"), (_info(name, 1), b"2")),
    }[kind]
    path = make()
    before = sorted(tmp_path.rglob("*"))
    refused(r"a\.(zip|tar)", extract, path, inner / "out", most_bytes=1e6)
    refused(".", members, path)
    assert sorted(tmp_path.rglob("*")) == before


def test_links_and_devices_are_refused(tmp_path: Path) -> None:
    kinds = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE)
    for kind in kinds:
        path = _tar(tmp_path / "a.tar", (_info("out", kind=kind, link="/etc"), b""))
        refused("a link, a device", extract, path, tmp_path / "out", most_bytes=1e6)
    path = _zip(tmp_path / "a.zip", {"out": b"/etc"}, mode=stat.S_IFLNK | 0o777)
    refused("a link", extract, path, tmp_path / "out", most_bytes=1e6)


def test_files_with_holes_are_refused(tmp_path: Path) -> None:
    info = _info("x", 512)
    info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.minor": "0",
                        "GNU.sparse.name": "x", "GNU.sparse.realsize": str(10**13)}  # fmt: skip
    path = _tar(tmp_path / "a.tar", (info, b"1\n0\n512\n".ljust(512, b"\0")))
    refused(r"a\.tar", extract, path, tmp_path / "out", most_bytes=1e6)


def _bomb(path: Path, files: int) -> Path:
    """Write an archive of files of 20 MB each (one, in a tar) that packs to next to nothing."""
    zeros = bytes(20_000_000)
    if path.suffix == ".zip":
        return _zip(path, {f"{k}": zeros for k in range(files)})
    return _tar(path, (_info("x", len(zeros)), zeros), mode="w:gz")


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_what_unfolds_a_thousandfold_is_refused(tmp_path: Path, kind: str) -> None:
    path = _bomb(tmp_path / f"a.{kind}", 1)
    assert path.stat().st_size < 100_000
    refused("more than is allowed", extract, path, tmp_path / "out", most_bytes=1e6)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_a_bomb_is_refused_by_its_size_whatever_room_there_is(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "ALWAYS_UNFOLDED", 1e6)
    path = _bomb(tmp_path / f"a.{kind}", 3)
    if kind == "zip":
        monkeypatch.setattr(archives, "_written", lambda *_: pytest.fail("a byte was unpacked"))
    refused("more than is allowed", extract, path, tmp_path / "out", most_bytes=1e12)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.GNUTYPE_LONGNAME])
def test_a_header_that_claims_gigabytes_is_refused(tmp_path: Path, kind: bytes) -> None:
    path = tmp_path / "a.tar.gz"
    with gzip.open(path, "wb") as file:
        file.write(_info("x", 8 << 30, kind).tobuf(tarfile.GNU_FORMAT))
        file.write(bytes(4 << 20))
    refused("claims 8589934592 bytes", members, path)


def test_a_header_with_a_length_that_no_machine_has_is_refused(tmp_path: Path) -> None:
    body = b"99999999999999999999 a=b\n".ljust(512, b"\0")
    data = _info("x", 25, tarfile.XHDTYPE).tobuf(tarfile.GNU_FORMAT) + body
    (tmp_path / "a.tar").write_bytes(data + _info("y", 0).tobuf(tarfile.GNU_FORMAT) + bytes(1024))
    refused("damaged or cannot be unpacked", members, tmp_path / "a.tar")


def test_a_zip_whose_sizes_lie_is_refused(tmp_path: Path) -> None:
    data = os.urandom(1000)
    path = _zip(tmp_path / "a.zip", {"x": data})
    raw = path.read_bytes()
    for claim in (999, 1001, 2**31):
        path.write_bytes(raw.replace(struct.pack("<I", 1000), struct.pack("<I", claim)))
        refused(r"a\.zip", extract, path, tmp_path / "out", most_bytes=1e6)


def test_a_table_of_contents_of_gigabytes_is_refused(tmp_path: Path) -> None:
    path = _zip(tmp_path / "a.zip", {"x": b"1"})
    raw = bytearray(path.read_bytes())
    at = raw.rfind(b"PK\x05\x06")
    raw[at + 12 : at + 16] = struct.pack("<I", 3_000_000_000)
    path.write_bytes(raw)
    refused("table of contents", members, path)


@pytest.mark.parametrize("data", [b"", b"PK", b"\x1f\x8b", b"hello" * 100, bytes(10_000)])
def test_what_is_no_archive_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.zip").write_bytes(data)
    refused(r"a\.zip", members, tmp_path / "a.zip")
