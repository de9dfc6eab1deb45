"""Arrays of others: what numpy or scipy wrote is read back, what a header claims is refused."""

import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import bounded_memory
from realsim.untrusted.arrays import read_npy, read_npz
from realsim.untrusted.mat_files import read_mat
from refusals import refused

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
