"""One wrong thing in a sample: bytes of any file, or a value of one whose structure is known.

A sample is a mapping from file name to bytes; None stands for a folder in the place of the file.
The same seed makes the same change.
"""

import io
import json
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np

Files = dict[str, bytes | None]
Change = Callable[[bytes, np.random.Generator], bytes]
ESCAPES = ("../../x", "/etc/passwd", "..", "/", "C:\\x", "a\0b", "x" * 5000, "~/x", "", "\udcff")
NUMBERS = (
    float("nan"), float("inf"), float("-inf"), 1e300, -1e300, 1e-320, -1, 0, 2**31, 2**63, 2**64,
    10**400, -(2**31), 1e9, 0.5,
)  # fmt: skip
OTHER_VALUES: tuple[Any, ...] = (
    None, True, "text", "", [], {}, [[]], [1, 2], {"a": 1}, "1.0", [None], ["x", 1], 3, -1, 1.5,
)  # fmt: skip
WORDS = (
    b"nan", b"inf", b"-inf", b"1e300", b"1e999", b"-1", b"0", b"99999999999", b"2147483648",
    b"18446744073709551616", b"", b"../../x", b"/etc/passwd", b"x", b"\xff\xfe", b"9" * 5000,
    b"0.5", b"-0.0", b"1000", b"\x00",
)  # fmt: skip
MOST_NODES = 3000
MAT_REMARK = 116
"""Bytes of the remark at the beginning of a .mat file."""


def mutated(files: Files, seed: int) -> tuple[Files, str]:
    """Return the sample with one change, and what it was."""
    rng = np.random.default_rng(seed)
    names = sorted(name for name, data in files.items() if data is not None)
    name = names[int(rng.integers(len(names)))]
    data = files[name]
    assert data is not None
    changed = dict(files)
    kinds = _structured(name, data)
    if kinds and rng.random() < 0.6:
        kind = list(kinds)[int(rng.integers(len(kinds)))]
        try:
            changed[name] = kinds[kind](data, rng)
            return changed, f"{name}: {kind}"
        except Exception as error:  # a value that the format itself cannot hold
            kind = f"{kind} ({type(error).__name__}), so "
    else:
        kind = ""
    k = int(rng.integers(10))
    if k < 8:
        raw = list(RAW)[int(rng.integers(len(RAW)))]
        changed[name] = RAW[raw](data, rng)
        return changed, f"{name}: {kind}{raw}"
    if k == 8:
        changed[name] = None
        return changed, f"{name}: {kind}a folder in its place"
    if rng.random() < 0.5 or len(names) < 2:
        del changed[name]
        return changed, f"{name}: {kind}removed"
    other = names[int(rng.integers(len(names)))]
    changed[name] = files[other]
    return changed, f"{name}: {kind}swapped with {other}"


# --- bytes ----------------------------------------------------------------------------------------


def _flipped(count: Callable[[int], int]) -> Change:
    def change(data: bytes, rng: np.random.Generator) -> bytes:
        array = np.frombuffer(data, np.uint8).copy()
        if len(array):
            at = rng.integers(0, len(array), count(len(array)))
            array[at] ^= rng.integers(1, 256, len(at), dtype=np.uint8)
        return array.tobytes()

    return change


def _flipped_head(data: bytes, rng: np.random.Generator) -> bytes:
    """Headers are where sizes stand."""
    return _flipped(lambda _: 2)(data[:128], rng) + data[128:]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(0, max(len(data), 1)))]


def _cut_start(data: bytes, rng: np.random.Generator) -> bytes:
    return data[int(rng.integers(0, max(len(data), 1))) :]


def _hole(data: bytes, rng: np.random.Generator) -> bytes:
    start = int(rng.integers(0, max(len(data), 1)))
    length = int(rng.integers(1, 65))
    fill = bytes([0, 255][int(rng.integers(2)) :][:1])
    return data[:start] + fill * len(data[start : start + length]) + data[start + length :]


