"""Archives of others are unpacked whole and inside the folder, or nothing of them is.

Arrays of others: what numpy or scipy wrote is read back, what a header claims is refused.
"""

import gzip
import io
import os
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import bounded_memory
from realsim.errors import InputError
from realsim.untrusted import archives
from realsim.untrusted.archives import Member, extract, members
from realsim.untrusted.arrays import read_npy, read_npz
from realsim.untrusted.mat_files import read_mat
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


# --- arrays --------------------------------------------------------------------------------------


NUMBERS = st.sampled_from(
    ["?", "i1", "u1", ">i2", "u2", "i4", ">u4", "i8", "u8", "f2", "f4", ">f8"]
)
ARRAYS = NUMBERS.flatmap(
    lambda kind: hnp.arrays(np.dtype(kind), hnp.array_shapes(min_dims=0, min_side=0, max_dims=4))
)


@given(array=ARRAYS, fortran=st.booleans())
@settings(max_examples=15, deadline=None)
def test_what_numpy_wrote_is_read_back_in_native_order(
    tmp_path_factory: pytest.TempPathFactory, array: np.ndarray[Any, Any], fortran: bool
) -> None:
    folder = tmp_path_factory.getbasetemp()
    given_array = np.asfortranarray(array) if fortran else array
    np.save(folder / "a.npy", given_array)
    np.savez_compressed(folder / "a.npz", x=given_array, y=np.arange(3))
    for read in (read_npy(folder / "a.npy"), read_npz(folder / "a.npz")["x"]):
        np.testing.assert_array_equal(read, given_array)
        assert read.shape == given_array.shape
        assert read.dtype == array.dtype.newbyteorder("=")
        assert read.dtype.isnative


def _header(text: str, version: tuple[int, int] = (1, 0)) -> bytes:
    width = 2 if version == (1, 0) else 4
    padded = text.encode("latin-1") + b"\n"
    return b"\x93NUMPY" + bytes(version) + len(padded).to_bytes(width, "little") + padded


def _array(shape: str, descr: str = "'<f8'") -> bytes:
    return _header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}")


CLAIMS = {
    "terabytes, plainly": _array("(1099511627776,)") + b"\0" * 64,
    "negative": _array("(-1, -8)") + b"\0" * 64,
    "beyond 64 bits": _array(f"({10**400},)"),
    "empty times terabytes": _array("(0, 4611686018427387904, 9)"),
    "objects": _array("(1,)", "'|O'") + b"\x80\x04N.",
    "fields": _array("(1,)", "[('a', '<f8')]") + b"\0" * 8,
    "nested": _header("(" * 3000),
    "a longer one": b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
    "the future": _header("{}", (9, 0)),
    "half": _array("(4,)") + b"\0" * 31,
    "a pickle": b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x94",
}


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
def test_claims_of_a_header_are_refused_before_anything_is_allocated(
    tmp_path: Path, claim: bytes
) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(claim)
    with bounded_memory.below(20e6):
        refused(r"a\.npy", read_npy, path)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", claim)
    refused(r"a\.npz", read_npz, tmp_path / "a.npz")


def test_only_the_named_arrays_are_unpacked_and_a_missing_one_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, good=np.arange(3), bad=np.array([{}], dtype=object))
    assert list(read_npz(path, ["good"])) == ["good"]
    refused("no array 'other'; it holds good, bad", read_npz, path, ["other"])
    refused("objects", read_npz, path)


def test_an_archive_that_unfolds_a_thousandfold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.zeros(3_000_000))
    assert path.stat().st_size < 100_000
    refused("unpacks to 24", read_npz, path, most_bytes=1e6)


