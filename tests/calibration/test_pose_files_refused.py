import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pose_rows import folder
from realsim.errors import InputError
from realsim_calibration.inputs import read_pose_file
from refusals import refused

# --- what is refused ---------------------------------------------------------------------------


ROW = "0.5 -0.1 0.4 1.1 2.8 -0.1\n"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.txt", "", "is empty"),
        ("a.txt", ROW + "0.5 -0.1 0.4 1.1 2.8\n" + ROW, "line 2: 5 fields.*line 1 has 6"),
        ("a.txt", "0.5 -0.1 0.4 1.1 2.8 -0.1 9\n" * 3, "no pose format fits its 7 numbers"),
        ("a.txt", "nan nan nan nan nan nan\n" * 3, "all 3 poses hold NaN"),
        ("a.csv", "0.5,-0.1,,1.1,2.8,-0.1\n", "line 1: field 3 is empty"),
        ("a.csv", "x,y,z,foo,bar\n1,2,3,4,5\n", "complete rotation is missing"),
        ("a.csv", "x_mm,y_m,z_mm,rx,ry,rz\n1,2,3,4,5,6\n", "state the units"),
        ("a.json", "[[1, 2, 3", "line 1 column"),
        ("a.json", '{"a.png": [1,2,3,4,5,6],\n "a.png": [1,2,3,4,5,6]}', "'a.png' is there twice"),
        ("a.json", '{"a":[[1,2,3,4,5,6]],"b":[[1,2,3,4,5,6]]}', r"2 lists of poses \(a, b\)"),
        ("a.json", '{"poses":[[1,2,3,4,5,6]],"images":["a","b"]}', "'images' holds 2 entries"),
        ("a.yaml", "poses: [1, 2\n  b: }", "not valid YAML.*line 2"),
        ("a.yaml", "a: !!python/object/apply:os.system ['true']\n", "has the tag"),
        ("a.xml", "<a/>", "not .xml"),
    ],
)
def test_malformed_files_are_refused_by_place(tmp_path, name, content, says):
    (tmp_path / name).write_text(content)
    refused(says, read_pose_file, tmp_path / name)


def test_bombs_and_pickles_are_refused(tmp_path):
    lines = ["a0: &a0 [1, 2, 3, 4, 5, 6]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    (tmp_path / "loop.yaml").write_text("a: &a [*a]")
    for name in ("bomb.yaml", "loop.yaml"):
        refused(r"unfolds|inside of what", read_pose_file, tmp_path / name)
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    for name in ("a.npy", "a.npz"):
        refused(r"pickled|Python objects", read_pose_file, tmp_path / name)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**11, 6)}
    )
    (tmp_path / "huge.npy").write_bytes(header.getvalue())
    refused("not a readable npy", read_pose_file, tmp_path / "huge.npy")


@settings(max_examples=40, deadline=None)
@given(
    data=st.binary(max_size=200)
    | st.text(max_size=200).map(lambda s: s.encode("utf-8", "replace")),
    ending=st.sampled_from(["txt", "csv", "json", "yaml", "npy", "npz"]),
)
def test_no_content_whatever_ends_in_a_traceback(data, ending):
    with folder() as place:
        path = place / f"a.{ending}"
        path.write_bytes(data)
        try:
            read_pose_file(path)
        except InputError as error:
            assert str(path) in str(error)