def _size_field(data: bytes, rng: np.random.Generator) -> bytes:
    """Write an enormous or negative number over four or eight bytes."""
    value = (0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 0, 0x10000000)[int(rng.integers(5))]
    width = (4, 8)[int(rng.integers(2))]
    order = ("little", "big")[int(rng.integers(2))]
    at = int(rng.integers(0, max(len(data) - width, 1)))
    field = (value if width == 4 else value << 12).to_bytes(8, "little")[:width]
    return data[:at] + (field if order == "little" else field[::-1]) + data[at + width :]


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a word of a text."""
    words = data.replace(b",", b" ").split()
    if not words:
        return b"\x00"
    word = words[int(rng.integers(len(words)))]
    start = data.find(word, int(rng.integers(len(data))))
    start = start if start >= 0 else data.find(word)
    return data[:start] + WORDS[int(rng.integers(len(WORDS)))] + data[start + len(word) :]


def _times_1000(data: bytes, rng: np.random.Generator) -> bytes:
    """Add three zeros, or an exponent, to a number of a text."""
    digits = [k for k in range(len(data)) if data[k : k + 1].isdigit()]
    if not digits:
        return data + data
    at = digits[int(rng.integers(len(digits)))]
    tail = (b"000", b"e3", b"e300", b"e999", b".")[int(rng.integers(5))]
    return data[: at + 1] + tail + data[at + 1 :]


RAW: dict[str, Change] = {
    "one byte": _flipped(lambda _: 1),
    "ten bytes": _flipped(lambda _: 10),
    "a hundredth of the bytes": _flipped(lambda n: max(1, n // 100)),
    "two bytes of its head": _flipped_head,
    "cut off": _cut,
    "without its beginning": _cut_start,
    "empty": lambda data, rng: b"",
    "twice": lambda data, rng: data + data,
    "a hole": _hole,
    "a size field": _size_field,
    "a word": _word,
    "a number of the text": _times_1000,
    "noise": lambda data, rng: rng.bytes(len(data)),
    "another format: json": lambda data, rng: b'{"a": [1, 2]}',
    "another format: png": lambda data, rng: b"\x89PNG\r\n\x1a\n" + bytes(40),
    "another format: zip": lambda data, rng: b"PK\x05\x06" + bytes(18),
}  # fmt: skip


# --- values ---------------------------------------------------------------------------------------


def _structured(name: str, data: bytes) -> dict[str, Change]:
    """Return the changes that know the file's structure."""
    end = name.rsplit(".", 1)[-1].lower()
    makers: dict[str, dict[str, Change]] = {
        "json": {"a value of JSON": _json, "two values of JSON": _twice(_json)},
        "yaml": {"a value of YAML": _yaml},
        "xml": {"an element of XML": _xml},
        "npy": {"numbers of npy": _npy},
        "npz": {"an array of npz": _npz},
        "mat": {"a variable of mat": _mat},
        "h5": {"a dataset of HDF5": _hdf5},
        "hdf5": {"a dataset of HDF5": _hdf5},
        "parquet": {"a column of Parquet": _parquet},
        "png": {"the head of PNG": _png_head},
        "jsonl": {"a line of JSON": _json_line},
    }
    return makers.get(end, {})


def _twice(change: Change) -> Change:
    return lambda data, rng: change(change(data, rng), rng)


def changed_value(value: Any, rng: np.random.Generator) -> Any:
    """Return JSON-like values with one of them changed."""
    places: list[tuple[Any, Any]] = []
    stack = [value]
    while stack and len(places) < MOST_NODES:
        node = stack.pop()
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, inner in items:
            places.append((node, key))
            if isinstance(inner, (dict, list)):
                stack.append(inner)
    if not places:
        return OTHER_VALUES[int(rng.integers(len(OTHER_VALUES)))]
    container, key = places[int(rng.integers(len(places)))]
    old = container[key]
    op = int(rng.integers(8))
    if op == 0:
        del container[key]
    elif op == 1:
        container[key] = OTHER_VALUES[int(rng.integers(len(OTHER_VALUES)))]
    elif op == 2 and isinstance(container, dict):
        container["renamed"] = container.pop(key)
    elif op == 3 and isinstance(old, list):
        container[key] = old + old if rng.random() < 0.5 else old[:-1]
    elif isinstance(old, str):
        container[key] = ESCAPES[int(rng.integers(len(ESCAPES)))]
    elif isinstance(old, (int, float)) and not isinstance(old, bool):
        factors = (1000, 1e300, -1, 0.001, 1e-300)
        container[key] = (
            NUMBERS[int(rng.integers(len(NUMBERS)))]
            if op < 6
            else old * factors[int(rng.integers(5))]
        )
    else:
        container[key] = OTHER_VALUES[int(rng.integers(len(OTHER_VALUES)))]
    return value