def test_a_member_there_twice_or_of_a_size_that_lies_is_refused(tmp_path: Path) -> None:
    data = io.BytesIO()
    np.save(data, np.arange(1000))
    twice = tmp_path / "twice.npz"
    with zipfile.ZipFile(twice, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("x.npy", data.getvalue())
        archive.writestr("x.npy", data.getvalue())
    refused("twice", read_npz, twice)
    lies = tmp_path / "lies.npz"
    with zipfile.ZipFile(lies, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", data.getvalue())
        size = archive.getinfo("x.npy").file_size
    raw = lies.read_bytes()
    for claim in (size - 8, size + 8, 2**31):
        lies.write_bytes(raw.replace(size.to_bytes(4, "little"), claim.to_bytes(4, "little")))
        refused(r"lies\.npz", read_npz, lies)


# --- .mat files: what scipy wrote is read as it reads it ------------------------------------------


VARIABLES: dict[str, Any] = {
    "intrinsic_matrix": np.array([[900.0, 0, 640], [0, 901, 360], [0, 0, 1]]),
    "factor_depth": np.array([[1000.0]]),
    "cls_indexes": np.arange(1, 6, dtype=np.int32),
    "poses": np.random.default_rng(0).normal(size=(3, 4, 5)),
    "single": np.float32([[1.5, 2.5]]),
    "yes": np.array([True, False]),
    "name": "text",
    "record": {"a": 1},
    "cells": np.array([1, "a"], dtype=object),
    "waves": np.array([1 + 2j]),
    "empty": np.zeros((0, 3)),
}
PLAIN = ["intrinsic_matrix", "factor_depth", "cls_indexes", "poses", "single", "yes", "empty"]


@pytest.mark.parametrize("packed", [False, True])
def test_mat_files_are_read_as_scipy_reads_them(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, VARIABLES, do_compression=packed)
    theirs = scipy.io.loadmat(path)
    ours = read_mat(path, PLAIN)
    assert sorted(ours) == sorted(PLAIN)
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name])
        assert array.dtype.isnative
        assert array.shape == theirs[name].shape
    for other in ("name", "record", "cells", "waves"):
        refused(f"'{other}' is", read_mat, path, [other])
    refused(r"no variable 'x'.*'poses'", read_mat, path, ["x"])


def test_numbers_that_matlab_stored_in_a_smaller_type_have_their_own_again(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"K": np.array([[1.0, 2.0]])})
    raw = path.read_bytes()
    body = struct.pack("<II", 9, 16) + np.array([1.0, 2.0]).tobytes()
    small = struct.pack("<HHBBxx", 2, 2, 1, 2)
    assert body in raw
    length = struct.unpack_from("<I", raw, 132)[0]
    heads = (struct.pack("<II", 14, n) for n in (length, length - len(body) + len(small)))
    path.write_bytes(raw.replace(body, small).replace(*heads))
    found = read_mat(path, ["K"])["K"]
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, [[1.0, 2.0]])


def test_every_cut_of_a_mat_file_is_refused_or_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"a": np.arange(12.0), "b": np.arange(3)}, do_compression=True)
    raw = path.read_bytes()
    for end in range(len(raw)):
        path.write_bytes(raw[:end])
        refused(r"a\.mat", read_mat, path, ["a", "b"])


def test_mat_files_that_unfold_or_lie_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"a": np.zeros(1_000_000)}, do_compression=True)
    refused("unpacks to more", read_mat, path, ["a"], most_bytes=1e6)
    head = path.read_bytes()[:128]
    flags = struct.pack("<IIII", 6, 8, 6, 0)
    shape = struct.pack("<IIii", 5, 8, 2**31 - 1, 2**31 - 1)
    name = struct.pack("<HHI", 1, 1, ord("a"))
    body = flags + shape + name + struct.pack("<II", 9, 2**32 - 8)
    packed = zlib.compress(struct.pack("<II", 14, len(body)) + body)
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    refused("could not read bytes", read_mat, path, ["a"])
    path.write_bytes(b"\x89HDF" + bytes(200))
    refused(r"7\.3", read_mat, path, ["a"])
    scipy.io.savemat(path, {"a": np.arange(3)}, format="4")
    refused("version 5", read_mat, path, ["a"])
