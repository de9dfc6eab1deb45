"""XML and .mat files of others, beside what ElementTree and scipy read."""

import struct
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import scipy.io

from realsim.untrusted.mat_files import read_mat
from realsim.untrusted.xml_tree import parsed_xml, read_xml
from refusals import refused

SCENE = (
    '<?xml version="1.0" encoding="utf-8"?><scene n="1"><!-- no --><obj><obj_id>0</obj_id>'
    '<pos>0.1 0.2 0.3</pos> tail</obj><u:x xmlns:u="urn:u" u:k="&lt;"/></scene>'
)


def test_xml_is_read_as_elementtree_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(SCENE)
    theirs = ElementTree.fromstring(SCENE)
    assert ElementTree.tostring(read_xml(path)) == ElementTree.tostring(theirs)


LAUGHS = '<!DOCTYPE a [<!ENTITY a0 "ha">' + "".join(
    f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(20)
)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (f"{LAUGHS}]><a>&a20;</a>".encode(), "doctype"),
        (b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "doctype"),
        (b'<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', "doctype"),
        (b"<a>&x;</a>", "not XML"),
        (b"<a>" * 1_000_000, "deeper"),
        (b"<a><b></a></b>", "not XML"),
        (b'<?xml version="1.0" encoding="zlib_codec"?><a/>', "not XML"),
        (b"<a>\xff</a>", "not XML"),
    ],
)
def test_xml_that_unfolds_or_is_none_is_refused(data: bytes, says: str) -> None:
    assert says in refused(r"there\.xml", parsed_xml, data, "there.xml")


def test_limits_of_xml_refuse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.xml"
    path.write_text(SCENE)
    refused("MB", read_xml, path, most_bytes=10)
    monkeypatch.setattr("realsim.untrusted.xml_tree.MOST_ELEMENTS", 2)
    refused("more than 2 elements", read_xml, path)


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
NUMBERS = ["intrinsic_matrix", "factor_depth", "cls_indexes", "poses", "single", "yes", "empty"]


@pytest.mark.parametrize("packed", [False, True])
def test_mat_files_are_read_as_scipy_reads_them(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, VARIABLES, do_compression=packed)
    theirs = scipy.io.loadmat(path)
    ours = read_mat(path, NUMBERS)
    assert sorted(ours) == sorted(NUMBERS)
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