def _json(data: bytes, rng: np.random.Generator) -> bytes:
    return json.dumps(changed_value(json.loads(data), rng)).encode()


def _json_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.splitlines()
    at = int(rng.integers(len(lines)))
    lines[at] = _json(lines[at], rng)
    return b"\n".join(lines) + b"\n"


def _yaml(data: bytes, rng: np.random.Generator) -> bytes:
    from ruamel.yaml import YAML

    out = io.BytesIO()
    writer = YAML(typ="safe", pure=True)
    writer.dump(changed_value(writer.load(data.decode()), rng), out)
    return out.getvalue()


def _xml(data: bytes, rng: np.random.Generator) -> bytes:
    root = ElementTree.fromstring(data)
    elements = list(root.iter())
    chosen = elements[int(rng.integers(len(elements)))]
    op = int(rng.integers(6))
    word = WORDS[int(rng.integers(len(WORDS)))].decode("latin-1")
    if op == 0 and len(chosen):
        chosen.remove(chosen[int(rng.integers(len(chosen)))])
    elif op == 1 and len(chosen):
        chosen.append(chosen[0])
    elif op == 2:
        chosen.tag = "renamed"
    elif op == 3:
        return data.replace(b"?>", b'?><!DOCTYPE a [<!ENTITY b "c">]>', 1)
    else:
        words = (chosen.text or "").split() or [""]
        words[int(rng.integers(len(words)))] = word
        chosen.text = " ".join(words)
    return ElementTree.tostring(root)


def changed_array(array: Any, rng: np.random.Generator) -> Any:
    """Return an array with a wrong number, shape or type."""
    array = np.array(array)
    op = int(rng.integers(10))
    if op < 5 and array.size and array.dtype.kind in "fiu":
        return _wrong_numbers(array, op, rng)
    if op == 5:
        return array[:-1] if array.ndim else array.reshape(1)
    if op == 6:
        return array.reshape(-1) if array.ndim != 1 else array[:, None]
    if op == 7:
        kinds = (np.float16, np.int8, np.uint64, np.complex128, bool, "S4", ">f8", np.float32)
        with np.errstate(all="ignore"):
            return array.astype(kinds[int(rng.integers(len(kinds)))])
    if op == 8:
        return np.zeros((0, *array.shape[1:]), array.dtype)
    return np.concatenate([array, array]) if array.ndim else np.array("text")


def _wrong_numbers(array: Any, op: int, rng: np.random.Generator) -> Any:
    """Return an array with one wrong number, or all of them scaled."""
    if op < 2:
        array = array.astype(np.float64)
    with np.errstate(all="ignore"):
        if op in (0, 2):
            wrong = np.array([NUMBERS[int(rng.integers(11))]], np.float64)
            array.reshape(-1)[int(rng.integers(array.size))] = wrong.astype(array.dtype)[0]
            return array
        factor = (1000.0, 1e300, -1.0, 0.001)[int(rng.integers(4))]
        return (array * factor).astype(array.dtype)


def _npy(data: bytes, rng: np.random.Generator) -> bytes:
    array = changed_array(np.load(io.BytesIO(data)), rng)
    if rng.random() < 0.1:
        array = array.astype(object)
    out = io.BytesIO()
    np.save(out, array, allow_pickle=True)
    return out.getvalue()


def _npz(data: bytes, rng: np.random.Generator) -> bytes:
    arrays = dict(np.load(io.BytesIO(data)))
    _changed_member(arrays, rng, lambda a: changed_array(a, rng))
    if rng.random() < 0.1:
        arrays["extra"] = np.array([{}], dtype=object)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _changed_member(
    members: dict[str, Any], rng: np.random.Generator, change: Callable[[Any], Any]
) -> None:
    name = sorted(members)[int(rng.integers(len(members)))]
    if rng.random() < 0.15:
        del members[name]
    elif rng.random() < 0.1:
        members["renamed"] = members.pop(name)
    else:
        members[name] = change(members[name])


def _mat(data: bytes, rng: np.random.Generator) -> bytes:
    import scipy.io

    loaded: dict[str, Any] = scipy.io.loadmat(io.BytesIO(data))
    variables = {k: v for k, v in loaded.items() if not k.startswith("__")}
    _changed_member(variables, rng, lambda a: changed_array(a, rng))
    if rng.random() < 0.1:
        variables["extra"] = {"a": [1, "b"]}
    out = io.BytesIO()
    scipy.io.savemat(out, variables, do_compression=bool(rng.integers(2)))
    return data[:MAT_REMARK] + out.getvalue()[MAT_REMARK:]  # the remark says when it was written


def _hdf5(data: bytes, rng: np.random.Generator) -> bytes:
    import h5py

    out = io.BytesIO(data)
    with h5py.File(out, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = sorted(names)[int(rng.integers(len(names)))]
        place: Any = file[name]
        op = int(rng.integers(8))
        if op == 0:
            del file[name]
        elif op == 1 and len(place.attrs):
            key = sorted(place.attrs)[int(rng.integers(len(place.attrs)))]
            place.attrs[key] = (1e300, "text", -1, np.zeros(3))[int(rng.integers(4))]
        elif op == 2:
            del file[name]
            file[name] = (h5py.SoftLink("/x"), h5py.ExternalLink("/etc/passwd", "/x"))[
                int(rng.integers(2))
            ]
        elif isinstance(place, h5py.Dataset):
            old = place[()]
            del file[name]
            if place_is_text(old):
                text = ESCAPES[int(rng.integers(len(ESCAPES)))]
                file[name] = _json(old, rng).decode() if old[:1] == b"{" else text
            else:
                file[name] = changed_array(old, rng)
        else:
            del file[name]
            file[name] = np.zeros(3)
    return out.getvalue()


def place_is_text(value: Any) -> bool:
    """Return whether what h5py read is one text."""
    return isinstance(value, (bytes, str))


def _parquet(data: bytes, rng: np.random.Generator) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    at = int(rng.integers(table.num_columns))
    name, column = table.column_names[at], table.column(at)
    op = int(rng.integers(7))
    if op == 0:
        table = table.drop_columns([name])
    elif op == 1:
        texts = pa.array(["../../x"] * table.num_rows)
        table = table.set_column(at, pa.field(name, pa.string()), texts)
    elif op == 2:
        table = pa.concat_tables([table, table])
    elif op == 3:
        nulls = pa.nulls(table.num_rows, column.type)
        table = table.set_column(at, table.field(at), nulls)
    elif op == 4:
        head = {k: v for k, v in (table.schema.metadata or {}).items()}
        for key, value in head.items():
            if value[:1] == b"{":
                head[key] = _json(value, rng)
        table = table.replace_schema_metadata(head)
    elif table.num_rows and pa.types.is_floating(column.type):
        array = changed_array(column.to_numpy(), rng)[: table.num_rows]
        table = table.set_column(at, name, pa.array(np.asarray(array).ravel()))
    else:
        table = table.slice(0, table.num_rows // 2)
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def _png_head(data: bytes, rng: np.random.Generator) -> bytes:
    """Change what the header claims, with the right checksum."""
    import struct
    import zlib

    head = list(struct.unpack(">IIBBBBB", data[16:29]))
    at = int(rng.integers(4))
    head[at] = (
        (1, 60_000, 2**31 - 1, 0, 9_000)[int(rng.integers(5))]
        if at < 2
        else (0, 1, 2, 3, 4, 6, 8, 16, 255)[int(rng.integers(9))]
    )
    chunk = b"IHDR" + struct.pack(">IIBBBBB", *head)
    return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
